"""Fresh noise on every observation and prior of a survey, drawn around the truth with its own covariance."""

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from gtsam import Pose3, Rot3

from adjust.design.noise import draw, moved, with_drawn_priors
from adjust.model.observations import Pair, TableReading
from adjust.model.survey import FloatArray, Survey
from survey.simulate.readings import fresh_readings
from survey.simulate.scene import Scene, Truth


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
            replace(r, angles=angles + draw(r.cov, rng))
            for r, angles in zip(survey.table_readings, ideal.table, strict=True)
        ),
        pairs=tuple(
            replace(p, b_from_a=moved(value, draw(p.cov, rng)))
            for p, value in zip(survey.pairs, ideal.pairs, strict=True)
        ),
        distances=tuple(
            replace(d, value=value + d.sigma * rng.standard_normal())
            for d, value in zip(survey.distances, ideal.distances, strict=True)
        ),
        coordinates=tuple(
            replace(c, values=values + draw(c.cov, rng).reshape(-1, 3))
            for c, values in zip(survey.coordinates, ideal.coordinates, strict=True)
        ),
    )
    return replace(with_drawn_priors(again, rng, truth), **fresh_readings(ideal.scene, rng))


def _ideal(scene: Scene) -> _Ideal:
    survey = scene.survey
    images: list[FloatArray] = [np.zeros((0, 2))]
    factors: list[FloatArray] = [np.zeros((0, 2, 2))]
    for block in survey.image_blocks:
        images.append(scene.image(block))
        factors.append(np.asarray(np.linalg.cholesky(block.cov), dtype=np.float64))
    uv = np.concatenate(images)
    if np.isnan(uv).any():
        raise ValueError("the survey has image points that its truth puts behind the camera")
    return _Ideal(
        scene,
        uv,
        np.concatenate(factors),
        np.cumsum([len(block.uv) for block in survey.image_blocks]).tolist(),
        [_true_angles(scene, r) for r in survey.table_readings],
        [_true_pair(scene, pair) for pair in survey.pairs],
        [float(np.linalg.norm(scene.position(d.b) - scene.position(d.a))) for d in survey.distances],
        [np.array([scene.position(p) for p in c.positions]) for c in survey.coordinates],
    )


def _true_angles(scene: Scene, reading: TableReading) -> FloatArray:
    """Of a table when it was read."""
    table = scene.survey.tables_by_id[reading.table_id]
    late = scene.courses.late(("table_clock", table.table_id), table.clock, reading.epoch_id)
    return scene.angles(table.table_id, reading.epoch_id, late)


def _true_pair(scene: Scene, pair: Pair) -> Pose3 | Rot3:
    clocks = {s.station_id: s.clock for s in scene.survey.stations if s.clock is not None}
    moving = [f for f in (pair.a, pair.b) if f.kind == "station" and f.epoch_id and f.frame_id in clocks]
    late = sum(scene.courses.late(("pose_clock", f.frame_id), clocks[f.frame_id], str(f.epoch_id)) for f in moving[:1])
    b_from_a = np.linalg.inv(scene.world_from_frame(pair.b, late)) @ scene.world_from_frame(pair.a, late)
    return Rot3(b_from_a[:3, :3]) if isinstance(pair.b_from_a, Rot3) else Pose3(b_from_a)
