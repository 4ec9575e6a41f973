"""Start values of surveys with readings, alone or together with cameras."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.observations import PositionRef
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, Survey
from adjust.observations.terrestrial.building import reading_refs
from adjust.start import Start, find_start
from adjust.start.given import given_poses, with_poses
from adjust.start.readings.start import explain, find_points, given_points, lacking_points, with_start
from adjust.start.readings.tilted import find_tilted, station_name, tilted_sights


def needs_points(survey: Survey) -> bool:
    """Whether readings, distances or baselines have to give start values to points or to tilted stations."""
    lacking = lacking_points(survey, given_points(survey))
    observed = survey.readings or survey.distances or survey.coordinate_differences
    return bool(observed) and (bool(lacking) or any(not s.levelled for s in survey.setups))


def find_all(survey: Survey) -> Start:
    """Start values of everything: points from readings first, then cameras, then points that only these bring near.

    Raises SurveyError naming what nothing determines.
    """
    seen = {int(i) for block in survey.image_blocks for i in block.point_idx if block.target_id is None}
    known = given_points(survey)
    found, poses = {**known}, dict[ParameterName, Pose3]()
    if any(np.isfinite(x).any() for x in known.values()) or not survey.image_blocks:
        found, poses = _from_readings(survey, known, given_poses(survey), {})
    lacking = lacking_points(survey, found)
    by_readings = [n for i, n in enumerate(p.point_id for p in survey.points) if n in set(lacking) and i not in seen]
    if lacking and not survey.image_blocks:
        raise explain(survey, lacking)
    # what only readings reach gets a place for now: find_start looks at it nowhere
    survey = with_poses(survey, poses)
    waiting = _waiting(survey) if survey.image_blocks else {}
    placed = with_poses(with_start(survey, found | dict.fromkeys(by_readings, np.zeros(3))), waiting)
    start = find_start(placed)
    if not by_readings and not waiting:
        return start
    points = {n: np.asarray(x) for n, x in start.points.items() if n not in set(by_readings)}
    have = {n: p for n, p in start.poses.items() if n not in waiting}
    more, poses = _from_readings(survey, {**{n: x for n, x in known.items() if n not in points}, **points}, have,
                                 _frames(survey, replace(start, poses=have)))  # fmt: skip
    lost = lacking_points(survey, points | more)
    if lost:
        raise explain(survey, lost)
    unmet = [" ".join(n) for n in waiting if n not in poses]
    if unmet:
        raise SurveyError(
            f"no start value can be found for {', '.join(unmet)}: the set-ups that stand there are not levelled, and "
            "see too few points whose places are known (3 by direction and zenith angle); give a start pose"
        )
    return replace(start, points={**more, **points}, poses={**start.poses, **{n: poses[n] for n in waiting}})


def _from_readings(
    survey: Survey, known: Mapping[str, FloatArray], poses: Mapping[ParameterName, Pose3],
    frames: Mapping[PositionRef, FloatArray],
) -> tuple[dict[str, FloatArray], dict[ParameterName, Pose3]]:  # fmt: skip
    """Points and poses from levelled and from tilted set-ups by turns, since each may need what the other gives."""
    found, given = dict(known), dict(poses)
    ids = {p.point_id for p in survey.points}
    for _ in range(len(survey.setups) + 1):
        before = sum(np.isfinite(x).all() for x in found.values())
        tilted = find_tilted(survey, found, given)
        if tilted is not None:
            given |= {n: p for n, p in tilted.poses().items() if n not in given}
            found |= {n: x for n, x in tilted.known.items() if n in ids}
            stand = {ref: T[:3, 3] for ref, T in tilted.stations.items()}
            frames = {**frames, **stand}
        found |= find_points(survey, found, frames)
        if tilted is None or sum(np.isfinite(x).all() for x in found.values()) == before:
            break
    return found, {n: p for n, p in given.items() if n not in poses}


def _waiting(survey: Survey) -> dict[ParameterName, Pose3]:
    """Stations of tilted set-ups without a pose that no camera or target on them gives, at a place for now."""
    carrying = {c.station_id for c in survey.cameras} | {t.station_id for t in survey.targets}
    given = given_poses(survey)
    names = {station_name(ref) for ref in tilted_sights(survey)}
    return {n: Pose3() for n in names if n[1] not in carrying and n not in given and n[:2] not in given}


def _frames(survey: Survey, start: Start) -> dict[PositionRef, FloatArray]:
    """Origins of stations that readings start from or end at, where their pose is known by now."""
    out = {}
    for ref in reading_refs(survey):
        if ref.frame is not None and ref.frame.kind == "station" and ref.point_id is None:
            epoch = (ref.frame.epoch_id,) if ref.frame.epoch_id else ()
            name = ("world_from_station", ref.frame.frame_id)
            pose = start.poses.get((*name, *epoch), start.poses.get(name))
            if pose is not None:
                out[ref] = np.asarray(pose.translation())
    return out
