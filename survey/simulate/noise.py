"""Fresh noise on every observation and prior of a survey, drawn around the truth with its own covariance."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from gtsam import Pose3, Rot3

from adjust.design.noise import draw, moved, with_drawn_priors
from adjust.model.frozen import frozen
from adjust.model.observations import Pair, TableReading
from adjust.model.survey import FloatArray, Survey
from survey.simulate.readings import fresh_readings
from survey.simulate.scene import Scene, Truth


@frozen(eq=False)
class _Ideal:
    """Error-free image points (N, 2) px of a survey, factors (N, 2, 2) of their noise, and other readings by field."""

    scene: Scene
    uv: FloatArray
    uv_factor: FloatArray
    others: dict[str, list[Any]]


_IDEAL: WeakKeyDictionary[Survey, _Ideal] = WeakKeyDictionary()


def resample(survey: Survey, truth: Truth, seed: int) -> Survey:
    """The same survey with new noise: every observation is the truth plus a draw from its covariance.

    Means of priors are drawn anew as well, for they are observations; those that hold for epochs not listed one by one
    stay as they are. Error-free values are kept between calls with the same ``survey``.
    """
    ideal = _IDEAL.get(survey)
    if ideal is None or ideal.scene.truth is not truth:
        ideal = _IDEAL[survey] = _ideal(Scene(survey, truth))
    rng = np.random.default_rng(seed)
    uv = ideal.uv + np.einsum("nij,nj->ni", ideal.uv_factor, rng.standard_normal(ideal.uv.shape))
    ends = np.cumsum([len(block.uv) for block in survey.image_blocks])
    parts = np.split(uv, ends[:-1]) if len(ends) else []
    blocks = tuple(replace(b, uv=part) for b, part in zip(survey.image_blocks, parts, strict=True))
    drawn: dict[str, Any] = {}
    for name, (_, noisy) in _KINDS.items():
        rows = zip(getattr(survey, name), ideal.others[name], strict=True)
        drawn[name] = tuple(noisy(item, true, rng) for item, true in rows)
    again = replace(survey, image_blocks=blocks, **drawn)
    return replace(with_drawn_priors(again, rng, truth), **fresh_readings(ideal.scene, rng))


def _ideal(scene: Scene) -> _Ideal:
    survey = scene.survey
    uv = np.concatenate([np.zeros((0, 2)), *map(scene.image, survey.image_blocks)])
    if np.isnan(uv).any():
        raise ValueError("the survey has image points that its truth puts behind the camera")
    factors = np.concatenate([np.zeros((0, 2, 2)), *(np.linalg.cholesky(block.cov) for block in survey.image_blocks)])
    others = {name: [true(scene, item) for item in getattr(survey, name)] for name, (true, _) in _KINDS.items()}
    return _Ideal(scene, uv, factors, others)


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


_KINDS: dict[str, tuple[Callable[[Scene, Any], Any], Callable[[Any, Any, np.random.Generator], Any]]] = {
    "table_readings": (_true_angles, lambda r, true, rng: replace(r, angles=true + draw(r.cov, rng))),
    "pairs": (_true_pair, lambda p, true, rng: replace(p, b_from_a=moved(true, draw(p.cov, rng)))),
    "distances": (
        lambda scene, d: float(np.linalg.norm(scene.position(d.b) - scene.position(d.a))),
        lambda d, true, rng: replace(d, value=true + d.sigma * rng.standard_normal()),
    ),
    "coordinates": (
        lambda scene, c: np.array([scene.position(p) for p in c.positions]),
        lambda c, true, rng: replace(c, values=true + draw(c.cov, rng).reshape(-1, 3)),
    ),
}
"""By field of a survey what is true of an observation, and that with noise; drawn in this order."""
