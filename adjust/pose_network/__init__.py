"""Networks of 10^2 to 10^5 stations joined by measured relative poses or rotations.

Their pairs as arrays, a start from averaged rotations, the one graph solved over them, whom to suspect among them, and
their loops. Misclosures, the condition form and networks that grow are in :mod:`adjust.relay`.
"""

from adjust.pose_network.network import PoseNetwork
from adjust.pose_network.solve import NetworkOptions

__all__ = ["NetworkOptions", "PoseNetwork"]
