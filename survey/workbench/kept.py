"""What the results in a project's folder say, for the view before anything is adjusted."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import IntArray
from survey.folder.text import NOT_OURS, read_bytes
from survey.project.project import RESULTS
from survey.project.tables.files import read_table
from survey.project.tables.reading import Layout, Table
from survey.solution.earlier.changes import in_short
from survey.workbench.rows import PointRows
from survey.workbench.situation import Situation

_LAYOUT = Layout(
    "residuals", ("epoch_id", "camera_id", "point_id"), ("u_px", "v_px", "used"), ("target_id",),
    ("residual_u_px", "residual_v_px", "sigma_u_px", "sigma_v_px", "redundancy_u", "redundancy_v", "standardized_u",
     "standardized_v", "test"),
)  # fmt: skip


@frozen(eq=False)
class Kept:
    """A solution as it was written: summary, warnings, limits of the chi-square test of image points and of |w|."""

    summary: Mapping[str, object]
    warnings: Sequence[str]
    image_limit: float
    w_limit: float
    date: str


def kept_results(situation: Situation) -> Kept | None:
    """What ``results/solution.json`` says; None where it is of other inputs, or not as it was written."""
    try:
        found = json.loads(read_bytes(situation.everything.folder / RESULTS / "solution.json")[0])
        if found["inputs"]["hashes"] != dict(situation.everything.inputs):
            return None
        said = found["summary"]
        return Kept(in_short(said), [str(w) for w in found["warnings"]], float(said["suspects"]["image_test_limit"]),
                    float(said["suspects"]["standardized_limit"]), str(found["inputs"]["date"]))  # fmt: skip
    except (SurveyError, *NOT_OURS):
        return None


def with_kept(rows: PointRows, situation: Situation) -> PointRows:
    """The rows with what ``results/residuals.csv`` says of them; as they are where it cannot be read."""
    try:
        return _joined(rows, read_table(situation.everything.folder / RESULTS / "residuals.csv", _LAYOUT))
    except (SurveyError, *NOT_OURS):
        return rows


def _joined(rows: PointRows, found: Table) -> PointRows:
    theirs = _keys_of(rows, found)
    blocks, sizes = rows.survey.image_blocks, np.diff(rows.ptr)
    first = {(b.camera_id, b.epoch_id, b.target_id): i for i, b in reversed(list(enumerate(blocks)))}
    at = np.repeat([first[b.camera_id, b.epoch_id, b.target_id] for b in blocks], sizes)
    mine = at * _span(rows) + np.concatenate([*(b.point_idx for b in blocks), np.zeros(0, dtype=np.int64)])
    order = np.argsort(mine, kind="stable")
    mine = mine[order]
    place = np.minimum(np.searchsorted(mine, theirs), max(len(mine) - 1, 0))
    there = np.flatnonzero(mine[place] == theirs) if len(mine) else np.zeros(0, dtype=np.int64)
    here = order[place[there]]
    residuals, test, redundancy = rows.residuals.copy(), rows.test.copy(), rows.redundancy.copy()
    used = rows.used.copy()
    for k, axis in enumerate("uv"):
        residuals[here, k] = found.numbers(f"residual_{axis}_px")[there]
        redundancy[here, k] = found.numbers(f"redundancy_{axis}")[there]
    test[here], used[here] = found.numbers("test")[there], found.numbers("used")[there] > 0
    return replace(rows, residuals=residuals, test=test, redundancy=redundancy, used=used)


def _span(rows: PointRows) -> int:
    return 1 + max((int(b.point_idx.max(initial=0)) for b in rows.survey.image_blocks), default=0)


def _keys_of(rows: PointRows, found: Table) -> IntArray:
    """Of every row of the table: its block and the place of its point in one number, -1 where there is none."""
    epoch, camera, point, target = (found.text(k) for k in ("epoch_id", "camera_id", "point_id", "target_id"))
    blocks: dict[tuple[str, str, str], int] = {}
    for i, b in enumerate(rows.survey.image_blocks):
        blocks.setdefault((b.epoch_id, b.camera_id, b.target_id or ""), i)
    image = (epoch.codes * len(camera.names) + camera.codes) * len(target.names) + target.codes
    begin = np.flatnonzero(np.diff(image, prepend=-1))  # rows of an image follow each other
    block = np.repeat(
        [blocks.get((epoch.names[epoch.codes[k]], camera.names[camera.codes[k]], target.names[target.codes[k]]), -1)
         for k in begin.tolist()], np.diff(begin, append=len(image))
    )  # fmt: skip
    index = np.full((len(target.names), len(point.names)), -1, dtype=np.int64)
    code = {name: j for j, name in enumerate(point.names)}
    for t, name in enumerate(target.names):
        for i, one in enumerate(rows.point_names.get(name or None, ())):
            if one in code:
                index[t, code[one]] = i
    place = index[target.codes, point.codes]
    return np.where((block < 0) | (place < 0) | (place >= _span(rows)), -1, block * _span(rows) + place)
