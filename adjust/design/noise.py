"""Fresh noise on a survey whose observations are exact: each gets a draw from its own covariance."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.design.readings import disturbed_readings, draw
from adjust.model.observations import ImageBlock, Pair
from adjust.model.survey import FloatArray, PoseParameter, Survey, VectorParameter, VectorPrior

Rng = np.random.Generator


def disturbed(survey: Survey, rng: Rng, sigmas: FloatArray | None = None) -> Survey:
    """The survey with noisy observations; means of priors are observations too.

    sigmas: (N,) of the readings, where they are not simply those that each has.
    """
    of_readings = np.array([r.sigma for r in survey.readings]) if sigmas is None else sigmas
    return replace(
        survey,
        image_blocks=tuple(_block(b, rng) for b in survey.image_blocks),
        table_readings=tuple(replace(r, angles=r.angles + draw(r.cov, rng)) for r in survey.table_readings),
        pairs=tuple(_pair(p, rng) for p in survey.pairs),
        distances=tuple(replace(d, value=d.value + d.sigma * rng.standard_normal()) for d in survey.distances),
        coordinates=tuple(
            replace(c, values=c.values + draw(c.cov, rng).reshape(-1, 3)) for c in survey.coordinates
        ),
        cameras=tuple(
            replace(
                c,
                lens=replace(c.lens, prior=_prior(c.lens.prior, rng)),
                station_from_camera=_pose(c.station_from_camera, rng),
            )
            for c in survey.cameras
        ),
        stations=tuple(
            replace(
                s,
                world_from_station=_pose(s.world_from_station, rng),
                mount_from_station=_pose(s.mount_from_station, rng),
                epochs=_poses(s.epochs, rng),
            )
            for s in survey.stations
        ),
        tables=tuple(
            replace(t, world_from_table=_pose(t.world_from_table, rng), geometry=_vector(t.geometry, rng))
            for t in survey.tables
        ),
        targets=tuple(
            replace(
                t,
                carrier_from_target=_pose(t.carrier_from_target, rng),
                epochs=_poses(t.epochs, rng),
                warp=None if t.warp is None else _vector(t.warp, rng),
            )
            for t in survey.targets
        ),
        points=tuple(
            replace(p, x_in_world=replace(p.x_in_world, value=p.x_in_world.value + draw(p.x_in_world.prior_cov, rng)))
            if p.x_in_world.prior_cov is not None and p.x_in_world.value is not None
            else p
            for p in survey.points
        ),
        **disturbed_readings(survey, of_readings, rng),
    )  # fmt: skip


def _block(block: ImageBlock, rng: Rng) -> ImageBlock:
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(block.cov), rng.standard_normal(block.uv.shape))
    return replace(block, uv=block.uv + noise)


def _pair(pair: Pair, rng: Rng) -> Pair:
    return replace(pair, b_from_a=_moved(pair.b_from_a, draw(pair.cov, rng)))


def _moved(value: Pose3 | Rot3, tangent: FloatArray) -> Pose3 | Rot3:
    if isinstance(value, Rot3):
        return value.compose(Rot3.Expmap(tangent))
    return value.compose(Pose3.Expmap(tangent))


def _pose(parameter: PoseParameter, rng: Rng) -> PoseParameter:
    if parameter.treatment != "prior" or parameter.value is None or parameter.prior_cov is None:
        return parameter
    return replace(parameter, value=parameter.value.compose(Pose3.Expmap(draw(parameter.prior_cov, rng))))


def _poses(parameters: Mapping[str, PoseParameter], rng: Rng) -> dict[str, PoseParameter]:
    return {epoch_id: _pose(parameter, rng) for epoch_id, parameter in parameters.items()}


def _prior(prior: VectorPrior | None, rng: Rng) -> VectorPrior | None:
    return None if prior is None else replace(prior, mean=prior.mean + draw(prior.cov, rng))


def _vector(parameter: VectorParameter, rng: Rng) -> VectorParameter:
    return replace(parameter, prior=_prior(parameter.prior, rng))
