"""Fresh noise on every observation and prior of a survey, drawn around the truth with its own covariance."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.observations import Pair
from adjust.model.survey import Camera, FloatArray, Point, PoseParameter, Station, Survey, Table, Target, VectorPrior
from survey.simulate.readings import fresh_readings
from survey.simulate.scene import BROWN, Scene, Truth


@dataclass(frozen=True, eq=False)
class _Ideal:
    """Error-free readings of one survey, and the factors that turn white noise into theirs."""

    scene: Scene
    uv: FloatArray  # (N, 2) px over all blocks
    uv_factor: FloatArray  # (N, 2, 2)
    block_ends: list[int]
    table: list[FloatArray]
    pairs: list[Pose3 | Rot3]
    distances: list[float]
    coordinates: list[FloatArray]


_IDEAL: WeakKeyDictionary[Survey, _Ideal] = WeakKeyDictionary()


def resample(survey: Survey, truth: Truth, seed: int) -> Survey:
    """The same survey with new noise: every observation is the truth plus a draw from its covariance.

    Means of priors are drawn anew as well, for they are observations; those that hold for epochs not listed one by one
    stay as they are. Error-free values are kept between calls with the same ``survey``.
    """
    ideal = _IDEAL.get(survey)
    if ideal is None or ideal.scene.truth is not truth:
        ideal = _ideal(Scene(survey, truth))
        _IDEAL[survey] = ideal
    rng = np.random.default_rng(seed)
    noise = np.einsum("nij,nj->ni", ideal.uv_factor, rng.standard_normal(ideal.uv.shape))
    parts = np.split(ideal.uv + noise, ideal.block_ends[:-1]) if ideal.block_ends else []
    again = replace(
        survey,
        image_blocks=tuple(replace(b, uv=uv) for b, uv in zip(survey.image_blocks, parts, strict=True)),
        table_readings=tuple(
            replace(r, angles=angles + _draw(r.cov, rng))
            for r, angles in zip(survey.table_readings, ideal.table, strict=True)
        ),
        pairs=tuple(
            replace(p, b_from_a=_disturbed(value, _draw(p.cov, rng)))
            for p, value in zip(survey.pairs, ideal.pairs, strict=True)
        ),
        distances=tuple(
            replace(d, value=value + d.sigma * rng.standard_normal())
            for d, value in zip(survey.distances, ideal.distances, strict=True)
        ),
        coordinates=tuple(
            replace(c, values=values + _draw(c.cov, rng).reshape(-1, 3))
            for c, values in zip(survey.coordinates, ideal.coordinates, strict=True)
        ),
        cameras=tuple(_camera(c, truth, rng) for c in survey.cameras),
        stations=tuple(_station(s, truth, rng) for s in survey.stations),
        tables=tuple(_table(t, truth, rng) for t in survey.tables),
        targets=tuple(_target(t, truth, rng) for t in survey.targets),
        points=tuple(_point(p, truth, rng) for p in survey.points),
    )
    return replace(again, **fresh_readings(ideal.scene, rng))


def _ideal(scene: Scene) -> _Ideal:
    survey = scene.survey
    images: list[FloatArray] = [np.zeros((0, 2))]
    factors: list[FloatArray] = [np.zeros((0, 2, 2))]
    for block in survey.image_blocks:
        name, epoch_id = block.target_id, block.epoch_id
        x = scene.world_points() if name is None else scene.target_points(name, epoch_id)
        images.append(scene.project(block.camera_id, block.epoch_id, x[block.point_idx]))
        factors.append(np.asarray(np.linalg.cholesky(block.cov), dtype=np.float64))
    uv = np.concatenate(images)
    if np.isnan(uv).any():
        raise ValueError("the survey has image points that its truth puts behind the camera")
    return _Ideal(
        scene,
        uv,
        np.concatenate(factors),
        np.cumsum([len(block.uv) for block in survey.image_blocks]).tolist(),
        [scene.vector("table_angles", r.table_id, r.epoch_id) for r in survey.table_readings],
        [_true_pair(scene, pair) for pair in survey.pairs],
        [float(np.linalg.norm(scene.position(d.b) - scene.position(d.a))) for d in survey.distances],
        [np.array([scene.position(p) for p in c.positions]) for c in survey.coordinates],
    )


def _true_pair(scene: Scene, pair: Pair) -> Pose3 | Rot3:
    b_from_a = np.linalg.inv(scene.world_from_frame(pair.b)) @ scene.world_from_frame(pair.a)
    return Rot3(b_from_a[:3, :3]) if isinstance(pair.b_from_a, Rot3) else Pose3(b_from_a)


def _draw(cov: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n,) noise with covariance (n, n); zero where the diagonal is infinite or the component exact."""
    noise = np.zeros(len(cov))
    known = np.isfinite(np.diag(cov)) & (np.diag(cov) > 0.0)
    if known.any():
        noise[known] = np.linalg.cholesky(cov[np.ix_(known, known)]) @ rng.standard_normal(int(known.sum()))
    return noise


def _disturbed(value: Pose3 | Rot3, tangent: FloatArray) -> Pose3 | Rot3:
    if isinstance(value, Rot3):
        return value.compose(Rot3.Expmap(tangent))
    return value.compose(Pose3.Expmap(tangent))


def _pose(parameter: PoseParameter, truth: Truth, name: tuple[str, ...], rng: np.random.Generator) -> PoseParameter:
    true = truth.get(name)
    if parameter.treatment != "prior" or parameter.prior_cov is None or not isinstance(true, Pose3):
        return parameter
    mean = true.compose(Pose3.Expmap(_draw(parameter.prior_cov, rng)))
    return replace(parameter, value=mean)


def _poses(
    parameters: Mapping[str, PoseParameter], draw: Callable[[PoseParameter, str], PoseParameter]
) -> dict[str, PoseParameter]:
    return {epoch_id: draw(parameter, epoch_id) for epoch_id, parameter in parameters.items()}


def _vector_prior(
    prior: VectorPrior | None, names: tuple[str, ...], true: Pose3 | FloatArray | None, rng: np.random.Generator
) -> VectorPrior | None:
    if prior is None or true is None or isinstance(true, Pose3):
        return prior
    by_name = dict(zip(names, true, strict=True))
    return replace(prior, mean=np.array([by_name[name] for name in prior.names]) + _draw(prior.cov, rng))


def _camera(camera: Camera, truth: Truth, rng: np.random.Generator) -> Camera:
    name = camera.camera_id
    prior = _vector_prior(camera.lens.prior, BROWN, truth.get(("lens", name)), rng)
    return replace(
        camera,
        lens=replace(camera.lens, prior=prior),
        station_from_camera=_pose(camera.station_from_camera, truth, ("station_from_camera", name), rng),
    )


def _station(station: Station, truth: Truth, rng: np.random.Generator) -> Station:
    name = station.station_id
    return replace(
        station,
        world_from_station=_pose(station.world_from_station, truth, ("world_from_station", name), rng),
        mount_from_station=_pose(station.mount_from_station, truth, ("mount_from_station", name), rng),
        epochs=_poses(station.epochs, lambda p, e: _pose(p, truth, ("world_from_station", name, e), rng)),
    )


def _table(table: Table, truth: Truth, rng: np.random.Generator) -> Table:
    name, geometry = table.table_id, table.geometry
    prior = _vector_prior(geometry.prior, geometry.names, truth.get(("table_geometry", name)), rng)
    return replace(
        table,
        geometry=replace(geometry, prior=prior),
        world_from_table=_pose(table.world_from_table, truth, ("world_from_table", name), rng),
    )


def _target(target: Target, truth: Truth, rng: np.random.Generator) -> Target:
    name, warp = target.target_id, target.warp
    if warp is not None:
        warp = replace(warp, prior=_vector_prior(warp.prior, warp.names, truth.get(("warp", name)), rng))
    return replace(
        target,
        warp=warp,
        carrier_from_target=_pose(target.carrier_from_target, truth, ("carrier_from_target", name), rng),
        epochs=_poses(target.epochs, lambda p, e: _pose(p, truth, ("carrier_from_target", name, e), rng)),
    )


def _point(point: Point, truth: Truth, rng: np.random.Generator) -> Point:
    parameter = point.x_in_world
    true = truth.get(("point", point.point_id))
    if parameter.treatment != "prior" or parameter.prior_cov is None or true is None or isinstance(true, Pose3):
        return point
    return replace(point, x_in_world=replace(parameter, value=true + _draw(parameter.prior_cov, rng)))
