"""What eyes observed, as frozen values: poses before targets, motions between epochs, targets known to each other."""

from dataclasses import dataclass

from gtsam import Pose3

from adjust.model.observations import FrameRef
from adjust.model.survey import FloatArray
from adjust.spatial.rigid_motions import Motions


@dataclass(frozen=True, eq=False)
class PoseSequence:
    """Poses of one eye in the world that it watches: n epochs.

    world_ids: (n,) name of the frame each pose refers to, a target or the eye's own start. world_from_eye: (n,).
    cov: (n, 6, 6) in the tangents on the right (frame of the eye), or the joint one (6n, 6n), as from one adjustment.
    """

    eye: FrameRef
    epoch_ids: tuple[str, ...]
    world_ids: tuple[str, ...]
    world_from_eye: Motions
    cov: FloatArray


@dataclass(frozen=True, eq=False)
class MotionSequence:
    """Motions ``before_from_after`` of one eye over n intervals, independent of each other; cov: (n, 6, 6)."""

    eye: FrameRef
    interval_ids: tuple[str, ...]
    before_from_after: Motions
    cov: FloatArray


@dataclass(frozen=True, eq=False)
class KnownWorlds:
    """Two targets known to each other: ``a_from_b`` with covariance (6, 6) in frame b, by the names of the worlds."""

    a_id: str
    b_id: str
    a_from_b: Pose3
    cov: FloatArray
