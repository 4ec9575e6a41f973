"""What is taken for known, as an unknown of its own where its score is clear: sags, uneven axes, lenses not shared."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import of_shape
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.diagnosis.prediction import Linear
from adjust.frames.lens_states import lenders
from adjust.frames.tables import check_harmonics
from adjust.graph.assembly import values_of
from adjust.graph.building import GraphBuilder
from adjust.model.boards import BENT, deformation
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.rewriting import with_changed
from adjust.model.survey import Survey, Table, VectorParameter
from adjust.model.tables import harmonic, harmonic_names
from adjust.statistics.score import own_score, shared_lenses
from adjust.testing.significance import significances

_FLAT = 0.1
_KINDS = (
    ("encoder of a table", {"angle": 2}, "its encoder errs as it turns: graduation or eccentricity"),
    ("axis of a table runs out", {"axial": 2, "radial": 1, "tilt": 1}, "it runs out and wobbles as it turns"),
)


def bent_targets(case: Case, linear: Linear) -> Iterator[Hypothesis]:
    """Flat targets that are not bent yet."""
    flat = [t for t in case.survey.targets if np.ptp(t.x_in_target[:, 2]) < _FLAT * np.ptp(t.x_in_target[:, :2])]
    for given in (t for t in flat if t.warp is None or not t.warp.free):
        target, warp = given.target_id, VectorParameter(BENT, np.zeros(2), free=BENT)
        drop = of_shape(linear, target, deformation(given.x_in_target, BENT)).drop
        if linear.clear(drop, 2, len(flat)):
            yield Hypothesis(
                "target bent", f"target {target} is bent", "let the adjustment find its sag: warp = { free = true }",
                Place("target", (target,), "warp"), with_changed(case.survey, "targets", target, warp=warp),
                (SetKey(("targets", target, "warp", "free"), True),), linear.ratio(drop), 2, len(flat), scored=True,
            ).told(partial(_sag, target))  # fmt: skip


def _sag(target: str, result: Adjustment) -> str:
    sag = result.estimates[("warp", target)]
    text = ", ".join(
        f"{1e3 * v:+.3f} mm +- {1e3 * s:.3f} mm along {axis}"
        for v, s, axis in zip(np.asarray(sag.value), np.sqrt(np.diag(sag.cov)), "xy", strict=True)
    )
    return f"target {target} is bent: sag {text}"


def unsteady_axes(case: Case, linear: Linear) -> Iterator[Hypothesis]:
    """Axes of tables that were read all round and have no harmonics yet: eccentric encoders, run-out and wobble."""
    for table in case.survey.tables:
        if any(harmonic(name) for name in table.geometry.names):
            continue
        for axis in range(len(table.axes)):
            for name, kinds, said in _KINDS:
                waves = tuple(n for kind, highest in kinds.items() for n in harmonic_names(kind, axis, highest))
                survey, looked_at = _with_harmonics(case.survey, table, waves), len(table.axes) * len(_KINDS)
                drop = 0.0 if survey is None else _promised(survey, linear.result)
                if survey is not None and linear.clear(drop, len(waves), looked_at):
                    keys = {f"{kind}_{axis + 1}": highest for kind, highest in kinds.items()}
                    cause = f"axis {axis + 1} of table {table.table_id}: {said}"
                    yield _uneven(survey, table.table_id, name, cause, keys, linear.ratio(drop), len(waves), looked_at)


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


def _with_harmonics(survey: Survey, table: Table, waves: tuple[str, ...]) -> Survey | None:
    """With these harmonics unknown; None where an axis was not read widely enough for them."""
    given = table.geometry
    geometry = replace(given, names=(*given.names, *waves), values=np.append(given.values, np.zeros(len(waves))),
                       free=(*given.free, *waves))  # fmt: skip
    changed = with_changed(survey, "tables", table.table_id, geometry=geometry)
    try:
        check_harmonics(changed)
    except SurveyError:
        return None
    return changed


def _uneven(
    survey: Survey, table: str, name: str, cause: str, keys: dict[str, int], evidence: float, n: int, looked_at: int
) -> Hypothesis:
    shown = ", ".join(f"{key} = {highest}" for key, highest in keys.items())
    edits = tuple(SetKey(("tables", table, "harmonics", key), highest) for key, highest in keys.items())
    return Hypothesis(
        name, cause, f"let the adjustment find its harmonics: harmonics = {{ {shown} }}",
        Place("table", (table,), "harmonics"), survey, edits, evidence, n, looked_at, scored=True,
    ).told(lambda result: f"{cause} ({_sizes(result, table)})")  # fmt: skip


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


def untied(case: Case, linear: Linear) -> Iterator[Hypothesis]:
    """Every camera with a lens of its own that shares parameters which clearly differ."""
    shared, survey = lenders(case.survey), case.survey
    for camera, (lender, parameters) in shared.items():
        score = own_score(linear, camera, lender, parameters)
        if score.seen and linear.clear(score.drop, score.seen, len(shared)):
            lens = replace(survey.cameras_by_id[camera].lens, shared=None)
            hypothesis = Hypothesis(
                "lens not shared", f"camera {camera}: its lens is not that of camera {lender}",
                f"give it parameters of its own: parameters = [] in cameras.{camera}.lens.shared",
                Place("camera", (camera,), "shared"), with_changed(survey, "cameras", camera, lens=lens),
                (SetKey(("cameras", camera, "lens", "shared", "parameters"), ()),),
                linear.ratio(score.drop), score.seen, len(shared), scored=True,
            )  # fmt: skip
            yield hypothesis.told(partial(_difference, hypothesis.cause, linear.result, camera))


def _difference(cause: str, tied: Adjustment, camera: str, _: Adjustment) -> str:
    found = next((s for s in shared_lenses(tied, True) if s.camera == camera), None)
    return "" if found is None else f"{cause}: {found.said()}"
