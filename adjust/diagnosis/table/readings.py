"""Mistakes that all readings of a table share: axes exchanged, wrong units, epochs out of step."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from adjust.diagnosis.hypothesis import ChangeColumns, Hypothesis, Place
from adjust.diagnosis.table.views import TableViews
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.memory import content, once
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.spatial.rigid import inverse, rotation_log
from adjust.start.closed_forms.hand_eye import solve_ax_zb

_CLEAR_DEG = 0.2
_BETTER = 5.0
_UNITS = (  # factor from what stands there to what is meant, and how that comes about
    (0.9, "are in gon, not degrees"),
    (1.0 / 0.9, "were turned from gon into degrees although they were degrees"),
    (180.0 / np.pi, "are in radians, not degrees"),
    (np.pi / 180.0, "were turned from radians into degrees although they were degrees"),
    (0.18 / np.pi, "are in milliradians, not degrees"),
    (360.0, "are in whole turns, not degrees"),
    (1.0 / 60.0, "are in arc minutes, not degrees"),
    (1.0 / 3600.0, "are in arc seconds, not degrees"),
    (0.5, "are twice the turn"),
    (2.0, "are half the turn"),
)


@frozen(eq=False)
class Misread:
    """What may have happened to the readings (e, k) rad: of which axes and of which epochs they are, and what factors.

    axes: (k,) positions of the columns meant. epochs: rearranges the rows. lost: epochs that then have no reading.
    """

    text: str
    factors: FloatArray
    axes: tuple[int, ...]
    epochs: Callable[[FloatArray], FloatArray] | None = None
    lost: tuple[int, ...] = ()

    def meant(self, angles: FloatArray) -> FloatArray:
        """Those meant, of those that stand there."""
        columns = angles[:, self.axes]
        return (columns if self.epochs is None else self.epochs(columns)) * self.factors

    @property
    def edits(self) -> FloatArray | None:
        """(k, k) of the columns of the table; None where its rows change places."""
        return None if self.epochs is not None else np.diag(self.factors) @ np.eye(len(self.axes))[list(self.axes)]


@frozen
class Verdict:
    """The likeliest hypothesis and the typical disagreement (rad) of the turns, as it stands and under it."""

    hypothesis: Misread
    as_given: float
    corrected: float


def misread_throughout(survey: Survey, views: TableViews, verdict: Verdict) -> Hypothesis:
    """The survey with all readings as they were meant."""
    table_id, h = views.table.table_id, verdict.hypothesis
    lost = {views.epoch_ids[i] for i in h.lost}
    angles = dict(zip(views.epoch_ids, h.meant(views.angles), strict=True))
    meant = with_angles(survey, table_id, angles)
    meant = replace(meant, table_readings=tuple(
        r for r in meant.table_readings if (r.table_id, r.epoch_id) not in {(table_id, e) for e in lost}))  # fmt: skip
    edits = () if h.edits is None else (column_edit(table_id, h.edits, np.zeros(len(h.axes))),)
    return Hypothesis(
        "table misread", f"table {table_id}: probably {h.text}: so read, the turns between images and between readings "
        f"agree to {np.degrees(verdict.corrected):.2f} deg instead of {np.degrees(verdict.as_given):.2f} deg (median)",
        "correct table_angles.csv", Place("table", (table_id,), "axis1_deg"), meant, edits,
        verdict.as_given / (verdict.corrected + np.radians(_CLEAR_DEG)), 1, len(hypotheses(len(h.axes))),
    )  # fmt: skip


def with_angles(survey: Survey, table_id: str, angles: Mapping[str, FloatArray]) -> Survey:
    """The survey with other readings (k,) rad of a table at these epochs."""
    new = {i: replace(r, angles=angles[r.epoch_id]) for i, r in enumerate(survey.table_readings)
           if r.table_id == table_id and r.epoch_id in angles}  # fmt: skip
    return with_rows(survey, "table_readings", new)


def column_edit(table_id: str, matrix: FloatArray, offset: FloatArray, epochs: tuple[str, ...] = ()) -> ChangeColumns:
    """In ``table_angles.csv`` at some epochs or all: matrix (k, k) times the readings of a table plus (k,) deg."""
    columns = tuple(f"axis{i + 1}_deg" for i in range(len(matrix)))
    where = {"table_id": (table_id,), **({"epoch_id": epochs} if epochs else {})}
    return ChangeColumns("table_angles", columns, matrix, offset, where)


def hypotheses(n_axes: int) -> list[Misread]:
    """All mistakes, the simplest first."""
    names, one, own = [f"axis{i + 1}" for i in range(n_axes)], np.ones(n_axes), tuple(range(n_axes))
    two, other = n_axes == 2, own[::-1]
    out = [Misread("", one, own)] + [Misread("axis1 and axis2 are exchanged", one, other)] * two
    out += [Misread(f"the readings of {' and '.join(names)} {what}", factor * one, own) for factor, what in _UNITS]
    out += [Misread(f"the readings of {name} {what}", np.where(np.arange(2) == i, factor, 1.0), own)
            for i, name in enumerate(names if two else ()) for factor, what in _UNITS]  # fmt: skip
    out += [Misread(f"every epoch has the reading of the {which} one", one, own, partial(np.roll, shift=by, axis=0),
                    (0 if by > 0 else -1,)) for by, which in ((1, "following"), (-1, "preceding"))]  # fmt: skip
    out.append(Misread("the readings are in the opposite order of the epochs", one, own, np.flipud))
    both = [Misread(f"axis1 and axis2 are exchanged, and the readings {what}", factor * one, other)
            for factor, what in _UNITS]  # fmt: skip
    return out + both * two


def shared_mistake(views: TableViews) -> tuple[Verdict | None, float]:
    """The mistake of all readings that explains the images, or None; and the disagreement (rad) as it stands.

    Turning angles sort out most mistakes; exchanged axes leave all of them as they are (the angle of ``R1(a) R2(b)`` is
    that of ``R2(b) R1(a)``), and only show when base and mount have to be the same for all views.
    """
    table = views.table.axes, views.table.geometry.by_name
    seen = content(*table, views.inner, views.outer, views.epoch, views.poses, views.angles)
    return once((_shared_mistake, seen), lambda: _shared_mistake(views))


def _shared_mistake(views: TableViews) -> tuple[Verdict | None, float]:
    pairs = _pairs(views)
    if not len(pairs):
        return None, 0.0
    seen = _turns(views.poses[:, :3, :3].reshape(-1, 9), pairs)
    known = hypotheses(views.angles.shape[1])
    rough = []
    for hypothesis in known:
        R = views.motions(hypothesis.meant(views.angles))[views.epoch][:, :3, :3].reshape(-1, 9)
        rough.append(float(np.median(np.abs(_turns(R, pairs) - seen))))
    bound = 1.5 * min(rough) + np.radians(0.1)
    scores = {i: max(s, _misfit(views, known[i])) for i, s in enumerate(rough) if i == 0 or s < bound}
    # of explanations that are as good as each other the simplest, which comes first
    least = min(scores.values())
    best = next(i for i, s in scores.items() if s <= max(1.5 * least, least + np.radians(0.02)))
    if best == 0 or scores[0] < np.radians(_CLEAR_DEG) or scores[0] < _BETTER * scores[best]:
        return None, scores[0]
    return Verdict(known[best], scores[0], scores[best]), scores[0]


def _misfit(views: TableViews, hypothesis: Misread) -> float:
    """Typical angle (rad) by which views miss what one base and one mount would show; zero where that is open."""
    M = views.motions(hypothesis.meant(views.angles))
    medians = []
    for i, o in sorted(set(zip(views.inner.tolist(), views.outer.tolist(), strict=True))):
        rows = np.flatnonzero((views.inner == i) & (views.outer == o))
        mount_from_table, seen = inverse(M)[views.epoch[rows]], views.poses[rows]
        try:
            Z, X, _ = solve_ax_zb(mount_from_table, seen)
        except (SurveyError, np.linalg.LinAlgError):
            continue
        miss = rotation_log((X @ seen)[:, :3, :3].swapaxes(1, 2) @ (mount_from_table @ Z)[:, :3, :3])
        medians.append(float(np.median(np.linalg.norm(miss, axis=1))))
    return float(np.mean(medians)) if medians else 0.0


def _pairs(views: TableViews) -> IntArray:
    """Pairs (m, 2) of views of one inner and one outer thing at two epochs, at most some thousands."""
    group = views.inner * (1 + views.outer.max()) + views.outer
    i, j = np.triu_indices(len(group), 1)
    keep = (group[i] == group[j]) & (views.epoch[i] != views.epoch[j])
    pairs = np.column_stack([i[keep], j[keep]])
    return pairs[:: max(1, len(pairs) // 5000)]


def _turns(flat: FloatArray, pairs: IntArray) -> FloatArray:
    """Angles (m,) rad between rotations (n, 9); exact near zero too."""
    apart = np.linalg.norm(flat[pairs[:, 0]] - flat[pairs[:, 1]], axis=1)
    # the Frobenius norm of R1 - R2 is 2 sqrt(2) sin(angle / 2)
    return np.asarray(2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0)))
