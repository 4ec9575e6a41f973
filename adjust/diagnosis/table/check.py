"""Table readings and targets checked against the images: what is wrong, in words, with its evidence.

Nothing is repaired: the likeliest mistake is named, and its owner decides.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.hypothesis import motion_text
from adjust.diagnosis.table.fit import fit_table
from adjust.diagnosis.table.places import (
    Places,
    Reread,
    displacement,
    find_places,
    outlying,
    reading_scatter,
    renumbered,
    reread,
    wrapped,
)
from adjust.diagnosis.table.readings import shared_mistake
from adjust.diagnosis.table.signs import SignVerdict, constants, given_constants, sign_mistake
from adjust.diagnosis.table.views import TableViews, table_views, with_lenses
from adjust.model.errors import SurveyError, listed
from adjust.model.result import Adjustment, ParameterName, adjusted_pose
from adjust.model.survey import FloatArray, IntArray, PoseParameter, Survey, Table
from adjust.spatial.rigid import inverse

_UNEXPLAINED_RAD = np.radians(1.0)
_SHOWN = 12
_TORN = 100.0  # scale of a fit's residuals from which most views contradict each other
_FEW, _MOST = 0.05, 0.8
_EXACT = 5.0  # sigmas


def probable_causes(survey: Survey, result: Adjustment | None = None) -> tuple[str, ...]:
    """What contradicts the images among table readings and fixed targets, for an adjustment that failed.

    result: an adjustment of the same survey, with lenses that are then used. Empty where nothing is found, or where no
    table carries anything.
    """
    try:
        every = table_views(survey if result is None else with_lenses(survey, result.estimates))
    except SurveyError:
        return ()
    return tuple(line for views in every for line in _causes(survey, views))


_SYMPTOMS = (
    "its images contradict those of all others",
    "no exchange of the axes, unit or shift by one epoch explains it",
    "which no reading of table",
)


def only_symptoms(lines: Sequence[str]) -> bool:
    """Whether the lines of ``probable_causes`` say where something does not fit, but not what happened."""
    return all(any(text in line for text in _SYMPTOMS) for line in lines)


def sign_warnings(survey: Survey, result: Adjustment) -> tuple[str, ...]:
    """Axes whose sign contradicts poses that are given as starts: images alone do not see it."""

    def pose(name: ParameterName, given: PoseParameter) -> FloatArray | None:
        found = adjusted_pose(result.estimates, name, given)
        return None if found is None else found.matrix()

    verdicts = [(t, sign_mistake(t, constants(survey, t, pose), given_constants(survey, t))) for t in survey.tables]
    return tuple(_sign_text(table, verdict) for table, verdict in verdicts if verdict is not None)


def _causes(survey: Survey, views: TableViews) -> list[str]:
    verdict, as_given = shared_mistake(views)
    table = f"table {views.table.table_id}"
    if verdict is not None:
        return [
            f"{table}: probably {verdict.hypothesis.text}: so read, the turns between images and between readings "
            f"agree to {np.degrees(verdict.corrected):.2f} deg instead of {np.degrees(verdict.as_given):.2f} deg "
            "(median); correct table_angles.csv"
        ]
    camera = contradicting_camera(views)
    if camera is not None:
        return [
            f"camera {camera}: its images contradict those of all others; without them the readings of {table} and all "
            "targets agree: look for mirrored or turned images, or those of another camera under its name"
        ]
    found = find_places(views)
    if found is None or not 2 * len(outlying(found.fit)) < len(views.poses):
        if as_given < _UNEXPLAINED_RAD:
            return []
        return [
            f"{table}: the turns between images and between readings disagree by {np.degrees(as_given):.1f} deg "
            "(median), and no exchange of the axes, unit or shift by one epoch explains it; compare the epochs of "
            "table_angles.csv with those of the images"
        ]
    lines = [_moved_text(views, found)] if found.moved is not None else []
    lines += _epoch_lines(views, found)
    return lines or _sign_lines(survey, views, found)


def contradicting_camera(views: TableViews) -> str | None:
    """The one camera without whose images everything agrees; None where there is none, or not one alone."""
    whole = fit_table(views, views.outer)
    if whole is None:
        return None
    off = np.isin(np.arange(len(views.poses)), outlying(whole))
    found = []
    for kind, camera_id in (*views.inner_ids, *views.outer_ids):
        mine = views.shows(kind, camera_id)
        # either the whole fit is torn, or what does not belong to it are the views of this camera
        if kind != "camera" or mine.all() or (whole.scale < _TORN and not off[mine].mean() > _MOST):
            continue
        rest = views.without(kind, camera_id)
        fit = fit_table(rest, rest.outer)
        if fit is not None and fit.scale < min(whole.scale, _TORN) and len(outlying(fit)) < _FEW * len(rest.poses):
            found.append(camera_id)
    return found[0] if len(found) == 1 else None


def _sign_lines(survey: Survey, views: TableViews, found: Places) -> list[str]:
    fit = found.fit
    inner = {name: fit.mount_from_inner[i] for i, name in enumerate(views.inner_ids)}
    outer = {name[1]: fit.table_from_place[i] for i, name in enumerate(views.outer_ids) if name[0] == "target"}
    verdict = sign_mistake(views.table, (inner, outer), given_constants(survey, views.table))
    return [] if verdict is None else [_sign_text(views.table, verdict)]


def _sign_text(table: Table, verdict: SignVerdict) -> str:
    axes = " and ".join(verdict.axes)
    many = len(verdict.axes) > 1
    return (
        f"table {table.table_id}: the sign{'s' if many else ''} of {axes} {'are' if many else 'is'} probably wrong: "
        f"{verdict.shown_by} comes out {np.degrees(verdict.as_given):.1f} deg from the pose given, with {axes} negated "
        f"{np.degrees(verdict.corrected):.1f} deg; correct the sign in table_angles.csv, or the pose given"
    )


def _moved_text(views: TableViews, found: Places) -> str:
    moved = found.moved or 0
    epochs_at = {p: views.epoch[found.place == p] for p in (moved, found.second)}
    a, b = sorted(epochs_at, key=lambda p: float(epochs_at[p].mean()))  # the second place is that of the later epochs
    how = motion_text(Pose3(inverse(found.fit.table_from_place[a]) @ found.fit.table_from_place[b]))
    epochs = [views.epoch_ids[e] for e in np.unique(epochs_at[b])]
    return (
        f"{' '.join(views.outer_ids[moved])} was moved between images: at epochs {listed(epochs, _SHOWN)} it stands "
        f"elsewhere than at the others, {how}; give it a name of its own there, or leave these epochs out"
    )


def _epoch_lines(views: TableViews, found: Places) -> list[str]:
    """One line for every epoch that disagrees, exchanged ones together."""
    rows = outlying(found.fit)
    epochs = [int(e) for e in np.unique(views.epoch[rows])]
    if not epochs:
        return []
    scatter = reading_scatter(views, found)
    again = {e: reread(views, found, e) for e in epochs}
    again = {e: replace(r, sigmas=np.maximum(r.sigmas, scatter)) for e, r in again.items()}
    lines, done = [], set()
    for e in epochs:
        if e in done:
            continue
        other = next((o for o in epochs if o > e and o not in done and _exchanged(views, again, e, o)), None)
        if other is None:
            lines.append(_epoch_text(views, found, e, rows[views.epoch[rows] == e], again[e]))
        else:
            done.add(other)
            lines.append(
                f"table {views.table.table_id}: the readings of epochs {views.epoch_ids[e]} and "
                f"{views.epoch_ids[other]} are exchanged: each fits the images of the other"
            )
    return lines


def _exchanged(views: TableViews, again: Mapping[int, Reread], a: int, b: int) -> bool:
    return all(
        again[i].explains
        and bool(np.all(np.abs(wrapped(again[i].angles - views.angles[j])) < 10.0 * again[i].sigmas + np.radians(0.02)))
        for i, j in ((a, b), (b, a))
    )


def _epoch_text(views: TableViews, found: Places, e: int, rows: IntArray, again: Reread) -> str:
    epoch = views.epoch_ids[e]
    tolerance = float(np.sqrt(found.fit.scale * np.trace(views.cov[rows[0]][3:, 3:])))
    for row in rows:
        target_id = _ends(views, int(row))["target"]
        D = displacement(views, found, row)
        inner_is_target = views.inner_ids[views.inner[row]][0] == "target"
        how = "" if inner_is_target else renumbered(views.targets[target_id], D, tolerance)
        if how:
            return f"{_view_text(views, row)} is mis-detected: {how}"
    if again.explains:
        return _reading_text(views, e, again)
    moved = motion_text(Pose3(displacement(views, found, int(rows[0]))))
    return (
        f"{_view_text(views, int(rows[0]))}: {' '.join(views.outer_ids[views.outer[rows[0]]])} appears displaced "
        f"{moved}, which no reading of table {views.table.table_id} explains: it was moved at epoch {epoch}, "
        "or is mis-detected there; leave the image out"
    )


def _ends(views: TableViews, row: int) -> dict[str, str]:
    """The ids of camera and target of a view."""
    return dict([views.inner_ids[views.inner[row]], views.outer_ids[views.outer[row]]])


def _view_text(views: TableViews, row: int) -> str:
    ends = _ends(views, row)
    return f"camera {ends['camera']} at epoch {views.epoch_ids[views.epoch[row]]}, target {ends['target']}"


def _reading_text(views: TableViews, e: int, again: Reread) -> str:
    reads = views.angles[e]
    off = wrapped(again.angles - reads)
    parts = [
        f"axis{i + 1} reads {np.degrees(reads[i]):.4f} deg, images say {np.degrees(reads[i] + off[i]):.3f} deg +- "
        f"{max(np.degrees(again.sigmas[i]), 0.001):.3f} deg"
        for i in range(len(reads))
        if abs(off[i]) > _EXACT * again.sigmas[i]
    ]
    repeated = e > 0 and bool(np.all(reads == views.angles[e - 1]))
    note = f" (the reading repeats that of epoch {views.epoch_ids[e - 1]})" if repeated else ""
    what = "; ".join(parts) if parts else "its reading does not fit the images"
    return f"table {views.table.table_id}, epoch {views.epoch_ids[e]}: {what}{note}"
