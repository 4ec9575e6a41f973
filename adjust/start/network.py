"""The frames of a survey as a network of poses, some known, and how knowledge spreads in it.

Every observation says: the product of a chain of poses is this one. A pose that is alone unknown in a chain follows
from it; where none is, what is symmetric is fixed (:mod:`adjust.start.gauge`), or two are found from the motion
between them (:mod:`adjust.start.motion`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from gtsam import Pose3

from adjust.frames.unknowns import Chain, FrameTree, Unknowns
from adjust.model.errors import SurveyError
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, PoseParameter, Survey, Table
from adjust.spatial.averaging import mean_pose, pose_distance
from adjust.spatial.rigid import inverse, rigid, rotation_exp

IDENTITY = np.eye(4)
_CONTRADICTION = np.deg2rad(10.0)
"""Two poses that differ by more, as an angle at the typical distance, have no mean."""


@dataclass(frozen=True, eq=False)
class ChainObservation:
    """The chain's product is one of ``poses`` (k, 4, 4), likeliest first.

    ends: whether the two ends of the chain are bound to what was seen (False: to points that are unknown themselves).
    rotation_only: the translation of the product is unknown. block_idx: the block of image points, -1 for a pair.
    """

    chain: Chain
    poses: FloatArray
    text: str
    block_idx: int = -1
    rotation_only: bool = False
    ends: tuple[bool, bool] = (True, True)


@dataclass(eq=False)
class PoseNetwork:
    """Slots by number (see :class:`adjust.frames.unknowns.Unknowns`) with what is known of them; filled step by step.

    known: values (4, 4). fixed: slots that were given. gauged: slots that were set freely. lever: m, typical distance
    of target and camera, which weighs turns against shifts.
    """

    unknowns: Unknowns
    frames: FrameTree
    names: dict[int, ParameterName] = field(default_factory=dict)
    known: dict[int, FloatArray] = field(default_factory=dict)
    fixed: set[int] = field(default_factory=set)
    gauged: list[int] = field(default_factory=list)
    observations: list[ChainObservation] = field(default_factory=list)
    lever: float = 1.0

    def register(self, survey: Survey) -> None:
        """Take over the slots made since the last call: given values, table motions."""
        readings = {(r.table_id, r.epoch_id): r.angles for r in survey.table_readings}
        tables = {t.table_id: t for t in survey.tables}
        for name, slot in self.unknowns.slot_of.items():
            if slot in self.names:
                continue
            self.names[slot] = name
            if name[0] == "table_motion":
                value: FloatArray | None = table_from_mount(tables[name[1]], readings[(name[1], name[2])])
            else:
                value = given_pose(self.unknowns.parameters[name])
            if value is not None:
                self.known[slot] = value
                self.fixed.add(slot)

    def link_pose(self, slot: int, inverted: bool) -> FloatArray:
        """The known pose of a link."""
        return inverse(self.known[slot]) if inverted else self.known[slot]

    def product(self, chain: Chain) -> FloatArray:
        """The product (4, 4) of a chain that is wholly known."""
        pose = IDENTITY
        for link in chain:
            pose = pose @ self.link_pose(link.slot, link.inverse)
        return pose

    def products(self, chains: Sequence[Chain]) -> FloatArray:
        """The products (n, 4, 4) of chains that are wholly known."""
        forward = np.array([IDENTITY, *self.known.values()])
        both = np.concatenate([forward, inverse(forward)])
        place = {slot: i + 1 for i, slot in enumerate(self.known)}
        longest = max((len(chain) for chain in chains), default=0)
        rows = np.zeros((longest, len(chains)), dtype=np.int64)
        for n, chain in enumerate(chains):
            for i, link in enumerate(chain):
                rows[i, n] = place[link.slot] + (len(forward) if link.inverse else 0)
        out = np.tile(IDENTITY, (len(chains), 1, 1))
        for row in rows:
            out = out @ both[row]
        return out

    def unknown_links(self, chain: Chain) -> list[int]:
        """Positions in the chain of the links that are unknown."""
        return [i for i, link in enumerate(chain) if link.slot not in self.known]

    def isolate(self, items: Sequence[tuple[ChainObservation, int]]) -> list[FloatArray]:
        """What observations say of the slot at a position of their chain, (k, 4, 4), all other links being known."""
        before = inverse(self.products([o.chain[:i] for o, i in items]))
        after = inverse(self.products([o.chain[i + 1 :] for o, i in items]))
        counts = [len(o.poses) for o, _ in items]
        poses = np.concatenate([o.poses for o, _ in items])
        value = np.repeat(before, counts, axis=0) @ poses @ np.repeat(after, counts, axis=0)
        turned = np.repeat([o.chain[i].inverse for o, i in items], counts)
        value[turned] = inverse(value[turned])
        return np.split(value, np.cumsum(counts)[:-1])

    def propagate(self, rotation_only: bool = False) -> bool:
        """Determine what is alone unknown in its chains, until nothing is; whether anything was found."""
        if self.known.keys() >= self.names.keys():
            return False
        missing: list[set[int]] = []
        using: dict[int, list[int]] = {}
        waiting: dict[int, list[int]] = {}
        for n, observation in enumerate(self.observations):
            slots = [link.slot for link in observation.chain if link.slot not in self.known]
            # a slot that a chain passes twice cannot be isolated
            missing.append(set(slots) if len(set(slots)) == len(slots) else {-1})
            for slot in missing[n]:
                using.setdefault(slot, []).append(n)
            self._queue(n, missing[n], waiting, rotation_only)
        found = bool(waiting)
        while waiting:
            # what many observations determine goes first: it is the safer ground for the rest
            most = max(len(w) for w in waiting.values())
            ready = sorted(s for s, w in waiting.items() if 2 * len(w) >= most)
            offers = self._offers([(n, slot) for slot in ready for n in waiting[slot]])
            for slot in ready:
                numbers = waiting.pop(slot)
                offers |= self._offers([(n, slot) for n in numbers if n not in offers])  # from slots just found
                items = [(self.observations[n], offers[n]) for n in numbers]
                self.known[slot] = self._mean(items, rotation_only)
                for n in using[slot]:
                    missing[n].discard(slot)
                    self._queue(n, missing[n], waiting, rotation_only)
        return found

    def _offers(self, wanted: Sequence[tuple[int, int]]) -> dict[int, FloatArray]:
        """What observations, by number, say of a slot of their chain."""
        if not wanted:
            return {}
        items = [
            (o, next(i for i, link in enumerate(o.chain) if link.slot == slot))
            for o, slot in ((self.observations[n], slot) for n, slot in wanted)
        ]
        return dict(zip((n for n, _ in wanted), self.isolate(items), strict=True))

    def _queue(self, n: int, missing: set[int], waiting: dict[int, list[int]], rotation_only: bool) -> None:
        if len(missing) == 1 and -1 not in missing and self.observations[n].rotation_only <= rotation_only:
            waiting.setdefault(next(iter(missing)), []).append(n)

    def _mean(self, said: list[tuple[ChainObservation, FloatArray]], rotation_only: bool = False) -> FloatArray:
        """Robust mean over all observations that isolate a slot; the likelier solution where just one does.

        said: with each what it says of the slot (k, 4, 4).
        """
        if rotation_only:  # full poses say more than rotations
            said = [s for s in said if not s[0].rotation_only] or said
        # images before pairs: a whole image is wrong less often than the ends of a pair are exchanged
        offers = [offer for _, offer in sorted(said, key=lambda s: s[0].block_idx < 0)]
        if len(offers) == 1:
            return np.asarray(offers[0][0])
        if len(offers) == 2:  # the pair of solutions in which the two agree
            d = pose_distance(offers[0][:, None], offers[1][None], self.lever)
            i, j = np.unravel_index(int(np.argmin(d)), d.shape)
            if d[i, j] > _CONTRADICTION * self.lever:  # a mean of right and wrong is wrong for certain
                return np.asarray(offers[0][0])
            return mean_pose(np.stack([offers[0][i], offers[1][j]]), self.lever)[0]
        members = np.repeat(np.arange(len(offers)), [len(o) for o in offers])
        return mean_pose(np.concatenate(offers), self.lever, members)[0]

    def relax(self, movable: set[int], rounds: int = 1) -> None:
        """Renew each movable slot as the mean over all observations that contain it once (Gauss-Seidel)."""
        by_slot: dict[int, list[tuple[ChainObservation, int]]] = {}
        for observation in self.observations:
            if observation.rotation_only or self.unknown_links(observation.chain):
                continue
            slots = [link.slot for link in observation.chain]
            for i, slot in enumerate(slots):
                if slot in movable and slots.count(slot) == 1:
                    by_slot.setdefault(slot, []).append((observation, i))
        for _ in range(rounds):
            for slot in sorted(by_slot):
                offers = self.isolate(by_slot[slot])
                self.known[slot] = self._mean([(o, x) for (o, _), x in zip(by_slot[slot], offers, strict=True)])


def given_pose(parameter: PoseParameter) -> FloatArray | None:
    """The pose that is used as given, or None where it must be found.

    A prior that leaves a component open (infinite variance) is no given pose, but see :func:`partial_pose`.
    """
    if parameter.value is None:
        return IDENTITY if parameter.treatment == "held" else None
    cov = parameter.prior_cov if parameter.treatment == "prior" else None
    if cov is not None and not np.all(np.isfinite(np.diag(cov))):
        return None
    return np.asarray(parameter.value.matrix(), dtype=float)


def partial_pose(parameter: PoseParameter | None) -> FloatArray | None:
    """The mean of a prior, also where it leaves components open; None where there is no prior."""
    if parameter is None or parameter.value is None:
        return None
    return np.asarray(parameter.value.matrix(), dtype=float)


def table_from_mount(table: Table, angles: FloatArray) -> FloatArray:
    """Motion (4, 4) of a table at angles (k,) rad with its given geometry (:class:`adjust.model.survey.Table`)."""
    geometry = dict(zip(table.geometry.names, table.geometry.values, strict=True))
    axes = ["xyz".index(a) for a in table.axes]
    if len(angles) != len(axes):
        raise SurveyError(f"table {table.table_id!r} has {len(axes)} axes, a reading has {len(angles)} angles")

    def turn(axis: int, angle: float) -> FloatArray:
        return rigid(rotation_exp(np.eye(3)[axis] * angle), np.zeros(3))

    motion = turn(axes[0], float(angles[0]) + geometry.get("zero_1", 0.0))
    if len(axes) == 1:
        return motion
    third = 3 - axes[0] - axes[1]
    shift = rigid(np.eye(3), np.eye(3)[third] * geometry.get("axis_offset", 0.0))
    skewness = turn(third, geometry.get("non_orthogonality", 0.0))
    return np.asarray(motion @ shift @ skewness @ turn(axes[1], float(angles[1]) + geometry.get("zero_2", 0.0)))


def as_pose3(matrix: FloatArray) -> Pose3:
    """GTSAM's pose of a matrix (4, 4)."""
    return Pose3(np.ascontiguousarray(matrix))
