"""Reading a project folder."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.names import natural_key
from adjust.model.survey import Datum, FloatArray, Point, PointParameter, Survey
from survey.folder.locking import settled
from survey.folder.text import id_problem, suggestion
from survey.project.declared.clocks import are_timed, read_times
from survey.project.declared.instruments import (
    read_beams,
    read_bearings,
    read_instruments,
    read_setups,
    read_surfaces,
    read_vertical,
)
from survey.project.declared.node import Node, read_toml
from survey.project.declared.options import read_alignment_tasks, read_options
from survey.project.declared.owners import read_cameras, read_stations, read_tables
from survey.project.declared.poses import flat_point, read_point
from survey.project.declared.targets import read_targets
from survey.project.detected import DetectedImage, ImageKey, ImageNews, image_news, read_detected
from survey.project.exclusions import EXCLUSIONS, EXCLUSIONS_FILE, Exclusion, Name, in_force, read_exclusions
from survey.project.finding import near
from survey.project.images import find_images, sought_in
from survey.project.observed import Observed, union
from survey.project.omitting import without
from survey.project.project import (
    DEFINITION_FILE,
    FORMAT,
    IMAGES_FOLDER,
    OBSERVATIONS_FOLDER,
    Definition,
    Project,
    Sigmas,
    SpotsRequest,
)
from survey.project.tables.files import Begun, read_table
from survey.project.tables.image_points import read_image_blocks, read_spots, world_names
from survey.project.tables.kinds import GROUPS, KINDS, with_observations
from survey.project.tables.layouts import LAYOUTS
from survey.project.tables.reading import Layout, Table
from survey.project.tables.references import Names


def read_definition(folder: Path) -> Definition:
    """Read survey.toml and list the images; raises SurveyError."""
    with settled(Path(folder)):
        return _read_definition(Path(folder))[0]


def read(folder: Path, ahead: dict[Path, Begun] | None = None) -> Project:
    """Read a whole project folder; tables of observations that are not there yet are empty. Raises SurveyError.

    What ``exclusions.csv`` leaves out is not used. ``notes`` say which of its rows name nothing, ``image_notes``
    which images are not those any more that the points come from. ahead: see :func:`read_all`.
    """
    everything, exclusions = with_exclusions(read_all(folder, ahead=ahead), Path(folder))
    return leaving_out(everything, exclusions.values())


def with_exclusions(everything: Project, place: Path) -> tuple[Project, dict[Name, Exclusion]]:
    """With the hash of ``exclusions.csv`` in the folder ``place``, and what it would leave out; raises SurveyError."""
    rows, digest = read_exclusions(place / OBSERVATIONS_FOLDER)
    inputs = {**everything.inputs, **({f"{OBSERVATIONS_FOLDER}/{EXCLUSIONS_FILE}": digest} if digest else {})}
    return dataclasses.replace(everything, inputs=dict(sorted(inputs.items()))), in_force(rows)


def read_all(
    folder: Path, texts: Mapping[str, str] = MappingProxyType({}), ahead: dict[Path, Begun] | None = None,
    beside: Path | None = None,
) -> Project:  # fmt: skip
    """:func:`read`, with what is excluded as if it were not.

    texts: what is to stand in files of the folder, not yet written, by their paths in it. ahead: tables that are being
    read already; they are taken from it, so that nothing of them stays in memory. beside: a folder whose images belong
    to the project too.
    """
    place = Path(folder) / OBSERVATIONS_FOLDER
    with settled(Path(folder)):
        definition, root = _read_definition(Path(folder), texts.get(DEFINITION_FILE), beside)
        tables = _read_tables(place, {Path(folder) / name: text for name, text in texts.items()}, ahead or {})
        known = read_detected(place)
        images = _image_news(definition, tables, known)
        project = _observed(definition, root, tables)
    notes = images.notes(definition.folder)
    detected = {**known, **(images.same or {})}
    return dataclasses.replace(project, detected=detected, to_detect=images.to_detect, image_notes=notes)


def leaving_out(project: Project, exclusions: Iterable[Exclusion]) -> Project:
    """A project without what is excluded; what names nothing is said in its notes."""
    exclusions = tuple(exclusions)
    if not exclusions:
        return dataclasses.replace(project, n_unused_in_files=_n_unused(project.survey))
    observed = Observed(project.survey, project.spots)
    path = project.folder / OBSERVATIONS_FOLDER / EXCLUSIONS_FILE
    found, hits, notes = [], [], []
    for one in exclusions:
        hit = observed.hits(one.name, one.at)
        if hit:
            hits.append(hit)
        else:
            notes.append(f"{path}:{one.line}: {one.name} is left out, but nothing has that name; "
                         f"{near(observed, one.name)}")  # fmt: skip
        found.append(hit.left_out(one))
    every = union(hits)
    survey, spots = without(project.survey, project.spots, every)
    in_files = _n_unused(survey) - (every.n - every.n_spots)
    return dataclasses.replace(
        project, survey=survey, spots=spots, left_out=tuple(found), n_left_out=every.n, n_unused_in_files=in_files,
        notes=(*project.notes, *notes),
    )  # fmt: skip


def _n_unused(survey: Survey) -> int:
    images = sum(int((~b.used).sum()) for b in survey.image_blocks if b.used is not None)
    return images + sum(not o.used for kind in survey.others.values() for o in kind)


def _image_news(
    definition: Definition, tables: Mapping[str, Table], known: Mapping[ImageKey, DetectedImage]
) -> ImageNews:
    if not definition.images and not known:
        return ImageNews()
    pointed: set[ImageKey] = set()
    for name in ("image_points", "spots"):
        if name in tables:
            camera, epoch = (tables[name].text(c) for c in ("camera_id", "epoch_id"))
            pairs = np.unique(camera.codes * len(epoch.names) + epoch.codes).tolist()
            pointed |= {(camera.names[i // len(epoch.names)], epoch.names[i % len(epoch.names)]) for i in pairs}
    if not known and not pointed:
        return ImageNews()  # nothing was looked at yet
    sought = {key: one.digest() for key, one in sought_in(definition).items()}
    return image_news(definition.images, known, pointed, sought)


def _observed(definition: Definition, root: Node, tables: dict[str, Table]) -> Project:
    """All that the tables hold."""
    _check_scales(root, definition.sigmas, tables)
    survey = _with_tie_points(definition, tables, flat_point(root.integer("dimensions")))
    _check_datum_points(root, survey)
    names, sigmas = Names.of(survey), definition.sigmas
    points = tables.get("image_points")
    blocks = read_image_blocks(points, names, sigmas) if points is not None else ()
    survey = with_observations(dataclasses.replace(survey, image_blocks=blocks), tables, sigmas)
    fields = {field.name: getattr(definition, field.name) for field in dataclasses.fields(Definition)}
    hashes = {table.path.relative_to(definition.folder).as_posix(): table.digest for table in tables.values()}
    fields |= {"survey": survey, "inputs": dict(sorted(({**definition.inputs, **hashes}).items()))}
    spots = read_spots(tables["spots"], names, sigmas) if "spots" in tables else ()
    return Project(**fields, spots=spots)


def _read_definition(folder: Path, text: str | None = None, beside: Path | None = None) -> tuple[Definition, Node]:
    path = folder / DEFINITION_FILE
    if not path.is_file():
        raise SurveyError(f"{path}: there is no such file; a project folder holds a {DEFINITION_FILE}")
    root, digest = read_toml(path, text)
    _check_format(root)
    root = root.declared_as("root")
    inputs = {DEFINITION_FILE: digest}
    times = read_times(root)
    tables, table_sigmas = read_tables(root, are_timed(times))
    stations = read_stations(root, tuple(table.table_id for table in tables), are_timed(times))
    station_ids = tuple(station.station_id for station in stations)
    cameras = read_cameras(root, station_ids, are_timed(times))
    camera_ids = tuple(camera.camera_id for camera in cameras)
    targets, kinds, seen_by = read_targets(root, station_ids, camera_ids, inputs)
    dimensions = root.integer("dimensions")
    if dimensions > 3:
        raise root.error(f"found {dimensions}; a network has 1 (levelling), 2 (plane) or 3 dimensions", "dimensions")
    points = tuple(Point(point_id, read_point(node, dimensions)) for point_id, node in root.tables("points"))
    datum = _read_datum(root.table("datum"), station_ids)
    instruments, accuracies = read_instruments(root)
    table_ids = tuple(table.table_id for table in tables)
    node = root.table("temperatures_degC")
    survey = Survey(
        cameras, stations, tables, targets, points, datum=datum, vertical=read_vertical(root.table("vertical")),
        bearings=read_bearings(root.table("bearings")), instruments=instruments,
        setups=read_setups(root, tuple(i.instrument_id for i in instruments), accuracies),
        beams=read_beams(root, station_ids, table_ids), surfaces=read_surfaces(root),
        temperatures={epoch_id: node.number(epoch_id) for epoch_id in node.values}, **times,
    )  # fmt: skip
    tie_points = root.flag("tie_points")
    if not tie_points:
        _check_datum_points(root, survey)
    definition = Definition(
        folder=folder,
        title=root.text("title"),
        tie_points=tie_points,
        survey=survey,
        target_kinds=kinds,
        images={key: path for place in (folder, beside) if place is not None
                for key, path in find_images(place / IMAGES_FOLDER, camera_ids).items()},
        spots_request=_read_spots_request(root.table("spots"), camera_ids) if root.has("spots") else None,
        options=read_options(root),
        sigmas=dataclasses.replace(_read_sigmas(root.table("sigmas"), table_sigmas), instruments=accuracies),
        inputs=inputs,
        target_cameras=seen_by,
        alignment_tasks=read_alignment_tasks(root, survey),
    )
    return definition, root


def _check_format(root: Node) -> None:
    if not root.has("format"):
        raise root.error(f"the key 'format' is missing; the first line is 'format = {FORMAT}'", "format")
    if root.integer("format", 0) != FORMAT:
        raise root.error(f"found {root.values['format']}; this program reads format {FORMAT}", "format")


def _read_datum(node: Node, station_ids: tuple[str, ...]) -> Datum:
    kind: Literal["given", "inner"] = node.choice("kind", ("given", "inner"))
    for key in ("points", "stations"):
        if kind == "given" and node.has(key):
            raise node.error('only the datum of kind "inner" names points and stations; remove this', key)
    stations = node.references("stations", station_ids, "station", ())
    return Datum(kind, node.names("points", ()), stations)


def _check_datum_points(root: Node, survey: Survey) -> None:
    node = root.table("datum")
    node.references("points", (point.point_id for point in survey.points), "point", ())


def _read_spots_request(node: Node, camera_ids: tuple[str, ...]) -> SpotsRequest:
    cameras = node.references("cameras", camera_ids, "camera")
    epochs = node.names("epochs") if node.has("epochs") else None
    for i, epoch_id in enumerate(epochs or ()):
        problem = id_problem(epoch_id)
        if problem:
            raise node.error(problem, "epochs", i)
    smallest, largest = node.numbers("diameter_px", (2,)).tolist()
    if not 0 < smallest <= largest:
        raise node.error(f"found [{smallest:g}, {largest:g}]; expected [smallest, largest]", "diameter_px")
    return SpotsRequest(cameras, epochs, (smallest, largest), node.number("gate_px"))


def _read_sigmas(node: Node, tables: dict[str, FloatArray]) -> Sigmas:
    scale = node.table("scale")
    return Sigmas(node.si("image_px", None), {group: scale.number(group) for group in scale.values}, tables)


def _check_scales(root: Node, sigmas: Sigmas, tables: dict[str, Table]) -> None:
    found = {name for table in tables.values() for name in table.text("group").names if name}
    for group in sigmas.scale:
        if group not in (*GROUPS, *found):
            problem = f"unknown group; {suggestion(group, (*GROUPS, *sorted(found)))}"
            raise root.table("sigmas").table("scale").error(problem, group)


def _read_tables(folder: Path, instead: Mapping[Path, str], ahead: dict[Path, Begun]) -> dict[str, Table]:
    """All tables in the folder by name; raises where a file is no known table or one is there twice.

    instead: what is to stand in some of them, not yet written. ahead: those that are being read already.
    """
    tables: dict[str, Table] = {}
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    for path in paths:
        if path.suffix not in (".csv", ".parquet") or path.name.startswith("."):
            continue
        if path.stem == EXCLUSIONS.name:
            continue
        layout: Layout | None = LAYOUTS.get(path.stem)
        if layout is None:
            near = suggestion(path.stem, (*LAYOUTS, EXCLUSIONS.name))
            raise SurveyError(f"{path}: unknown table {path.stem!r}; {near}")
        if path.stem in tables:
            raise SurveyError(f"{path}: {tables[path.stem].path.name} is there too; keep one of the two")
        tables[path.stem] = read_table(path, layout, instead.get(path), ahead.pop(path, None))
    return tables


def _with_tie_points(definition: Definition, tables: dict[str, Table], unknown: PointParameter) -> Survey:
    """The survey with the world points that only the observations name, where the project allows that."""
    survey = definition.survey
    if not definition.tie_points:
        return survey
    found = world_names(tables["image_points"]) if "image_points" in tables else set()
    for kind in KINDS:
        for column in kind.positions if kind.layout.name in tables else ():
            texts = tables[kind.layout.name].text(column).names
            found |= {name for name in texts if name and not set(name) & set(":@/")}
    new = found - {point.point_id for point in survey.points} - {"world"}
    ordered = sorted((name for name in new if not id_problem(name)), key=natural_key)
    return dataclasses.replace(survey, points=(*survey.points, *(Point(name, unknown) for name in ordered)))
