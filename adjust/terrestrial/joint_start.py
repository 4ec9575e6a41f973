"""Start values of surveys with readings, alone or together with cameras."""

from dataclasses import replace

import numpy as np

from adjust.initial import Start, find_start
from adjust.model import FloatArray, Survey
from adjust.observations import PositionRef
from adjust.terrestrial.building import reading_refs
from adjust.terrestrial.start import explain, find_points, given_points, lacking_points, with_start


def needs_points(survey: Survey) -> bool:
    """Whether readings, distances or baselines have to give start values to points."""
    lacking = lacking_points(survey, given_points(survey))
    return bool(lacking) and bool(survey.readings or survey.distances or survey.coordinate_differences)


def find_all(survey: Survey) -> Start:
    """Start values of everything: points from readings first, then cameras, then points that only these bring near.

    Raises SurveyError naming what nothing determines.
    """
    seen = {int(i) for block in survey.image_blocks for i in block.point_idx if block.target_id is None}
    known = given_points(survey)
    found = {**known}
    if any(np.isfinite(x).any() for x in known.values()) or not survey.image_blocks:
        found = find_points(survey, known)
    lacking = lacking_points(survey, found)
    by_readings = [n for i, n in enumerate(p.point_id for p in survey.points) if n in set(lacking) and i not in seen]
    if lacking and not survey.image_blocks:
        raise explain(survey, lacking)
    # what only readings reach gets a place for now: find_start looks at it nowhere
    start = find_start(with_start(survey, found | dict.fromkeys(by_readings, np.zeros(3))))
    if not by_readings:
        return start
    points = {n: np.asarray(x) for n, x in start.points.items() if n not in set(by_readings)}
    more = find_points(survey, {**points, **{n: x for n, x in known.items() if n not in points}},
                       _frames(survey, start))  # fmt: skip
    lost = lacking_points(survey, points | more)
    if lost:
        raise explain(survey, lost)
    return replace(start, points={**more, **points})


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
