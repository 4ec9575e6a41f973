"""Single epochs at which table readings and images disagree: readings mistyped or exchanged, points misnumbered."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.hypothesis import Edit, Hypothesis, LeaveOut, Place, Rename, motion_text
from adjust.diagnosis.table.fit import TableFit
from adjust.diagnosis.table.readings import column_edit, with_angles
from adjust.diagnosis.table.rereading import (
    Reread,
    displacement,
    meant_points,
    outlying,
    reading_scatter,
    renumbered,
    reread,
)
from adjust.diagnosis.table.views import TableViews
from adjust.model.frozen import frozen
from adjust.model.rewriting import with_rows
from adjust.model.survey import PoseParameter, Survey
from adjust.spatial.averaging import wrapped

_MOST = 0.25
"""Share of the epochs up to which it is single ones that disagree."""
_SEVERAL = 10.0
"""Evidence of more than one, over their number: the rather something else has changed between some of them."""
_EXACT = 5.0  # sigmas
_ALIKE = 10.0, np.radians(0.02)
"""Sigmas, and rad beside them, by which readings that were exchanged are each other's at most."""


@frozen(eq=False)
class _Wrong:
    """What is wrong at one epoch or two: in words, how the survey would be without it, and as edits.

    name: of the kind. parameters: how many numbers were chosen to fit.
    """

    name: str
    said: str
    epochs: tuple[str, ...]
    mend: Callable[[Survey], Survey]
    edits: tuple[Edit, ...]
    parameters: int


def misread_epochs(survey: Survey, views: TableViews, fit: TableFit) -> Iterator[Hypothesis]:
    """All that disagree as one: what is wrong with one of them leaves the others unexplained."""
    rows = outlying(fit)
    epochs = np.unique(views.epoch[rows]).tolist()
    if not epochs or len(epochs) > max(1.0, _MOST * len(views.epoch_ids)):
        return
    found = list(_found(survey, views, fit, epochs))
    changed = survey
    for wrong in found:
        changed = wrong.mend(changed)
    evidence = float(fit.chi2[rows].max() / fit.scale) if len(found) == 1 else _SEVERAL / len(found)
    table_id, at = views.table.table_id, tuple(e for wrong in found for e in wrong.epochs)
    yield Hypothesis(
        found[0].name, "; ".join(wrong.said for wrong in found), _REMEDIES[found[0].name],
        Place("table", (table_id,), "epoch", at), changed, tuple(e for wrong in found for e in wrong.edits),
        evidence, sum(wrong.parameters for wrong in found), len(views.epoch_ids),
    )  # fmt: skip


_READ, _EXCHANGED, _NUMBERED, _DISPLACED = "reading mistyped", "readings exchanged", "points misnumbered", "displaced"
_REMEDIES = {_READ: "correct table_angles.csv", _EXCHANGED: "exchange them in table_angles.csv",
             _NUMBERED: "detect the image again, or leave it out", _DISPLACED: "leave the image out"}  # fmt: skip


def _found(survey: Survey, views: TableViews, fit: TableFit, epochs: Sequence[int]) -> Iterator[_Wrong]:
    """One for every epoch that disagrees, exchanged ones together."""
    scatter = reading_scatter(views, fit)
    again = {e: reread(views, fit, e) for e in epochs}
    again = {e: replace(r, sigmas=np.maximum(r.sigmas, scatter)) for e, r in again.items()}
    done = set[int]()
    for e in epochs:
        if e in done:
            continue
        other = next((o for o in epochs if o > e and o not in done and _swapped(views, again, e, o)), None)
        if other is None:
            yield _at(survey, views, fit, e, again[e])
        else:
            done.add(other)
            yield _exchanged(views, e, other)


def _swapped(views: TableViews, again: Mapping[int, Reread], a: int, b: int) -> bool:
    sigmas, more = _ALIKE
    return all(
        again[i].explains
        and bool(np.all(np.abs(wrapped(again[i].angles - views.angles[j])) < sigmas * again[i].sigmas + more))
        for i, j in ((a, b), (b, a))
    )


def _exchanged(views: TableViews, a: int, b: int) -> _Wrong:
    table_id, (first, second) = views.table.table_id, (views.epoch_ids[a], views.epoch_ids[b])
    angles = {first: views.angles[b], second: views.angles[a]}
    return _Wrong(
        _EXCHANGED, f"table {table_id}: the readings of epochs {first} and {second} are exchanged: each fits the "
        "images of the other", (first, second), lambda s: with_angles(s, table_id, angles),
        (Rename("table_angles", "epoch_id", {first: second, second: first}, {"table_id": (table_id,)}),), 1,
    )  # fmt: skip


def _at(survey: Survey, views: TableViews, fit: TableFit, e: int, again: Reread) -> _Wrong:
    rows = outlying(fit)
    rows = rows[views.epoch[rows] == e]
    tolerance = float(np.sqrt(fit.scale * np.trace(views.cov[rows[0]][3:, 3:])))
    for row in rows.tolist():
        target = views.targets[_ends(views, row)["target"]]
        inner_is_target = views.inner_ids[views.inner[row]][0] == "target"
        how = "" if inner_is_target else renumbered(target, displacement(views, fit, row), tolerance)
        if how:
            return _numbered(survey, views, fit, row, how)
    return _read(views, e, again) if again.explains else _displaced(views, fit, int(rows[0]))


def _ends(views: TableViews, row: int) -> dict[str, str]:
    """The ids of camera and target of a view."""
    return dict([views.inner_ids[views.inner[row]], views.outer_ids[views.outer[row]]])


def _block(survey: Survey, views: TableViews, row: int) -> int:
    """The image of a view, among those of a survey."""
    place = (*_ends(views, row).values(), views.epoch_ids[views.epoch[row]])
    every = enumerate(survey.image_blocks)
    return next(i for i, b in every if {*place} == {b.camera_id, str(b.target_id), b.epoch_id})


def _said(views: TableViews, row: int) -> tuple[str, str]:
    """A view in words, and its epoch."""
    ends, epoch = _ends(views, row), views.epoch_ids[views.epoch[row]]
    return f"camera {ends['camera']} at epoch {epoch}, target {ends['target']}", epoch


def _numbered(survey: Survey, views: TableViews, fit: TableFit, row: int, how: str) -> _Wrong:
    said, epoch = _said(views, row)
    ends, i = _ends(views, row), _block(survey, views, row)
    block, target = survey.image_blocks[i], views.targets[_ends(views, row)["target"]]
    meant = meant_points(target, displacement(views, fit, row))
    names = {target.point_ids[k]: target.point_ids[int(meant[k])] for k in block.point_idx.tolist()}
    where = {"epoch_id": (epoch,), "camera_id": (ends["camera"],), "target_id": (ends["target"],)}

    def mend(s: Survey) -> Survey:
        return with_rows(s, "image_blocks", {i: replace(s.image_blocks[i], point_idx=meant[block.point_idx])})

    return _Wrong(_NUMBERED, f"{said} is mis-detected: {how}", (epoch,), mend,
                  (Rename("image_points", "point_id", names, where),), 1)  # fmt: skip


def _displaced(views: TableViews, fit: TableFit, row: int) -> _Wrong:
    said, epoch = _said(views, row)
    ends, moved = _ends(views, row), motion_text(Pose3(displacement(views, fit, row)))

    def mend(s: Survey) -> Survey:
        target, i = s.targets_by_id[ends["target"]], _block(s, views, row)
        there = replace(target, target_id=f"{target.target_id} at {epoch}", carrier_from_target=PoseParameter())
        block = replace(s.image_blocks[i], target_id=there.target_id)
        return replace(with_rows(s, "image_blocks", {i: block}), targets=(*s.targets, there))

    outer = " ".join(views.outer_ids[views.outer[row]])
    return _Wrong(
        _DISPLACED, f"{said}: {outer} appears displaced {moved}, which no reading of table {views.table.table_id} "
        f"explains: it was moved at epoch {epoch}, or is mis-detected there", (epoch,), mend,
        (LeaveOut((f"image:{ends['camera']}/{epoch}",)),), 6,
    )  # fmt: skip


def _read(views: TableViews, e: int, again: Reread) -> _Wrong:
    table_id, epoch, reads = views.table.table_id, views.epoch_ids[e], views.angles[e]
    off = wrapped(again.angles - reads)
    wrong = np.abs(off) > _EXACT * again.sigmas
    wrong = wrong if wrong.any() else np.ones_like(wrong)
    parts = [f"axis{i + 1} reads {np.degrees(reads[i]):.4f} deg, images say {np.degrees(reads[i] + off[i]):.3f} deg "
             f"+- {max(np.degrees(again.sigmas[i]), 0.001):.3f} deg" for i in np.flatnonzero(wrong)]  # fmt: skip
    repeated = e > 0 and bool(np.all(reads == views.angles[e - 1]))
    note = f" (the reading repeats that of epoch {views.epoch_ids[e - 1]})" if repeated else ""
    by = np.where(wrong, off, 0.0)
    return _Wrong(
        _READ, f"table {table_id}, epoch {epoch}: {'; '.join(parts)}{note}", (epoch,),
        lambda s: with_angles(s, table_id, {epoch: reads + by}),
        (column_edit(table_id, np.eye(len(by)), np.degrees(by), (epoch,)),), int(wrong.sum()),
    )  # fmt: skip
