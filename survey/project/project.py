"""What a project folder holds, as frozen values."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from gtsam import Rot3

from adjust.model.frozen import frozen
from adjust.model.observations import Closure, FrameRef, ReadingKind
from adjust.model.survey import FloatArray, Survey
from survey.folder.locking import OBSERVATIONS_FOLDER as OBSERVATIONS_FOLDER
from survey.folder.locking import RESULTS as RESULTS
from survey.folder.plain import attributes
from survey.project.detected import DetectedImage
from survey.project.exclusions import Exclusion
from survey.project.targets import TargetKind

_SEVERAL = {"table_readings": "table readings", "reading_covariances": "covariances of readings",
            "coordinate_differences": "coordinate differences", "laser_spots": "laser spots",
            "on_surfaces": "points on surfaces"}  # fmt: skip
_OWNERS = ("cameras", "stations", "tables", "targets", "points", "instruments", "setups", "beams", "surfaces")


def observed(survey: Survey, n_spots: int) -> dict[str, int]:
    """How many observations of each kind there are; n_spots: those that are still to be identified."""
    found = {"image points": sum(len(b.uv) for b in survey.image_blocks), "images": len(
        {(b.camera_id, b.epoch_id) for b in survey.image_blocks})}  # fmt: skip
    found |= {_SEVERAL.get(name, name): len(items) for name, items in survey.others.items()}
    found["spots to identify"] = n_spots
    return {name: n for name, n in found.items() if n}


def owners(survey: Survey) -> dict[str, int]:
    """How many cameras, stations, points ... there are."""
    return {name: len(getattr(survey, name)) for name in _OWNERS if getattr(survey, name)}


def contents(survey: Survey, n_spots: int) -> list[tuple[str, str]]:
    """What is observed, of what, in which datum: names and texts of a table."""
    return [("observed", _counted(observed(survey, n_spots))), ("of", _counted(owners(survey))),
            ("datum", survey.datum.kind)]  # fmt: skip


def _counted(found: dict[str, int]) -> str:
    return ", ".join(f"{n} {name if n != 1 else name.removesuffix('s')}" for name, n in found.items()) or "nothing"


def lines_text(lines: Iterable[tuple[str, str]]) -> list[str]:
    """The table as lines of a text."""
    return [f"  {name:<9} {said}" for name, said in lines]


FORMAT = 1
DEFINITION_FILE = "survey.toml"
IMAGES_FOLDER = "images"
SigmaKind = Literal["a_priori", "a_posteriori"]
SIGMA_KINDS: tuple[SigmaKind, ...] = get_args(SigmaKind)
DEMANDED = {
    "points": ("point",),
    "stations": ("world_from_station", "mount_from_station"),
    "cameras": ("station_from_camera",),
    "lenses": ("lens",),
    "tables": ("world_from_table",),
    "table_geometry": ("table_geometry",),
    "targets": ("carrier_from_target",),
}
"""Of what a tolerance may be demanded, and the names of those estimates."""
POSITION, ROTATION = "position", "rotation"


@frozen
class SpotsRequest:
    """Light spots that ``detect`` looks for in ``cameras``.

    epochs: None for every image of these cameras in which no target is expected. diameter_px: smallest and largest.
    gate_px: how far from its prediction a spot may lie to be taken for a beacon.
    """

    cameras: tuple[str, ...]
    epochs: tuple[str, ...] | None = None
    diameter_px: tuple[float, float] = (2.0, 12.0)
    gate_px: float = 15.0


@frozen(eq=False)
class SpotBlock:
    """Spots that one camera saw at one epoch, not yet identified: ``spot_ids`` n, uv (n, 2) px, cov (n, 2, 2) px^2."""

    camera_id: str
    epoch_id: str
    spot_ids: tuple[str, ...]
    uv: FloatArray
    cov: FloatArray


@frozen
class Tolerance:
    """One demand. of: a key of ``DEMANDED``; ids: whose (all where empty).

    quantity: "position", "rotation", or the name of a component (of a lens, a table's geometry).
    expanded: largest expanded uncertainty allowed, in the worst direction; None where only the value matters.
    nominal, within: the value must be proven to lie within +- ``within`` of ``nominal``; of components only. SI units,
    px for those in pixels.
    """

    name: str
    of: str
    ids: tuple[str, ...]
    quantity: str
    expanded: float | None = None
    nominal: float | None = None
    within: float | None = None


@frozen
class AdjustmentOptions:
    """How the project is adjusted and reported: the tables [adjustment], [tolerances.NAME] and [identification].

    alpha: error probability of each family of tests; alpha0: of one test of one component instead, where observations
    are tested for their reliability (Baarda's B-method). power: with which a minimal detectable bias is found.
    reject_blocks: leave mis-detected images out of the start, then test them.
    reject_points: leave gross errors among the image points out, and list them. reject_pairs: the same for measured
    pairs and single observations of all other kinds. variance_components: estimate the variance of every group.
    sigmas: of all that is estimated, as the observations' own sigmas say (a_priori) or times sigma0 (a_posteriori);
    None where the project does not say: every job then has its usual ones, ``adjust`` a posteriori.
    tolerances: what is demanded of the results. identification: who measured what, where and with
    what, printed in the report as it is. pairs: by the poses of their frames, or with all their loops closed, through
    the mounts of ``closures``.
    """

    alpha: float = 0.05
    reject_blocks: bool = True
    reject_points: bool = True
    reject_pairs: bool = True
    variance_components: bool = False
    sigmas: SigmaKind | None = None
    pairs: Literal["poses", "closed"] = "poses"
    closures: tuple[Closure, ...] = ()
    tolerances: tuple[Tolerance, ...] = ()
    identification: tuple[tuple[str, str], ...] = ()
    alpha0: float | None = None
    power: float = 0.80


@frozen
class Foot:
    """A screw or edge that carries a body, at (x, y) m in the body's plane."""

    name: str
    x: float
    y: float


@frozen(eq=False)
class AlignmentTask:
    """A body that is to be turned until its axes are those of ``onto`` (the table [align.ID]).

    onto_from_body: the rotation wanted. pitch: m per turn of the feet's screws. tolerance: rad, about each axis.
    """

    task_id: str
    body: FrameRef
    onto: FrameRef
    onto_from_body: Rot3 = field(default_factory=Rot3)
    feet: tuple[Foot, ...] = ()
    pitch: float | None = None
    tolerance: float | None = None


@frozen
class Accuracy:
    """What an instrument's readings are worth where the table gives no sigma, in SI; None where not given.

    angle: of an angle between two directions; sqrt(2) that of a direction where it is not given. distance, slope: the
    sigma of a distance d is ``distance + slope * d``. levelling: m per square root of a kilometre of levelled line.
    target_centring: of targets set up over points. centring, height: of the instrument, for its setups.
    """

    direction: float | None = None
    angle: float | None = None
    zenith: float | None = None
    azimuth: float | None = None
    distance: float | None = None
    distance_slope: float = 0.0
    height_difference: float | None = None
    levelling: float | None = None
    target_centring: float = 0.0
    centring: float = 0.0
    height: float = 0.0

    def sigma(self, kind: ReadingKind, length: float) -> float | None:
        """Of one reading. length: m, of a distance, or of the line of a height difference (nan: not known)."""
        match kind:
            case "slope_distance" | "horizontal_distance":
                return None if self.distance is None else self.distance + self.distance_slope * length
            case "height_difference":
                if self.levelling is None or np.isnan(length):
                    return self.height_difference
                return float(np.hypot(self.height_difference or 0.0, self.levelling * (length / 1000.0) ** 0.5))
            case "angle" if self.angle is None and self.direction is not None:
                return self.direction * math.sqrt(2.0)  # the difference of two directions
        return {"direction": self.direction, "angle": self.angle, "zenith": self.zenith, "azimuth": self.azimuth}[kind]


@frozen(eq=False)
class Sigmas:
    """A priori sigmas where the tables give none, in SI.

    image_px: of image points, None where not given. scale: factor on all sigmas of a group.
    tables: (axes,) rad by table id. instruments: by instrument id.
    """

    image_px: float | None = None
    scale: Mapping[str, float] = field(default_factory=dict)
    tables: Mapping[str, FloatArray] = field(default_factory=dict)
    instruments: Mapping[str, Accuracy] = field(default_factory=dict)


@frozen
class LeftOut:
    """An exclusion in force, and how many images, image points, spots without a name and readings it meets."""

    exclusion: Exclusion
    n_images: int = 0
    n_image_points: int = 0
    n_spots: int = 0
    n_readings: int = 0

    def counts(self) -> dict[str, int]:
        """How many of each."""
        return attributes(self, "n_images", "n_image_points", "n_spots", "n_readings")


@frozen(eq=False)
class Definition:
    """What survey.toml says, and the images that are there; ``survey`` has no observations.

    images: by (camera_id, epoch_id), in natural order. inputs: sha256 of every file read, by its path in the folder.
    target_cameras: the cameras in whose images a target is looked for, where not in all.
    """

    folder: Path
    title: str
    tie_points: bool
    survey: Survey
    target_kinds: Mapping[str, TargetKind]
    images: Mapping[tuple[str, str], Path]
    spots_request: SpotsRequest | None
    options: AdjustmentOptions
    sigmas: Sigmas
    inputs: Mapping[str, str]
    target_cameras: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    alignment_tasks: tuple[AlignmentTask, ...] = ()


@frozen(eq=False)
class Project(Definition):
    """A definition whose ``survey`` holds the observations too; ``spots`` are image points without identity.

    The covariances of the observations contain ``sigmas.scale`` already. left_out: what people excluded; it is not used
    in ``survey``, nor among the ``spots``. n_left_out: how many observations that are, each once. n_unused_in_files:
    those that only a table marks ``used = false``. detected: what is known of every image and its points. to_detect:
    images whose points are to be found anew. notes: exclusions that name nothing. image_notes: images that are new,
    have changed or are gone. files: where they are, if not in ``folder`` yet. origins: by file, the file and line from
    which each of its lines was taken, in a project that was merged.
    """

    spots: tuple[SpotBlock, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    n_left_out: int = 0
    n_unused_in_files: int = 0
    detected: Mapping[tuple[str, str], DetectedImage] = field(default_factory=dict)
    to_detect: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    image_notes: tuple[str, ...] = ()
    files: Path | None = None
    origins: Mapping[str, Sequence[tuple[Path, int]]] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to adjust yet: angles of turntables alone are not."""
        others = (v for k, v in self.survey.others.items() if k != "table_readings")
        return not any((self.survey.image_blocks, self.spots, *others))

    @property
    def contents(self) -> list[tuple[str, str]]:
        """What is observed, of what, in which datum: names and texts of a table."""
        return contents(self.survey, sum(len(b.uv) for b in self.spots))

    def __repr__(self) -> str:
        """What is in the folder, in a few lines: a notebook prints it."""
        kinds = Counter(type(k).__name__ for k in self.target_kinds.values())
        targets = f", targets {', '.join(f'{n} {kind}' for kind, n in kinds.items())}" if kinds else ""
        images = f", {len(self.images)} images" if self.images else ""
        head = f"Project {self.title or self.folder.name!r} in {self.folder}{images}{targets}"
        return "\n".join((head, *lines_text(self.contents)))
