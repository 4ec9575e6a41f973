"""Where a bundle is cut into blocks that are reduced each by itself, as Helmert's blocks of a triangulation are.

Images whose points are seen from far apart have little in common: a point that two blocks see stays in sight, all else
is hidden in its block. Without this, the reduced normal matrix of a building is as full as that of a single room.
"""

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from adjust.model.observations import ImageBlock
from adjust.model.survey import BoolArray, FloatArray, IntArray

SMALLEST = 150
"""Poses below which a block is not cut."""
_STEPS = 200
_EPOCHS = 24
"""Epochs in one run, where nothing is hidden."""
_GAIN = 0.5
"""Share of the work of reducing a block that may be left when it is cut."""


def helmert_blocks(owner: IntArray, seen: Sequence[IntArray], hidden: FloatArray) -> IntArray:
    """Block (B,) of every image block, numbered from zero.

    owner: (B,) the pose of an image block, numbered from zero. seen: the free points of each image block, by number.
    hidden: (poses,) how many unknowns of a pose are hidden: 6, or 0 where others touch it.
    Nested dissection (A. George, SIAM Journal on Numerical Analysis 10, 1973), poses in the order of the second vector
    of their normalised graph (J. Shi, J. Malik, IEEE Trans. PAMI 22, 2000), cut where the work is least.
    """
    points = np.concatenate([np.zeros(0, dtype=np.int64), *seen])
    shape = (len(hidden), int(points.max(initial=-1)) + 1)
    entry = (np.ones(len(points), dtype=np.int8), (np.repeat(owner, [len(s) for s in seen]), points))
    incidence = sparse.csr_array(entry, shape=shape)
    block_of = np.zeros(len(hidden), dtype=np.int64)
    count, open_ = 1, [np.arange(len(hidden))]
    while open_:
        poses = open_.pop()
        at = _cut(incidence[poses], hidden[poses]) if np.count_nonzero(hidden[poses]) > SMALLEST else None
        if at is not None:
            block_of[poses[at]] = count
            count += 1
            open_ += [poses[at], poses[~at]]
    return block_of[owner]


def runs_of_epochs(blocks: Sequence[ImageBlock]) -> IntArray:
    """Run (B,) of image blocks that hide nothing: some epochs each, where rows are less work than one matrix."""
    number: dict[str, int] = {}
    epoch = np.array([number.setdefault(b.epoch_id, len(number)) for b in blocks], dtype=np.int64)
    point = np.concatenate([np.zeros(0, dtype=np.int64), *(b.point_idx for b in blocks)])
    of_point, n_points = np.repeat(epoch, [len(b.point_idx) for b in blocks]), int(point.max(initial=-1)) + 1

    def columns(run: IntArray) -> FloatArray:
        """Of the runs (n,) of all image points: unknowns of their epochs and points (r,)."""
        epochs, points = np.unique(run * len(number) + of_point), np.unique(run * n_points + point)
        n = int(run.max(initial=-1)) + 1
        return np.asarray(6.0 * np.bincount(epochs // max(len(number), 1), minlength=n)
                          + 3.0 * np.bincount(points // max(n_points, 1), minlength=n))  # fmt: skip

    run, together = of_point // _EPOCHS, columns(np.zeros_like(of_point)).sum()
    work = (4.0 * np.bincount(run) * columns(run) ** 2).sum()
    return epoch // _EPOCHS if work < _GAIN * float(_work(together, 0.0)) else np.zeros_like(epoch)


def _cut(incidence: sparse.csr_array, hidden: FloatArray) -> BoolArray | None:
    """Which poses (n,) lie beyond the cut that leaves the least work; None where none leaves clearly less."""
    seen = incidence.tocsc()[:, np.flatnonzero(np.diff(incidence.tocsc().indptr))]
    order = np.argsort(_far_apart(seen), kind="stable")
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    first, last = (f.reduceat(place[seen.indices], seen.indptr[:-1]) for f in (np.minimum, np.maximum))
    # a point is shared by the cuts after its first and up to its last pose
    n = len(hidden) + 1
    shared = 3.0 * np.cumsum(np.bincount(first + 1, minlength=n + 1) - np.bincount(last + 1, minlength=n + 1))[:n]
    left = np.concatenate([[0.0], np.cumsum(hidden[order])])
    whole = float(left[-1])
    work = _work(left, shared) + _work(whole - left, shared) + shared**3 / 3.0
    best = int(np.argmin(work))
    return np.asarray(place >= best) if work[best] < _GAIN * _work(whole, 0.0) else None


def _far_apart(seen: sparse.csc_array) -> FloatArray:
    """A number for each pose (n,): near those of poses that see the same points, far from others."""
    from scipy.sparse.csgraph import connected_components  # small surveys do without
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

    parts, part = connected_components(sparse.block_array([[None, seen], [seen.T, None]]), directed=False)
    if parts > 1:
        return np.asarray(part[: seen.shape[0]], dtype=float)
    of_pose = np.sqrt(np.maximum(seen.sum(axis=1), 1.0))
    of_point = seen.sum(axis=0)

    def common(x: FloatArray) -> FloatArray:
        return np.asarray(seen @ ((seen.T @ (x.ravel() / of_pose)) / of_point) / of_pose)

    n = len(of_pose)
    operator = LinearOperator((n, n), matvec=common, dtype=np.float64)
    try:
        found = eigsh(operator, k=2, which="LA", v0=np.random.default_rng(0).normal(size=n), tol=1e-3, maxiter=_STEPS)
    except ArpackNoConvergence as error:  # rough vectors cut well enough
        found = error.eigenvalues, error.eigenvectors
    return np.asarray(found[1][:, 0] / of_pose if found[1].shape[1] == 2 else np.zeros(n))


def _work(hidden: FloatArray | float, seen: FloatArray | float) -> FloatArray:
    """Multiplications to reduce so many unknowns from a dense normal matrix with so many others."""
    return np.asarray(hidden**3 / 3.0 + hidden**2 * seen + hidden * seen**2)
