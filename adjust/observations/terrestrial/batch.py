"""All readings of a survey: evaluated together, served to GTSAM chunk by chunk."""

from collections.abc import Mapping, Sequence
from copy import copy
from functools import partial

import gtsam
import numpy as np

from adjust.frames.state import State
from adjust.frames.unknowns import VectorMap
from adjust.model.errors import SurveyError
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.observations.adapter import evaluated
from adjust.observations.factors import Jacobians
from adjust.observations.terrestrial import equations as k
from adjust.observations.terrestrial.layout import Chunk, Layout
from adjust.observations.terrestrial.parameters import TerrestrialParameters
from adjust.spatial.averaging import circular_median
from adjust.spatial.vertical import Horizon, Plumb


class TerrestrialBatch:
    """Readings with their predicted values and derivatives at the values last prepared.

    residual (N,): predicted minus observed, horizontal angles in (-pi, pi]. A (N, 22): derivatives by what
    :mod:`adjust.observations.terrestrial.equations` lists. e (N,): residuals over their sigmas (not decorrelated).
    Arrays are in the order of ``Survey.readings``.
    """

    def __init__(self, survey: Survey, state: State, parameters: TerrestrialParameters, layout: Layout) -> None:
        self.state, self.parameters, self.layout = state, parameters, layout
        self.ids = [r.reading_id for r in survey.readings]
        self.sign = -1.0 if survey.bearings.clockwise else 1.0
        radius = survey.vertical.radius
        if radius is not None and not radius > 0.0:
            raise SurveyError(f"vertical: the radius of the level surfaces is {radius} m; give a positive one, or none")
        self.curve = 0.5 / radius if radius else 0.0
        a = layout.arrays
        n, p = len(a.kind), len(layout.positions)
        self.horizon = Horizon(*(np.zeros((p, *shape)) for shape in ((3, 3), (3, 3), (3, 2), (), (2,))))
        self.X, self.body_axes = np.zeros((p, 3)), np.zeros((max(1, len(layout.bodies)), 3, 3))
        self.orientation = np.zeros(max(1, len(parameters.orientations)))
        self.centring = np.zeros((max(1, len(parameters.centrings)), 3))
        self.instrument = np.zeros((1 + len(parameters.instruments), 4))
        self.geometry = k.Geometry(
            self.X, self.horizon, self.body_axes, self.orientation, self.centring, self.instrument
        )
        self.predicted, self.residual, self.A = np.zeros(n), np.zeros(n), np.zeros((n, k.N_COLUMNS))
        self.chain_jacobians: dict[int, Jacobians] = {}
        self.sigma = a.sigma.copy()
        self.weights = a.used.astype(np.float64)
        self.J = np.zeros(layout.size)
        self.e = np.zeros(n)
        self._orientation_maps: list[VectorMap] = list(parameters.orientations.values())
        self._centring_maps: list[VectorMap] = list(parameters.centrings.values())
        self._instrument_maps: list[VectorMap] = list(parameters.instruments.values())
        for i, position in enumerate(layout.positions):
            if position.point_key is None and position.chain is None:
                self.X[i] = position.x_in_frame
        self._point_keys = [(i, p.point_key) for i, p in enumerate(layout.positions) if p.point_key is not None]
        self._chained = [i for i, p in enumerate(layout.positions) if p.point_key is None and p.chain is not None]
        self.correlated = [c for c, chunk in enumerate(layout.chunks) if chunk.whitener is not None]
        self._views = [_blocks(chunk, self.J) for chunk in layout.chunks]
        self.chi_square = 0.0
        self._plumb: Plumb | None = None  # that of the horizons at all positions, where these were found together

    @property
    def used(self) -> BoolArray:
        """Which readings (N,) take part."""
        return np.asarray(self.weights > 0.0)

    @property
    def keys(self) -> set[int]:
        """All unknowns that a reading depends on, used or not."""
        return {key for chunk in self.layout.chunks for key in chunk.keys}

    # -- evaluation --------------------------------------------------------------------------------------------------

    def _load(self, values: gtsam.Values, positions: IntArray | None, bodies: Sequence[int]) -> None:
        self.state.outdate()
        plumb = self.parameters.vertical.at(values)
        for i, key in self._point_keys if positions is None else self._points_of(positions):
            self.X[i] = values.atPoint3(key)
        chained = self._chained if positions is None else [i for i in self._chained if i in set(positions.tolist())]
        for i in chained:
            self.X[i], self.chain_jacobians[i] = self.layout.positions[i](values)
        for b in bodies:
            pose, jacobians = self.layout.bodies[b](values)
            self.body_axes[b] = pose.rotation().matrix().T
            self.chain_jacobians[len(self.X) + b] = [(key, J[:3]) for key, J in jacobians]
        for i, vector in enumerate(self._instrument_maps):
            self.instrument[i + 1] = vector.full(values)
        where: IntArray | slice = slice(None) if positions is None else positions
        if plumb is self._plumb and not plumb.radius:  # parallel plumb lines: nothing but heights goes with positions
            x = self.X[where]
            self.horizon.height[where], self.horizon.height_by_tilt[where] = x @ plumb.up, x @ plumb.turned_up
            return
        for name, found in vars(plumb.horizon(self.X[where])).items():
            getattr(self.horizon, name)[where] = found
        self._plumb = plumb if positions is None else None

    def _points_of(self, positions: IntArray) -> list[tuple[int, int]]:
        found = [(int(i), self.layout.positions[int(i)].point_key) for i in positions]
        return [(i, key) for i, key in found if key is not None]

    def evaluate(self, values: gtsam.Values) -> None:
        """Predicted values, residuals and derivatives of all readings at ``values``."""
        for i, vector in enumerate(self._orientation_maps):
            self.orientation[i] = values.atVector(vector.key)[0] if vector.key is not None else 0.0
        for i, vector in enumerate(self._centring_maps):
            self.centring[i] = vector.full(values)
        self._load(values, None, range(len(self.layout.bodies)))
        a = self.layout.arrays
        self.predicted, self.A = k.predict(a, self.geometry, self.sign, self.curve)
        self.residual = k.wrapped(a.kind, self.predicted, a.observed)

    def prepare(self, values: gtsam.Values, jacobians: bool) -> None:
        """Evaluate everything at ``values``; chi-square is infinite where these give a reading no direction."""
        self.evaluate(values)
        chi_square = self._whiten(np.sqrt(self.weights))
        self.chi_square = chi_square if np.isfinite(chi_square) else np.inf
        if jacobians:
            self._serve(np.sqrt(self.weights))

    def require_directions(self) -> None:
        """Raises SurveyError where the values that were evaluated last, those of the start, give a reading none."""
        for bad in np.flatnonzero(~np.isfinite(self.residual))[:1].tolist():
            raise SurveyError(
                f"reading {self.ids[bad]!r}: its positions coincide, or are one above the other, at the start "
                "values; give better coordinates"
            )

    def _whiten(self, root: FloatArray) -> float:
        """Whitened residuals e (N,), of correlated readings jointly, times ``root``; returns their square sum."""
        self.e = self.residual / self.sigma
        for c in self.correlated:
            chunk = self.layout.chunks[c]
            self.e[chunk.rows] = self._whitener(chunk) @ self.residual[chunk.rows]
        self.e *= root
        self.e[root == 0.0] = 0.0
        return float(self.e @ self.e)

    @staticmethod
    def _whitener(chunk: Chunk) -> FloatArray:
        if chunk.whitener is None:
            raise ValueError("only chunks with a joint covariance have a whitener")
        return chunk.whitener

    def _serve(self, root: FloatArray) -> None:
        """Jacobian blocks of all chunks, whitened and times ``root`` (N,)."""
        layout = self.layout
        self.J[:] = 0.0
        scale = root / self.sigma
        for c in self.correlated:
            scale[layout.chunks[c].rows] = 1.0
        self._scatter(slice(None), scale)
        for c in layout.chain_rows:
            self._chain_blocks(c, scale)
        for c in self.correlated:
            self._decorrelate(c, root)

    def _scatter(self, entries: slice, scale: FloatArray) -> None:
        """Add the derivatives of these entries of the layout to their places in J, times ``scale`` (N,) of the row."""
        layout = self.layout
        row = layout.row[entries]
        by = scale[row] * self.A[row, layout.column[entries]] * layout.factor[entries]
        np.add.at(self.J, layout.goal[entries], by)

    def _chain_blocks(self, c: int, scale: FloatArray) -> None:
        for item in self.layout.chain_rows[c]:
            by_position = scale[item.row] * self.A[item.row, item.column : item.column + 3]
            for key, J in self.chain_jacobians[item.chain]:
                at = item.goal[key]
                self.J[at : at + J.shape[1]] += by_position @ J

    def _decorrelate(self, c: int, root: FloatArray) -> None:
        chunk = self.layout.chunks[c]
        W = root[chunk.rows][:, None] * self._whitener(chunk)
        for block in self._views[c]:
            block[:] = W @ block

    def unweighted(self, values: gtsam.Values) -> FloatArray:
        """Whitened residuals (N,) of all readings at ``values``, whatever their weight; J holds rows to match."""
        self.evaluate(values)
        root = np.ones(len(self.weights))
        self._whiten(root)
        self._serve(root)
        return self.e

    def jacobian(self, c: int) -> FloatArray:
        """Whitened Jacobian (m, n) of chunk ``c`` as last served, keys in the chunk's order."""
        views = self._views[c]
        return np.hstack(views) if views else np.zeros((len(self.layout.chunks[c].rows), 0))

    def with_sigmas_at(self, values: gtsam.Values) -> tuple["TerrestrialBatch", float]:
        """The readings with sigmas that have the target's centring at these distances; the largest relative change."""
        if not self.layout.arrays.target_centring.any():
            return self, 0.0
        self.evaluate(values)
        joint = [r for c in self.correlated for r in self.layout.chunks[c].rows]
        out = copy(self)  # its working memory is that of the last evaluation, whichever of them was evaluated
        out.sigma = self._sigmas()
        out.sigma[joint] = self.sigma[joint]
        return out, float(np.max(np.abs(out.sigma / self.sigma - 1.0)))

    def _sigmas(self) -> FloatArray:
        """Sigmas (N,) of readings with targets off by ``target_centring`` in any horizontal direction."""
        a = self.layout.arrays
        off = np.where((a.kind != k.HEIGHT) & (a.target_centring > 0.0), a.target_centring, 0.0)
        rows, variance = np.flatnonzero(off), a.sigma**2
        for column, target in ((k.TO, a.to), (k.SECOND, a.second)):
            variance[rows] += off[rows] ** 2 * (self.by_horizontal(column, target)[rows] ** 2).sum(axis=1)
        return np.sqrt(variance)

    def by_horizontal(self, column: int, position: IntArray) -> FloatArray:
        """Derivatives (N, 2) by horizontal movements of positions (N,), of which A has those from ``column`` on.

        Zero where there is none.
        """
        along = self.A[:, None, column : column + 3] @ np.swapaxes(self.horizon.axes[position, :2], 1, 2)
        return np.where(position[:, None] >= 0, along[:, 0], 0.0)

    # -- GTSAM -------------------------------------------------------------------------------------------------------

    def add_factors(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """One factor per chunk of which anything is used."""
        used = self.layout.arrays.used
        noise: dict[int, gtsam.noiseModel.Base] = {}
        for c, chunk in enumerate(self.layout.chunks):
            m = len(chunk.rows)
            # readings between held positions adjust nothing, but count in the square sum and the redundancy
            if used[chunk.rows].any() and chunk.keys:
                noise.setdefault(m, gtsam.noiseModel.Unit.Create(m))
                graph.add(evaluated(noise[m], list(chunk.keys), partial(self.residual_of, c)))

    def residual_of(self, c: int, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        """What GTSAM's custom factor of chunk ``c`` returns."""
        rows = self.layout.chunks[c].rows
        if not self.state.served:
            self._alone(c, values)
        if jacobians is not None:
            for i, block in enumerate(self._views[c]):
                jacobians[i] = block
        return np.asarray(self.e[rows])

    def _alone(self, c: int, values: gtsam.Values) -> None:
        """Evaluate one chunk, for a caller that did not prepare the batch."""
        layout, a = self.layout, self.layout.arrays
        chunk = layout.chunks[c]
        rows = chunk.rows
        for i in np.unique(a.orientation[rows][a.kind[rows] == k.DIRECTION]):
            key = self._orientation_maps[i].key
            self.orientation[i] = 0.0 if key is None else values.atVector(key)[0]
        for i in np.unique(a.centring[rows]):
            if i >= 0:
                self.centring[i] = self._centring_maps[i].full(values)
        positions = np.unique(np.concatenate([a.at[rows], a.to[rows], a.second[rows]]))
        self._load(values, positions[positions >= 0], [int(b) for b in np.unique(a.body[rows]) if b >= 0])
        self.predicted[rows], self.A[rows] = k.predict(a.of(rows), self.geometry, self.sign, self.curve)
        out = self.residual[rows] = k.wrapped(a.kind[rows], self.predicted[rows], a.observed[rows])
        root = np.sqrt(self.weights)
        scale = root / self.sigma
        if chunk.whitener is not None:
            scale[rows] = 1.0
        self.e[rows] = scale[rows] * out
        self.J[chunk.start : chunk.start + len(rows) * chunk.width] = 0.0
        self._scatter(slice(layout.entry_ptr[c], layout.entry_ptr[c + 1]), scale)
        if c in layout.chain_rows:
            self._chain_blocks(c, scale)
        if chunk.whitener is not None:
            self.e[rows] = root[rows] * (chunk.whitener @ out)
            self._decorrelate(c, root)

    def orient(self, values: gtsam.Values, known: set[str], poses: Mapping[str, int]) -> None:
        """Set the orientations not ``known`` (setups) to what their directions say at the other ``values``.

        poses: keys of stations that are turned instead, by setup whose orientation is held for their sake.
        """
        self.evaluate(values)
        a, orientations = self.layout.arrays, self.parameters.orientations
        rows = np.flatnonzero(a.kind == k.DIRECTION)
        rows = rows[np.argsort(a.orientation[rows], kind="stable")]
        first = np.searchsorted(a.orientation[rows], np.arange(1, len(orientations)))
        turns = np.split(self.residual[rows], first) if orientations else []
        for i, (turn, (setup_id, vector)) in enumerate(zip(turns, orientations.items(), strict=True)):
            if setup_id not in known and vector.key is not None:
                values.update(vector.key, self.orientation[i : i + 1] + circular_median(turn[np.isfinite(turn)]))
            elif setup_id not in known and setup_id in poses:
                turn_about_z = self.sign * circular_median(turn[np.isfinite(turn)])
                station = values.atPose3(poses[setup_id])
                values.update(poses[setup_id], station * gtsam.Pose3(gtsam.Rot3.Rz(turn_about_z), np.zeros(3)))


def _blocks(chunk: Chunk, J: FloatArray) -> list[FloatArray]:
    out, at, m = [], chunk.start, len(chunk.rows)
    for dim in chunk.dims:
        out.append(J[at : at + m * dim].reshape(m, dim))
        at += m * dim
    return out
