"""Networks of 10^2 to 10^5 stations joined by measured relative poses or rotations.

Their pairs as arrays, a start from averaged rotations, the one graph solved over them, whom to suspect among them,
their loops, and a session for networks that grow. Misclosures and the condition form are in :mod:`adjust.relay`.
"""

from adjust.pose_network.network import PoseNetwork, pose_network
from adjust.pose_network.solution import NetworkSolution, solve_network
from adjust.pose_network.solve import NetworkOptions

__all__ = ["NetworkOptions", "NetworkSolution", "PoseNetwork", "pose_network", "solve_network"]
