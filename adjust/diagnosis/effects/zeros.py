"""Zeros of the axes of a table that are others from some epoch on: referenced anew, or a coupling that slipped."""

from collections.abc import Iterator

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import Effect, of_others
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.prediction import Linear
from adjust.diagnosis.table.readings import column_edit, with_angles
from adjust.model.observations import TableReading
from adjust.model.result import Adjustment
from adjust.model.rewriting import Fields
from adjust.model.survey import FloatArray, Survey, Table
from adjust.precision.precision import noise_of
from adjust.statistics.score import Part, Score

_FEWEST = 4


def zeros(case: Case, linear: Linear) -> Iterator[Effect]:
    """Of every axis the best epoch for it."""
    for table in case.survey.tables:
        read = [r for r in case.survey.table_readings if r.table_id == table.table_id and r.used]
        for axis in range(len(table.axes) if len(read) >= _FEWEST else 0):
            parts = _parts(linear, read, axis)
            (found,) = linear.steps([parts]) if len(parts) == len(read) else ({},)
            if found:
                cut = max(found, key=lambda t: found[t].drop)
                yield _moved(case.survey, table, read[cut:], axis, found[cut], len(found))


def _parts(linear: Linear, read: list[TableReading], axis: int) -> list[Part]:
    """Rows of the readings, and their derivatives by a zero that each of them counts from."""
    at = {o.ids: i for i, o in enumerate(linear.system.precision.graph.others) if o.kind == "table"}
    out = []
    for r in read:
        i = at.get((r.table_id, r.epoch_id))
        if i is not None:
            R = np.asarray(noise_of(linear.system.precision.graph.others[i]).R())
            first, last = linear.system.ptr[linear.system.n_image + i :][:2]
            out.append((np.arange(first, last), R[:, axis : axis + 1]))
    return out


def _moved(survey: Survey, table: Table, late: list[TableReading], axis: int, first: Score, looked_at: int) -> Effect:
    table_id, since = table.table_id, late[0].epoch_id
    epochs, unit = tuple(r.epoch_id for r in late), np.eye(len(table.axes))[axis]
    shifts: dict[tuple[str, ...], FloatArray] = {(table_id, e): unit[:, None] for e in epochs}

    def mended(_: Adjustment, theta: FloatArray) -> Survey:
        return with_angles(survey, table_id, {r.epoch_id: r.angles - theta[0] * unit for r in late})

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        size = f"{np.degrees(theta[0]):+.4f} +- {np.degrees(sigmas[0]):.4f} deg"
        return f"table {table_id}: the zero of axis{axis + 1} is another one from epoch {since} on, by {size}{alike}"

    inner = axis == len(table.axes) - 1
    what = f"what table {table_id} carries" if inner else f"table {table_id}, or all that stands still around it,"
    alike = f" (or {what} was turned about that axis: what was observed cannot tell)"
    place = Place("table", (table_id,), "axis1_deg", epochs)
    remedy = f"take that off axis{axis + 1}_deg of table_angles.csv from {since} on"
    hypothesis = Hypothesis("zero of an axis", "", remedy, place, survey, (), 1.0, 1, looked_at)

    def edited(theta: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, Fields]:
        edit = column_edit(table_id, np.eye(len(unit)), -np.degrees(theta[0]) * unit, epochs)
        return theta, {"cause": said(theta, sigmas), "edits": (edit,)}

    return Effect(hypothesis, first, lambda at: of_others(at, "table", shifts), mended, said, known=edited)
