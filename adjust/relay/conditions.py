"""The condition form: one unknown per measured pair, its measurement with covariance, and loops that must close.

Minimise the sum of ``r_e' C_e^-1 r_e``, ``r_e = Log(measured_e^-1 X_e)``, under the independent loop closures
(Chao et al. 2011, eqs. 26-30, here with three or six equations a loop and the rigorous total residuals). At X the
tangent's cofactors are Q_e = Jr C_e Jr', and with misclosures w and their derivatives B

    N = B Q B',   lambda = N^-1 (w - B r),   d = -r - Q B' lambda,   cov = Q - Q B' N^-1 B Q

(Koch 1999, section 3.2; Jr(r) r = r). At a fixed point the loops close and r = -Q B' lambda, so it is the constrained
minimum, the same as that by the poses of the stations in the one graph. GTSAM eliminates hard constraints in an order
that knows nothing of their size and loses them in large sets, so the normal equations are formed here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from adjust.model.errors import NotConvergedError
from adjust.model.survey import FloatArray
from adjust.observations.pair_arrays import whitening
from adjust.pose_network.loops import evaluate_loops, loop_vectors
from adjust.relay.loops import LoopBasis, loop_basis, loop_misclosures
from adjust.relay.network import MeasuredPairs
from adjust.relay.normal_equations import (
    NormalEquations,
    SparseNormals,
    TreeNormals,
    condition_matrix,
    joint_covariance,
)
from adjust.relay.result import AdjustedPairs, adjusted_pairs
from adjust.spatial.rigid_motions import Motions, right_jacobian

# side of the dense matrix that the spanning tree's way may need
MAX_TREE_SIDE = 3000


@dataclass(frozen=True)
class ConditionOptions:
    """When to stop, and which loops.

    closure: largest misclosure allowed at the end, rad, and m per m of the longest pair. max_step: last correction, in
    sigmas of the measured pairs. loops: ``auto`` takes a spanning tree's in dense networks, else the shortest.
    """

    closure: float = 1e-12
    max_step: float = 1e-8
    max_iterations: int = 50
    loops: Literal["auto", "shortest", "tree"] = "auto"


@dataclass(frozen=True, eq=False)
class ConditionAdjustment:
    """pairs: adjusted pairs and statistics. basis: the loops used. closure: the largest misclosure left."""

    pairs: AdjustedPairs
    basis: LoopBasis
    closure: float


def adjust_conditions(network: MeasuredPairs, options: ConditionOptions = ConditionOptions()) -> ConditionAdjustment:
    """Adjust by full Gauss-Newton steps until all loops close and nothing moves; any size, connected or not.

    Raises NotConvergedError, naming the loop that closes worst.
    """
    basis = loop_basis(network.topology, _loop_kind(network, options))
    limit, root = options.closure * max(1.0, _reach(network)), whitening(network.cov)
    X, moved, closure = network.b_from_a, np.inf, np.inf
    for iteration in range(1, options.max_iterations + 1):
        d = _Linearised(network, basis, X).step()
        X = X.retract(d)
        moved = float(np.abs(root @ d[..., None]).max())
        closure = float(np.abs(loop_vectors(basis, X)).max()) if len(basis) else 0.0
        if not np.isfinite(moved):
            break
        if closure < limit and moved < options.max_step:
            at = _Linearised(network, basis, X)
            cov, total = at.normals.adjusted_covariances(), network.dim * len(basis)
            return ConditionAdjustment(adjusted_pairs(network, X, cov, total, iteration, at.joint), basis, closure)
    worst = loop_misclosures(network)
    raise NotConvergedError(
        f"the loops do not close after {options.max_iterations} steps (misclosure left {closure:.2g}, last step "
        f"{moved:.2g} sigma); look for a wrong pair in {worst.text(int(np.argmax(worst.test)))}"
    )


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
    """Misclosures w, residuals r, cofactors Q, the conditions' matrix B, and their normal equations, at pairs X."""

    def __init__(self, network: MeasuredPairs, basis: LoopBasis, X: Motions) -> None:
        self.w, blocks = evaluate_loops(basis, X)
        self.r = (network.b_from_a.inverse() @ X).log()
        forward = right_jacobian(self.r)
        self.Q = forward @ network.cov @ np.swapaxes(forward, -1, -2)
        self.B = condition_matrix(basis, blocks)
        by_tree = basis.tree is not None and 2 * len(basis) > len(np.unique(basis.pair_idx))
        self.normals: NormalEquations = (TreeNormals if by_tree else SparseNormals)(basis, blocks, self.Q)

    def step(self) -> FloatArray:
        """Of all pairs (E, dim), in their tangents."""
        multipliers = self.normals.solve(self.w.ravel() - self.B @ self.r.ravel())
        return np.asarray(-self.r - (self.Q @ (self.B.T @ multipliers).reshape(*self.r.shape, 1))[..., 0])

    def joint(self, pair_idx: Sequence[int]) -> FloatArray:
        """Joint covariance of some adjusted pairs, stacked."""
        return joint_covariance(self.normals, self.B, self.Q, pair_idx)
