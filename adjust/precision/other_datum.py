"""A solution in another datum, without solving again: new coordinates and their covariances by an S-transformation.

What was held becomes free: a held point has the covariance zero before and another one after. Only motions of the whole
survey that no observation sees can be chosen anew.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from gtsam import Rot3
from scipy.linalg import block_diag

from adjust.frames.tree import in_world
from adjust.frames.unknowns import Unknowns
from adjust.graph.assembly import AdjustmentGraph, values_of
from adjust.graph.building import GraphBuilder
from adjust.graph.datum import InnerDatum, datum_rows, inner_datum, survey_motions
from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.rewriting import Rewriting
from adjust.model.survey import Datum, FloatArray, PointParameter, PoseParameter, Survey
from adjust.precision.precision import Covariances, Precision, precision_of, rotations_only
from adjust.precision.s_transformation import STransformation, s_transformation
from adjust.spatial.motions import moved_value

_ROUNDS, _SETTLED = 20, 1e-13


@frozen(eq=False)
class TransformedPrecision(Covariances):
    """Covariances in the new datum.

    blocks: per key, how its tangent (dim, dim) turned and grew with the finite motion to the new coordinates.
    """

    precision: Precision
    unknowns: Unknowns
    transformation: STransformation
    blocks: Mapping[int, FloatArray]

    def joint(self, names: Sequence[ParameterName]) -> FloatArray:
        """See :class:`Covariances`."""
        before, now = self.precision.unknowns.by_name, self.unknowns.by_name
        old = [name for name in names if name in before]
        keys = [now[name].key for name in names]
        start = np.cumsum([0] + [now[name].dim for name in names])
        at = [np.arange(start[i], start[i + 1]) for i, name in enumerate(names) if name in before]
        Q = np.zeros((int(start[-1]),) * 2)
        if old:
            index = np.concatenate(at)
            B = block_diag(*(self.blocks[now[name].key] for name in old))
            Q[np.ix_(index, index)] = B @ self.precision.joint(old) @ B.T
        return self.transformation.apply(keys, Q)


def in_datum(result: Adjustment, datum: Datum, reference: Mapping[str, FloatArray] | None = None) -> Adjustment:
    """The adjusted survey in an inner datum over other points or stations.

    reference: coordinates (3,) m that the datum's points are fitted to; None keeps all coordinates where they are and
    changes the covariances only. Residuals and their statistics stay. Raises SurveyError where the observations
    themselves define the datum, and where what is named cannot carry it.
    """
    if datum.kind != "inner":
        raise SurveyError("a solution can be moved to a datum of kind 'inner' only; to hold points, adjust again")
    precision = precision_of(result)
    if rotations_only(result):
        raise SurveyError("nothing but rotations was measured: there are no coordinates to be moved to another datum")
    survey = replace(released(result.survey), datum=datum)
    start = values_of(result)
    graph = GraphBuilder(survey, start.lenses).build(start)
    inner = inner_datum(graph, graph.prepare(graph.start, jacobians=True))
    if inner is None:
        raise SurveyError("the observations define position, orientation and scale: no datum is left to choose")
    values, blocks = graph.start, {u.key: np.eye(u.dim) for u in graph.unknowns.by_name.values()}
    if reference is not None:
        values, blocks = _fitted(graph, inner, reference)
    motions = survey_motions(graph, values, inner.directions)
    old_key = {graph.unknowns.by_name[n].key: u.key for n, u in precision.graph.unknowns.by_name.items()}

    def products(rows: Mapping[int, FloatArray]) -> dict[int, FloatArray]:
        mine = {old_key[k]: row @ blocks[k] for k, row in rows.items() if k in old_key}
        found = precision.datum_products(mine) if mine else {}
        return {k: blocks[k] @ found[old_key[k]] if k in old_key and found else np.zeros(m.shape)
                for k, m in motions.items()}  # fmt: skip

    transformation = s_transformation(datum_rows(inner.keys, motions), motions, products)
    new = TransformedPrecision(precision, graph.unknowns, transformation, blocks)
    estimates = {name: _moved(graph, estimate, values, new) for name, estimate in result.estimates.items()}
    return replace(
        result, survey=survey, estimates=estimates, precision=new, datum_defect=inner.defect,
        n_unknowns=graph.unknowns.n_unknowns,
    )  # fmt: skip


class _Released(Rewriting):
    """Held points and held poses of things in the world are free."""

    def __init__(self, survey: Survey) -> None:
        self.survey = survey

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        return replace(given, treatment="free") if given.treatment == "held" and in_world(self.survey, name) else given

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        return replace(given, treatment="free") if given.treatment == "held" else given


def released(survey: Survey) -> Survey:
    """The survey with held points and held poses of things in the world free."""
    return _Released(survey)(survey)


def _fitted(
    graph: AdjustmentGraph, inner: InnerDatum, reference: Mapping[str, FloatArray]
) -> tuple[gtsam.Values, dict[int, FloatArray]]:
    """Values moved as a whole onto the reference by least squares, and how the tangents (dim, dim) change with it."""
    names = {key: graph.unknowns.by_key[key].name for key in inner.keys}
    lost = [name[1] for name in names.values() if name[0] != "point" or name[1] not in reference]
    if lost:
        raise SurveyError(f"no reference coordinates for {listed(lost, 5)}; give them for every point of the datum")
    values, turn, scale = graph.start, np.eye(3), 1.0
    for _ in range(_ROUNDS):
        motions = survey_motions(graph, values, inner.directions)
        rows = datum_rows(inner.keys, motions)
        seen = np.sum([row @ motions[k] for k, row in rows.items()], axis=0)
        away = {k: np.asarray(values.atPoint3(k)) - reference[names[k][1]] for k in rows}
        shift = -np.linalg.solve(seen, np.sum([row @ away[k] for k, row in rows.items()], axis=0))
        c = inner.directions @ shift
        values = _move(graph, values, c, {k: m @ shift for k, m in motions.items()})
        turn, scale = Rot3.Expmap(c[3:6]).matrix() @ turn, scale * float(np.exp(c[6]))
        if np.abs(c).max() < _SETTLED:
            break
    blocks = {}
    for unknown in graph.unknowns.by_name.values():
        block = np.eye(unknown.dim)
        if unknown.kind == "point":
            block = scale * turn
        elif unknown.kind == "pose":
            block[3:, 3:] *= scale
        blocks[unknown.key] = block
    return values, blocks


def _move(
    graph: AdjustmentGraph, values: gtsam.Values, c: FloatArray, steps: Mapping[int, FloatArray]
) -> gtsam.Values:
    """Values after the finite motion c (7,): translation, rotation vector, logarithm of the scale; vectors by steps."""
    only_larger, out = np.concatenate([np.zeros(6), c[6:]]), gtsam.Values(values)
    for name, unknown in graph.unknowns.by_name.items():
        if unknown.kind == "point":
            out.update(unknown.key, moved_value(np.asarray(values.atPoint3(unknown.key)), c))
        elif unknown.kind == "pose":
            motion = c if in_world(graph.survey, name) else only_larger
            out.update(unknown.key, moved_value(values.atPose3(unknown.key), motion))
        else:
            out.update(unknown.key, np.asarray(values.atVector(unknown.key) + steps[unknown.key]))
    return out


def _moved(graph: AdjustmentGraph, estimate: Estimate, values: gtsam.Values, new: TransformedPrecision) -> Estimate:
    unknown = graph.unknowns.by_name.get(estimate.name)
    if unknown is None:
        return estimate
    cov, held = new.whole([estimate.name], [len(estimate.components)]), graph.unknowns.held.get(unknown.key, ())
    if unknown.kind != "vector":
        value = values.atPose3(unknown.key) if unknown.kind == "pose" else np.asarray(values.atPoint3(unknown.key))
        status = tuple("free" if s == "held" and i not in held else s for i, s in enumerate(estimate.status))
        return replace(estimate, value=value, cov=cov, status=status)
    vector = graph.unknowns.vectors.get(estimate.name)
    if vector is not None and vector.borrowed:  # a lens, which no datum changes
        return estimate
    full = np.asarray(values.atVector(unknown.key)) if vector is None else vector.full(values)
    return replace(estimate, value=full, cov=cov)
