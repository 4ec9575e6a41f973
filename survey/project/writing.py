"""Writing a project folder, and the tables that a job adds to it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import Survey
from survey.folder.text import atomic_write
from survey.folder.units import from_si
from survey.project.declared.options import task_sections
from survey.project.declared.sections import head_section, option_sections, points_file, survey_sections
from survey.project.declared.toml_text import toml_text
from survey.project.project import (
    DEFINITION_FILE,
    OBSERVATIONS_FOLDER,
    AdjustmentOptions,
    AlignmentTask,
    Sigmas,
    SpotBlock,
    SpotsRequest,
)
from survey.project.tables.files import write_table
from survey.project.tables.image_points import image_point_columns, spot_columns
from survey.project.tables.kinds import observation_tables
from survey.project.tables.layouts import LAYOUTS
from survey.project.tables.reading import Columns
from survey.project.targets import PointList, TargetKind


def write_project(
    folder: Path,
    survey: Survey,
    *,
    title: str = "",
    target_kinds: Mapping[str, TargetKind] | None = None,
    target_cameras: Mapping[str, tuple[str, ...]] | None = None,
    tie_points: bool = False,
    options: AdjustmentOptions | None = None,
    sigmas: Sigmas | None = None,
    spots_request: SpotsRequest | None = None,
    spots: Sequence[SpotBlock] = (),
    alignment_tasks: Sequence[AlignmentTask] = (),
    parquet: bool = False,
    overwrite: bool = False,
) -> None:
    """Write survey.toml and all tables, so that ``read`` gives the same survey back.

    Image coordinates keep every bit, other numbers lose a few in their units; observations come back sorted by ids.

    target_kinds: a target that is not in it becomes a list of points. target_cameras: in whose images targets are
    looked for, where not in all. sigmas: of future tables without sigma columns; its ``scale`` is not written, because
    the covariances of the observations contain it. overwrite: replace a project that is there, and remove those of its
    tables that the new one does not have; else that raises SurveyError.
    """
    folder = Path(folder)
    _make_room(folder, overwrite)
    kinds = _complete_kinds(survey, target_kinds or {})
    sigmas = sigmas or Sigmas()
    seen_by: dict[tuple[str, ...], dict[str, object]] = {
        ("targets", target_id): {"cameras": ids} for target_id, ids in (target_cameras or {}).items()
    }
    sections = [(path, {**values, **seen_by.get(path, {})}) for path, values in survey_sections(survey, kinds, sigmas)]
    text = toml_text(
        [
            head_section(title, tie_points, survey),
            *sections,
            *task_sections(alignment_tasks),
            *option_sections(options or AdjustmentOptions(), spots_request, sigmas),
        ]
    )
    for target_id, kind in kinds.items():
        if isinstance(kind, PointList):
            write_table(folder, Path(points_file(target_id)).stem, _point_list_columns(kind))
    tables = _tables(survey, spots)
    for name in LAYOUTS:
        if name in tables:
            write_table(folder / OBSERVATIONS_FOLDER, name, tables[name], parquet)
            continue
        for ending in ("csv", "parquet"):
            (folder / OBSERVATIONS_FOLDER / f"{name}.{ending}").unlink(missing_ok=True)
    atomic_write(folder / DEFINITION_FILE, text)


def _make_room(folder: Path, overwrite: bool) -> None:
    there = [folder / DEFINITION_FILE]
    there += [folder / OBSERVATIONS_FOLDER / f"{name}.{ending}" for name in LAYOUTS for ending in ("csv", "parquet")]
    for path in there:
        if path.exists() and not overwrite:
            raise SurveyError(f"{path}: there is a project already; choose another folder")


def _complete_kinds(survey: Survey, given: Mapping[str, TargetKind]) -> dict[str, TargetKind]:
    """A kind for every target; raises where the kind has other points than the target."""
    kinds: dict[str, TargetKind] = {}
    for target in survey.targets:
        kind = given.get(target.target_id, PointList(target.point_ids, target.x_in_target))
        point_ids, x_in_target = kind.points()
        if point_ids != target.point_ids or not np.allclose(x_in_target, target.x_in_target, rtol=0, atol=1e-12):
            found = "its points are not those of its kind"
            raise SurveyError(f"target {target.target_id!r}: {found}; write it as a list of points")
        kinds[target.target_id] = kind
    return kinds


def _point_list_columns(kind: PointList) -> Columns:
    x_mm = from_si(kind.x_in_target, "mm")
    return {"point_id": kind.point_ids, "x_mm": x_mm[:, 0], "y_mm": x_mm[:, 1], "z_mm": x_mm[:, 2]}


def _tables(survey: Survey, spots: Sequence[SpotBlock]) -> dict[str, Columns]:
    """The columns of every table that has rows."""
    tables = {"image_points": image_point_columns(survey.image_blocks, survey), "spots": spot_columns(spots)}
    tables |= observation_tables(survey)
    return {name: columns for name, columns in tables.items() if len(next(iter(columns.values())))}
