"""The image points of a bundle one by one: two rows each on its lens, its poses and its point, nothing hidden.

What :class:`~adjust.observations.images.bundles.BundleBatch` condenses into one factor, as GTSAM's own algorithms
can take it: the same chi-square and, with hidden poses and points eliminated, the same normal equations.
"""

import gtsam
import numpy as np

from adjust.model.survey import FloatArray
from adjust.native.bundles import SightArrays, rows
from adjust.native.lenses import MAX_LENS
from adjust.observations.adapter import evaluated
from adjust.observations.images.bundles import BundleBatch


def add_point_factors(batch: BundleBatch, graph: gtsam.NonlinearFactorGraph) -> None:
    """One factor for every image point of the batch; one that is not used weighs nothing."""
    noise = gtsam.noiseModel.Unit.Create(2)
    for k in range(len(batch.block)):
        factor = PointFactor(batch, k)
        if factor.keys:
            graph.add(evaluated(noise, factor.keys, factor.residual))


class PointFactor:
    """One image point, ``k`` in the batch's sorted order: whitened by its covariance and its weight."""

    def __init__(self, batch: BundleBatch, k: int) -> None:
        self.batch, self.k = batch, k
        self.block, self.point = int(batch.block[k]), int(batch.point[k])
        self.camera = int(batch.camera_of[k])
        self.point_key = batch.point_key.get(self.point)
        self.lens = batch.state.lens_states.parts(self.camera)
        keys = [part.key for part in self.lens]
        for slot in batch.chains.slots(self.block):
            keys += batch.unknowns.link_keys(slot)
        keys += [] if self.point_key is None else [self.point_key]
        self.keys = list(dict.fromkeys(keys))

    def residual(self, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        """What GTSAM's custom factor returns: predicted minus observed (2,), whitened, and its derivatives by key."""
        A, C = self._alone(values)
        if jacobians is not None:
            for i, J in enumerate(self._by_keys(A, C)):
                jacobians[i] = J
        return np.array(A[:, MAX_LENS + 6])

    def _alone(self, values: gtsam.Values) -> tuple[FloatArray, FloatArray]:
        """The row (2, MAX_LENS + 7) and the links' derivatives, from this image point alone."""
        b, s = self.batch, self.batch.state
        s.load(values, b.chains.slots(self.block))
        R, t, C = b.chains.one(s, self.block)
        x = b.world[self.point] if self.point_key is None else np.asarray(values.atPoint3(self.point_key))
        mine = slice(self.k, self.k + 1)
        A, place = np.zeros((1, 2, MAX_LENS + 7)), np.zeros(1, dtype=np.int64)
        sight = SightArrays(place, b.camera[self.block : self.block + 1], R, t, x[None].copy(), b.uv[mine], b.W[mine])
        rows(s.lenses, sight, A, np.zeros(1), np.zeros(1))
        return A[0], C

    def _by_keys(self, A: FloatArray, C: FloatArray) -> list[FloatArray]:
        b = self.batch
        out = {key: np.zeros((2, b.unknowns.by_key[key].dim)) for key in self.keys}
        for p in self.lens:
            out[p.key][:, p.within : p.within + p.n] += p.factor * A[:, p.first : p.first + p.n]
        by_pose = A[:, MAX_LENS : MAX_LENS + 6]
        for slot, by_link in zip(b.chains.slots(self.block), C, strict=True):
            for key, J in b.state.by_keys(slot, by_link):
                out[key] += by_pose @ J
        if self.point_key is not None:
            out[self.point_key] += A[:, MAX_LENS + 3 : MAX_LENS + 6]
        return list(out.values())
