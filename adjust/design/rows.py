"""Whitened Jacobian rows of single observations over all unknowns, dense: what each of them tells about what.

The batches condense their observations and hide some unknowns; here every observation stays apart, so that sets of them
can be weighed against each other. For designs of some thousand unknowns at most.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from adjust.design.prediction import Predictor
from adjust.graph.assembly import StartValues
from adjust.lenses.models import MODELS, camera_constants, lens_derivatives
from adjust.model.boards import deformation, warming_of
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.observations.factors import ChainPose
from adjust.observations.images.batch import square_root_information
from adjust.spatial.rigid import skew


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened rows A (m, k) of one observation and the columns (k,) of the unknowns they touch.

    kind, number: image block ``survey.image_blocks[number]``, or ``graph.others[number]`` under its kind, or
    ``survey.readings[number]`` under kind "reading" (the first of those with a joint covariance). group: of the
    variance component.
    """

    kind: str
    number: int
    group: str
    A: FloatArray
    columns: IntArray


@dataclass(frozen=True, eq=False)
class DesignMatrix:
    """All used observations of a survey at given values. names: unknowns in column order; at: their columns."""

    predictor: Predictor
    names: tuple[ParameterName, ...]
    at: dict[ParameterName, slice]
    n: int
    rows: tuple[Rows, ...]

    def normal(self, rows: Iterable[Rows] | None = None) -> FloatArray:
        """Normal matrix (n, n) of all observations, or of these."""
        N = np.zeros((self.n, self.n))
        for r in self.rows if rows is None else rows:
            N[np.ix_(r.columns, r.columns)] += r.A.T @ r.A
        return N

    def columns(self, names: Sequence[ParameterName]) -> IntArray:
        """Columns of these unknowns, one after the other."""
        return _ranges([self.at[n] for n in names])


def design_matrix(survey: Survey, start: StartValues) -> DesignMatrix:
    """Linearise every used observation of the survey at ``start``. Raises SurveyError where a value is missing."""
    p = Predictor(survey, start)
    names, at, n = [], {}, 0
    for name, unknown in p.graph.unknowns.by_name.items():
        names.append(name)
        at[name] = slice(n, n + unknown.dim)
        n += unknown.dim
    by_key = {u.key: at[name] for name, u in p.graph.unknowns.by_name.items()}
    rows = [_image(p, i, block, by_key) for i, block in enumerate(survey.image_blocks)]
    for i, item in enumerate(p.graph.others):
        if item.used:
            linear = item.factor.linearize(p.values)
            columns = _ranges([by_key[k] for k in list(linear.keys())])
            rows.append(Rows(item.kind, i, item.group, np.asarray(linear.jacobian()[0]), columns))
    rows += _readings(p, by_key)
    return DesignMatrix(p, tuple(names), at, n, tuple(r for r in rows if len(r.A)))


def _readings(p: Predictor, by_key: dict[int, slice]) -> list[Rows]:
    """Rows of used readings, one by one, those with a joint covariance together."""
    batch, out = p.graph.terrestrial, list[Rows]()
    if batch is None:
        return out
    batch, _ = batch.with_sigmas_at(p.values)
    batch.unweighted(p.values)
    for c, chunk in enumerate(batch.layout.chunks):
        columns, A = _ranges([by_key[k] for k in chunk.keys]), batch.jacobian(c)
        parts = [np.arange(len(chunk.rows))] if chunk.whitener is not None else np.arange(len(chunk.rows))[:, None]
        for part in parts:
            first = int(chunk.rows[part[0]])
            if p.survey.readings[first].used and len(columns):
                out.append(Rows("reading", first, p.survey.readings[first].group, A[part], columns))
    return out


def _image(p: Predictor, number: int, block: ImageBlock, by_key: dict[int, slice]) -> Rows:
    """Rows (2n, k) of an image block by the chain rule: lens, chain of poses, warp, points."""
    used = np.ones(len(block.uv), dtype=np.bool_) if block.used is None else block.used
    idx, camera = block.point_idx[used], p.cameras[block.camera_id]
    ref = FrameRef("target", block.target_id, block.epoch_id) if block.target_id else FrameRef("world")
    chain = p.frames.relative(ref, FrameRef("camera", block.camera_id, block.epoch_id))
    pose, jacobians = ChainPose(p.graph.unknowns, p.graph.state, chain)(p.values)
    R, x = pose.rotation().matrix(), p.points_in_frame(block.target_id, block.epoch_id)[idx]
    q = x @ R.T + pose.translation()
    model, lens = MODELS[camera.lens.model], p.lens(camera, block.epoch_id)
    _, by_lens, by_q = lens_derivatives(model, lens, camera_constants(camera), q, block.uv[used])
    W = _whitening(block.cov[used])
    out: dict[int, FloatArray] = {}

    def add(key: int, J: FloatArray) -> None:
        out[key] = out[key] + J if key in out else J

    states = p.graph.state.lens_states
    by_free = by_lens @ p.graph.unknowns.vectors["lens", camera.camera_id].matrix
    for part in states.parts(states.of(camera.camera_id, block.epoch_id)):
        J = np.zeros((len(idx), 2, p.graph.unknowns.by_key[part.key].dim))
        J[:, :, part.within : part.within + part.n] = part.factor * by_free[:, :, part.first : part.first + part.n]
        add(part.key, J)
    by_x = by_q @ R
    by_pose = np.concatenate([by_x @ -skew(x), by_x], axis=2)
    for key, J in jacobians:
        add(key, by_pose @ J)
    for key, J, row in _own_points(p, block, idx, by_x):
        full = np.zeros((len(idx), 2, J.shape[-1]))
        full[row] = J
        add(key, full)
    keys = list(out)
    A = np.concatenate([(W @ out[k]).reshape(2 * len(idx), -1) for k in keys] or [np.zeros((2 * len(idx), 0))], axis=1)
    return Rows("image", number, block.group, A, _ranges([by_key[k] for k in keys]))


def _own_points(
    p: Predictor, block: ImageBlock, idx: IntArray, by_x: FloatArray
) -> list[tuple[int, FloatArray, IntArray]]:
    """Derivatives by what the points themselves depend on: key, (r, 2, dim), and the rows r."""
    unknowns = p.graph.unknowns
    if block.target_id is not None:
        vector = unknowns.vectors.get(("warp", block.target_id))
        if vector is None or vector.key is None:
            return []
        target = p.targets[block.target_id]
        moves = deformation(target.x_in_target, vector.names, warming_of(p.survey, target, block.epoch_id))[idx]
        return [(vector.key, by_x @ moves @ vector.matrix, np.arange(len(idx)))]
    out = []
    for row, i in enumerate(idx.tolist()):
        unknown = unknowns.by_name.get(("point", p.survey.points[i].point_id))
        if unknown is not None:
            out.append((unknown.key, by_x[row : row + 1], np.array([row])))
    return out


def _ranges(places: Sequence[slice]) -> IntArray:
    return np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(s.start, s.stop) for s in places)])


def _whitening(cov: FloatArray) -> FloatArray:
    w = square_root_information(cov)
    W = np.zeros((len(cov), 2, 2))
    W[:, 0, 0], W[:, 0, 1], W[:, 1, 1] = w.T
    return W
