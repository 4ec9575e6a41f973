"""What a survey consists of: the owners of the unknowns, as frozen values.

Frames are a closed list: *world, station, camera, table, mount, target, image*. A transform ``a_from_b`` takes
coordinates in b to coordinates in a. Lengths are metres, angles radians, image coordinates pixels; the centre of the
first pixel is (0, 0). Tangents of poses are GTSAM's: rotation (rad) then translation (m), in the frame on the right.
"""

from collections.abc import Mapping
from dataclasses import field
from functools import cached_property
from typing import Literal

import numpy as np
from gtsam import Pose3

from adjust.model.arrays import BoolArray as BoolArray
from adjust.model.arrays import FloatArray as FloatArray
from adjust.model.arrays import IntArray as IntArray
from adjust.model.frozen import frozen
from adjust.model.observations import (
    Alignment,
    Closure,
    CoordinateDifferences,
    Coordinates,
    Distance,
    FrameRef,
    ImageBlock,
    ImagePoints,
    LaserSpot,
    Level,
    Observation,
    OnSurface,
    Pair,
    PositionRef,
    Reading,
    ReadingCovariance,
    TableReading,
)

Treatment = Literal["free", "held", "prior"]


@frozen(eq=False)
class PoseParameter:
    """A rigid motion ``a_from_b`` and how it is treated.

    value: start value when free (None: found by the program), the constant when held, the mean when prior.
    prior_cov: (6, 6), in the tangent at ``value``; ``np.inf`` on the diagonal means nothing is known of that component
    (its row and column are then ignored).
    held: components (rx ry rz tx ty tz, of the tangent at ``value``) of a free or prior pose that keep their value.
    """

    value: Pose3 | None = None
    treatment: Treatment = "free"
    prior_cov: FloatArray | None = None
    held: tuple[str, ...] = ()


@frozen(eq=False)
class PointParameter:
    """Coordinates of a point in the world, (3,) m, and how they are treated; ``prior_cov`` is (3, 3).

    held: axes (x y z) of a free or prior point that keep their value: z in a plane network, x and y in a levelling.
    """

    value: FloatArray | None = None
    treatment: Treatment = "free"
    prior_cov: FloatArray | None = None
    held: tuple[str, ...] = ()


@frozen(eq=False)
class VectorPrior:
    """Prior knowledge of some components of a vector: ``mean`` (k,) and ``cov`` (k, k) in the order of ``names``."""

    names: tuple[str, ...]
    mean: FloatArray
    cov: FloatArray


@frozen
class Tie:
    """Component ``name`` follows ``to`` with a constant factor: fy = ratio * fx."""

    name: str
    to: str
    factor: float = 1.0


@frozen(eq=False)
class VectorParameter:
    """Named scalars of one owner; those in ``free`` are unknowns, the others keep their value.

    values: (n,) in the order of ``names``: start values of the free ones, constants of the others.
    """

    names: tuple[str, ...]
    values: FloatArray
    free: tuple[str, ...] = ()
    prior: VectorPrior | None = None
    ties: tuple[Tie, ...] = ()

    @property
    def by_name(self) -> dict[str, float]:
        """The values by their names."""
        return dict(zip(self.names, map(float, self.values), strict=True))


@frozen(eq=False)
class LensDrift:
    """How parameters of a lens change: from one block of epochs to the next, or with the temperature.

    parameters: k free ones of the lens. begins: epochs at which a new block begins, as the camera's images are ordered;
    the first block has the lens itself, the others differences from it. step_sigmas: (k,) in the units of the model, of
    a random walk from block to block; None: every block by itself. reference_temperature: degC; where it is given, the
    parameters are linear in ``Survey.temperatures``, the lens holds there, and there are no blocks.
    """

    parameters: tuple[str, ...]
    begins: tuple[str, ...] = ()
    step_sigmas: FloatArray | None = None
    reference_temperature: float | None = None


@frozen
class LensSharing:
    """Free parameters of a lens that are those of another camera: one unknown with several users.

    camera_id: of the camera whose unknowns they are. It shares none itself and has a lens of the same model.
    """

    camera_id: str
    parameters: tuple[str, ...]


CROP = ("scale", "left", "top")


@frozen(eq=False)
class ImageCrop:
    """Images that show a part of the sensor, or in another size.

    Pixel u of the whole image is ``scale (u + 1/2 - left) - 1/2`` of these, v likewise with the top. parameters: names
    as in ``CROP`` (1, px, px of the whole image). size: (width, height) of these images in px, None where the whole
    image was cut at the left and at the top only.
    """

    parameters: VectorParameter
    size: tuple[int, int] | None = None


@frozen(eq=False)
class LensParameter:
    """The lens of a camera and how it is treated.

    model: a name of ``adjust.lenses.models.MODELS``.
    values: (n,) in the order of the model's parameters, or None where the program must find a start.
    free: the parameters to be estimated; the others are held at ``values`` (zero where those are None).
    pixel_size_mm: needed by the models whose parameters are in millimetres.
    balance_radius_mm: where the radial distortion of the model "aicon" is zero (its r0); no other model uses it.
    crops: by the epoch from which on images are such, as the camera's images are ordered; the lens and ``image_size``
    are those of the whole image.
    """

    model: str
    free: tuple[str, ...]
    values: FloatArray | None = None
    prior: VectorPrior | None = None
    ties: tuple[Tie, ...] = ()
    pixel_size_mm: float | None = None
    balance_radius_mm: float = 0.0
    drift: LensDrift | None = None
    shared: LensSharing | None = None
    crops: Mapping[str, ImageCrop] = field(default_factory=dict)


@frozen(eq=False)
class Clock:
    """When a camera exposes, or readings are taken: components of ``adjust.model.clocks.CLOCK``.

    jitter: s, sigma of every single epoch's own time about that; 0: none.
    """

    parameters: VectorParameter
    jitter: float = 0.0


@frozen(eq=False)
class Camera:
    """A camera, x right, y down, z forward, fixed on a station. ``image_size`` is (width, height) in pixels."""

    camera_id: str
    station_id: str
    image_size: tuple[int, int]
    lens: LensParameter
    station_from_camera: PoseParameter = PoseParameter()
    clock: Clock | None = None
    """When it exposes; None: at the epochs' times."""


@frozen(eq=False)
class Station:
    """A rigid body that carries cameras and targets: the head, a relay station, a tripod.

    motion: ``fixed`` (one pose for all epochs), ``epoch`` (one pose per epoch) or ``table`` (carried by ``table_id`` in
    the epochs that have a reading of that table, with one pose per epoch in the others, as for images taken by hand).
    world_from_station: the pose (fixed), or what holds for every epoch that is not listed in ``epochs``.
    """

    station_id: str
    motion: Literal["fixed", "epoch", "table"] = "fixed"
    world_from_station: PoseParameter = PoseParameter()
    epochs: Mapping[str, PoseParameter] = field(default_factory=dict)
    table_id: str | None = None
    mount_from_station: PoseParameter = PoseParameter()
    clock: Clock | None = None
    """When its measured poses (pairs at its epochs, as of a robot) were read."""


TABLE_GEOMETRY = ("non_orthogonality", "axis_offset", "zero_1", "zero_2")


@frozen(eq=False)
class Table:
    """A turntable of one or two axes, outermost (fixed to the base) first.

    ``table_from_mount = R1(a1 + zero_1) * Trans3(axis_offset) * R3(non_orthogonality) * R2(a2 + zero_2)`` where R1, R2
    turn about the named axes (right-handed) and 3 is the remaining axis, the common perpendicular of the two.
    geometry: names as in ``TABLE_GEOMETRY`` (rad, m, rad, rad); a one-axis table has only ``zero_1``.
    """

    table_id: str
    axes: tuple[str, ...] = ("x", "z")
    world_from_table: PoseParameter = PoseParameter()
    geometry: VectorParameter = field(
        default_factory=lambda: VectorParameter(
            TABLE_GEOMETRY, np.zeros(4), free=("non_orthogonality", "axis_offset")
        )
    )
    clock: Clock | None = None
    """When its axes were read."""


@frozen(eq=False)
class Target:
    """Known points on one rigid body: a board, a marker block. It stands in the world or on a station.

    point_ids: n names; x_in_target: (n, 3) m.
    motion: ``fixed`` or ``epoch`` (moved between epochs, as a board held by hand).
    carrier_from_target: ``world_from_target``, or ``station_from_target`` where ``station_id`` is given; with motion
    ``epoch`` what holds for every epoch that is not listed in ``epochs``.
    warp: how the points deviate from that, components of ``adjust.model.boards.BOARD``. reference_temperature: degC, at
    which x_in_target holds.
    """

    target_id: str
    point_ids: tuple[str, ...]
    x_in_target: FloatArray
    station_id: str | None = None
    motion: Literal["fixed", "epoch"] = "fixed"
    carrier_from_target: PoseParameter = PoseParameter()
    epochs: Mapping[str, PoseParameter] = field(default_factory=dict)
    warp: VectorParameter | None = None
    reference_temperature: float = 20.0


@frozen(eq=False)
class Point:
    """A beacon or tie point in the world."""

    point_id: str
    x_in_world: PointParameter = PointParameter()


TILT = ("tilt_1", "tilt_2")


def tilt_axes(direction: FloatArray) -> FloatArray:
    """Two unit vectors (2, 3) that make a right-handed frame with a unit ``direction`` (3,): e1 x e2 = direction.

    For z they are x and y; near any other axis the two next ones in cyclic order, made perpendicular.
    """
    first = np.roll(np.eye(3)[int(np.argmax(np.abs(direction)))], 1)
    e1 = first - direction * (first @ direction)
    e1 /= np.linalg.norm(e1)
    return np.array([e1, np.cross(direction, e1)])


@frozen(eq=False)
class Vertical:
    """The direction of the plumb line in the world, for levels and for instruments that are set up level.

    up_in_world: (3,) unit vector, upwards, before the tilt. tilt: names as in ``TILT`` (rad), small turns of it about
    ``tilt_axes(up_in_world)``; held at zero unless freed. radius: of the level surfaces (m), whose plumb lines meet at
    ``origin - radius * up``; None where the surfaces are planes.
    """

    up_in_world: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    tilt: VectorParameter = field(default_factory=lambda: VectorParameter(TILT, np.zeros(2)))
    radius: float | None = None


@frozen
class Bearings:
    """How horizontal angles are counted: from the world's axis ``zero``, and clockwise seen from above or not.

    Geodesists in (east, north): zero "y", clockwise. Directions, angles, azimuths and orientations all follow it.
    """

    zero: Literal["x", "y"] = "y"
    clockwise: bool = True


INSTRUMENT = ("distance_offset", "distance_scale", "refraction", "vertical_index")


@frozen(eq=False)
class Instrument:
    """A total station, theodolite or level.

    parameters: names as in ``INSTRUMENT`` (m, 1, 1, rad): an observed distance is ``offset + (1 + scale) * true``; the
    coefficient of refraction bends zenith angles (with ``Vertical.radius``); the index is added to zenith angles.
    """

    instrument_id: str
    parameters: VectorParameter = field(default_factory=lambda: VectorParameter(INSTRUMENT, np.zeros(4)))


@frozen
class Setup:
    """An instrument set up once: its readings of kind "direction" share one orientation unknown.

    levelled: its vertical axis is the plumb line; else readings are in the axes of the frame it stands on, which must
    be a station (as of a tilted scanner or tracker). centring_sigma, height_sigma: m, of the offset of the instrument
    from the point it stands on, one unknown with a prior for all its readings where positive.
    """

    setup_id: str
    instrument_id: str | None = None
    levelled: bool = True
    centring_sigma: float = 0.0
    height_sigma: float = 0.0


BEAM = ("offset_1", "offset_2", "slope_1", "slope_2")


@frozen(eq=False)
class Beam:
    """A laser beam fixed on a body (a mount, a station): the line ``offset + s * (e + slope)`` in that body's frame.

    axis: the axis e ("x", "y", "z") of the body that it runs along; 1 and 2 are the next axes in cyclic order.
    parameters: names as in ``BEAM`` (m, m, 1, 1).
    """

    beam_id: str
    carrier_kind: Literal["mount", "station"]
    carrier_id: str
    axis: Literal["x", "y", "z"] = "z"
    parameters: VectorParameter = field(default_factory=lambda: VectorParameter(BEAM, np.zeros(4), free=BEAM))


SURFACES: Mapping[str, tuple[str, ...]] = {
    "plane": ("normal_1", "normal_2", "distance"),
    "line": ("direction_1", "direction_2", "offset_1", "offset_2"),
    "sphere": ("x", "y", "z", "radius"),
}


@frozen(eq=False)
class Surface:
    """A plane, line or sphere in the world on which positions lie (see ``OnSurface``).

    parameters: names as in ``SURFACES``. A plane is ``n . x = distance``, a line passes ``offset`` along ``n``: n is
    ``reference`` (3,) turned by the small angles _1, _2 about ``tilt_axes(reference)``, and the two offsets are along
    those axes. None in ``reference`` or ``parameters``: found by the program.
    """

    surface_id: str
    kind: Literal["plane", "line", "sphere"]
    reference: FloatArray | None = None
    parameters: VectorParameter | None = None


@frozen
class Datum:
    """Where origin, directions and scale come from.

    ``given``: from what is held, has a prior or is observed. ``inner``: inner constraints (free network) over the
    named points and stations (all of them where none is named).
    """

    kind: Literal["given", "inner"] = "given"
    points: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()


@frozen(eq=False)
class Survey:
    """A whole survey: what there is, what was observed (``adjust.model.observations``) and what defines the datum."""

    cameras: tuple[Camera, ...] = ()
    stations: tuple[Station, ...] = ()
    tables: tuple[Table, ...] = ()
    targets: tuple[Target, ...] = ()
    points: tuple[Point, ...] = ()
    image_blocks: tuple[ImageBlock, ...] = ()
    table_readings: tuple[TableReading, ...] = ()
    pairs: tuple[Pair, ...] = ()
    distances: tuple[Distance, ...] = ()
    coordinates: tuple[Coordinates, ...] = ()
    datum: Datum = Datum()
    vertical: Vertical = field(default_factory=Vertical)
    bearings: Bearings = Bearings()
    instruments: tuple[Instrument, ...] = ()
    setups: tuple[Setup, ...] = ()
    beams: tuple[Beam, ...] = ()
    surfaces: tuple[Surface, ...] = ()
    readings: tuple[Reading, ...] = ()
    reading_covariances: tuple[ReadingCovariance, ...] = ()
    coordinate_differences: tuple[CoordinateDifferences, ...] = ()
    levels: tuple[Level, ...] = ()
    alignments: tuple[Alignment, ...] = ()
    laser_spots: tuple[LaserSpot, ...] = ()
    on_surfaces: tuple[OnSurface, ...] = ()
    pair_form: Literal["poses", "closed"] = "poses"
    """Pairs by the poses of their frames, or every loop of them closed; set by :mod:`adjust.relay.closed`."""
    closures: tuple[Closure, ...] = ()
    """Mounts (``adjust.model.observations.Closure``) whose play the covariances of their pairs already contain."""
    temperatures: Mapping[str, float] = field(default_factory=dict)
    """degC by epoch, where it matters: of targets that expand."""
    times: Mapping[str, float] = field(default_factory=dict)
    """s by epoch, where it matters: to clocks. Without any, epochs are ``epoch_interval`` (s; None: unknown) apart."""
    epoch_interval: float | None = None

    @property
    def others(self) -> Mapping[str, tuple[Observation, ...]]:
        """All observations that are no image points, by the field that holds them."""
        return {
            "table_readings": self.table_readings, "pairs": self.pairs, "distances": self.distances,
            "coordinates": self.coordinates, "coordinate_differences": self.coordinate_differences,
            "readings": self.readings, "levels": self.levels, "alignments": self.alignments,
            "laser_spots": self.laser_spots, "on_surfaces": self.on_surfaces,
        }  # fmt: skip

    @cached_property
    def n_others_used(self) -> int:
        """How many of them are in use."""
        return sum(o.used for kind in self.others.values() for o in kind)

    @cached_property
    def image_points(self) -> ImagePoints:
        """The image points of all blocks, one block after the other."""
        return ImagePoints.of(self.image_blocks)

    @cached_property
    def cameras_by_id(self) -> Mapping[str, Camera]:
        """Its cameras."""
        return {c.camera_id: c for c in self.cameras}

    @cached_property
    def stations_by_id(self) -> Mapping[str, Station]:
        """Its stations."""
        return {s.station_id: s for s in self.stations}

    @cached_property
    def tables_by_id(self) -> Mapping[str, Table]:
        """Its tables."""
        return {t.table_id: t for t in self.tables}

    @cached_property
    def targets_by_id(self) -> Mapping[str, Target]:
        """Its targets."""
        return {t.target_id: t for t in self.targets}

    @cached_property
    def is_pose_network(self) -> bool:
        """Whether it observes nothing but pairs between stations that stay where they are."""
        others = (v for k, v in self.others.items() if k != "pairs")
        if not self.pairs or self.cameras or self.image_blocks or any(others):
            return False
        return self.pairs_join_fixed_stations

    @cached_property
    def pairs_join_fixed_stations(self) -> bool:
        """Whether no pair ends at anything else."""
        fixed = {s.station_id for s in self.stations if s.motion == "fixed"}
        return all(r.kind == "station" and r.frame_id in fixed for r in self.pair_frames)

    @cached_property
    def pair_frames(self) -> tuple[FrameRef, ...]:
        """The frames that the pairs join, each once, in order of appearance."""
        seen = {id(r): r for p in self.pairs for r in (p.a, p.b)}  # most are the same object: no hash of each
        return tuple(dict.fromkeys(seen.values()))

    @cached_property
    def reading_refs(self) -> tuple[PositionRef, ...]:
        """The positions that the readings need, likewise."""
        seen = {id(ref): ref for r in self.readings for ref in (r.at, r.to, r.second) if ref is not None}
        return tuple(dict.fromkeys(seen.values()))
