"""Navigation: the pose of a calibrated head from beacons, epoch by epoch, with covariance."""

from adjust.navigation.head import head_and_beacons, head_of
from adjust.navigation.model import (
    Beacons,
    EpochPose,
    Head,
    HeadCamera,
    HeadTable,
    Motion,
    NavigateOptions,
    NavigationEpoch,
    PosePrior,
    Shares,
    Solution,
    Spots,
    Trajectory,
)
from adjust.navigation.precision import Expected, expected_precision
from adjust.navigation.sequence import navigate

__all__ = [
    "Beacons",
    "EpochPose",
    "Expected",
    "Head",
    "HeadCamera",
    "HeadTable",
    "Motion",
    "NavigateOptions",
    "NavigationEpoch",
    "PosePrior",
    "Shares",
    "Solution",
    "Spots",
    "Trajectory",
    "expected_precision",
    "head_and_beacons",
    "head_of",
    "navigate",
]
