"""Plain ways to everything the numerical core computes: residuals by OpenCV and matrix lines, derivatives by
differences, covariances by a dense inverse. Nothing here is fast, and nothing here is taken from the core."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import Solved, SolveOptions, solve
from adjust.lenses.models import MODELS
from adjust.model.observations import Coordinates, Distance, FrameRef, ImageBlock, PositionRef, TableReading
from adjust.model.result import ParameterName
from adjust.model.survey import (
    Camera,
    FloatArray,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
    Table,
    Target,
    Tie,
    VectorParameter,
)
from adjust.precision.precision import Precision, other_residuals
from survey.simulate import resample
from survey.simulate.scene import BROWN, Scene, Truth, rotation_about, transform

HELD = PoseParameter(Pose3(), "held")
FREE_LENS = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")


# -- start values ------------------------------------------------------------------------------------------------------


def start_at(truth: Truth) -> StartValues:
    """Start values at the truth."""
    vectors = ("table_geometry", "table_angles", "warp")
    return StartValues(
        {name[1]: np.asarray(v) for name, v in truth.items() if name[0] == "lens"},
        {name: v for name, v in truth.items() if isinstance(v, Pose3)},
        {name[1]: np.asarray(v) for name, v in truth.items() if name[0] == "point"},
        {name: np.asarray(v) for name, v in truth.items() if name[0] in vectors},
    )


def shaken(start: StartValues, seed: int, poses: float = 0.01, points: float = 0.0) -> StartValues:
    """Start values off by ``poses`` (rad and m, one sigma) and ``points`` (m)."""
    rng = np.random.default_rng(seed)
    return replace(
        start,
        poses={k: p.compose(Pose3.Expmap(rng.normal(0.0, poses, 6))) for k, p in start.poses.items()},
        points={k: x + rng.normal(0.0, points, 3) for k, x in start.points.items()},
    )


def build(survey: Survey, start: StartValues) -> AdjustmentGraph:
    return GraphBuilder(survey, start.lenses).build(start)


def solved(survey: Survey, start: StartValues, tight: bool = True) -> tuple[AdjustmentGraph, Solved]:
    """Graph and solution; ``tight`` leaves nothing to go but rounding."""
    graph = build(survey, start)
    return graph, solve(graph, SolveOptions(max_step=1e-10) if tight else SolveOptions())


def disturbed(values: gtsam.Values, graph: AdjustmentGraph, seed: int, scale: float = 1.0) -> gtsam.Values:
    """Values well away from ``values``, so that no residual is zero."""
    rng = np.random.default_rng(seed)
    delta = gtsam.VectorValues()
    for unknown in graph.unknowns.by_name.values():
        size = scale * steps_of(unknown, values) * (1.0 if unknown.kind == "vector" else 10.0)
        delta.insert(unknown.key, rng.normal(size=unknown.dim) * size)
    return values.retract(delta)


# -- derivatives -------------------------------------------------------------------------------------------------------


def steps_of(unknown: Any, values: gtsam.Values) -> FloatArray:
    """Difference steps (dim,): well seen in the image, and small enough for an error of the fourth order."""
    if unknown.kind != "vector":
        return np.full(unknown.dim, 3e-4)
    size = {"px": 1.0, "mm": 1e-2, "rad": 3e-4, "m": 3e-4, "1": 0.01}
    high_orders = {"k1": 0.05, "k2": 0.3, "k3": 2.0}
    high_orders |= {"k4": 0.03, "k5": 0.1, "k6": 0.2} if "k6" in unknown.components else {"k4": 10.0}
    high_orders |= dict.fromkeys(("scale_x", "scale_y", "shear"), 1e-3)
    x = np.abs(values.atVector(unknown.key))
    steps = [size.get(u, 0.03 * v + 1e-7) for u, v in zip(unknown.units, x, strict=True)]
    return np.array([high_orders.get(c, s) for c, s in zip(unknown.components, steps, strict=True)])


def differences(
    f: Callable[[gtsam.Values], FloatArray], values: gtsam.Values, key: int, steps: FloatArray
) -> FloatArray:
    """Derivative (n, dim) of f by the tangent of ``key``, five-point central differences: error O(step^4)."""
    columns = []
    for i, h in enumerate(steps):
        total: FloatArray = np.zeros(1)
        for k, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
            delta = gtsam.VectorValues()
            delta.insert(key, h * k * np.eye(len(steps))[i])
            total = total + weight * f(values.retract(delta))
        columns.append(total / (12.0 * h))
    return np.stack(columns, axis=-1)


def whitened_residual(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> FloatArray:
    return -np.asarray(factor.linearize(values).jacobian()[1])


def jacobian_mismatch(factor: gtsam.NonlinearFactor, graph: AdjustmentGraph, values: gtsam.Values) -> float:
    """Largest error of a factor's Jacobian against differences of its own residual, relative to each row's length.

    Knows nothing of the factor but ``linearize``; the residual must not be near zero, where wrong derivatives of
    logarithms cannot be seen.
    """
    linear = factor.linearize(values)
    A, b = linear.jacobian()
    if np.linalg.norm(b) < 1e-3:
        raise ValueError("the residual is too small to see a wrong derivative")
    by_key = graph.unknowns.by_key
    numeric = np.hstack(
        [
            differences(lambda v: whitened_residual(factor, v), values, k, steps_of(by_key[k], values))
            for k in list(linear.keys())
        ]
    )
    return float(np.max(np.abs(A - numeric) / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1.0)))


# -- the survey once more, in plain lines ------------------------------------------------------------------------------


def image_residual(camera: Camera, lens: FloatArray, q: FloatArray, uv: FloatArray) -> FloatArray:
    """Predicted minus observed (n, 2) px of points (n, 3) in the camera, by OpenCV or the published formulas.

    brown_backward (Australis, PhotoModeler), DBAT and AICON: x right, y up in mm about the image's centre (DBAT: about
    the pixel origin); the backward models are compared in the corrected plane.
    """
    if camera.lens.model == "brown":
        fx, fy, skew, u0, v0 = lens[:5]
        distortion = lens[[5, 6, 7, 8, 9, 10, 11, 12]]
        plane = cv2.projectPoints(q, np.zeros(3), np.zeros(3), np.eye(3), distortion)[0].reshape(-1, 2)
        return plane @ np.array([[fx, skew], [0.0, fy]]).T + (u0, v0) - uv
    if camera.lens.model == "fisheye":
        fx, fy, skew, u0, v0 = lens[:5]
        K = np.array([[fx, 0.0, u0], [0.0, fy, v0], [0.0, 0.0, 1.0]])
        found = cv2.fisheye.projectPoints(q[:, None], np.zeros(3), np.zeros(3), K, lens[5:9], alpha=skew / fx)[0]
        return found.reshape(-1, 2) - uv
    s = camera.lens.pixel_size_mm or 1.0
    middle = (np.array(camera.image_size) - 1) / 2
    ideal = lens[0] * q[:, :2] / q[:, 2:] * (1.0, -1.0)
    if camera.lens.model == "aicon":
        _, xh, yh, a1, a2, a3, b1, b2, c1, c2 = lens
        shift = _brown(ideal, (a1, a2, a3), (b1, b2)) + np.column_stack(
            [c1 * ideal[:, 0] + c2 * ideal[:, 1], 0.0 * ideal[:, 1]]
        )
        return (ideal + shift + (xh, yh)) / s * (1.0, -1.0) + middle - uv
    if camera.lens.model == "brown_backward":
        _, xp, yp, k1, k2, k3, p1, p2, b1, b2 = lens
        x = (uv - middle) * s * (1.0, -1.0) - (xp, yp)
        corrected = x + _brown(x, (k1, k2, k3), (p1, p2)) + np.column_stack([b1 * x[:, 0] + b2 * x[:, 1], 0 * x[:, 1]])
    else:
        _, px, py, affinity, k1, k2, k3, p1, p2 = lens
        x = np.column_stack([(uv[:, 0] * s - px) * (1.0 + affinity), py - uv[:, 1] * s])
        corrected = x + _brown(x, (k1, k2, k3), (p1, p2))
    return (ideal - corrected) / s * (1.0, -1.0)


def _brown(x: FloatArray, radial: Sequence[float], decentring: Sequence[float]) -> FloatArray:
    """Brown's (1971) radial and decentring corrections."""
    r2 = (x**2).sum(axis=1)
    k = sum(c * r2 ** (i + 1) for i, c in enumerate(radial))
    p1, p2 = decentring
    return np.column_stack(
        [
            x[:, 0] * k + p1 * (r2 + 2.0 * x[:, 0] ** 2) + 2.0 * p2 * x[:, 0] * x[:, 1],
            x[:, 1] * k + p2 * (r2 + 2.0 * x[:, 1] ** 2) + 2.0 * p1 * x[:, 0] * x[:, 1],
        ]
    )


def root(cov: FloatArray) -> FloatArray:
    """Upper triangular W with W'W = inv(cov)."""
    return np.linalg.cholesky(np.linalg.inv(np.atleast_2d(cov))).T


def _held(survey: Survey) -> dict[ParameterName, PoseParameter]:
    out: dict[ParameterName, PoseParameter] = {}
    for c in survey.cameras:
        out["station_from_camera", c.camera_id] = c.station_from_camera
    for t in survey.tables:
        out["world_from_table", t.table_id] = t.world_from_table
    for s in survey.stations:
        out["world_from_station", s.station_id] = s.world_from_station
        out["mount_from_station", s.station_id] = s.mount_from_station
        out.update({("world_from_station", s.station_id, e): p for e, p in s.epochs.items()})
    for g in survey.targets:
        out["carrier_from_target", g.target_id] = g.carrier_from_target
        out.update({("carrier_from_target", g.target_id, e): p for e, p in g.epochs.items()})
    return out


class _Poses(dict[ParameterName, Any]):
    """Parameters that are not in ``Values``: poses that are held come from the survey.

    in_camera: of image blocks that were asked for, their points in the camera.
    """

    def __init__(self, held: dict[ParameterName, PoseParameter], known: Mapping[ParameterName, Any]) -> None:
        super().__init__(known)
        self.held, self.in_camera = held, dict[tuple[str, str, str | None, str], FloatArray]()

    def __missing__(self, name: ParameterName) -> Pose3:
        parameter = self.held.get(name) or self.held[name[:2]]
        if parameter.treatment != "held":
            raise KeyError(name)
        return parameter.value or Pose3()

    def with_other(self, name: ParameterName, value: Any) -> "_Poses":
        """The same with another value of one parameter; a lens leaves the points where they are."""
        out = _Poses(self.held, self)
        out[name], out.in_camera = value, self.in_camera if name[0] == "lens" else {}
        return out


class _Read(_Poses):
    """Notes which parameters are asked for."""

    def __init__(self, found: _Poses) -> None:
        super().__init__(found.held, found)
        self.names: set[ParameterName] = set()

    def __getitem__(self, name: ParameterName) -> Any:
        self.names.add(name)
        return super().__getitem__(name)


@dataclass(frozen=True, eq=False)
class Plain:
    """All residuals of a survey at given ``Values``. lenses: the start vectors, which held components keep."""

    graph: AdjustmentGraph
    lenses: dict[str, FloatArray]

    @cached_property
    def _vectors(self) -> dict[ParameterName, tuple[Sequence[str], FloatArray, Sequence[Tie]]]:
        """Names, values of what is held, and ties."""
        survey = self.graph.survey
        out: dict[ParameterName, tuple[Sequence[str], FloatArray, Sequence[Tie]]] = {
            ("lens", c.camera_id): (MODELS[c.lens.model].names, self.lenses[c.camera_id], c.lens.ties)
            for c in survey.cameras}  # fmt: skip
        for table in survey.tables:
            out["table_geometry", table.table_id] = table.geometry.names, table.geometry.values, ()
        for target in survey.targets:
            if target.warp:
                out["warp", target.target_id] = target.warp.names, target.warp.values, target.warp.ties
        return out

    def _value(self, name: ParameterName, values: gtsam.Values) -> Any:
        unknown = self.graph.unknowns.by_name.get(name)
        if name in self._vectors:
            names, base, ties = self._vectors[name]
            full = dict(zip(names, base, strict=True))
            if unknown is not None:
                full.update(zip(unknown.components, values.atVector(unknown.key), strict=True))
                full.update({tie.name: tie.factor * full[tie.to] for tie in ties})
            return np.array([full[n] for n in names])
        if unknown.kind == "pose":
            return values.atPose3(unknown.key)
        return np.asarray(values.atPoint3(unknown.key) if unknown.kind == "point" else values.atVector(unknown.key))

    def parameters(self, values: gtsam.Values) -> _Poses:
        survey, found = self.graph.survey, dict[ParameterName, Any]()
        for name, unknown in self.graph.unknowns.by_name.items():
            if unknown.kind in ("pose", "point") or name[0] == "table_angles":
                found[name] = self._value(name, values)
        found.update({name: self._value(name, values) for name in self._vectors})
        for point in survey.points:
            if point.x_in_world.treatment == "held":
                found["point", point.point_id] = point.x_in_world.value
        return _Poses(_held(survey), found)

    def displaced(self, found: _Poses, name: ParameterName, values: gtsam.Values) -> _Poses:
        """``found``, but for one parameter, which is that of ``values``."""
        return found.with_other(name, self._value(name, values))

    def image(self, block: ImageBlock, found: _Poses) -> FloatArray:
        """Predicted minus observed (n, 2) px."""
        camera = self.graph.survey.cameras_by_id[block.camera_id]
        if block.place not in found.in_camera:
            found.in_camera[block.place] = self._in_camera(block, found)
        return image_residual(camera, found["lens", block.camera_id], found.in_camera[block.place], block.uv)

    def _in_camera(self, block: ImageBlock, found: _Poses) -> FloatArray:
        scene = Scene(self.graph.survey, found)
        if block.target_id is None:
            x = np.array([found["point", self.graph.survey.points[i].point_id] for i in block.point_idx])
        else:
            x = scene.target_points(block.target_id, block.epoch_id)[block.point_idx]
        return transform(np.linalg.inv(scene.world_from_camera(block.camera_id, block.epoch_id)), x)

    def other(self, item: Any, found: _Poses) -> tuple[FloatArray, FloatArray]:
        """Unwhitened residual (k,) and its covariance (k, k) of an observation that is not an image point."""
        survey, scene = self.graph.survey, Scene(self.graph.survey, found)
        if item.kind == "table":
            reading = next(r for r in survey.table_readings if (r.table_id, r.epoch_id) == item.ids)
            return found["table_angles", *item.ids] - reading.angles, reading.cov
        if item.kind == "pair":
            pair = next(p for p in survey.pairs if p.pair_id == item.ids[0])
            b_from_a = np.linalg.inv(scene.world_from_frame(pair.b)) @ scene.world_from_frame(pair.a)
            if isinstance(pair.b_from_a, Rot3):
                return Rot3.Logmap(pair.b_from_a.inverse() * Rot3(b_from_a[:3, :3])), pair.cov
            return Pose3.Logmap(pair.b_from_a.inverse() * Pose3(b_from_a)), pair.cov
        if item.kind == "distance":
            d = next(d for d in survey.distances if d.distance_id == item.ids[0])
            length = np.linalg.norm(scene.position(d.b) - scene.position(d.a))
            return np.array([length - d.value]), np.array([[d.sigma**2]])
        if item.kind == "coordinates":
            c = next(c for c in survey.coordinates if np.array_equal(c.values.ravel(), item.observed))
            x = np.array([scene.position(p) for p in c.positions])
            return (x - c.values).ravel(), c.cov
        return self._prior(item.ids, found)

    def _prior(self, name: ParameterName, found: _Poses) -> tuple[FloatArray, FloatArray]:
        survey = self.graph.survey
        if name[0] in ("lens", "table_geometry", "warp"):
            owner: Any
            if name[0] == "lens":
                owner = next(c for c in survey.cameras if c.camera_id == name[1])
                prior, names = owner.lens.prior, MODELS[owner.lens.model].names
            elif name[0] == "warp":
                owner = next(t for t in survey.targets if t.target_id == name[1])
                prior, names = owner.warp.prior, owner.warp.names
            else:
                owner = next(t for t in survey.tables if t.table_id == name[1])
                prior, names = owner.geometry.prior, owner.geometry.names
            return found[name][[names.index(n) for n in prior.names]] - prior.mean, prior.cov
        if name[0] == "point":
            p = next(p for p in survey.points if p.point_id == name[1]).x_in_world
            return found[name] - p.value, np.asarray(p.prior_cov)
        parameter = found.held.get(name) or found.held[name[:2]]
        known = np.isfinite(np.diag(parameter.prior_cov))
        r = Pose3.Logmap(parameter.value.inverse() * found[name])
        return r[known], parameter.prior_cov[np.ix_(known, known)]


@dataclass(frozen=True, eq=False)
class Dense:
    """The whole linearised survey in one matrix. Rows: all image points (u, v), then all others.

    A, e: whitened Jacobian and residual; v: residual; W: its whitening, block after block; used: rows that take part.
    """

    A: FloatArray
    e: FloatArray
    v: FloatArray
    W: list[FloatArray]
    used: np.ndarray[Any, np.dtype[np.bool_]]
    place: dict[ParameterName, slice]
    n_image: int

    @property
    def normal(self) -> FloatArray:
        A = self.A[self.used]
        return A.T @ A

    def inverse(self, gauge: FloatArray | None = None, refined: bool = False) -> FloatArray:
        """Inverse of the normal matrix by a QR of the scaled Jacobian, so that it keeps more digits than a product of
        matrices; ``gauge`` (k, n): rows of constraints of a free network, of no influence on the rest.

        refined: one step of Newton's (Schulz) with extended numbers, which stay: exact in weak geometry, where double
        ones lose the digits of redundancy numbers in the product with A.
        """
        A = self.A[self.used]
        if gauge is not None:
            n, k = A.shape[1], len(gauge)
            scale = np.sqrt((A**2).sum(axis=0).mean())
            bordered = np.block([[self.normal, scale * gauge.T], [scale * gauge, np.zeros((k, k))]])
            return np.linalg.inv(bordered)[:n, :n]
        length = np.linalg.norm(A, axis=0)
        R = np.linalg.qr(A / length, mode="r")
        half = np.linalg.solve(R, np.eye(len(R)))
        Q = half @ half.T
        if refined:
            scaled = A.astype(np.longdouble) / length
            Q = Q + Q @ (np.eye(len(Q)) - (scaled.T @ scaled) @ Q)
        return Q / np.outer(length, length)


def dense(graph: AdjustmentGraph, lenses: dict[str, FloatArray], values: gtsam.Values) -> Dense:
    plain = Plain(graph, dict(lenses))
    blocks, items = graph.survey.image_blocks, graph.others
    covs: list[FloatArray] = [c for block in blocks for c in block.cov]
    found = plain.parameters(values)
    covs += [plain.other(item, found)[1] for item in items]
    W = [root(c) for c in covs]
    n_image = sum(len(b.uv) for b in blocks)
    used = [np.repeat(b.used if b.used is not None else np.ones(len(b.uv), bool), 2) for b in blocks]
    used += [np.full(len(np.atleast_2d(c)), item.used) for item, c in zip(items, covs[n_image:], strict=True)]

    parts: list[Callable[[_Poses], FloatArray]] = [
        *(lambda p, b=b: plain.image(b, p).ravel() for b in blocks),
        *(lambda p, item=item: plain.other(item, p)[0] for item in items),
    ]  # fmt: skip
    asked = [_Read(found) for _ in parts]
    each = [part(p) for part, p in zip(parts, asked, strict=True)]
    ends = np.cumsum([0, *map(len, each)])

    def by(name: ParameterName, unknown: Any) -> FloatArray:
        """Derivatives of all of them; zero of those that do not ask for it."""
        some = [i for i, p in enumerate(asked) if name in p.names]
        out = np.zeros((ends[-1], unknown.dim))
        if some:
            rows = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in some])

            def residuals(at: gtsam.Values) -> FloatArray:
                p = plain.displaced(found, name, at)
                return np.concatenate([parts[i](p) for i in some])

            out[rows] = differences(residuals, values, unknown.key, steps_of(unknown, values))
        return out

    place, n, columns = {}, 0, []
    for name, unknown in graph.unknowns.by_name.items():
        place[name] = slice(n, n + unknown.dim)
        n += unknown.dim
        columns.append(by(name, unknown))
    v = np.concatenate(each)
    return Dense(whiten(W, np.hstack(columns)), whiten(W, v), v, W, np.concatenate(used), place, n_image)


def whiten(W: list[FloatArray], rows: FloatArray) -> FloatArray:
    out, at = np.empty_like(rows), 0
    for w in W:
        out[at : at + len(w)] = w @ rows[at : at + len(w)]
        at += len(w)
    return out


def relative(found: FloatArray, expected: FloatArray) -> float:
    """Largest difference of two covariances in units of the expected sigmas."""
    sigma = np.sqrt(np.diag(expected))
    return float(np.max(np.abs(found - expected) / np.outer(sigma, sigma)))


def covariance_of(precision: Precision, name: ParameterName) -> FloatArray:
    return precision.joint([name])


# -- small surveys -----------------------------------------------------------------------------------------------------


def random_cov(rng: np.random.Generator, sigmas: Sequence[float]) -> FloatArray:
    """A covariance with these sigmas and honest correlations."""
    n = len(sigmas)
    a = rng.normal(size=(n, n + 2))
    c = a @ a.T
    d = np.asarray(sigmas) / np.sqrt(np.diag(c))
    return c * np.outer(d, d)


def point_covs(rng: np.random.Generator, n: int, sigma: float = 0.1) -> FloatArray:
    return np.array([random_cov(rng, sigma * rng.uniform(0.5, 2.0, 2)) for _ in range(n)])


def pose(rng: np.random.Generator, size: float, at: Sequence[float] = (0.0, 0.0, 0.0)) -> Pose3:
    """A pose near ``at``, turned by about ``size`` rad."""
    return Pose3(Rot3.Expmap(rng.normal(0.0, size, 3)), np.asarray(at) + rng.normal(0.0, 0.02, 3))


def lens_values(model: str) -> FloatArray:
    values = {
        "brown": [800, 810, 1.5, 320, 240, -0.1, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.005],
        "fisheye": [400, 410, 1.5, 320, 240, 0.01, -0.02, 0.003, 0.001],
        "brown_backward": [8, 0.1, -0.2, 1e-3, 1e-5, 1e-6, 2e-4, -1e-4, 3e-4, -2e-4],
        "brown_backward_dbat": [8, 3.2, 2.4, 3e-4, 1e-3, 1e-5, 1e-6, 2e-4, -1e-4],
        "aicon": [8, 0.1, -0.2, -1e-3, 1e-5, 1e-6, 2e-4, -1e-4, 3e-4, -2e-4],
    }
    return np.array(values[model], dtype=float)


GRID = np.array([(x, y, 0.0) for y in np.linspace(0.0, 0.2, 5) for x in np.linspace(0.0, 0.3, 6)])


def everything(
    seed: int, model: str = "brown", axes: tuple[str, ...] = ("x", "z"), ties: Sequence[Any] = ()
) -> tuple[Survey, StartValues]:
    """Every kind of link in one chain or another, all of it free: for derivatives, not to be solved.

    Camera X on the head, which a table carries at epochs t1, t2 and a hand at h1; camera T on a fixed tripod. Target
    "board" in the world (warped), "wand" moved between epochs, "block" on the head.
    """
    rng = np.random.default_rng(seed)
    names = MODELS[model].names
    of_axes = ("non_orthogonality", "axis_offset", "zero_1", "zero_2") if len(axes) == 2 else ("zero_1",)
    values = np.array([0.02, 0.03, 0.1, -0.15]) if len(axes) == 2 else np.array([0.1])
    waves = ("angle_1_cos_1", "angle_1_sin_3", "axial_1_sin_2", "radial_1_re_m1", "radial_1_im_p2", "tilt_1_im_m1")
    waves += ("angle_2_sin_1", "axial_2_cos_1", "radial_2_im_m2", "tilt_2_re_p3") if len(axes) == 2 else ()
    geometry = VectorParameter((*of_axes, *waves), np.append(values, 0.002 * np.sin(np.arange(len(waves)))),
                               (*of_axes, *waves))  # fmt: skip
    ids = tuple(f"c{i}" for i in range(len(GRID)))
    deviations = ("warp_x", "warp_y", "warp_xy", "scale_x", "scale_y", "shear", "expansion")
    warp = VectorParameter(deviations, np.array([0.004, -0.003, 0.002, 0.01, -0.02, 0.015, 0.002]), deviations)
    lens = LensParameter(model, names, lens_values(model), ties=tuple(ties), pixel_size_mm=0.01)
    cameras = (
        Camera("X", "head", (640, 480), lens),
        Camera("T", "tripod", (640, 480), LensParameter("brown", FREE_LENS, lens_values("brown"))),
    )
    survey = Survey(
        cameras=cameras,
        stations=(Station("head", "table", table_id="table"), Station("tripod")),
        tables=(Table("table", axes, geometry=geometry),),
        targets=(
            Target("board", ids, GRID, warp=warp),
            Target("wand", ids, GRID[:, [0, 1, 2]] * 0.7, motion="epoch"),
            Target("block", ids, GRID * 0.5, station_id="head"),
        ),
        temperatures={"t1": 23.0, "t2": 18.0, "h1": 27.5},
        table_readings=tuple(
            TableReading("table", e, rng.normal(0.0, 0.1, len(axes)), random_cov(rng, [1e-4] * len(axes)))
            for e in ("t1", "t2")
        ),
    )
    poses: dict[ParameterName, Pose3] = {
        ("station_from_camera", "X"): pose(rng, 0.05),
        ("station_from_camera", "T"): pose(rng, 0.05),
        ("mount_from_station", "head"): pose(rng, 0.05),
        ("world_from_table", "table"): pose(rng, 0.05),
        ("world_from_station", "head", "h1"): pose(rng, 0.05),
        ("world_from_station", "tripod"): pose(rng, 0.05, (0.0, 0.0, -1.2)),
        ("carrier_from_target", "board"): pose(rng, 0.2, (-0.15, -0.1, 1.0)),
        ("carrier_from_target", "block"): pose(rng, 0.2, (-0.1, 0.0, 0.1)),
        **{("carrier_from_target", "wand", e): pose(rng, 0.2, (-0.1, -0.1, 0.9)) for e in ("t1", "h1")},
    }
    seen = [("X", "t1", "board"), ("X", "t2", "board"), ("X", "h1", "board"), ("X", "t1", "wand"), ("X", "h1", "wand"),
            ("T", "t1", "block"), ("T", "t2", "block"), ("T", "h1", "block"), ("T", "t1", "wand"),
            ("T", "t1", "board")]  # fmt: skip
    start = StartValues({"X": lens_values(model), "T": lens_values("brown")}, poses, {})
    blocks = []
    for camera_id, epoch_id, target_id in seen:
        idx = np.sort(rng.permutation(len(GRID))[:24])
        uv = rng.uniform((100, 80), (540, 400), (24, 2))
        blocks.append(
            ImageBlock(camera_id, epoch_id, target_id, idx, uv, point_covs(rng, 24), rng.uniform(size=24) < 0.8)
        )
    return replace(survey, image_blocks=tuple(blocks)), start


def network(
    seed: int,
    *,
    n_epochs: int = 6,
    n_points: int = 14,
    n_cameras: int = 2,
    held: int = 4,
    distances: int = 2,
    coordinates: int = 0,
    unused: float = 0.0,
    free_lens: tuple[str, ...] = FREE_LENS,
) -> tuple[Survey, Truth]:
    """A head with cameras carried round a cloud of unknown points; the first ``held`` points are known.

    The first camera is the head's frame. ``distances``: measured between points at the end of the list.
    """
    rng = np.random.default_rng(seed)
    truth: Truth = {}
    x = rng.uniform(-0.5, 0.5, (n_points, 3))
    cameras, points = [], []
    for i in range(n_cameras):
        name = f"C{i + 1}"
        brown = dict(zip(FREE_LENS, (900 + 30 * i, 905, 640 + i, 512, -0.1, 0.05, 5e-4, -3e-4), strict=True))
        truth["lens", name] = np.array([brown.get(n, 0.0) for n in BROWN])
        truth["station_from_camera", name] = pose(rng, 0.05) if i else Pose3()
        lens = LensParameter("brown", free_lens, truth["lens", name])
        cameras.append(Camera(name, "head", (1280, 1024), lens, PoseParameter() if i else HELD))
    for i in range(n_points):
        truth["point", f"P{i}"] = x[i]
        points.append(Point(f"P{i}", PointParameter(x[i], "held") if i < held else PointParameter()))
    epochs = [f"e{i}" for i in range(n_epochs)]
    for i, epoch in enumerate(epochs):
        turn = rotation_about("y", 2.0 * np.pi * i / n_epochs)[:3, :3] @ rotation_about("x", 0.5 * (-1) ** i)[:3, :3]
        turn = turn @ rotation_about("z", 1.5 * i)[:3, :3]
        truth["world_from_station", "head", epoch] = Pose3(Rot3(turn), turn @ (0.05, 0.02, -2.0 - 0.1 * i))
    survey = Survey(cameras=tuple(cameras), stations=(Station("head", "epoch"),), points=tuple(points))
    blocks = []
    for camera in cameras:
        for epoch in epochs:
            idx = np.sort(rng.permutation(n_points)[: n_points - 2])
            used = rng.uniform(size=len(idx)) >= unused
            blocks.append(ImageBlock(camera.camera_id, epoch, None, idx, np.zeros((len(idx), 2)),
                                     point_covs(rng, len(idx)), used))  # fmt: skip
    last = n_points - 1
    taped = [Distance(f"d{i}", PositionRef(f"P{last - 2 * i}"), PositionRef(f"P{last - 2 * i - 1}"), 0.0, 2e-4)
             for i in range(distances)]  # fmt: skip
    given = [Coordinates((PositionRef(f"P{last - i}"),), np.zeros((1, 3)), random_cov(rng, [3e-4] * 3))
             for i in range(coordinates)]  # fmt: skip
    ideal = replace(survey, image_blocks=tuple(blocks), distances=tuple(taped), coordinates=tuple(given))
    return resample(ideal, truth, seed + 1), truth


def station_frame(station_id: str, epoch_id: str | None = None) -> FrameRef:
    return FrameRef("station", station_id, epoch_id)


# -- the whole precision against the dense one -------------------------------------------------------------------------


def check_against_dense(
    survey: Survey, start: StartValues, tolerance: float = 1e-8, refined: bool = False
) -> tuple[Precision, Dense]:
    """Solve, and compare the minimum, all covariances and all statistics with one dense matrix."""
    graph, done = solved(survey, start)
    precision = Precision(graph, done)
    full = dense(graph, dict(start.lenses), done.values)
    gauge = inner_rows(graph, full, done)
    Q = full.inverse(gauge, refined)
    check_minimum(full, done, Q)
    for name, place in full.place.items():
        mine, expected = covariance_of(precision, name), Q[place, place]
        assert relative(mine, expected) < tolerance, (name, relative(mine, expected))
    check_statistics(precision, full, Q)
    return precision, full


def check_minimum(full: Dense, done: Solved, Q: FloatArray) -> None:
    """No unknown has further to go than a millionth of its sigma; the weighted square sum is the plain one."""
    A, e = full.A[full.used], full.e[full.used]
    step = Q @ A.T @ e
    assert np.max(np.abs(step) / np.sqrt(np.diag(Q))) < 1e-6
    np.testing.assert_allclose(done.omega, e @ e, rtol=1e-9)


def check_statistics(precision: Precision, full: Dense, Q: FloatArray) -> None:
    """Residuals, redundancy numbers, standardized residuals and tests against Q_vv of the dense matrix."""
    images, others = precision.image_residuals, other_residuals(precision)
    n = full.n_image
    np.testing.assert_allclose(images.residuals.ravel(), full.v[: 2 * n], atol=1e-8)
    sums, at = 0.0, 0
    for k in range(n + len(others)):
        rows = slice(at, at + len(full.W[k]))
        at = rows.stop
        A, e, used = full.A[rows], full.e[rows], bool(full.used[rows.start])
        Qv = np.asarray(np.eye(len(A)) + (-1.0 if used else 1.0) * A @ Q @ A.T, dtype=np.float64)
        inverse_root = np.linalg.inv(full.W[k])
        sigma_v = np.sqrt(np.maximum(0.0, np.diag(inverse_root @ Qv @ inverse_root.T)))
        v = full.v[rows]
        redundancy = np.diag(Qv) if used else np.zeros(len(A))
        sums += redundancy.sum()
        if k < n:
            found = images.redundancy[k], images.standardized[k], images.test[k]
        else:
            item = others[k - n]
            np.testing.assert_allclose(item.residual, v, atol=1e-9)
            np.testing.assert_allclose(item.sigma, np.sqrt(np.diag(inverse_root @ inverse_root.T)), rtol=1e-9)
            found = item.redundancy, item.standardized, np.asarray(item.test)
        np.testing.assert_allclose(found[0], redundancy, atol=1e-7)
        if np.linalg.eigvalsh(Qv)[0] > 1e-4:
            np.testing.assert_allclose(found[1], v / sigma_v, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(found[2], e @ np.linalg.solve(Qv, e), rtol=1e-5, atol=1e-6)
    datum = precision.solved.datum
    defect = datum.defect if datum else 0
    assert sums == pytest.approx(int(full.used.sum()) - full.A.shape[1] + defect, abs=1e-5)


def inner_rows(graph: AdjustmentGraph, full: Dense, done: Solved) -> FloatArray | None:
    """Rows (k, n) of inner constraints over the datum's unknowns, from differences: how these move with the world.

    Which of the seven motions are free is decided by what the plain residuals see of them.
    """
    datum = graph.survey.datum
    if datum.kind != "inner":
        return None
    motions = np.column_stack([world_motion(graph, full, done.values, i) for i in range(7)])
    seen = np.linalg.norm(full.A[full.used] @ motions, axis=0) / np.linalg.norm(motions, axis=0)
    free = motions[:, seen < 1e-4 * np.linalg.norm(full.A[full.used]) / np.sqrt(full.A.shape[1])]
    points = datum.points or (() if datum.stations else tuple(p.point_id for p in graph.survey.points))
    stations = datum.stations
    if not points and not stations:
        stations = tuple(s.station_id for s in graph.survey.stations)
    mask = np.zeros(len(free))
    for name, place in full.place.items():
        if (name[0] == "point" and name[1] in points) or (name[0] == "world_from_station" and name[1] in stations):
            mask[place] = 1.0
    return (free * mask[:, None]).T


def world_motion(graph: AdjustmentGraph, full: Dense, values: gtsam.Values, i: int) -> FloatArray:
    """How all unknowns (n,) move with the world: translations 0-2, rotations 3-5, scale 6; by differences."""
    h, total = 1e-4, np.zeros(full.A.shape[1])
    for k, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
        turn, shift = np.zeros(3), np.zeros(3)
        turn[i - 3 : i - 2] = h * k if 3 <= i < 6 else 0.0
        shift[i : i + 1] = h * k if i < 3 else 0.0
        motion, scale = Pose3(Rot3.Expmap(turn), shift), np.exp(h * k) if i == 6 else 1.0
        for name, place in full.place.items():
            unknown = graph.unknowns.by_name[name]
            if unknown.kind == "point":
                x = np.asarray(values.atPoint3(unknown.key))
                total[place] += weight * (motion.transformFrom(scale * x) - x)
            elif unknown.kind == "pose":
                p = values.atPose3(unknown.key)
                moved = Pose3(p.rotation(), scale * p.translation())
                in_world = name[0] in ("world_from_station", "world_from_table") or (
                    name[0] == "carrier_from_target"
                    and next(t for t in graph.survey.targets if t.target_id == name[1]).station_id is None
                )
                total[place] += weight * Pose3.Logmap(p.inverse() * (motion * moved if in_world else moved))
    return total / (12.0 * h)
