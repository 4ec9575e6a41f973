"""The chordal cost of SE-Sync (Rosen, Carlone, Bandeira and Leonard, IJRR 2019, problem 1), for comparison with it.

f = sum kappa |R_a - R_b R_ba|_F^2 + tau |t_a - t_b - R_b t_ba|^2 over the measured ``b_from_a``, with one kappa and tau
per pair from the blocks of its information: tau = 3 / tr(info_t^-1), kappa = 3 / (2 tr(info_R^-1)). For small residuals
and isotropic covariances f is v'Pv.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.model.survey import FloatArray
from adjust.pose_network.network import PoseNetwork, check_determined
from adjust.pose_network.start import find_network_start
from adjust.relay.motions import Motions
from adjust.spatial.rigid import skew

_GENERATORS = skew(np.eye(3))


@dataclass(frozen=True, eq=False)
class ChordalMinimum:
    """Minimum of the chordal cost: poses (N, 3, 3), (N, 3) m, cost, steps, Newton decrement of the last step."""

    rotations: FloatArray
    translations: FloatArray
    cost: float
    iterations: int
    max_step: float


def chordal_weights(network: PoseNetwork) -> tuple[FloatArray, FloatArray]:
    """The weights kappa (E,) and tau (E,). Raises SurveyError for pairs without translation."""
    if not network.is_pose.all():
        pair = network.pair_ids[int(np.argmin(network.is_pose))]
        raise SurveyError(f"pair {pair!r} is a rotation only; the chordal cost is that of poses")
    info = np.linalg.inv(network.cov)
    kappa = 1.5 / np.trace(np.linalg.inv(info[:, :3, :3]), axis1=1, axis2=2)
    tau = 3.0 / np.trace(np.linalg.inv(info[:, 3:, 3:]), axis1=1, axis2=2)
    return kappa, tau


def chordal_cost(network: PoseNetwork, rotations: FloatArray, translations: FloatArray) -> float:
    """The cost at these poses (N, 3, 3), (N, 3) over the pairs in use."""
    kappa, tau = chordal_weights(network)
    use, a, b = network.used, network.a_idx, network.b_idx
    turn = rotations[a] - rotations[b] @ network.rotations
    shift = translations[a] - translations[b] - np.einsum("nij,nj->ni", rotations[b], network.translations)
    return float(np.sum((kappa * (turn**2).sum(axis=(1, 2)) + tau * (shift**2).sum(axis=1))[use]))


def minimize_chordal(
    network: PoseNetwork, start: tuple[FloatArray, FloatArray] | None = None, max_iterations: int = 200
) -> ChordalMinimum:
    """Minimise exactly this cost by Gauss-Newton from a start or from nothing; one station keeps its place.

    Raises NotConvergedError.
    """
    check_determined(network)
    R, t = find_network_start(network) if start is None else start
    here = Motions(R, t)
    cost = chordal_cost(network, R, t)
    free = np.flatnonzero(~network.constants)
    ordering: gtsam.Ordering | None = None
    damping = 0.0
    for iteration in range(1, max_iterations + 1):
        linear, ordering = _linear(network, here, damping, ordering)
        delta = linear.optimize(ordering)
        decrement = float(np.sqrt(max(0.0, -delta.dot(linear.gradientAtZero()))))
        step = np.zeros((network.n_stations, 6))
        step[free] = delta.vector().reshape(-1, 6)
        trial = here.retract(step)
        new = chordal_cost(network, trial.rotation, _translation(trial))
        if new <= cost * (1.0 + 1e-13) or decrement < 1e-7 * np.sqrt(max(cost, 1e-12)):
            here, cost, damping = trial, new, damping / 10.0 if damping > 1e-6 else 0.0
            if damping == 0.0 and decrement < 1e-6 * np.sqrt(max(cost, 1e-12)):
                return ChordalMinimum(here.rotation, _translation(here), cost, iteration, decrement)
        else:
            damping = max(10.0 * damping, 1e-5)
    raise NotConvergedError(f"the chordal cost did not settle in {max_iterations} steps (f = {cost:.6g})")


def _translation(motions: Motions) -> FloatArray:
    if motions.translation is None:
        raise ValueError("chordal costs are of poses")
    return motions.translation


def _rows(network: PoseNetwork, here: Motions) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (E, 12) and derivatives (E, 12, 6) by b and by a, weighted, turned into the frames of the pair."""
    kappa, tau = chordal_weights(network)
    R, t = here.rotation, _translation(here)
    a, b = network.a_idx, network.b_idx
    back = np.swapaxes(R[b], 1, 2)
    M = np.swapaxes(R[a], 1, 2) @ R[b] @ network.rotations
    arm = np.einsum("nij,nj->ni", back, t[a] - t[b])
    n = network.n_pairs
    residual = np.zeros((n, 12))
    by_a, by_b = np.zeros((2, n, 12, 6))
    residual[:, :9] = (np.eye(3) - M).reshape(n, 9)
    for k in range(3):
        by_a[:, :9, k] = (_GENERATORS[k] @ M).reshape(n, 9)
        turned = np.swapaxes(network.rotations, 1, 2) @ _GENERATORS[k] @ network.rotations
        by_b[:, :9, k] = -(M @ turned).reshape(n, 9)
    residual[:, 9:] = arm - network.translations
    by_a[:, 9:, 3:] = back @ R[a]
    by_b[:, 9:, 3:] = -np.eye(3)
    by_b[:, 9:, :3] = skew(arm)
    root = np.repeat(np.sqrt(np.stack([kappa, tau], axis=1)), [9, 3], axis=1)
    return residual * root, by_b * root[:, :, None], by_a * root[:, :, None]


def _linear(
    network: PoseNetwork, here: Motions, damping: float, ordering: gtsam.Ordering | None
) -> tuple[gtsam.GaussianFactorGraph, gtsam.Ordering]:
    residual, by_b, by_a = _rows(network, here)
    fixed, graph = network.constants, gtsam.GaussianFactorGraph()
    unit, diagonal = gtsam.noiseModel.Unit.Create(12), np.zeros((network.n_stations, 6))
    near: set[int] = set()
    for e in np.flatnonzero(network.used).tolist():
        a, b = int(network.a_idx[e]), int(network.b_idx[e])
        if fixed[a] or fixed[b]:
            if not (fixed[a] and fixed[b]):
                key, J = (a, by_a[e]) if fixed[b] else (b, by_b[e])
                graph.add(gtsam.JacobianFactor(key, J, -residual[e], unit))
                near.add(key)
        else:
            graph.add(gtsam.JacobianFactor(b, by_b[e], a, by_a[e], -residual[e], unit))
    if damping > 0.0:
        np.add.at(diagonal, network.a_idx, (by_a**2).sum(axis=1))
        np.add.at(diagonal, network.b_idx, (by_b**2).sum(axis=1))
        six = gtsam.noiseModel.Unit.Create(6)
        for i in np.flatnonzero(~fixed).tolist():
            graph.add(gtsam.JacobianFactor(i, np.diag(np.sqrt(damping * diagonal[i])), np.zeros(6), six))
    if ordering is None:
        ordering = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(graph, sorted(near))
    return graph, ordering
