"""What was observed: values with their covariance and the group they belong to, as frozen values."""

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.arrays import BoolArray, FloatArray, IntArray
from adjust.model.frozen import frozen

FrameKind = Literal["world", "station", "camera", "target", "table", "mount"]
ReadingKind = Literal[
    "direction", "angle", "zenith", "azimuth", "slope_distance", "horizontal_distance", "height_difference"
]


@frozen
class FrameRef:
    """A frame by name; ``epoch_id`` where the frame moves."""

    kind: FrameKind
    frame_id: str = ""
    epoch_id: str | None = None

    @cached_property
    def text(self) -> str:
        """``kind:id@epoch``, as in the tables of the project folder; ``world``. Kept: pairs share their frames."""
        if self.kind == "world":
            return "world"
        return f"{self.kind}:{self.frame_id}" + (f"@{self.epoch_id}" if self.epoch_id else "")


@frozen
class PositionRef:
    """A position: a world point (``point_id`` alone), a point of a target, or the origin of a frame."""

    point_id: str | None = None
    frame: FrameRef | None = None


def frame_text(ref: FrameRef) -> str:
    """See :attr:`FrameRef.text`."""
    return ref.text


def position_text(ref: PositionRef) -> str:
    """A position as people write it."""
    if ref.frame is None:
        return str(ref.point_id)
    return frame_text(ref.frame) + (f"/{ref.point_id}" if ref.point_id else "")


@frozen(eq=False)
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

    @property
    def place(self) -> tuple[str, str, str | None, str]:
        """What tells it from the other blocks of a survey."""
        return self.camera_id, self.epoch_id, self.target_id, self.group

    @property
    def mask(self) -> BoolArray:
        """Which points (n,) are used."""
        return np.ones(len(self.uv), dtype=np.bool_) if self.used is None else np.asarray(self.used, dtype=np.bool_)

    @property
    def n_used(self) -> int:
        """How many are."""
        return len(self.uv) if self.used is None else int(np.count_nonzero(self.used))

    def part(self, rows: IntArray | BoolArray) -> "ImageBlock":
        """These image points of it alone."""
        used = None if self.used is None else self.used[rows]
        return replace(self, point_idx=self.point_idx[rows], uv=self.uv[rows], cov=self.cov[rows], used=used)

    def in_use(self) -> "ImageBlock":
        """Less what is predicted and tested only."""
        return self if self.used is None else replace(self.part(self.used), used=None)


@frozen(eq=False)
class ImagePoints:
    """The image points (N,) of B blocks, block after block, as :class:`ImageBlock` has them.

    ptr: (B + 1,) where each block begins.
    """

    ptr: IntArray
    point_idx: IntArray
    uv: FloatArray
    cov: FloatArray
    used: BoolArray

    @staticmethod
    def of(blocks: Sequence[ImageBlock]) -> "ImagePoints":
        """Those of blocks; put together, but where they were cut out of one table."""
        if isinstance(blocks, ImageBlocks):
            return blocks.points
        ptr = np.cumsum([0] + [len(b.uv) for b in blocks])
        point_idx = np.concatenate([np.zeros(0, dtype=np.int64), *(b.point_idx for b in blocks)])
        uv = np.concatenate([np.zeros((0, 2)), *(b.uv for b in blocks)])
        cov = np.concatenate([np.zeros((0, 2, 2)), *(b.cov for b in blocks)])
        used = np.concatenate([np.zeros(0, dtype=np.bool_), *(b.mask for b in blocks)])
        return ImagePoints(ptr, point_idx, uv, cov, used)


class ImageBlocks(tuple[ImageBlock, ...]):
    """Image blocks that were cut out of one table of image points, which goes with them."""

    points: ImagePoints

    def __new__(cls, blocks: Iterable[ImageBlock], points: ImagePoints) -> Self:
        """points: those of the blocks, in their order."""
        made = super().__new__(cls, blocks)
        made.points = points
        return made

    def __reduce__(self) -> tuple[type[Self], tuple[tuple[ImageBlock, ...], ImagePoints]]:
        """How it is copied and sent to other processes."""
        return type(self), (tuple(self), self.points)


@frozen(eq=False)
class TableReading:
    """Angles (k,) rad read off a table's axes at an epoch, with covariance (k, k); a start even if not used."""

    table_id: str
    epoch_id: str
    angles: FloatArray
    cov: FloatArray
    group: str = "table"
    used: bool = True


@frozen(eq=False)
class Pair:
    """A measured ``b_from_a``: a pose with covariance (6, 6), or a rotation with covariance (3, 3)."""

    pair_id: str
    a: FrameRef
    b: FrameRef
    b_from_a: Pose3 | Rot3
    cov: FloatArray
    group: str = "pair"
    used: bool = True


@frozen
class Closure:
    """A loop of pairs that a mechanical mount closes: only as well as the mount repeats.

    pair_ids: in the order of the walk; the mount sits at end a of the last of them. rotation_sigma (rad),
    translation_sigma (m): of the mount about and along each axis.
    """

    closure_id: str
    pair_ids: tuple[str, ...]
    rotation_sigma: float
    translation_sigma: float = 0.0

    def cov(self, dim: int) -> FloatArray:
        """Covariance (dim, dim) of the mount's play, a tangent in frame a of its pair."""
        sigma = np.repeat([self.rotation_sigma, self.translation_sigma], 3)[:dim]
        return np.diag(sigma**2)


@frozen
class Distance:
    """A distance in m between two positions (caliper, tape, laser)."""

    distance_id: str
    a: PositionRef
    b: PositionRef
    value: float
    sigma: float
    group: str = "distance"
    used: bool = True


@frozen(eq=False)
class Coordinates:
    """World coordinates (n, 3) m of n positions, with their joint covariance (3n, 3n).

    ``np.inf`` on the diagonal of cov: that coordinate was not observed (its row and column are then ignored).
    set_id: the name of the set in its table, "" for the coordinates of one position, which has its name.
    """

    positions: tuple[PositionRef, ...]
    values: FloatArray
    cov: FloatArray
    group: str = "coordinates"
    used: bool = True
    set_id: str = ""


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of a total station, theodolite, level or GNSS-free instrument, from one position to another.

    value, sigma: rad for direction, angle, zenith and azimuth; else m. Horizontal angles count as ``Survey.bearings``
    says. setup_id: needed by directions; names the instrument and the shared orientation and centring of the others.
    second: the right-hand target of an angle (``to`` is the left-hand one: value = bearing of second - bearing of to).
    instrument_height, target_height, second_height: m, along the plumb line, above the positions.
    target_centring_sigma: m, of the target's plumbing, for this reading alone.
    """

    reading_id: str
    kind: ReadingKind
    at: PositionRef
    to: PositionRef
    value: float
    sigma: float
    setup_id: str = ""
    second: PositionRef | None = None
    instrument_height: float = 0.0
    target_height: float = 0.0
    second_height: float = 0.0
    target_centring_sigma: float = 0.0
    group: str = "reading"
    used: bool = True


@frozen(eq=False)
class ReadingCovariance:
    """Joint covariance (n, n) of n readings, in rad^2, rad m, m^2; it replaces their sigmas. All used, or none."""

    reading_ids: tuple[str, ...]
    cov: FloatArray

    def of(self, ids: Container[str]) -> "ReadingCovariance":
        """That of some of the readings."""
        rows = [k for k, name in enumerate(self.reading_ids) if name in ids]
        return ReadingCovariance(tuple(self.reading_ids[k] for k in rows), self.cov[np.ix_(rows, rows)])


@frozen(eq=False)
class CoordinateDifferences:
    """World coordinates of ``to`` minus those of ``at``, (n, 3) m of n baselines, with joint covariance (3n, 3n).

    set_id: the name of the set in its table, or of the difference that is a set by itself.
    """

    at: tuple[PositionRef, ...]
    to: tuple[PositionRef, ...]
    values: FloatArray
    cov: FloatArray
    group: str = "coordinate_difference"
    used: bool = True
    set_id: str = ""


@frozen(eq=False)
class Level:
    """Inclination (rad) of a body's axis above the horizontal, from a spirit level or an accelerometer (asin f/g).

    axis_in_frame: (3,) unit vector along which the instrument was laid.
    """

    level_id: str
    frame: FrameRef
    axis_in_frame: FloatArray
    value: float
    sigma: float
    group: str = "level"
    used: bool = True


@frozen(eq=False)
class Alignment:
    """Two axes of two bodies are parallel: the components (2,) rad of ``axis_in_a`` seen from b, across ``axis_in_b``.

    axis_in_a, axis_in_b: (3,) unit vectors. value: (2,) along ``tilt_axes(axis_in_b)``, usually zero; cov (2, 2) rad^2,
    ``np.inf`` on the diagonal where that component was not observed.
    """

    alignment_id: str
    a: FrameRef
    axis_in_a: FloatArray
    b: FrameRef
    axis_in_b: FloatArray
    value: FloatArray
    cov: FloatArray
    group: str = "alignment"
    used: bool = True


@frozen(eq=False)
class LaserSpot:
    """Where a beam meets the plane of a target at an epoch: (2,) m, x and y in the target, covariance (2, 2)."""

    spot_id: str
    beam_id: str
    epoch_id: str
    target_id: str
    xy: FloatArray
    cov: FloatArray
    group: str = "laser"
    used: bool = True


@frozen
class OnSurface:
    """A position lies at ``offset`` (m) from a surface, with sigma (m): a feeler, a rail, a ball bar.

    offset: along the normal of a plane, beyond the radius of a sphere, from the axis of a line (0: on it; then the
    observation has two components, across).
    """

    surface_id: str
    position: PositionRef
    sigma: float
    offset: float = 0.0
    group: str = "surface"
    used: bool = True


Observation = (
    TableReading | Pair | Distance | Coordinates | Reading | CoordinateDifferences | Level | Alignment | LaserSpot
    | OnSurface
)  # fmt: skip
"""One observation that is no image point."""
