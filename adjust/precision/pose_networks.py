"""The covariances of a survey that was solved as a pose network, by the names of its parameters."""

from typing import TYPE_CHECKING

import numpy as np

from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray

if TYPE_CHECKING:
    from adjust.pose_network.solution import NetworkSolution
    from adjust.relay.result import AdjustedPairs


class NamedPrecision:
    """Joint covariances of stations by parameter name. closed: the pairs in use, where they are from the conditions."""

    def __init__(self, solution: "NetworkSolution", closed: "AdjustedPairs | None" = None) -> None:
        self.solution, self.closed = solution, closed

    def pair_covariances(self) -> dict[str, FloatArray]:
        """Covariances (k, k) of the adjusted pairs by id, a priori, in the tangent in frame a."""
        network, cov = self.solution.network, self.solution.precision.pairs.adjusted_cov
        sizes = np.where(network.is_pose, 6, 3).tolist()
        out = {p: cov[e, :k, :k] for e, (p, k) in enumerate(zip(network.pair_ids, sizes, strict=True))}
        if self.closed is not None:
            out |= dict(zip(self.closed.network.topology.pair_ids, self.closed.cov, strict=True))
        return out

    def joint(self, names: list[ParameterName]) -> FloatArray:
        """Covariance (6 k, 6 k) of ``("world_from_station", id)`` names, stacked in this order.

        In networks of rotations the translations, of which nothing is known, have zeros: they are held.
        """
        network = self.solution.network
        Q = self.solution.precision.joint([network.index_of[name[1]] for name in names])
        if network.dim == 6:
            return Q
        out = np.zeros((6 * len(names),) * 2)
        rows = (6 * np.arange(len(names))[:, None] + np.arange(3)).ravel()
        out[np.ix_(rows, rows)] = Q
        return out


def rotations_only(adjustment: Adjustment) -> bool:
    """Whether nothing but rotations was measured, so that nothing is where it seems to be."""
    found = adjustment.precision
    return isinstance(found, NamedPrecision) and found.solution.network.rotation_only


def in_conditions(adjustment: Adjustment) -> bool:
    """Whether what the adjustment says of pairs is from the conditions of their loops, not from the poses of frames."""
    found = adjustment.precision
    return isinstance(found, NamedPrecision) and found.closed is not None
