"""Whom to suspect among measured pairs: graduated non-convexity over chordal solutions, which need no start.

Rotations first, then positions, with the truncated least squares weights of Yang, Antonante, Tzoumas and Carlone
(Graduated non-convexity for robust spatial perception, RA-L 2020). What that sorts out is only a proposal: tests decide
(:mod:`adjust.statistics.outliers.search`).
"""

from collections.abc import Callable

import numpy as np

from adjust.model.survey import BoolArray, FloatArray
from adjust.pose_network.network import PoseNetwork
from adjust.pose_network.solve import minimize
from adjust.pose_network.start import (
    find_network_start,
    rotation_residuals,
    start_rotations,
    start_translations,
    translation_misfits,
    translation_sigmas,
)
from adjust.spatial.rigid_motions import Motions
from adjust.testing.criteria import MANY, limits, typical_factor
from adjust.testing.distributions import chi2

_TRUNCATION = float(chi2.isf(1e-4, 3))
_SLACK = 4.0  # positions inherit what is left in the rotations of the first stage
_LEAST = 1e-6  # pairs that are sorted out keep this weight, so that the network holds together
_GROWTH = 2.0
_PLAINLY = 25.0
_BACK = 5


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


def graduated_start(
    network: PoseNetwork, weights: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """``world_from_station`` (N, 3, 3), (N, 3) from the pairs that agree with each other; weights: where known."""
    weights = graduated_weights(network) if weights is None else weights
    return find_network_start(network, np.maximum(weights, _LEAST))


def plainly_contradictory(network: PoseNetwork) -> bool:
    """Whether a few of many pairs miss averaged rotations and linear positions by so much more than the typical one."""
    rows = np.flatnonzero(network.used)
    if len(rows) < MANY:
        return False
    squares, freedom = _squares(network, *find_network_start(network))[rows], network.sizes[rows]
    return bool(squares.mean() > _PLAINLY * freedom.mean() * max(1.0, typical_factor(squares, freedom)))


def _squares(network: PoseNetwork, R: FloatArray, t: FloatArray) -> FloatArray:
    """Whitened squares (E,) of all pairs with the stations there."""
    rotations_only = network.rotation_only
    here, measured = Motions(R, None if rotations_only else t), network.arrays.motions
    measured = Motions(measured.rotation) if rotations_only else measured
    residual = (measured.inverse() @ here[network.b_idx].inverse() @ here[network.a_idx]).log()
    return np.asarray(np.square(np.einsum("nij,nj->ni", network.whitening, residual)).sum(axis=1))


def disagreeing(
    network: PoseNetwork, family_alpha: float, factor: float = 1.0
) -> tuple[BoolArray, tuple[FloatArray, FloatArray]]:
    """Pairs (E,) in use that do not agree with the others, and can all go at once; the solution of the others.

    Graduated non-convexity sorts out; from the least squares of the rest all that fits comes back, for a square of the
    residual that does not reach the limit of a test cannot fail it. factor: of all variances.
    """
    weights = graduated_weights(network, factor)
    used, at = _connected(network, weights), graduated_start(network, weights)
    limit = limits(family_alpha, network.sizes, int(network.used.sum()))
    for _ in range(_BACK):
        found = minimize(network.with_used(used), at)
        at = found.rotations, found.translations
        squares = _squares(network, *at)
        typical = typical_factor(squares[used], network.sizes[used]) if used.sum() >= MANY else 1.0
        back = network.used & ~used & (squares <= max(factor, typical) * limit)
        if not back.any():
            break
        used |= back
    return network.used & ~used, at


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
