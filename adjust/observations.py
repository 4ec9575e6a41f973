"""What was observed: values with their covariance and the group they belong to, as frozen values."""

from dataclasses import dataclass
from typing import Literal

from gtsam import Pose3, Rot3

from adjust.model import BoolArray, FloatArray, IntArray

FrameKind = Literal["world", "station", "camera", "target", "table"]


@dataclass(frozen=True)
class FrameRef:
    """A frame by name; ``epoch_id`` where the frame moves."""

    kind: FrameKind
    frame_id: str = ""
    epoch_id: str | None = None


@dataclass(frozen=True)
class PositionRef:
    """A position: a world point (``point_id`` alone), a point of a target, or the origin of a frame."""

    point_id: str | None = None
    frame: FrameRef | None = None


@dataclass(frozen=True, eq=False)
class ImageBlock:
    """The image points that one camera saw of one target (or of the world's points) at one epoch.

    target_id: None for world points. point_idx: (n,) positions in the target's ``point_ids`` or in ``Survey.points``.
    uv: (n, 2) px. cov: (n, 2, 2) px^2. used: (n,) or None for all; the others are predicted and tested only.
    """

    camera_id: str
    epoch_id: str
    target_id: str | None
    point_idx: IntArray
    uv: FloatArray
    cov: FloatArray
    used: BoolArray | None = None
    group: str = "image"


@dataclass(frozen=True, eq=False)
class TableReading:
    """Angles (k,) rad read off a table's axes at an epoch, with covariance (k, k)."""

    table_id: str
    epoch_id: str
    angles: FloatArray
    cov: FloatArray
    group: str = "table"


@dataclass(frozen=True, eq=False)
class Pair:
    """A measured ``b_from_a``: a pose with covariance (6, 6), or a rotation with covariance (3, 3)."""

    pair_id: str
    a: FrameRef
    b: FrameRef
    b_from_a: Pose3 | Rot3
    cov: FloatArray
    group: str = "pair"
    used: bool = True


@dataclass(frozen=True)
class Distance:
    """A distance in m between two positions (caliper, tape, laser)."""

    distance_id: str
    a: PositionRef
    b: PositionRef
    value: float
    sigma: float
    group: str = "distance"
    used: bool = True


@dataclass(frozen=True, eq=False)
class Coordinates:
    """World coordinates (n, 3) m of n positions, with their joint covariance (3n, 3n)."""

    positions: tuple[PositionRef, ...]
    values: FloatArray
    cov: FloatArray
    group: str = "coordinates"
    used: bool = True
