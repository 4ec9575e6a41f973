"""``motion = "epoch"`` forgotten: a target, or a station, that is said to stand still and is seen to move.

Evidence: poses of single images, ``camera_from_target`` of a camera that stands still too, scatter far more than each
fits its own image.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.model.rewriting import with_changed
from adjust.model.survey import Survey
from adjust.spatial.averaging import mean_pose, typical_distance
from adjust.spatial.rigid import inverse
from adjust.start.views import View

_CLEARLY = 10.0
_FEWEST = 2
"""Images beyond the first of each camera and target, all together, that have to show it moved."""


def forgotten_motion(case: Case) -> Iterator[Hypothesis]:
    """Targets before stations: what is held by hand is moved more often than what carries cameras."""
    survey = case.survey
    fixed = {s.station_id for s in survey.stations if s.motion == "fixed"}
    still = {t.target_id for t in survey.targets if t.motion == "fixed" and (t.station_id or "") in fixed | {""}}
    station_of = {c.camera_id: c.station_id for c in survey.cameras}
    carriers = {t.target_id: t.station_id for t in survey.targets}
    moves: dict[tuple[str, str], tuple[float, int]] = {}
    for (camera_id, target_id), views in case.views_of.items():
        joined = carriers[target_id] == station_of[camera_id]
        if target_id in still and station_of[camera_id] in fixed and not joined and len(views) > 1:
            key, ratio = (station_of[camera_id], target_id), _scatter([*views.values()])
            if ratio > _CLEARLY:
                most, n = moves.get(key, (0.0, 0))
                moves[key] = max(most, ratio), n + len(views) - 1
    for which, kind, share in ((1, "target", 1.0), (0, "station", 0.9)):
        for owner in dict.fromkeys(key[which] for key in moves):
            ratios, numbers = zip(*(found for key, found in moves.items() if key[which] == owner), strict=True)
            if sum(numbers) >= _FEWEST:
                yield _moving(survey, kind, owner, share * max(ratios))


def _scatter(views: Sequence[View]) -> float:
    """How far the poses are apart, as angles at the camera, over the error of a single image."""
    target_from_camera = inverse(np.array([v.poses[0] for v in views]))
    error = float(np.median([v.error_px[0] for v in views])) / views[0].focal_px
    lever = typical_distance(target_from_camera)
    apart = mean_pose(target_from_camera, lever)[1]
    return float(np.median(apart) / lever / max(10.0 * error, 1e-5))


def _moving(survey: Survey, kind: str, owner: str, evidence: float) -> Hypothesis:
    cause = {"target": f"target {owner} moves between epochs, but is said to stand still",
             "station": f"station {owner} moves between epochs, but is said to stand still"}[kind]  # fmt: skip
    return Hypothesis(
        "motion forgotten", cause,
        f'write motion = "epoch" below [{kind}s.{owner}] in survey.toml', Place(kind, (owner,), "motion"),
        with_changed(survey, f"{kind}s", owner, motion="epoch"), (SetKey((f"{kind}s", owner, "motion"), "epoch"),),
        evidence, 6,
    )  # fmt: skip
