"""The current values of all slots, lenses and warps as plain arrays, for the compiled kernels."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

import gtsam
import numpy as np

from adjust.frames.lens_states import LensStates, lenders
from adjust.frames.tables import table_motions
from adjust.frames.unknowns import ShiftedSlot, TableSlot, Unknowns, VectorMap, vector_map
from adjust.lenses.models import MODELS, camera_constants
from adjust.model.boards import BOARD, checked_warp, extent
from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, IntArray, Survey, VectorParameter
from adjust.native.images import MAX_MAP, LensArrays, WarpArrays
from adjust.native.lenses import MAX_LENS

Shift = Callable[["State", gtsam.Values, Sequence[ShiftedSlot] | None], None]


class State:
    """Arrays that the kernels read. :meth:`load` fills them from GTSAM values; nothing else changes them.

    What batches compute from them is of the last evaluation, whose number is ``evaluation``: a new load is a new one.
    GTSAM is served with it only inside :meth:`serving`, by which a caller says that it asks at the values of that
    evaluation; asked at any other time, a factor evaluates itself.

    slot_R (S, 3, 3), slot_t (S, 3): poses of all slots. D (derived slots, 6, k): derivative of the motion of a table,
    or at the time of a clock, by what it follows from, as the slot's ``parts`` say. lenses, warps: see LensArrays and
    WarpArrays.
    points (P, 3) m: the free ones in the order of their keys, ``point_rows`` says where.
    """

    def __init__(self, survey: Survey, unknowns: Unknowns, shift: Shift = lambda state, values, slots: None) -> None:
        """shift: fills slot_R, slot_t and D of these slots at the times of clocks, or of all, where there are any."""
        self.unknowns, self.shift = unknowns, shift
        self.targets = {t.target_id: i for i, t in enumerate(survey.targets)}
        self.lens_states = LensStates(survey, unknowns)
        self.warp_maps: list[VectorMap | None] = [unknowns.vectors.get(("warp", t.target_id)) for t in survey.targets]
        self.lenses = self._lens_arrays(survey)
        n = len(unknowns.slot_key)
        self.slot_R, self.slot_t = np.zeros((n, 3, 3)), np.zeros((n, 3))
        for slot, key in enumerate(unknowns.slot_key):
            if key is None:  # the others are loaded
                self._set(slot, unknowns.slot_pose[slot])
        derived: dict[int, TableSlot | ShiftedSlot] = {**unknowns.table_slots, **unknowns.shifted_slots}
        self.derived_index: IntArray = np.full(n, -1, dtype=np.int64)
        self.derived_index[list(derived)] = np.arange(len(derived))
        most = max((start + k for s in derived.values() for _, start, k in s.parts), default=6)
        self.D = np.zeros((max(1, len(derived)), 6, most))
        self.warps = self._warp_arrays(survey)
        self._free_slots = [
            (slot, key)
            for slot, key in enumerate(unknowns.slot_key)
            if key is not None and unknowns.derived(slot) is None
        ]
        self._pose_keys = {key for _, key in self._free_slots}
        self.evaluation = 0
        self.served = False
        keys = sorted(u.key for name, u in unknowns.by_name.items() if name[0] == "point")
        self.point_rows = {key: row for row, key in enumerate(keys)}
        self.points = np.zeros((len(keys), 3))
        self._slots_by_key = np.array([s for s, _ in sorted(self._free_slots, key=lambda x: x[1])], dtype=np.int64)

    def _lens_arrays(self, survey: Survey) -> LensArrays:
        states = self.lens_states
        n = len(states.states)
        cameras = [survey.cameras[s.camera] for s in states.states]
        patterns = [states.pattern(i) for i in range(n)]
        integers = (np.zeros((n, MAX_MAP), dtype=np.int64), np.zeros((n, MAX_MAP), dtype=np.int64))
        arrays = LensArrays(
            np.array([MODELS[c.lens.model].kind for c in cameras], dtype=np.int64),
            np.zeros((n, MAX_LENS)),
            np.zeros((n, 4)),
            np.array([p.shape[1] for p in patterns], dtype=np.int64),
            np.zeros(n, dtype=np.int64),
            *integers,
            np.zeros((n, MAX_MAP)),
        )
        for i, camera in enumerate(cameras):
            arrays.constants[i] = camera_constants(camera)
            sources, columns = np.nonzero(patterns[i])
            k = arrays.n_map[i] = len(sources)
            arrays.source[i, :k], arrays.column[i, :k] = sources, columns
            if states.states[i].crop is None:  # else they depend on the values
                arrays.factor[i, :k] = states.maps[states.states[i].camera].matrix[sources, columns]
        return arrays

    def _warp_arrays(self, survey: Survey) -> WarpArrays:
        n, order = max(1, len(survey.targets)), tuple(BOARD)
        arrays = WarpArrays(np.zeros((n, len(order))), np.ones((n, 4)), np.zeros((n, len(order)), dtype=np.int64))
        for i, (target, found) in enumerate(zip(survey.targets, self.warp_maps, strict=True)):
            if found is not None:
                arrays.extent[i] = extent(target.x_in_target)
                arrays.of_free[i, : len(found.free)] = [order.index(name) for name in found.free]
        return arrays

    def _set(self, slot: int, pose: gtsam.Pose3) -> None:
        matrix = pose.matrix()
        self.slot_R[slot], self.slot_t[slot] = matrix[:3, :3], matrix[:3, 3]

    @contextmanager
    def serving(self) -> Iterator[None]:
        """Factors serve what was evaluated last, for GTSAM will ask at these values only."""
        self.served = True
        try:
            yield
        finally:
            self.served = False

    def outdate(self) -> None:
        """What was evaluated last is overwritten, or no longer right."""
        if not self.served:
            self.evaluation += 1

    def load(self, values: gtsam.Values, slots: Iterable[int] | None = None, lenses: bool = True) -> None:
        """Read everything, or only these slots (and the lenses and warps unless told otherwise), from ``values``."""
        self.outdate()
        if slots is None:
            self._load_poses(values)
            self._load_points(values)
            self._move_tables(values, self.unknowns.table_slots.values())
            self.shift(self, values, None)
        else:
            shifted = [s for slot in slots if (s := self.unknowns.shifted_slots.get(slot)) is not None]
            asked = list(dict.fromkeys([*slots, *(n for s in shifted for n in s.nodes)]))
            tables = self.unknowns.table_slots
            self._move_tables(values, [tables[slot] for slot in asked if slot in tables])
            for slot in asked:
                found = self.unknowns.slot_key[slot]
                if found is not None and self.unknowns.derived(slot) is None:
                    self._set(slot, values.atPose3(found))
            self.shift(self, values, shifted)
        if lenses:
            self._load_lenses(values)

    def _load_poses(self, values: gtsam.Values) -> None:
        """All free poses: in one call where ``values`` hold no others, which it gives in the order of their keys."""
        rows = gtsam.utilities.extractPose3(values)  # (n, 12): rotation by rows, translation
        if len(rows) == len(self._free_slots) and self._pose_keys.issubset(values.keys()):
            self.slot_R[self._slots_by_key] = rows[:, :9].reshape(-1, 3, 3)
            self.slot_t[self._slots_by_key] = rows[:, 9:]
            return
        for slot, key in self._free_slots:
            self._set(slot, values.atPose3(key))

    def _load_points(self, values: gtsam.Values) -> None:
        """All free points, likewise."""
        if len(self.points):
            x = gtsam.utilities.extractPoint3(values)
            self.points[:] = x if len(x) == len(self.points) else [values.atPoint3(key) for key in self.point_rows]

    def _load_lenses(self, values: gtsam.Values) -> None:
        for i, state in enumerate(self.lens_states.states):
            full = self.lens_states.full(i, values)
            self.lenses.values[i, : full.size] = full
            if state.crop is not None:
                k, lenses = self.lenses.n_map[i], self.lenses
                lenses.factor[i, :k] = self.lens_states.by_free(i, values)[lenses.source[i, :k], lenses.column[i, :k]]
        for i, warp_map in enumerate(self.warp_maps):
            if warp_map is not None:
                self.warps.values[i, [list(BOARD).index(name) for name in warp_map.names]] = warp_map.full(values)

    def by_keys(self, slot: int, by_slot: FloatArray) -> list[tuple[int, FloatArray]]:
        """From a derivative (n, 6) by a slot's pose to those by the unknowns behind it (none where it is held)."""
        derived = self.unknowns.derived(slot)
        if derived is None:
            return [(key, by_slot) for key in self.unknowns.link_keys(slot)]
        D = self.D[self.derived_index[slot]]
        return [(key, by_slot @ D[:, start : start + n]) for key, start, n in derived.parts]

    def _move_tables(self, values: gtsam.Values, slots: Iterable[TableSlot]) -> None:
        by_table: dict[str, list[TableSlot]] = {}
        for slot in slots:
            by_table.setdefault(slot.table_id, []).append(slot)
        for tables in by_table.values():
            self._move_table(values, tables)

    def _move_table(self, values: gtsam.Values, slots: list[TableSlot]) -> None:
        """Poses of one table's slots, and their derivatives into D."""
        at = [s.slot for s in slots]
        angles = np.array([values.atVector(s.angles_key) for s in slots])
        self.slot_R[at], self.slot_t[at], derivative = self.of_table(values, slots[0], angles)
        self.D[self.derived_index[at], :, : derivative.shape[2]] = derivative

    @staticmethod
    def of_table(
        values: gtsam.Values, slot: TableSlot, angles: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Motions of the table of a slot at angles (n, k): R, t, and derivatives by these and the free geometry."""
        k, geometry = angles.shape[1], slot.geometry
        given = dict(zip(geometry.names, geometry.full(values).tolist(), strict=True))
        R, t, derivative = table_motions(slot.axes, given, angles)
        return R, t, np.concatenate([derivative[:, :, :k], derivative[:, :, k:] @ geometry.matrix], axis=2)


def collect_vectors(survey: Survey, unknowns: Unknowns, lenses: dict[str, FloatArray]) -> None:
    """Register the lenses and board warps. ``lenses`` gives the full start vector of every camera.

    Raises SurveyError where a target's warp or a lens has components that there are not, or a lens cannot be shared.
    """
    lent = lenders(survey)
    for camera in sorted(survey.cameras, key=lambda c: c.camera_id in lent):
        model = MODELS[camera.lens.model]
        unknown_names = set(camera.lens.free) - set(model.names)
        if unknown_names:
            raise SurveyError(
                f"camera {camera.camera_id!r}: lens model {model.name!r} has no parameter {sorted(unknown_names)}; "
                f"it has {', '.join(model.names)}"
            )
        parameter = VectorParameter(
            model.names, lenses[camera.camera_id], camera.lens.free, camera.lens.prior, camera.lens.ties
        )
        name, borrowed = ("lens", camera.camera_id), dict[str, tuple[int, int]]()
        if camera.camera_id in lent:
            lender = unknowns.vectors["lens", lent[camera.camera_id][0]]
            borrowed = {x: lender.sources[lender.free.index(x)] for x in lent[camera.camera_id][1]}
        unknowns.vectors[name] = vector_map(parameter, model.units, unknowns, name, borrowed)
    for target in survey.targets:
        if (warp := checked_warp(target)) is not None:
            name = ("warp", target.target_id)
            unknowns.vectors[name] = vector_map(warp, tuple(BOARD[x] for x in warp.names), unknowns, name)
