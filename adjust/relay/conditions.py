"""The condition form: one unknown per measured pair, its measurement with covariance, and loops that must close.

Minimise the sum of ``r_e' C_e^-1 r_e``, ``r_e = Log(measured_e^-1 X_e)``, under the independent loop closures
(Chao et al. 2011, eqs. 26-30, here with three or six equations a loop and the rigorous total residuals). At X the
tangent's cofactors are Q_e = Jr C_e Jr', and with misclosures w and their derivatives B

    N = B Q B',   lambda = N^-1 (w - B r),   d = -r - Q B' lambda,   cov = Q - Q B' N^-1 B Q

(Koch 1999, section 3.2; Jr(r) r = r). At a fixed point the loops close and r = -Q B' lambda, so it is the constrained
minimum, the same as that by the poses of the stations in the one graph.

As a graph of GTSAM: a prior factor per pair, a hard closure factor per loop, and our own loop. GTSAM's optimisers stop
on such graphs without a word, and its elimination takes the constraints in an order that knows nothing of their size,
so it loses them in large sets: the loop here takes full steps, checks the closure itself, and refuses more loops than
were found safe.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import gtsam
import numpy as np

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.observations.factors import Jacobians, custom
from adjust.observations.pair_arrays import whitening
from adjust.pose_network.cycles import connected_parts
from adjust.pose_network.loops import Loops, evaluate_loops, loop_vectors
from adjust.relay.loops import LoopBasis, loop_basis, loop_misclosures
from adjust.relay.network import MeasuredPairs, gtsam_motion, prior_factor, station_values
from adjust.relay.normal_equations import NormalEquations, SparseNormals, TreeNormals, joint_covariance
from adjust.relay.result import AdjustedPairs, adjusted_pairs
from adjust.spatial.rigid_motions import Motions, right_jacobian

# complete networks were exact far beyond; grids of loops went wrong from about 300 on
MAX_HARD_LOOPS = 200
# side of the dense matrix that the spanning tree's way may need
MAX_TREE_SIDE = 3000


@frozen
class ConditionOptions:
    """When to stop, and which loops.

    closure: largest misclosure allowed at the end, rad, and m per m of the longest pair. max_step: last correction, in
    sigmas of the measured pairs. loops: ``auto`` takes a spanning tree's in dense networks, else the shortest.
    """

    closure: float = 1e-12
    max_step: float = 1e-8
    max_iterations: int = 50
    loops: Literal["auto", "shortest", "tree"] = "auto"


@frozen(eq=False)
class ConditionAdjustment:
    """pairs: adjusted pairs and statistics. basis: the loops used. closure: the largest misclosure left."""

    pairs: AdjustedPairs
    basis: LoopBasis
    closure: float


def adjust_conditions(network: MeasuredPairs, options: ConditionOptions = ConditionOptions()) -> ConditionAdjustment:
    """Adjust by the normal equations of the conditions; any size, connected or not.

    Raises NotConvergedError, naming the loop that closes worst.
    """
    basis = loop_basis(network.topology, _loop_kind(network, options))

    def step(X: Motions) -> FloatArray:
        at = _Linearised(network, basis, X)
        B, Q = at.normals.B, at.normals.Q
        multipliers = at.normals.solve(at.w.ravel() - B @ at.r.ravel())
        return np.asarray(-at.r - (Q @ (B.T @ multipliers).reshape(*at.r.shape, 1))[..., 0])

    def advice() -> str:
        worst = loop_misclosures(network)
        return f"look for a wrong pair in {worst.text(int(np.argmax(worst.test)))}"

    X, closure, iterations = _closed(network, basis, options, step, advice)
    at = _Linearised(network, basis, X)
    cov = at.normals.adjusted_covariances()
    pairs = adjusted_pairs(network, X, cov, network.dim * len(basis), iterations, at.joint)
    return ConditionAdjustment(pairs, basis, closure)


def adjust_condition_factors(
    network: MeasuredPairs, options: ConditionOptions = ConditionOptions()
) -> ConditionAdjustment:
    """The same by GTSAM: a prior per pair and a hard closure factor per loop; for small sets of loops.

    Raises SurveyError for more loops than GTSAM eliminates safely, NotConvergedError where they do not close.
    """
    basis = loop_basis(network.topology, _loop_kind(network, options))
    if len(basis) > MAX_HARD_LOOPS:
        raise SurveyError(
            f"{len(basis)} loops are too many hard constraints (at most {MAX_HARD_LOOPS}); use the normal equations of "
            "the conditions, or the parametric form"
        )
    graph, every = condition_graph(network, basis), range(network.topology.n_pairs)

    def step(X: Motions) -> FloatArray:
        delta = graph.linearize(station_values(X)).optimize()
        return np.array([delta.at(e) for e in every])

    def advice() -> str:
        return "use the normal equations of the conditions, which name the loop that closes worst"

    X, closure, iterations = _closed(network, basis, options, step, advice)
    marginals = gtsam.Marginals(graph, station_values(X))
    cov = np.array([marginals.marginalCovariance(e) for e in every])
    # GTSAM's own joint covariance inverts an information matrix, which pairs that close a loop do not have
    joint = _Linearised(network, basis, X).joint
    return ConditionAdjustment(
        adjusted_pairs(network, X, cov, network.dim * len(basis), iterations, joint), basis, closure
    )


def adjust_loops(network: MeasuredPairs) -> ConditionAdjustment:
    """By GTSAM's graph of priors and hard closures where that is safe, else by the normal equations; any size.

    Safe: few enough loops, all of them closed, and redundancy numbers that sum to the equations, which constraints lost
    in the elimination would not do. Raises NotConvergedError, naming the loop that closes worst.
    """
    top = network.topology
    n_parts = int(connected_parts(top.n_stations, top.a_idx, top.b_idx).max(initial=-1)) + 1
    if top.n_pairs - top.n_stations + n_parts <= MAX_HARD_LOOPS:
        try:
            found = adjust_condition_factors(network)
        except NotConvergedError:
            return adjust_conditions(network)
        except RuntimeError as error:
            if "ndetermin" not in str(error):
                raise
            return adjust_conditions(network)
        total = found.pairs.redundancy_total
        if abs(float(found.pairs.redundancy.sum()) - total) < 1e-6 * max(1, total):
            return found
    return adjust_conditions(network)


def _loop_kind(network: MeasuredPairs, options: ConditionOptions) -> Literal["shortest", "tree"]:
    if options.loops != "auto":
        return options.loops
    top = network.topology
    side = top.n_stations * network.dim
    # plane grids have two pairs a station and stay sparse; with more, short loops overlap too much
    dense = 2 * top.n_pairs > 5 * top.n_stations and side <= MAX_TREE_SIDE
    return "tree" if dense else "shortest"


def _reach(network: MeasuredPairs) -> float:
    """The longest pair, m."""
    t = network.b_from_a.translation
    return 0.0 if t is None or not len(t) else float(np.linalg.norm(t, axis=1).max())


class _Linearised:
    """Misclosures w, residuals r and the normal equations of the conditions, at pairs X."""

    def __init__(self, network: MeasuredPairs, basis: LoopBasis, X: Motions) -> None:
        self.w, blocks = evaluate_loops(basis, X)
        self.r = (network.b_from_a.inverse() @ X).log()
        forward = right_jacobian(self.r)
        Q = forward @ network.cov @ np.swapaxes(forward, -1, -2)
        by_tree = basis.tree is not None and 2 * len(basis) > len(np.unique(basis.pair_idx))
        self.normals: NormalEquations = (TreeNormals if by_tree else SparseNormals)(basis, blocks, Q)

    def joint(self, pair_idx: Sequence[int]) -> FloatArray:
        """Joint covariance of some adjusted pairs, stacked."""
        return joint_covariance(self.normals, pair_idx)


def _closed(
    network: MeasuredPairs, basis: LoopBasis, options: ConditionOptions, step: Callable[[Motions], FloatArray],
    advice: Callable[[], str],
) -> tuple[Motions, float, int]:  # fmt: skip
    """Full Gauss-Newton steps until all loops close and nothing moves; the largest misclosure left, and how many."""
    limit, root = options.closure * max(1.0, _reach(network)), whitening(network.cov)
    X, moved, closure = network.b_from_a, np.inf, np.inf
    for iteration in range(1, options.max_iterations + 1):
        d = step(X)
        X = X.retract(d)
        moved = float(np.abs(root @ d[..., None]).max())
        closure = float(np.abs(loop_vectors(basis, X)).max()) if len(basis) else 0.0
        if not np.isfinite(moved):
            break
        if closure < limit and moved < options.max_step:
            return X, closure, iteration
    raise NotConvergedError(
        f"the loops do not close after {options.max_iterations} steps (misclosure left {closure:.2g}, last step "
        f"{moved:.2g} sigma); {advice()}"
    )


# -- the conditions as factors of GTSAM's graph -----------------------------------------------------------------------


def condition_graph(network: MeasuredPairs, basis: LoopBasis) -> gtsam.NonlinearFactorGraph:
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
    alone = Loops(np.array([0, n]), np.arange(n), basis.sense[rows], basis.start_idx[loop : loop + 1])

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        if dim == 3:
            motions = Motions(np.array([values.atRot3(key).matrix() for key in keys]))
        else:
            poses = [values.atPose3(key) for key in keys]
            motions = Motions(
                np.array([p.rotation().matrix() for p in poses]), np.array([p.translation() for p in poses])
            )
        w, blocks = evaluate_loops(alone, motions)
        return w[0], list(zip(keys, blocks, strict=True))

    return custom(keys, gtsam.noiseModel.Constrained.All(dim), residual)
