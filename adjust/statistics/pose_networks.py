"""Pairs and priors of a survey that was solved as a pose network, whitened as its precision knows them."""

import numpy as np

from adjust.frames.unknowns import POSE_COMPONENTS
from adjust.model.result import Adjustment
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.precision.pose_networks import NamedPrecision

Whitening = tuple[IntArray, FloatArray, FloatArray, FloatArray, BoolArray]
"""Numbers (n,) among the other residuals, whitened residuals (n, k) and A Q A' (n, k, k), W (n, k, k), used (n,)."""


def network_whitening(adjustment: Adjustment, precision: NamedPrecision) -> list[Whitening]:
    """Rotations, poses and priors, those with the same number of components together."""
    solution = precision.solution
    network, stats = solution.network, solution.precision.pairs
    out = []
    n_pairs = len(adjustment.survey.pairs)
    kind = np.asarray(network.is_pose, dtype=np.bool_)
    for k, rows in ((6, np.flatnonzero(kind)), (3, np.flatnonzero(~kind))):
        if len(rows):
            W = _roots(network.cov[rows, :k, :k])
            e = np.einsum("nij,nj->ni", W, stats.residual[rows, :k])
            M = W @ stats.adjusted_cov[rows, :k, :k] @ W.transpose(0, 2, 1)
            out.append((rows, e, M, W, np.asarray(network.used[rows], dtype=np.bool_)))
    for i, o in enumerate(adjustment.other_residuals[n_pairs:]):
        station = network.index_of[o.ids[1]]
        known = [POSE_COMPONENTS.index(c) for c in o.components]
        Q = solution.precision.joint([station])[np.ix_(known, known)]
        W = _roots(network.prior_cov[station][np.ix_(known, known)][None])
        e = (W[0] @ o.residual)[None]
        out.append((np.array([n_pairs + i]), e, W @ Q[None] @ W.transpose(0, 2, 1), W, np.ones(1, dtype=np.bool_)))
    return out


def _roots(cov: FloatArray) -> FloatArray:
    """Square root information (n, k, k), upper triangular."""
    return np.asarray(np.linalg.cholesky(np.linalg.inv(cov)).transpose(0, 2, 1))
