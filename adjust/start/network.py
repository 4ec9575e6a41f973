"""The frames of a survey as a network of poses, some known, and how knowledge spreads in it.

Every observation says: the product of a chain of poses is this one. A pose that is alone unknown in a chain follows
from it; where none is, what is symmetric is fixed (:mod:`adjust.start.gauge`), or two are found from the motion
between them (:mod:`adjust.start.motion`).
"""

from collections.abc import Sequence

import numpy as np
from gtsam import Pose3

from adjust.frames.tables import table_poses
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Chain, Link
from adjust.model.errors import SurveyError
from adjust.model.names import grouped
from adjust.model.survey import BoolArray, FloatArray, IntArray, PoseParameter, Survey, Table
from adjust.spatial.averaging import least, mean_poses, pose_distance
from adjust.spatial.rigid import inverse, rigid
from adjust.start.chains import ChainObservation, Chains, Observations, runs

IDENTITY = np.eye(4)
_CONTRADICTION = np.deg2rad(10.0)
"""Two poses that differ by more, as an angle at the typical distance, have no mean."""


class FrameNetwork:
    """Slots by number (see :class:`adjust.frames.unknowns.Unknowns`) with what is known of them; filled step by step.

    names: (n) by slot. pose: (n, 4, 4), of those that ``has`` (n,) says are known. fixed: (n,) those that were given.
    gauged: slots that were set freely. lever: m, typical distance of target and camera, which weighs turns against
    shifts.
    """

    def __init__(self, frames: FrameTree, survey: Survey) -> None:
        """Take over the slots made by now: given values, table motions."""
        self.frames, self.parameters = frames, frames.unknowns.parameters
        self.names = list(frames.unknowns.slot_of)
        n = len(self.names)
        self.pose, self.has = np.tile(IDENTITY, (n, 1, 1)), np.zeros(n, dtype=np.bool_)
        self.observations = Observations.of([])
        self.gauged: list[int] = []
        self.lever = 1.0
        moved = ((name, slot) for slot, name in enumerate(self.names) if name[0] == "table_motion")
        turned = grouped((name[1], (slot, name[2])) for name, slot in moved)
        readings = {(r.table_id, r.epoch_id): r.angles for r in survey.table_readings} if turned else {}
        for table_id, of in turned.items():
            angles = [readings[table_id, epoch_id] for _, epoch_id in of]
            self.set([slot for slot, _ in of], table_from_mount(survey.tables_by_id[table_id], angles))
        for slot, name in enumerate(self.names):
            value = given_pose(self.parameters[name]) if name[0] != "table_motion" else None
            if value is not None:
                self.set(slot, value)
        self.fixed = self.has.copy()

    @property
    def state(self) -> tuple[object, ...]:
        """All that is known and observed, to be told apart from another state."""
        o = self.observations
        observed = o.chains.slots, o.chains.inverted, o.poses, o.first, o.block_idx, o.rotation_only
        return self.pose, self.has, self.lever, *observed

    def set(self, slot: int | list[int], value: FloatArray) -> None:
        """Let a slot, or several (n), be known."""
        self.pose[slot], self.has[slot] = value, True

    def set_link(self, link: Link, value: FloatArray) -> None:
        """Let the pose of a link be known."""
        self.set(link.slot, inverse(value) if link.inverse else value)

    def product(self, chain: Chain) -> FloatArray:
        """The product (4, 4) of a chain that is wholly known."""
        return np.asarray(self.products([chain])[0])

    def observe(self, items: Sequence[ChainObservation]) -> None:
        """Take them among the observations."""
        self.observations = self.observations.and_also(Observations.of(items))

    def products(self, chains: Sequence[Chain] | Chains) -> FloatArray:
        """The products (n, 4, 4) of chains that are wholly known."""
        padded = chains if isinstance(chains, Chains) else Chains.of(chains)
        return self._products(padded, padded.slots >= 0)

    def _products(self, chains: Chains, taken: BoolArray) -> FloatArray:
        """Products (n, 4, 4) of those links that are ``taken`` (n, L)."""
        out = np.tile(IDENTITY, (len(taken), 1, 1))
        for column in range(taken.shape[1]):
            rows = np.flatnonzero(taken[:, column])
            step, turned = self.pose[chains.slots[rows, column]], chains.inverted[rows, column]
            if turned.any():
                step[turned] = inverse(step[turned])
            out[rows] = out[rows] @ step
        return out

    def unknown_links(self, chain: Chain) -> list[int]:
        """Positions in the chain of the links that are unknown."""
        return [i for i, link in enumerate(chain) if not self.has[link.slot]]

    def open_slots(self, chain: Chain) -> bool:
        """Whether any link of the chain is unknown."""
        return bool(self.unknown_links(chain))

    def whole(self) -> Observations:
        """Observations of poses whose chains are known."""
        every = self.observations
        slots = every.chains.slots
        return every.part(np.flatnonzero(~every.rotation_only & ((slots < 0) | self.has[slots]).all(axis=1)))

    def _isolate(
        self, observed: Observations, rows: IntArray, chains: Chains, at: IntArray
    ) -> tuple[FloatArray, IntArray]:
        """What observations ``rows`` (n,) say of the slot at the position (n,) of their chain, all others being known.

        (m, 4, 4), and where those of each begin (n + 1,).
        """
        column = np.arange(chains.slots.shape[1])
        inside = chains.slots >= 0
        before = inverse(self._products(chains, inside & (column < at[:, None])))
        after = inverse(self._products(chains, inside & (column > at[:, None])))
        counts, value = np.diff(observed.first)[rows], observed.poses[runs(observed.first, rows)]
        value = np.repeat(before, counts, axis=0) @ value @ np.repeat(after, counts, axis=0)
        turned = np.repeat(chains.inverted[np.arange(len(at)), at], counts)
        value[turned] = inverse(value[turned])
        return value, np.concatenate([[0], np.cumsum(counts)])

    def propagate(self, rotation_only: bool = False) -> bool:
        """Determine what is alone unknown in its chains, until nothing is; whether anything was found.

        What many observations determine goes first: it is the safer ground for the rest.
        """
        if self.has.all():
            return False
        observed = self.observations.part(np.flatnonzero(rotation_only | ~self.observations.rotation_only))
        chains = observed.chains
        # a slot that a chain passes twice cannot be isolated
        unknown = (chains.slots >= 0) & ~self.has[chains.slots]
        unknown[(unknown & ~chains.once(~self.has)).any(axis=1)] = False
        row, column = chains.by_slot(unknown)
        first = np.searchsorted(chains.slots[row, column], np.arange(len(self.has) + 1))
        left = unknown.sum(axis=1)
        support = np.bincount(chains.slots[row, column][left[row] == 1], minlength=len(self.has))
        found = False
        while (most := int(support.max(initial=0))) > 0:
            ready = np.flatnonzero(2 * support >= most)
            using = runs(first, ready)
            # of two that one chain joins the second is better off after the first
            both, times = np.unique(row[using], return_counts=True)
            both = both[(times == 2) & (left[both] == 2)]
            if len(both):
                ready = np.setdiff1d(ready, np.where(unknown[both], chains.slots[both], -1).max(axis=1))
                using = runs(first, ready)
            telling = using[left[row[using]] == 1]
            self._determine(observed, row[telling], column[telling])
            unknown[row[using], column[using]] = False
            np.subtract.at(left, row[using], 1)
            support[ready] = 0
            alone = np.unique(row[using])
            alone = alone[left[alone] == 1]
            np.add.at(support, chains.slots[alone, np.argmax(unknown[alone], axis=1)], 1)
            found = True
        return found

    def _determine(self, observed: Observations, rows: IntArray, at: IntArray) -> None:
        """Set the slots at the positions (n,) of the chains of observations ``rows`` (n,), sorted by slot.

        To the robust mean over all observations that isolate a slot; the likelier solution where just one does, and of
        two the alternatives in which they agree.
        """
        chains = observed.chains.part(rows)
        value, begins = self._isolate(observed, rows, chains, at)
        slot, full = chains.slots[np.arange(len(at)), at], ~observed.rotation_only[rows]
        # full poses say more than rotations; a whole image is wrong less often than the ends of a pair are exchanged
        telling = full | ~np.isin(slot, slot[full])
        order = np.lexsort((observed.block_idx[rows] < 0, slot))
        order = order[telling[order]]
        slots, first, count = np.unique(slot[order], return_index=True, return_counts=True)
        self.pose[slots] = value[begins[order[first]]]
        self.has[slots] = True
        # of two that contradict each other the mean of right and wrong is wrong for certain
        two, more = np.flatnonzero(count == 2), np.flatnonzero(count > 2)
        pairs, apart = self._nearest(value, begins, order[first[two]], order[first[two] + 1])
        agree = apart <= _CONTRADICTION * self.lever
        of_two, others = pairs[agree].ravel(), order[runs(np.append(first, len(order)), more)]
        sizes = np.diff(begins)[others]
        member = np.concatenate([np.arange(len(of_two)), len(of_two) + np.repeat(np.arange(len(others)), sizes)])
        meant = np.concatenate([two[agree], more])
        if len(meant):
            owner = np.repeat(np.arange(len(meant)), np.concatenate([count[two[agree]], count[more]]))
            of_each = np.bincount(owner, np.concatenate([np.ones(len(of_two)), sizes]))
            ptr = np.append(0, np.cumsum(of_each.astype(np.int64)))
            rows = np.concatenate([of_two, runs(begins, others)])
            self.pose[slots[meant]] = mean_poses(value[rows], self.lever, ptr, member)

    def _nearest(self, value: FloatArray, begins: IntArray, a: IntArray, b: IntArray) -> tuple[IntArray, FloatArray]:
        """Of the alternatives of two observations each (n,) those nearest to each other (n, 2), and how far, m (n,)."""
        n = np.diff(begins)[b]
        count = np.diff(begins)[a] * n
        owner = np.repeat(np.arange(len(a)), count)
        place = np.arange(len(owner)) - (np.cumsum(count) - count)[owner]
        both = np.column_stack([begins[a][owner] + place // n[owner], begins[b][owner] + place % n[owner]])
        distance = pose_distance(value[both[:, 0]], value[both[:, 1]], self.lever)
        best = least(distance, owner)
        return both[best], distance[best]

    def relax(self, movable: BoolArray) -> None:
        """Renew each movable slot as the mean over all observations that contain it once (Gauss-Seidel)."""
        whole = self.whole()
        chains = whole.chains
        row, column = chains.by_slot(chains.once(movable))
        for mine in np.split(np.arange(len(row)), np.flatnonzero(np.diff(chains.slots[row, column])) + 1):
            if len(mine):
                self._determine(whole, row[mine], column[mine])


def pair_observations(survey: Survey, frames: FrameTree) -> tuple[Observations, Observations]:
    """What pairs say: those in use, and the others, which are doubtful."""
    out: tuple[list[ChainObservation], list[ChainObservation]] = [], []
    for pair in survey.pairs:
        full = isinstance(pair.b_from_a, Pose3)
        matrix = pair.b_from_a.matrix()
        pose = np.asarray(matrix, dtype=float) if full else rigid(matrix, np.zeros(3))
        observation = ChainObservation(frames.relative(pair.a, pair.b), pose[None], rotation_only=not full)
        out[not pair.used].append(observation)
    return Observations.of(out[0]), Observations.of(out[1])


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


def table_from_mount(table: Table, angles: Sequence[FloatArray]) -> FloatArray:
    """Motions (n, 4, 4) of a table at n angles (k,) with its given geometry (:class:`adjust.model.survey.Table`)."""
    k = len(table.axes)
    for wrong in (a for a in angles if len(a) != k):
        raise SurveyError(f"table {table.table_id!r} has {k} axes, a reading has {len(wrong)} angles")
    return rigid(*table_poses(table.axes, table.geometry.by_name, np.array(angles, dtype=float).reshape(-1, k)))
