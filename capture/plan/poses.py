"""The poses of a capture plan: grids, lists, and those that cover a camera's image with a board."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from capture.plan.given import with_given
from capture.plan.table import TablePlan
from survey.folder.text import id_problem
from survey.project.declared.node import Node

if TYPE_CHECKING:
    from survey.project import Definition

_KINDS = ("grid", "list", "cover", "still")
_MOST_POSES = 100_000


@frozen(eq=False)
class Pose:
    """A position of the table, (n,) rad (empty where there is no table); its id names its epochs."""

    pose_id: str
    angles: FloatArray


def read_poses(root: Node, table: TablePlan | None, survey: Path | None) -> tuple[Pose, ...]:
    """All poses, in the order of the file; ids are the section's name and a number. Raises SurveyError."""
    poses: list[Pose] = []
    for name, node in root.tables("poses"):
        angles = _angles(node, table, survey)
        width = max(2, len(str(len(angles))))
        poses += [Pose(f"{name}{i + 1:0{width}d}", row) for i, row in enumerate(angles)]
    if not poses:
        raise root.error('there is no pose; add [poses.t] with kind = "grid", "list", "cover" or "still"', "poses")
    return tuple(poses)


def check_names(root: Node, poses: Sequence[Pose]) -> None:
    """Raise SurveyError where a pose's id cannot name files or names two poses."""
    seen: set[str] = set()
    for pose in poses:
        problem = id_problem(pose.pose_id)
        if problem:
            raise root.error(problem, "poses")
        if pose.pose_id.casefold() in seen:  # some file systems hold A01 and a01 for one file
            raise root.error(f"two sections give a pose {pose.pose_id!r}; rename one", "poses")
        seen.add(pose.pose_id.casefold())


def _angles(node: Node, table: TablePlan | None, survey: Path | None) -> FloatArray:
    kind = node.choice("kind", _KINDS)
    if kind == "still":
        node.allow("kind", "count")
        if table is not None:
            raise node.error('"still" is for plans without a table; use a list of one pose and repeats', "kind")
        return np.zeros((_count(node, 1), 0))
    if table is None:
        raise node.error('poses of a table, but the plan has no [table]; add it, or use kind = "still"', "kind")
    if kind == "grid":
        return _grid(node, table)
    if kind == "list":
        node.allow("kind", "angles_deg")
        rows = node.value("angles_deg")
        n = len(rows) if isinstance(rows, list) else 0
        return np.asarray(np.radians(node.numbers("angles_deg", (n, len(table.axes)))))
    return _cover(node, table, survey)


def _grid(node: Node, table: TablePlan) -> FloatArray:
    """Boustrophedon: the innermost axis turns back and forth, so that no move is longer than it must be."""
    keys = [f"{axis.axis.name}_deg" for axis in table.axes]
    node.allow("kind", *keys)
    values = [_values(node, key) for key in keys]
    if len(values) == 1:
        return np.radians(values[0])[:, None]
    if math.prod(map(len, values)) > _MOST_POSES:
        raise node.error(f"more than {_MOST_POSES} poses; take fewer", *keys[:1])
    rows = [
        (outer, inner)
        for i, outer in enumerate(values[0])
        for inner in (values[1] if i % 2 == 0 else values[1][::-1])
    ]
    return np.asarray(np.radians(np.array(rows)))


def _values(node: Node, key: str) -> FloatArray:
    """A list of angles, or { from, to, count }, deg."""
    value = node.value(key)
    if isinstance(value, list):
        if not value:
            raise node.error("the list is empty; give at least one angle", key)
        return node.numbers(key, (len(value),))
    range_ = node.table(key)
    range_.allow("from", "to", "count")
    return np.linspace(range_.number("from"), range_.number("to"), _count(range_))


def _count(node: Node, *default: int) -> int:
    count = node.integer("count", 1, *default)
    if count > _MOST_POSES:
        raise node.error(f"found {count}; a plan has at most {_MOST_POSES} poses", "count")
    return count


def _cover(node: Node, table: TablePlan, survey: Path | None) -> FloatArray:
    from capture.plan.cover import CoverRequest, cover_board

    request = with_given(CoverRequest(), node, {"count": 1, "steps": 5, "margin_px": 0}, ("kind", "cameras", "target"))
    if survey is None:
        raise node.error('"cover" needs approximate lenses and poses; name a survey.toml with survey = "..."', "kind")
    definition = definition_of(survey)
    cameras = {camera.camera_id: camera for camera in definition.survey.cameras}
    targets = {target.target_id: target for target in definition.survey.targets}
    camera_ids = node.references("cameras", cameras, "camera")
    target = targets[node.reference("target", targets, "target")]
    try:
        found = [cover_board(definition.survey, cameras[name], target, table, request) for name in camera_ids]
    except ValueError as error:
        raise node.error(str(error), "cameras") from error
    return np.concatenate(found)


def definition_of(path: Path) -> "Definition":
    """A template of any name, read as the survey.toml of an empty folder."""
    import tempfile

    from survey.project import read_definition

    with tempfile.TemporaryDirectory() as folder:
        for file in (path, *path.parent.glob("*.csv")):
            name = "survey.toml" if file == path else file.name
            (Path(folder) / name).write_bytes(file.read_bytes())
        return read_definition(Path(folder))
