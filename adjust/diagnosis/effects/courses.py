"""Unknowns through time, as an adjustment has them: the parts of the linear system that tell each at every epoch."""

from collections.abc import Iterator, Mapping

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.case import Case
from adjust.diagnosis.prediction import Linear
from adjust.lenses.models import CENTRE, FOCAL
from adjust.model.frozen import frozen
from adjust.model.names import numbered
from adjust.model.result import ParameterName
from adjust.model.survey import IntArray, Survey
from adjust.statistics.normal import DENSE
from adjust.statistics.score import Part

_FEWEST = 4
_ELIMINATIONS = 12.5
"""Eliminations of the whole system that all courses together may cost in surveys of many unknowns."""
_ROWS = 20_000
"""Of courses that are looked at together."""
MOVED = {  # name of the unknown: of the mistake, kind of the thing, what happened to it
    "station_from_camera": ("camera moved", "camera", "camera {} was moved on its station"),
    "carrier_from_target": ("target moved", "target", "target {} was moved"),
    "mount_from_station": ("station moved", "station", "station {} was moved on its table"),
    "world_from_table": ("table moved", "table", "table {}, or all that stands still around it, was moved"),
    "world_from_station": ("station moved", "station", "station {} was bumped"),
    "station_body": ("station moved", "station", "station {} was moved on its table"),
    "target_body": ("target moved", "target", "target {}, which stands for the world, was moved"),
    "point": ("point moved", "point", "point {} was moved, or exchanged for another one"),
    "orientation": ("set-up turned", "setup", "the instrument of set-up {} was turned or bumped"),
}


@frozen(eq=False)
class Course:
    """An unknown, or some components of it, through time, as an adjustment has it. labels: of its parts."""

    linear: Linear
    name: ParameterName
    components: tuple[str, ...]
    kind: str  # of observation: image, pair, reading
    labels: tuple[str, ...]
    parts: tuple[Part, ...]

    @property
    def estimated(self) -> list[str]:
        """Those of its components that are."""
        columns = self.linear.system.columns
        known = [columns.components[i] for i in self.linear.columns(self.name)]
        return [c for c in self.components if c in known]

    @property
    def is_pose(self) -> bool:
        """Whether it is a motion."""
        return self.name[0].endswith("_body") or isinstance(self.linear.result.estimates[self.name].value, Pose3)


def affordable(case: Case, linear: Linear) -> Iterator[Course]:
    """Those of several epochs, as many as columns of the covariance matrix cost no more than some adjustments."""
    n, tree = len(linear.system.columns), linear.system.precision.tree
    room = min(float(n), tree.cliques.columns_for(_ELIMINATIONS)) if n > DENSE else np.inf
    for course in courses(linear):
        room -= sum(B.shape[1] for _, B in course.parts)
        if not case.few("what moved from some epoch on, of things that fit better than others", int(room < 0.0), 0):
            return
        if len(course.parts) >= _FEWEST:
            yield course


def alike(every: Iterator[Course]) -> Iterator[list[Course]]:
    """Together those with derivatives by as many numbers, as long as they have no more rows than make it worth it."""
    some, n = list[Course](), 0
    for course in every:
        if some and (n > _ROWS or course.parts[0][1].shape[1] != some[0].parts[0][1].shape[1]):
            yield some
            some, n = [], 0
        some.append(course)
        n += sum(len(rows) for rows, _ in course.parts)
    if some:
        yield some


def courses(
    linear: Linear, only: ParameterName | None = None, components: tuple[str, ...] | None = None
) -> Iterator[Course]:
    """Of all unknowns, or of one; of a lens by parts of its components, or of some of these alone."""
    survey, columns = linear.result.survey, linear.system.columns
    ptr, row_of = linear.system.ptr, linear.system.row_of
    first_reading = len(ptr) - 1 - len(survey.readings)
    pairs = {i: survey.pairs[k].pair_id for k, i in enumerate(_other_rows(linear, "pair"))}
    readings = {first_reading + k: r.reading_id for k, r in enumerate(survey.readings)}

    def course(name: ParameterName, kind: str, ids: Mapping[int, str], rows: IntArray) -> Course:
        numbers = [i for i in np.unique(row_of[rows]).tolist() if i in ids]
        of = [np.arange(ptr[i], ptr[i + 1]) for i in numbers]
        parts = tuple(linear.parts(columns.at[name], of))
        return Course(linear, name, (), kind, tuple(ids[i] for i in numbers), parts)

    yield from _of_held(linear, only)
    for name in _worst_first(linear) if only is None else [only] if only in columns.at else []:
        at = columns.at[name]
        if name[0] not in (*MOVED, "lens") or not len(at) or len(name) > 2 or _is_the_world(survey, name):
            continue
        rows = linear.rows_of(at)
        if (rows < ptr[linear.system.n_image]).any():
            yield from _of_images(linear, name, rows, components)
        elif name[0] == "world_from_station":
            yield course(name, "pair", pairs, rows)
        elif name[0] == "orientation":
            yield course(name, "reading", readings, rows)


def _worst_first(linear: Linear) -> list[ParameterName]:
    """The unknowns; of many those first whose observations fit least."""
    at = linear.system.columns.at
    if len(linear.system.columns) <= DENSE:
        return list(at)
    some = [name for name in at if len(at[name]) and (name[0] in MOVED or name[0] == "lens")]
    misfit = dict(zip(some, linear.mean_squares([at[name] for name in some]).tolist(), strict=True))
    return sorted(misfit, key=lambda name: -misfit[name])


def _is_the_world(survey: Survey, name: ParameterName) -> bool:
    """Whether a table stands before one target alone: moving either is the same to all observations."""
    return name[0] == "world_from_table" and len(standing(survey)) == 1 and not survey.points


def standing(survey: Survey) -> list[str]:
    """Targets that stand still in the world."""
    return [t.target_id for t in survey.targets if t.motion == "fixed" and t.station_id is None]


def _of_images(
    linear: Linear, name: ParameterName, rows: IntArray, only: tuple[str, ...] | None
) -> Iterator[Course]:
    blocks = linear.result.survey.image_blocks
    ptr = 2 * linear.result.image_residuals.block_ptr
    epochs, at = numbered(b.epoch_id for b in blocks)
    of = np.repeat(at, np.diff(ptr))
    images = rows[rows < ptr[-1]]
    known = np.unique(of[images])
    by_epoch = [images[of[images] == k] for k in known]
    parts = (FOCAL, CENTRE, FOCAL + CENTRE) if name[0] == "lens" else ((),)
    for components in parts if only is None else (only,):
        columns = linear.columns(name, components)
        if len(columns):
            labels = tuple(epochs[k] for k in known)
            yield Course(linear, name, components, "image", labels, tuple(linear.parts(columns, by_epoch)))


def _of_held(linear: Linear, only: ParameterName | None) -> Iterator[Course]:
    """Bodies whose poses are held: the targets that tell the datum, the mounts of stations; by differences."""
    survey, free = linear.result.survey, linear.system.columns.at
    still = [t.target_id for t in survey.targets if t.motion == "fixed"]
    turned = [s.station_id for s in survey.stations if s.motion == "table"]
    held = [("target_body", t) for t in still if ("carrier_from_target", t) not in free]
    held += [("station_body", s) for s in turned if ("mount_from_station", s) not in free]
    on_table = {r.epoch_id for r in survey.table_readings}
    for name in held if only is None else [n for n in held if n == only]:
        by_epoch: dict[str, list[Part]] = {}
        cameras = {c.camera_id for c in survey.cameras if c.station_id == name[1]}
        mine = {i for i, b in enumerate(survey.image_blocks) if b.target_id == name[1] or
                (name[0] == "station_body" and b.camera_id in cameras and b.epoch_id in on_table)}  # fmt: skip
        for i in sorted(mine):
            D = linear.prediction.by_motion(survey.image_blocks[i], name)
            if D is not None:
                by_epoch.setdefault(survey.image_blocks[i].epoch_id, []).extend(linear.image_parts({i: D}))
        parts = tuple((np.concatenate([r for r, _ in p]), np.concatenate([B for _, B in p])) for p in by_epoch.values())
        yield Course(linear, name, (), "image", tuple(by_epoch), parts)


def _other_rows(linear: Linear, kind: str) -> list[int]:
    """Numbers in the linear system of all observations of a kind, in the order of the survey."""
    kinds = linear.system.precision.graph.of_others(lambda o: o.kind, lambda _: "pair")
    return [linear.system.n_image + i for i, k in enumerate(kinds) if k == kind]
