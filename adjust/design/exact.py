"""A survey whose observations are what its own model predicts: the design without the observations' values."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.design.prediction import Predictor
from adjust.design.readings import exact_readings
from adjust.graph.assembly import StartValues
from adjust.lenses.models import MODELS, camera_constants, project
from adjust.model.observations import Coordinates, Distance, ImageBlock, Pair
from adjust.model.result import ParameterName
from adjust.model.survey import (
    Camera,
    FloatArray,
    Point,
    PoseParameter,
    Station,
    Survey,
    Table,
    Target,
    VectorParameter,
    VectorPrior,
)


def exact(survey: Survey, start: StartValues) -> Survey:
    """The survey with every observation and prior as the model predicts it at ``start``: no residual is left.

    Raises SurveyError for an image point that these values put behind its camera, and for a point that should lie on a
    line but does not.
    """
    p = Predictor(survey, start)
    return replace(
        survey,
        cameras=tuple(_camera(p, c) for c in survey.cameras),
        stations=tuple(_station(p, s) for s in survey.stations),
        tables=tuple(_table(p, t) for t in survey.tables),
        targets=tuple(_target(p, t) for t in survey.targets),
        points=tuple(_point(p, x) for x in survey.points),
        image_blocks=tuple(_block(p, b) for b in survey.image_blocks),
        table_readings=tuple(replace(r, angles=p.reading(r)) for r in survey.table_readings),
        pairs=tuple(_pair(p, pair) for pair in survey.pairs),
        distances=tuple(_distance(p, d) for d in survey.distances),
        coordinates=tuple(_coordinates(p, c) for c in survey.coordinates),
        **exact_readings(p),
    )


def _block(p: Predictor, block: ImageBlock) -> ImageBlock:
    camera = p.cameras[block.camera_id]
    uv, q = p.image(block)
    if np.isnan(uv).any():
        lens = p.lens(camera, block.epoch_id)
        uv = project(MODELS[camera.lens.model], lens, camera_constants(camera), q)  # says why there is none
    return replace(block, uv=uv)


def _pair(p: Predictor, pair: Pair) -> Pair:
    motion = p.b_from_a(pair.a, pair.b)
    return replace(pair, b_from_a=motion if isinstance(pair.b_from_a, Pose3) else motion.rotation())


def _distance(p: Predictor, d: Distance) -> Distance:
    return replace(d, value=float(np.linalg.norm(p.position(d.b) - p.position(d.a))))


def _coordinates(p: Predictor, c: Coordinates) -> Coordinates:
    return replace(c, values=np.array([p.position(ref) for ref in c.positions]))


def _pose(p: Predictor, name: ParameterName, parameter: PoseParameter) -> PoseParameter:
    if parameter.treatment != "prior" or name not in p.graph.unknowns.by_name:
        return parameter
    return replace(parameter, value=p.values.atPose3(p.graph.unknowns.by_name[name].key))


def _epochs(
    p: Predictor, kind: str, owner: str, default: PoseParameter, epochs: Mapping[str, PoseParameter]
) -> dict[str, PoseParameter]:
    """Poses by epoch; a prior that holds for all epochs becomes one for each, since each has its own value."""
    own = [n for n in p.graph.unknowns.by_name if n[:2] == (kind, owner) and len(n) == 3]
    wanted = {**epochs, **{n[2]: epochs.get(n[2], default) for n in own}}
    listed = {e: x for e, x in wanted.items() if e in epochs or x.treatment == "prior"}
    return {epoch: _pose(p, (kind, owner, epoch), x) for epoch, x in listed.items()}


def _full(p: Predictor, name: ParameterName) -> FloatArray | None:
    vector = p.graph.unknowns.vectors.get(name)
    return None if vector is None else vector.full(p.values)


def _prior(prior: VectorPrior | None, names: tuple[str, ...], full: FloatArray | None) -> VectorPrior | None:
    if prior is None or full is None:
        return prior
    return replace(prior, mean=np.array([full[names.index(n)] for n in prior.names]))


def _vector(p: Predictor, name: ParameterName, parameter: VectorParameter) -> VectorParameter:
    return replace(parameter, prior=_prior(parameter.prior, parameter.names, _full(p, name)))


def _camera(p: Predictor, camera: Camera) -> Camera:
    name = ("lens", camera.camera_id)
    prior = _prior(camera.lens.prior, MODELS[camera.lens.model].names, _full(p, name))
    pose = _pose(p, ("station_from_camera", camera.camera_id), camera.station_from_camera)
    return replace(camera, lens=replace(camera.lens, prior=prior), station_from_camera=pose)


def _station(p: Predictor, s: Station) -> Station:
    return replace(
        s,
        world_from_station=_pose(p, ("world_from_station", s.station_id), s.world_from_station),
        mount_from_station=_pose(p, ("mount_from_station", s.station_id), s.mount_from_station),
        epochs=_epochs(p, "world_from_station", s.station_id, s.world_from_station, s.epochs),
    )


def _table(p: Predictor, t: Table) -> Table:
    pose = _pose(p, ("world_from_table", t.table_id), t.world_from_table)
    return replace(t, world_from_table=pose, geometry=_vector(p, ("table_geometry", t.table_id), t.geometry))


def _target(p: Predictor, t: Target) -> Target:
    kind = "carrier_from_target"
    return replace(
        t,
        carrier_from_target=_pose(p, (kind, t.target_id), t.carrier_from_target),
        epochs=_epochs(p, kind, t.target_id, t.carrier_from_target, t.epochs),
        warp=None if t.warp is None else _vector(p, ("warp", t.target_id), t.warp),
    )


def _point(p: Predictor, point: Point) -> Point:
    unknown = p.graph.unknowns.by_name.get(("point", point.point_id))
    if point.x_in_world.treatment != "prior" or unknown is None:
        return point
    return replace(point, x_in_world=replace(point.x_in_world, value=np.asarray(p.values.atPoint3(unknown.key))))
