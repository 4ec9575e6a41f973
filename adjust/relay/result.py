"""What the adjustment of a relay network gives back, the same for both forms."""

from collections.abc import Callable, Sequence

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.observations.pair_arrays import whitening
from adjust.observations.pairs import pair_tests
from adjust.relay.network import MeasuredPairs
from adjust.spatial.rigid_motions import Motions, right_jacobian_inverse

# joint covariance of adjusted pairs by their positions
Joint = Callable[[Sequence[int]], FloatArray]

# eigenvalues of a residual's cofactors (1 where others control it fully) below which it is not tested
_UNCONTROLLED = 1e-9


@frozen(eq=False)
class AdjustedPairs:
    """Adjusted pairs with their statistics (Baarda 1968), a priori sigma0 = 1.

    b_from_a: adjusted. residual: (E, dim) Log(measured^-1 adjusted), in frame a. cov: (E, dim, dim) of the adjusted
    pairs in their tangents. redundancy: (E, dim) numbers of the whitened components. standardized: (E, dim) residuals
    over their own sigmas (nan where uncontrolled). test, freedom, p_value: (E,) of the whole pair, nan where no loop
    controls it. omega: v'Pv. redundancy_total: equations of the independent conditions.
    joint: covariance of several adjusted pairs (k dim, k dim), by their positions.
    """

    network: MeasuredPairs
    b_from_a: Motions
    residual: FloatArray
    cov: FloatArray
    redundancy: FloatArray
    standardized: FloatArray
    test: FloatArray
    freedom: IntArray
    p_value: FloatArray
    omega: float
    redundancy_total: int
    iterations: int
    joint: Joint

    @property
    def sigma0(self) -> float:
        """A posteriori standard deviation of unit weight, nan without redundancy."""
        return float(np.sqrt(self.omega / self.redundancy_total)) if self.redundancy_total else float("nan")


def adjusted_pairs(
    network: MeasuredPairs, b_from_a: Motions, cov: FloatArray, redundancy_total: int, iterations: int,
    joint: Joint,
) -> AdjustedPairs:  # fmt: skip
    """The statistics that follow from the adjusted pairs and their covariances: Q_vv = Q_ll - Q_adjusted."""
    v = (network.b_from_a.inverse() @ b_from_a).log()
    back = right_jacobian_inverse(v)
    root = whitening(network.cov)
    e = (root @ v[..., None])[..., 0]
    to_white = root @ back
    Q = np.eye(network.dim) - to_white @ cov @ np.swapaxes(to_white, -1, -2)
    Q = 0.5 * (Q + np.swapaxes(Q, -1, -2))
    with np.errstate(divide="ignore", invalid="ignore"):
        unwhiten = np.linalg.inv(root)
        own = np.sqrt(np.maximum(np.einsum("eij,ejk,eik->ei", unwhiten, Q, unwhiten), 0.0))
        sigma = np.sqrt(np.diagonal(network.cov, axis1=1, axis2=2))
        standardized = np.where(own > np.sqrt(_UNCONTROLLED) * sigma, v / own, np.nan)
    return AdjustedPairs(
        network, b_from_a, v, cov, np.diagonal(Q, axis1=1, axis2=2).copy(), standardized,
        *pair_tests(Q, e, _UNCONTROLLED), float(np.sum(e * e)), redundancy_total, iterations, joint,
    )  # fmt: skip
