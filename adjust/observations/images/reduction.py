"""Poses that only image points of known targets touch, reduced before GTSAM sees the rest.

The station or board of an epoch stands in hundreds of blocks' worth of factors, and in nothing else. Its six unknowns
are eliminated here, block by block, by Schur complements; GTSAM gets one factor on what the epochs share (lenses, poses
of cameras on their station), and the reduced poses come back as leaves of its Bayes tree: the same step and the same
covariances as if it had eliminated them first (Triggs et al. 2000, section 6).
"""

from collections.abc import Sequence
from itertools import accumulate

import gtsam
import numpy as np

from adjust.frames.unknowns import Unknowns
from adjust.model.errors import IndeterminateError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native.blocks import run_split, split_blocks
from adjust.native.reduction import WEAKEST_PIVOT, ReducedPoses, ReductionArrays, leaf_rows, pose_steps, reduce_poses
from adjust.observations.adapter import evaluated
from adjust.observations.images.batch import ImageBatch
from adjust.observations.images.segments import first_seen, ranges

_FEWEST_POSES = 8
_SUMS = 4
"""Sums of what the poses leave, so many for any number of threads: the same to the last bit."""
_WIDEST_INTERFACE = 700
"""Components that the epochs may share: their normal matrix is dense here."""
_AT_EPOCHS = ("world_from_station", "carrier_from_target")


@frozen
class Leaves:
    """Cliques of one frontal pose each, eliminated before a tree: those of S, the others, lie in one of its cliques.

    keys[key_ptr[c]:key_ptr[c + 1]]: of clique c, the frontal one first. width: columns of the blocks [R S] of six rows,
    one after the other and row by row in ``data``.
    """

    keys: IntArray
    key_ptr: IntArray
    width: IntArray
    data: FloatArray


@frozen
class Interface:
    """What the reduced poses share with everything else: keys, and the first column of each."""

    keys: tuple[int, ...]
    at: dict[int, int]
    n: int


def hidden_poses(batch: ImageBatch, unknowns: Unknowns, outside: set[int]) -> list[int]:
    """Keys of the poses that can be reduced: of one epoch, in no other factor, and never two in the same block."""
    at_epochs = {
        key for key, u in unknowns.by_key.items() if u.name[0] in _AT_EPOCHS and len(u.name) == 3 and key not in outside
    }
    mine = np.isin(batch.of_blocks.key, np.array(list(at_epochs), dtype=np.int64))
    if np.bincount(batch.of_blocks.block[mine]).max(initial=0) > 1:
        return []
    return list(dict.fromkeys(batch.of_blocks.key[mine].tolist()))


def _positions(keys: IntArray, among: IntArray) -> IntArray:
    """Where each key stands among these different ones (at least one), -1 for one that does not."""
    order = np.argsort(among)
    at = order[np.minimum(np.searchsorted(among, keys, sorter=order), len(among) - 1)]
    return np.where(among[at] == keys, at, -1)


class PoseReduction:
    """The reduction of ``hidden`` poses of an image batch, and the one factor that is left of their blocks."""

    def __init__(self, batch: ImageBatch, unknowns: Unknowns, hidden: Sequence[int]) -> None:
        self.batch, self.hidden, k = batch, list(hidden), batch.of_blocks
        pose_of_key = _positions(k.key, np.array(self.hidden, dtype=np.int64))
        owner: IntArray = np.full(len(batch.blocks), -1, dtype=np.int64)
        owner[k.block[pose_of_key >= 0]] = pose_of_key[pose_of_key >= 0]
        self.others: IntArray = np.flatnonzero(owner < 0)
        """Blocks without such a pose: they keep factors of their own."""
        order = np.argsort(owner, kind="stable")[len(self.others) :].astype(np.int64)
        block_ptr = np.searchsorted(owner[order], np.arange(len(self.hidden) + 1)).astype(np.int64)
        # the keys that the poses' blocks share with others, pose after pose
        of_pose = ranges(k.ptr[order], np.diff(k.ptr)[order])
        of_pose = of_pose[pose_of_key[of_pose] < 0]
        first, number = first_seen(k.key[of_pose])
        keys = k.key[of_pose[first]].tolist()
        widths = [unknowns.by_key[key].dim for key in keys]
        starts = list(accumulate(widths, initial=0))
        self.interface = Interface(tuple(keys), dict(zip(keys, starts, strict=False)), starts[-1])
        self._place(of_pose, owner[k.block[of_pose]], number, np.array(widths, dtype=np.int64), order, block_ptr)
        runs = split_blocks(np.concatenate([[0], np.cumsum(np.diff(batch.ptr)[order])])[block_ptr], _SUMS)
        self._turns = [np.append(turn, run) for turn, run in enumerate(runs)]
        self._blocks = order

    def _place(
        self, at: IntArray, pose: IntArray, number: IntArray, widths: IntArray, order: IntArray, block_ptr: IntArray
    ) -> None:
        """Columns of every pose's shared keys: ``number`` and ``pose`` of each, ``at`` its place among all keys."""
        pairs, which = np.unique(pose * len(widths) + number, return_inverse=True)
        self._shared_pose, self._shared = np.divmod(pairs, max(1, len(widths)))
        shared_width = widths[self._shared]
        end = np.concatenate([[0], np.cumsum(shared_width)])
        col_ptr = end[np.searchsorted(self._shared_pose, np.arange(len(self.hidden) + 1))].astype(np.int64)
        of_key = np.zeros(len(self.batch.of_blocks.key), dtype=np.int64)  # a pose's own columns come first
        of_key[at] = (6 + end[:-1] - col_ptr[self._shared_pose])[which]
        starts = np.cumsum(widths) - widths
        self.arrays = ReductionArrays(
            block_ptr, order, col_ptr, ranges(starts[self._shared], shared_width),
            of_key[self.batch.of_blocks.of_segment] + self.batch.of_blocks.segments.within,
        )  # fmt: skip
        self.L = np.zeros((len(self.hidden), 6, 6))
        self.T = np.zeros(6 * (int(col_ptr[-1]) + len(self.hidden)))
        self._views: list[FloatArray] = []
        self._r = np.zeros(self.interface.n + 1)

    def reduce(self, damping: float) -> bool:
        """Reduce at the values the batch was last prepared at; False where something has no inverse to speak of."""
        batch, n, count = self.batch, self.interface.n, len(self._turns)
        out = ReducedPoses(
            self.L, self.T, np.zeros((count, n)), np.zeros((count, n + 1, n + 1)), np.full(count, -1, dtype=np.int64)
        )
        run_split(reduce_poses, self._turns, self.arrays, batch.at(batch.W), batch.by_keys, damping, batch.H, out)
        return bool((out.bad < 0).all()) and self._serve(out.rest.sum(axis=0), out.diagonal.sum(axis=0))

    def _serve(self, N: FloatArray, diagonal: FloatArray) -> bool:
        """Square root of what is left, as the rows of the factor."""
        n = self.interface.n
        if not (diagonal > 0.0).all():
            return False
        scale = np.sqrt(diagonal)
        A = np.empty((n + 1, n + 1))
        A[:n, :n], A[n, :n] = N[:n, :n].T / scale[:, None] / scale, N[:n, n] / scale
        A[n, n] = 2.0 * N[n, n] + 1.0  # above y'y in any case: y does not depend on it
        try:
            L = np.linalg.cholesky(A)
        except np.linalg.LinAlgError:
            return False
        if not np.diag(L)[:n].min() ** 2 > WEAKEST_PIVOT:
            return False
        y = L[n, :n]
        self._r[:n], self._r[n] = y, np.sqrt(max(0.0, N[n, n] - float(y @ y)))
        R = np.zeros((n + 1, n))
        R[:n] = L[:n, :n].T * scale
        ends = [*list(self.interface.at.values())[1:], n]
        self._views = [
            np.ascontiguousarray(R[:, at:end]) for at, end in zip(self.interface.at.values(), ends, strict=True)
        ]
        return True

    def add_factor(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """The one factor, which serves what :meth:`reduce` left of these values, and reduces others by itself."""
        noise = gtsam.noiseModel.Unit.Create(self.interface.n + 1)
        graph.add(evaluated(noise, list(self.interface.keys), self._residual))

    def _residual(self, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        batch = self.batch
        if not batch.state.served:
            batch.state.load(values)
            batch.prepare(jacobians is not None)
            if jacobians is not None and not self.reduce(0.0):
                raise IndeterminateError("a pose that was reduced has no solution at these values")
        if jacobians is None:  # only the length of the residual is asked for
            length = np.zeros(self.interface.n + 1)
            length[-1] = np.sqrt(batch.chi[self._blocks].sum())
            return length
        for i, view in enumerate(self._views):
            jacobians[i] = view
        return self._r

    def complete(self, delta: gtsam.VectorValues) -> float:
        """Insert the steps of the reduced poses; returns by how much these alone lower chi-square."""
        d = np.concatenate([delta.at(key) for key in self.interface.keys])
        steps = np.empty((len(self.hidden), 6))
        decrease = pose_steps(self.arrays, self.L, self.T, d, steps)
        for key, step in zip(self.hidden, steps, strict=True):
            delta.insert(key, step)
        return decrease

    def leaves(self) -> Leaves:
        """The reduced poses as cliques below that of the interface: blocks [L' T]."""
        width = 6 + np.diff(self.arrays.col_ptr)
        data = np.empty(6 * int(width.sum()))
        leaf_rows(self.arrays, self.L, self.T, data)
        first = np.searchsorted(self._shared_pose, np.arange(len(self.hidden)))
        keys = np.insert(np.array(self.interface.keys, dtype=np.int64)[self._shared], first, self.hidden)
        return Leaves(keys, np.append(first, len(self._shared)) + np.arange(len(first) + 1), width, data)


def reduction(batch: ImageBatch, unknowns: Unknowns, outside: set[int]) -> PoseReduction | None:
    """The reduction of a batch, or None where it would not pay or has nothing to hang on."""
    hidden = hidden_poses(batch, unknowns, outside)
    if len(hidden) < _FEWEST_POSES:
        return None
    found = PoseReduction(batch, unknowns, hidden)
    return found if 0 < found.interface.n <= _WIDEST_INTERFACE else None
