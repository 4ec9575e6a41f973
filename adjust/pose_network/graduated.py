"""Whom to suspect among measured pairs: graduated non-convexity over chordal solutions, which need no start.

Rotations first, then positions, with the truncated least squares weights of Yang, Antonante, Tzoumas and Carlone
(Graduated non-convexity for robust spatial perception, RA-L 2020). What that sorts out is only a proposal: tests decide
(:mod:`adjust.statistics.outliers.search`).
"""

from collections.abc import Callable

import numpy as np

from adjust.model.survey import BoolArray, FloatArray
from adjust.pose_network.network import PoseNetwork
from adjust.pose_network.start import (
    find_network_start,
    rotation_residuals,
    start_rotations,
    start_translations,
    translation_misfits,
    translation_sigmas,
)
from adjust.spatial.rigid_motions import Motions
from adjust.testing.criteria import MANY, typical_factor
from adjust.testing.distributions import chi2

_TRUNCATION = float(chi2.isf(1e-4, 3))
_SLACK = 4.0  # positions inherit what is left in the rotations of the first stage
_LEAST = 1e-6  # pairs that are sorted out keep this weight, so that the network holds together
_GROWTH = 2.0
_PLAINLY = 25.0


def _graduated(
    network: PoseNetwork, fit: Callable[[FloatArray], FloatArray], c2: float, weights: FloatArray
) -> FloatArray:
    """Weights (E,) after graduated non-convexity; ``fit`` gives the squared misfits (E,) of a weighted solution."""
    rows = network.used & (weights > 0.5)
    r2 = fit(np.maximum(weights, _LEAST))
    worst = float(r2[rows].max(initial=0.0))
    if 2.0 * worst <= c2:
        return weights
    mu = c2 / (2.0 * worst - c2)
    while True:
        with np.errstate(divide="ignore"):
            middle = np.sqrt(c2 * mu * (mu + 1.0) / np.maximum(r2, 1e-300)) - mu
        new = np.where(r2 >= (mu + 1.0) / mu * c2, 0.0, np.where(r2 <= mu / (mu + 1.0) * c2, 1.0, middle))
        new = np.where(rows, new, 0.0)
        if mu > 1e3 or (mu > 1.0 and not np.any((new > 0.01) & (new < 0.99))):
            return new
        mu *= _GROWTH
        r2 = fit(np.maximum(new, _LEAST))


def graduated_weights(network: PoseNetwork, factor: float = 1.0) -> FloatArray:
    """1 for the pairs (E,) that agree on rotations and positions, 0 for the others. factor: of all variances."""
    info = np.linalg.inv(network.cov[:, :3, :3])

    def rotations(weights: FloatArray) -> FloatArray:
        R = start_rotations(network, weights)
        e = rotation_residuals(network, R)
        return np.asarray(np.einsum("ni,nij,nj->n", e, info, e))

    weights = _graduated(network, rotations, factor * _TRUNCATION, network.used.astype(float))
    if not network.is_pose.any():
        return weights
    R = start_rotations(network, np.maximum(weights, _LEAST))
    sigma = translation_sigmas(network)

    def positions(w: FloatArray) -> FloatArray:
        t = start_translations(network, R, w)
        return np.asarray((translation_misfits(network, R, t) / sigma) ** 2)

    return _graduated(network, positions, factor * _SLACK * _TRUNCATION, weights)


def graduated_start(network: PoseNetwork) -> tuple[FloatArray, FloatArray]:
    """``world_from_station`` (N, 3, 3), (N, 3) from the pairs that agree with each other."""
    return find_network_start(network, np.maximum(graduated_weights(network), _LEAST))


def plainly_contradictory(network: PoseNetwork) -> bool:
    """Whether a few of many pairs miss averaged rotations and linear positions by so much more than the typical one."""
    rows = np.flatnonzero(network.used)
    if len(rows) < MANY:
        return False
    R, t = find_network_start(network)
    d, here = network.dim, Motions(R, None if network.rotation_only else t)
    measured = network.arrays.motions
    measured = measured if d == 6 else Motions(measured.rotation)
    residual = (measured.inverse() @ here[network.b_idx].inverse() @ here[network.a_idx]).log()
    squares = np.square(np.einsum("nij,nj->ni", network.whitening, residual)[rows]).sum(axis=1)
    freedom = np.where(network.is_pose, 6, 3)[rows]
    return bool(squares.mean() > _PLAINLY * freedom.mean() * max(1.0, typical_factor(squares, freedom)))


def suspected_pairs(network: PoseNetwork, factor: float = 1.0) -> BoolArray:
    """Pairs (E,) in use that do not agree with the others, and can all go at once. factor: of all variances."""
    return network.used & ~_connected(network, graduated_weights(network, factor))


def _connected(network: PoseNetwork, weights: FloatArray) -> BoolArray:
    """The pairs of weight above one half, and of the others as many as hold the network together."""
    used = network.used & (weights > 0.5)
    for poses_only in (False, True):
        part = network.components(used, poses_only)
        if part.max(initial=0) == 0:
            continue
        whole = network.components(network.used, poses_only)
        for e in np.flatnonzero(network.used & ~used):
            if poses_only and not network.is_pose[e]:
                continue
            a, b = part[network.a_idx[e]], part[network.b_idx[e]]
            if a != b and whole[network.a_idx[e]] == whole[network.b_idx[e]]:
                used[e] = True
                part[part == b] = a
    return used
