"""Where things are between the epochs: bodies and tables at the time of a clock, from the epochs around.

With Lagrange's weights w over the times of the epoch e and the ``_AROUND`` epochs nearest to it, a body is at

    T(dt) = T_e Exp(sum_k w_k(dt) Log(T_e^-1 T_k)),    d T / d T_k = w_k Jr(xi) Jr^-1(L_k)

a time dt after e, and a table at angles ``sum_k w_k(dt) a_k``. All of these are unknowns of the one graph, so what a
late camera sees tells of several epochs at once. Epochs far apart are another run (:mod:`adjust.frames.runs`).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from adjust.frames.runs import MOVING, runs
from adjust.frames.state import State
from adjust.frames.unknowns import Chain, Link, ShiftedSlot, Unknowns, VectorMap, vector_map
from adjust.model.clocks import CLOCK, EpochTimes, clocks_of, epoch_times
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock, Pair, TableReading
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.spatial.rigid import rigid
from adjust.spatial.rigid_motions import Motions, exp, right_jacobian, right_jacobian_inverse

Reading = Callable[[gtsam.Values], tuple[FloatArray, list[tuple[int, FloatArray]]]]

_AROUND = 4


def collect_clocks(survey: Survey, unknowns: Unknowns) -> EpochTimes | None:
    """Register all clocks; the times of the epochs, None where there is no clock."""
    found = list(clocks_of(survey))
    if not found:
        return None
    times = epoch_times(survey)
    for name, clock in found:
        units = tuple(CLOCK[x] if CLOCK[x] == "1" else times.unit for x in clock.parameters.names)
        unknowns.vectors[name] = vector_map(clock.parameters, units, unknowns, name)
    return times


class Shifts:
    """Chains at the times of clocks. Made when the slots of all epochs are known."""

    def __init__(self, survey: Survey, unknowns: Unknowns, times: EpochTimes) -> None:
        self.unknowns, self.times = unknowns, times
        self.middle_row = {c.camera_id: 0.5 * (c.image_size[1] - 1) for c in survey.cameras}
        self._around = dict(self._neighbours())
        self._made: dict[tuple[int, ParameterName, float], int] = {}
        self._jitter = {name: clock.jitter for name, clock in clocks_of(survey) if clock.jitter > 0.0}
        self.jitters: dict[ParameterName, float] = {}
        """Sigmas of the single epochs' own times."""

    def _neighbours(self) -> Iterable[tuple[int, list[int]]]:
        """Of every slot of an epoch itself, and the slots of the same body at the epochs around."""
        series: dict[ParameterName, list[tuple[float, int]]] = {}
        self._epoch: dict[int, tuple[ParameterName, float]] = {}
        self._epoch_ids: dict[int, str] = {}
        for name, slot in self.unknowns.slot_of.items():
            if name[0] in MOVING and len(name) == 3 and name[2] in self.times.of:
                body, time = name[:2], self.times.of[name[2]]
                series.setdefault(body, []).append((time, slot))
                self._epoch[slot], self._epoch_ids[slot] = (body, time), name[2]
        for found in series.values():
            found.sort()
            slots = [slot for _, slot in found]
            for run in runs([t for t, _ in found], self._epoch[slots[0]][0]):
                for i in run:
                    yield slots[i], [slots[i], *(slots[j] for j in _near(run, i) if j != i)]

    def of_image(self, block: ImageBlock, chain: Chain) -> list[tuple[ImageBlock, Chain]]:
        """Parts of an image block that were exposed at one moment each, in its order, and their chains."""
        name = ("camera_clock", block.camera_id)
        whole = self.shifted(chain, name)
        vector = self.unknowns.vectors.get(name)
        if whole == chain or vector is None or "line_time" not in vector.names:
            return [(block, whole)]
        if block.target_id is None:
            raise SurveyError(f"camera {block.camera_id!r}: its rows are read one after the other, which is modelled "
                              "for points of targets alone; take line_time out of its clock")  # fmt: skip
        rows = np.split(np.arange(len(block.uv)), np.flatnonzero(np.diff(block.uv[:, 1])) + 1)
        late = [float(block.uv[r[0], 1]) - self.middle_row[block.camera_id] for r in rows if len(r)]
        return [(block.part(r), self.shifted(chain, name, t)) for r, t in zip(rows, late, strict=True)]

    def shifted(self, chain: Chain, clock: ParameterName, row: float = 0.0) -> Chain:
        """A chain at the time of a clock; itself where there is no such clock."""
        vector = self.unknowns.vectors.get(clock)
        if vector is None:
            return chain
        return tuple(Link(self._slot(x.slot, clock, vector, row), x.inverse) if x.slot in self._around else x
                     for x in chain)  # fmt: skip

    def of_pair(self, pair: Pair, chain: Chain) -> Chain:
        """The chain of a pair as it is when the pose of the station that it moves with was measured."""
        moving = [("pose_clock", f.frame_id) for f in (pair.a, pair.b) if f.kind == "station" and f.epoch_id]
        known = [clock for clock in moving if clock in self.unknowns.vectors]
        return self.shifted(chain, (known or moving or [("pose_clock", "")])[0])

    def reading(self, reading: TableReading) -> ShiftedSlot | None:
        """The motion of a table when its angles were read; None where that is the epoch's time, or nothing sees it."""
        slot = self.unknowns.slot_of.get(("table_motion", reading.table_id, reading.epoch_id))
        if slot is None:
            return None
        (link,) = self.shifted((Link(slot),), ("table_clock", reading.table_id))
        return self.unknowns.shifted_slots.get(link.slot)

    def _slot(self, slot: int, clock: ParameterName, vector: VectorMap, row: float) -> int:
        place = slot, clock, row
        if place in self._made:
            return self._made[place]
        u, nodes, (_, time) = self.unknowns, tuple(self._around[slot]), self._epoch[slot]
        times = tuple(self._epoch[n][1] - time for n in nodes[1:])
        by = {"offset": 1.0, "drift": time - self.times.middle, "line_time": row}
        clocks = [(vector, np.array([by[x] for x in vector.names]))]
        if clock in self._jitter:
            clocks.append((self._own_time(clock, nodes[0]), np.ones(1)))
        made = self._made[place] = len(u.slot_key)
        u.slot_key.append(None)
        u.slot_pose.append(u.slot_pose[slot])
        u.slot_identity.append(False)
        u.shifted_slots[made] = ShiftedSlot(made, nodes, times, tuple(clocks), _parts(u, nodes, [c for c, _ in clocks]))
        return made

    def _own_time(self, clock: ParameterName, slot: int) -> VectorMap:
        """The deviation of a clock at the epoch of a slot."""
        u, name = self.unknowns, (*clock, self._epoch_ids[slot])
        if name not in u.vectors:
            self.jitters[name] = self._jitter[clock]
            key = u.add(name, "vector", ("jitter",), (self.times.unit,)).key
            one = np.eye(1)
            u.vectors[name] = VectorMap(("jitter",), (self.times.unit,), np.zeros(1), one, key, ("jitter",), ("prior",))
        return u.vectors[name]


def _near(run: range, i: int) -> range:
    """The epochs of a run from which it is known how things move about the i-th."""
    first = min(max(run.start, i - _AROUND // 2), max(run.start, run.stop - 1 - _AROUND))
    return range(first, min(run.stop, first + _AROUND + 1))


def nearest(times: Sequence[float], time: float) -> list[float]:
    """Of the times of a body's epochs those from which it is known how it moves about one of them, that one first."""
    order = sorted(times)
    i = order.index(time)
    run = next(r for r in runs(order, ("epochs",)) if i in r)
    return [time, *(order[j] for j in _near(run, i) if j != i)]


def between(poses: Sequence[FloatArray], times: Sequence[float], dt: float) -> FloatArray:
    """(4, 4) a time dt after the first of the times, from poses (4, 4) at all of them."""
    w, by_dt = weights(np.array([times]) - times[0], np.array([dt]))
    every = np.array(poses)
    motions = Motions(every[:, :3, :3], every[:, :3, 3])
    only = np.zeros(1, dtype=np.int64)
    R, t, _ = moved_poses(motions[:1], motions[1:], only, Interpolated(w, by_dt, np.zeros((1, 0))))
    return rigid(R[0], t[0])


def _parts(u: Unknowns, nodes: Sequence[int], clocks: Sequence[VectorMap]) -> list[tuple[int, int, int]]:
    """Where the derivatives of a shifted slot stand: by the pose or angles of every node, geometry, clocks."""
    tables, parts, at = [u.table_slots[n] for n in nodes if n in u.table_slots], [], 0
    for node in nodes:
        table = u.table_slots.get(node)
        key, n = (u.slot_key[node], 6) if table is None else (table.angles_key, len(table.axes))
        parts += [] if key is None else [(key, at, n)]
        at += n
    if tables:
        parts += tables[0].parts[1:] and [(tables[0].parts[1][0], at, tables[0].parts[1][2])]
        at += len(tables[0].geometry.free)
    for clock in clocks:
        parts += [] if clock.key is None else [(clock.key, at, len(clock.free))]
        at += len(clock.free)
    return parts


def weights(times: FloatArray, dt: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lagrange's weights (s, n) at dt (s,) over times (s, n) that differ, and their derivatives by dt."""
    n = times.shape[1]
    w, by = np.ones(times.shape), np.zeros(times.shape)
    for k in range(n):
        for j in range(n):
            if j != k:
                f, g = dt - times[:, j], times[:, k] - times[:, j]
                by[:, k] = (by[:, k] * f + w[:, k]) / g
                w[:, k] *= f / g
    return w, by


@dataclass(frozen=True, eq=False)
class Interpolated:
    """Of s slots with n nodes each the weights (s, n) and by_dt (s, n) at their times, and how clocks move these.

    by_clock: (s, c) derivatives of the times by free components of the clocks, which are equally many.
    """

    w: FloatArray
    by_dt: FloatArray
    by_clock: FloatArray


def interpolated(slots: Sequence[ShiftedSlot], values: gtsam.Values) -> Interpolated:
    """Of slots with equally many nodes and free components of their clocks."""
    full = {clock: clock.full(values) for clock in {clock for s in slots for clock, _ in s.clocks}}
    late = np.array([sum(rates @ full[clock] for clock, rates in s.clocks) for s in slots])
    w, by_dt = weights(np.array([(0.0, *s.times) for s in slots]), late)
    return Interpolated(w, by_dt, np.array([s.by_clocks for s in slots]))


def moved_poses(
    own: Motions, others: Motions, epoch: IntArray, at: Interpolated
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R (s, 3, 3), t (s, 3) between poses of e epochs and others (e (n - 1)) around; each about one epoch, (s,).

    Then their derivatives (s, 6, 6 n + c) by all of these and the clocks.
    """
    s, n = at.w.shape
    first = Motions(np.repeat(own.rotation, n - 1, axis=0), np.repeat(own.shifts, n - 1, axis=0))
    logs = (first.inverse() @ others).log()
    inverse, back = (x.reshape(-1, n - 1, 6, 6)[epoch] for x in (right_jacobian_inverse(logs), exp(-logs).adjoint()))
    L = logs.reshape(-1, n - 1, 6)[epoch]
    xi = np.einsum("sk,ski->si", at.w[:, 1:], L)
    right = right_jacobian(xi)
    J = right[:, None] @ inverse * at.w[:, 1:, None, None]
    by_own = exp(-xi).adjoint() - np.einsum("skij,skjl->sil", J, back)
    speed = (right @ np.einsum("sk,ski->si", at.by_dt[:, 1:], L)[..., None])[..., 0]
    by_nodes = np.swapaxes(np.concatenate([by_own[:, None], J], axis=1), 1, 2).reshape(s, 6, 6 * n)
    by_clock = speed[:, :, None] * at.by_clock[:, None, :]
    moved = own[epoch] @ exp(xi)
    return moved.rotation, moved.shifts, np.concatenate([by_nodes, by_clock], axis=2)


def shift(state: State, values: gtsam.Values, slots: Sequence[ShiftedSlot]) -> None:
    """Poses of slots at the times of clocks, and their derivatives; what they follow from is in the state."""
    alike: dict[tuple[str, int, int], list[ShiftedSlot]] = {}
    for s in slots:
        table = state.unknowns.table_slots.get(s.nodes[0])
        place = "" if table is None else table.table_id, len(s.nodes), len(s.by_clocks)
        alike.setdefault(place, []).append(s)
    for (table_id, *_), of in alike.items():
        at, i = interpolated(of, values), [s.slot for s in of]
        if table_id:
            R, t, D = _between_readings(state, values, of, at)
        else:
            around = {nodes: k for k, nodes in enumerate(dict.fromkeys(s.nodes for s in of))}
            own, others = [nodes[0] for nodes in around], [n for nodes in around for n in nodes[1:]]
            first, rest = (Motions(state.slot_R[x], state.slot_t[x]) for x in (own, others))
            R, t, D = moved_poses(first, rest, np.array([around[s.nodes] for s in of]), at)
        state.slot_R[i], state.slot_t[i] = R, t
        state.D[state.derived_index[i], :, : D.shape[2]] = D


def _between_readings(
    state: State, values: gtsam.Values, slots: Sequence[ShiftedSlot], at: Interpolated
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of slots of one table R, t, and derivatives by the angles of all nodes, free geometry and clocks."""
    tables = [[state.unknowns.table_slots[n] for n in s.nodes] for s in slots]
    angles = np.array([[values.atVector(t.angles_key) for t in nodes] for nodes in tables])
    R, t, D = state.of_table(values, tables[0][0], np.einsum("sk,ska->sa", at.w, angles))
    k = angles.shape[2]
    by_nodes = np.einsum("sk,sia->sika", at.w, D[:, :, :k]).reshape(len(slots), 6, -1)
    speed = D[:, :, :k] @ np.einsum("sk,ska->sa", at.by_dt, angles)[..., None]
    return R, t, np.concatenate([by_nodes, D[:, :, k:], speed * at.by_clock[:, None, :]], axis=2)


def reading_residual(slot: ShiftedSlot, unknowns: Unknowns, observed: FloatArray) -> tuple[list[int], Reading]:
    """Keys, and angles (k,) of a table at the time of its clock minus those read, with derivatives by these keys."""
    nodes = [unknowns.table_slots[n].angles_key for n in slot.nodes]
    clocks = [(clock.key, rates @ clock.matrix) for clock, rates in slot.clocks if clock.key is not None]

    def residual(values: gtsam.Values) -> tuple[FloatArray, list[tuple[int, FloatArray]]]:
        at = interpolated([slot], values)
        angles = np.array([values.atVector(key) for key in nodes])
        by = [(key, w * np.eye(len(observed))) for key, w in zip(nodes, at.w[0], strict=True)]
        return at.w[0] @ angles - observed, by + [(key, np.outer(at.by_dt[0] @ angles, r)) for key, r in clocks]

    return nodes + [key for key, _ in clocks], residual
