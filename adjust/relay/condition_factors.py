"""The condition form as a GTSAM graph: a prior factor per pair, a hard closure factor per loop, and our own loop.

GTSAM's optimisers stop on such graphs without a word, and its elimination takes the constraints in an order that knows
nothing of their size, so it loses them in large sets: the loop here takes full steps, checks the closure itself, and
refuses more loops than were found safe.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.model.survey import FloatArray
from adjust.relay.loops import LoopBasis, evaluate_loops
from adjust.relay.motions import Motions
from adjust.relay.network import Network, gtsam_motion, motions_from_values, prior_factor, station_values
from adjust.relay.result import whitening

# complete networks were exact far beyond; grids of loops went wrong from about 300 on
MAX_HARD_LOOPS = 200


@dataclass(frozen=True, eq=False)
class FactorSolution:
    """Adjusted pairs, their covariances (E, dim, dim), the largest misclosure left."""

    b_from_a: Motions
    cov: FloatArray
    closure: float
    iterations: int


def solve_factors(
    network: Network, basis: LoopBasis, limit: float, max_step: float, max_iterations: int
) -> FactorSolution:
    """Full Gauss-Newton steps until all loops close and nothing moves. Raises SurveyError, NotConvergedError."""
    if len(basis) > MAX_HARD_LOOPS:
        raise SurveyError(
            f"{len(basis)} loops are too many hard constraints (at most {MAX_HARD_LOOPS}); use the normal equations of "
            "the conditions, or the parametric form"
        )
    graph, values = condition_graph(network, basis), station_values(network.b_from_a)
    n, dim, root = network.topology.n_pairs, network.dim, whitening(network.cov)
    step = closure = np.inf
    for iteration in range(1, max_iterations + 1):
        delta = graph.linearize(values).optimize()
        values = values.retract(delta)
        d = np.array([delta.at(e) for e in range(n)])
        X = motions_from_values(values, n, dim)
        step = float(np.abs(root @ d[..., None]).max())
        closure = float(np.abs(evaluate_loops(basis, X)[0]).max()) if len(basis) else 0.0
        if closure < limit and step < max_step:
            marginals = gtsam.Marginals(graph, values)
            cov = np.array([marginals.marginalCovariance(e) for e in range(n)])
            return FactorSolution(X, cov, closure, iteration)
        if not np.isfinite(step):
            break
    raise NotConvergedError(
        f"the hard loop closures did not settle in {max_iterations} steps (misclosure left {closure:.2g}, last step "
        f"{step:.2g} sigma); use the normal equations of the conditions, which name the loop that closes worst"
    )


def condition_graph(network: Network, basis: LoopBasis) -> gtsam.NonlinearFactorGraph:
    """Priors on the pairs (keys are their positions) and hard closures of the loops."""
    graph = gtsam.NonlinearFactorGraph()
    for e in range(network.topology.n_pairs):
        graph.add(prior_factor(e, gtsam_motion(network.b_from_a, e), network.cov[e]))
    for k in range(len(basis)):
        graph.add(_closure_factor(basis, k, network.dim))
    return graph


def _closure_factor(basis: LoopBasis, loop: int, dim: int) -> gtsam.CustomFactor:
    """The misclosure of one loop, to be zero. Its noise is a constraint, which no covariance can say."""
    rows = slice(basis.ptr[loop], basis.ptr[loop + 1])
    keys = [int(e) for e in basis.pair_idx[rows]]
    n = len(keys)
    alone = LoopBasis(
        basis.topology, np.array([0, n]), np.arange(n), basis.sense[rows], basis.start_idx[loop : loop + 1], False, ""
    )

    def call(_factor, values, jacobians):  # type: ignore[no-untyped-def]  # GTSAM's protocol, bound untyped
        if dim == 3:
            motions = Motions(np.array([values.atRot3(key).matrix() for key in keys]))
        else:
            poses = [values.atPose3(key) for key in keys]
            motions = Motions(
                np.array([p.rotation().matrix() for p in poses]), np.array([p.translation() for p in poses])
            )
        w, blocks = evaluate_loops(alone, motions)
        if jacobians is not None:
            for i in range(n):
                jacobians[i] = blocks[i]
        return w[0]

    return gtsam.CustomFactor(gtsam.noiseModel.Constrained.All(dim), keys, call)
