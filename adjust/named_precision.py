"""The covariances of a survey that was solved as a pose network, by the names of its parameters."""

from typing import TYPE_CHECKING

from adjust.model import FloatArray
from adjust.result import ParameterName

if TYPE_CHECKING:
    from adjust.pose_network.solution import NetworkSolution


class NamedPrecision:
    """Joint covariances of stations by parameter name."""

    def __init__(self, solution: "NetworkSolution") -> None:
        self.solution = solution

    def joint(self, names: list[ParameterName]) -> FloatArray:
        """Covariance (k dim, k dim) of ``("world_from_station", id)`` names, stacked in this order."""
        index = self.solution.network.index_of
        return self.solution.precision.joint([index[name[1]] for name in names])
