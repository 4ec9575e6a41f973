"""What a survey consists of: the owners of the unknowns, as frozen values.

Frames are a closed list: *world, station, camera, table, mount, target, image*. A transform ``a_from_b`` takes
coordinates in b to coordinates in a. Lengths are metres, angles radians, image coordinates pixels; the centre of the
first pixel is (0, 0). Tangents of poses are GTSAM's: rotation (rad) then translation (m), in the frame on the right.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from gtsam import Pose3

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Treatment = Literal["free", "held", "prior"]


@dataclass(frozen=True, eq=False)
class PoseParameter:
    """A rigid motion ``a_from_b`` and how it is treated.

    value: start value when free (None: found by the program), the constant when held, the mean when prior.
    prior_cov: (6, 6), in the tangent at ``value``; ``np.inf`` on the diagonal means nothing is known of that component
    (its row and column are then ignored).
    """

    value: Pose3 | None = None
    treatment: Treatment = "free"
    prior_cov: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class PointParameter:
    """Coordinates of a point in the world, (3,) m, and how they are treated; ``prior_cov`` is (3, 3)."""

    value: FloatArray | None = None
    treatment: Treatment = "free"
    prior_cov: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class VectorPrior:
    """Prior knowledge of some components of a vector: ``mean`` (k,) and ``cov`` (k, k) in the order of ``names``."""

    names: tuple[str, ...]
    mean: FloatArray
    cov: FloatArray


@dataclass(frozen=True)
class Tie:
    """Component ``name`` follows ``to`` with a constant factor: fy = ratio * fx."""

    name: str
    to: str
    factor: float = 1.0


@dataclass(frozen=True, eq=False)
class VectorParameter:
    """Named scalars of one owner; those in ``free`` are unknowns, the others keep their value.

    values: (n,) in the order of ``names``: start values of the free ones, constants of the others.
    """

    names: tuple[str, ...]
    values: FloatArray
    free: tuple[str, ...] = ()
    prior: VectorPrior | None = None
    ties: tuple[Tie, ...] = ()


@dataclass(frozen=True, eq=False)
class LensParameter:
    """The lens of a camera and how it is treated.

    model: a name of ``adjust.lens.MODELS``.
    values: (n,) in the order of the model's parameters, or None where the program must find a start.
    free: the parameters to be estimated; the others are held at ``values`` (zero where those are None).
    pixel_size_mm: needed by the models whose parameters are in millimetres.
    balance_radius_mm: where the radial distortion of the model "aicon" is zero (its r0); no other model uses it.
    """

    model: str
    free: tuple[str, ...]
    values: FloatArray | None = None
    prior: VectorPrior | None = None
    ties: tuple[Tie, ...] = ()
    pixel_size_mm: float | None = None
    balance_radius_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera, x right, y down, z forward, fixed on a station. ``image_size`` is (width, height) in pixels."""

    camera_id: str
    station_id: str
    image_size: tuple[int, int]
    lens: LensParameter
    station_from_camera: PoseParameter = PoseParameter()


@dataclass(frozen=True, eq=False)
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


TABLE_GEOMETRY = ("non_orthogonality", "axis_offset", "zero_1", "zero_2")


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
class Target:
    """Known points on one rigid body: a board, a marker block. It stands in the world or on a station.

    point_ids: n names; x_in_target: (n, 3) m.
    motion: ``fixed`` or ``epoch`` (moved between epochs, as a board held by hand).
    carrier_from_target: ``world_from_target``, or ``station_from_target`` where ``station_id`` is given; with motion
    ``epoch`` what holds for every epoch that is not listed in ``epochs``.
    warp: sag of a board, names ("warp_x", "warp_y") m: z = warp_x 4u(1-u) + warp_y 4v(1-v), with u, v from 0 to 1 over
    the board.
    """

    target_id: str
    point_ids: tuple[str, ...]
    x_in_target: FloatArray
    station_id: str | None = None
    motion: Literal["fixed", "epoch"] = "fixed"
    carrier_from_target: PoseParameter = PoseParameter()
    epochs: Mapping[str, PoseParameter] = field(default_factory=dict)
    warp: VectorParameter | None = None


@dataclass(frozen=True, eq=False)
class Point:
    """A beacon or tie point in the world."""

    point_id: str
    x_in_world: PointParameter = PointParameter()


@dataclass(frozen=True)
class Datum:
    """Where origin, directions and scale come from.

    ``given``: from what is held, has a prior or is observed. ``inner``: inner constraints (free network) over the
    named points and stations (all of them where none is named).
    """

    kind: Literal["given", "inner"] = "given"
    points: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Survey:
    """A whole survey: what there is, what was observed and what defines the datum. See ``adjust.observations``."""

    cameras: tuple[Camera, ...] = ()
    stations: tuple[Station, ...] = ()
    tables: tuple[Table, ...] = ()
    targets: tuple[Target, ...] = ()
    points: tuple[Point, ...] = ()
    image_blocks: tuple[Any, ...] = ()
    table_readings: tuple[Any, ...] = ()
    pairs: tuple[Any, ...] = ()
    distances: tuple[Any, ...] = ()
    coordinates: tuple[Any, ...] = ()
    datum: Datum = Datum()
