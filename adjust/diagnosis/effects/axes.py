"""A turntable whose axes do not turn evenly: eccentric encoders, run-out and wobble, as unknowns of their own."""

from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.diagnosis.prediction import Linear
from adjust.frames.tables import check_harmonics
from adjust.graph.assembly import values_of
from adjust.graph.building import GraphBuilder
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey, Table
from adjust.model.tables import harmonic, harmonic_names
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2
from adjust.testing.significance import significances

_ALPHA = 1e-4
_KINDS = (
    ("encoder of a table", {"angle": 2}, "its encoder errs as it turns: graduation or eccentricity"),
    ("axis of a table runs out", {"axial": 2, "radial": 1, "tilt": 1}, "it runs out and wobbles as it turns"),
)


def unsteady_axes(case: Case, linear: Linear) -> Iterator[Hypothesis]:
    """Of every axis that was read all round and has no harmonics yet, where their score is clear."""
    for table in case.survey.tables:
        if any(harmonic(name) for name in table.geometry.names):
            continue
        for axis in range(len(table.axes)):
            for name, kinds, said in _KINDS:
                survey = _freed(case.survey, table, axis, kinds)
                found = None if survey is None else _hypothesis(survey, table, axis, name, kinds, said)
                if found is None or survey is None:
                    continue
                drop = _promised(survey, linear.result)
                if drop > linear.scale * float(chi2.isf(sidak(_ALPHA, found.looked_at), found.parameters)):
                    yield replace(found, evidence=linear.ratio(drop), scored=True)


def _promised(survey: Survey, result: Adjustment) -> float:
    """By how much a step from the adjusted values, with the harmonics at zero, lowers v'Pv; 0 where there is none."""
    start = values_of(result, survey)
    graph = GraphBuilder(survey, start.lenses).build(start)
    linear = graph.linearized(graph.prepare(graph.start, jacobians=True, reduced=False))
    try:
        step = linear.optimize()
    except RuntimeError:  # GTSAM: no step, as of a free network
        return 0.0
    nothing = gtsam.VectorValues(step)
    nothing.setZero()
    return 2.0 * float(linear.error(nothing) - linear.error(step))


def _freed(survey: Survey, table: Table, axis: int, kinds: dict[str, int]) -> Survey | None:
    """With these harmonics unknown; None where the axis was not read widely enough for them."""
    waves = tuple(n for kind, highest in kinds.items() for n in harmonic_names(kind, axis, highest))
    given = table.geometry
    geometry = replace(given, names=(*given.names, *waves), values=np.append(given.values, np.zeros(len(waves))),
                       free=(*given.free, *waves))  # fmt: skip
    tables = tuple(replace(t, geometry=geometry) if t.table_id == table.table_id else t for t in survey.tables)
    changed = replace(survey, tables=tables)
    try:
        check_harmonics(changed)
    except SurveyError:
        return None
    return changed


def _hypothesis(survey: Survey, table: Table, axis: int, name: str, kinds: dict[str, int], said: str) -> Hypothesis:
    keys = {f"{kind}_{axis + 1}": highest for kind, highest in kinds.items()}
    shown = ", ".join(f"{key} = {highest}" for key, highest in keys.items())
    n = sum(len(harmonic_names(kind, axis, highest)) for kind, highest in kinds.items())
    cause = f"axis {axis + 1} of table {table.table_id}: {said}"
    return Hypothesis(
        name, cause,
        f"let the adjustment find its harmonics: harmonics = {{ {shown} }}",
        Place("table", (table.table_id,), "harmonics"), survey,
        tuple(SetKey(("tables", table.table_id, "harmonics", key), highest) for key, highest in keys.items()),
        parameters=n, looked_at=len(table.axes) * len(_KINDS),
    ).told(lambda result: f"{cause} ({_sizes(result, table.table_id)})")  # fmt: skip


def _sizes(result: Adjustment, table_id: str) -> str:
    """Of the harmonics that stand out."""
    estimate = result.estimates[("table_geometry", table_id)]
    values = dict(zip(estimate.components, np.asarray(estimate.value).tolist(), strict=True))
    parts = []
    for test in significances(result, estimate, estimated_sigma0=True):
        if test.significant:
            size, in_m = float(np.hypot(*(values[c] for c in test.components))), test.term[:2] in ("ax", "ra")
            shown = f"{1e3 * size:.3f} mm" if in_m else f"{np.degrees(size) * 3600.0:.1f} arcsec"
            parts.append(f"{test.term.replace('_', ' ')} {shown}")
    return ", ".join(parts) or "no single order stands out"
