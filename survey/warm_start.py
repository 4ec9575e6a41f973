"""Adjusting a project that has grown, from the values of its last solution.

The result is that of adjusting everything at once: the minimum does not depend on where the search begins. Where it
might (free networks, whose datum is that of the start; observations left out before), the search begins anew.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3
from tqdm import tqdm

from adjust.adjustment import AdjustOptions, start_values
from adjust.errors import NotConvergedError
from adjust.graph import StartValues
from adjust.initial import find_start
from adjust.model import FloatArray, PointParameter, PoseParameter, Survey
from adjust.pair_screen import PairOptions, adjusted_network, is_pure, network_solution
from adjust.pose_network.from_survey import network_from_survey
from adjust.result import Adjustment, ParameterName
from adjust.statistics.cleaned import adjust_cleaned
from survey.cleaning import clean_options
from survey.files import Project
from survey.previous import Previous

WARM, COLD = "from the previous solution", "from the beginning"


def warm_adjustment(
    project: Project, previous: Previous, cold: Callable[[Project], Adjustment], progress: bool
) -> tuple[Adjustment, str]:
    """Adjust a project that has grown, and how that began. cold: adjusts a project from the beginning."""
    survey = project.survey
    if survey.datum.kind == "inner" or not previous.clean or project.spots:
        return cold(project), COLD
    options = AdjustOptions(project.options.alpha, project.options.reject_blocks, project.options.reject_points)
    pairs = PairOptions(project.options.reject_pairs, options)
    with tqdm(desc="adjusting", unit=" steps", disable=not progress, file=sys.stderr, leave=False) as bar:

        def step(_iteration: int, omega: float) -> None:
            bar.set_postfix_str(f"v'Pv = {omega:.6g}")
            bar.update()

        if is_pure(survey):
            begin = network_start(survey, previous.poses)
            if begin is not None:
                return adjusted_network(survey, network_solution(survey, pairs, step, begin), pairs), WARM
        elif (start := survey_start(survey, previous)) is not None:
            try:
                return adjust_cleaned(survey, clean_options(project.options), step, start), WARM
            except NotConvergedError:
                pass  # what is new may contradict what was there; the search from the beginning looks for that
    return cold(project), COLD


def network_start(
    survey: Survey, known: Mapping[ParameterName, Pose3]
) -> tuple[FloatArray, FloatArray] | None:  # fmt: skip
    """Rotations (N, 3, 3) and translations (N, 3) of a pure network: known ones, the others by the best pairs.

    None where the pairs do not reach all stations.
    """
    ids = network_from_survey(survey).station_ids
    poses = {s: known["world_from_station", s] for s in ids if ("world_from_station", s) in known}
    given = {s.station_id: s.world_from_station for s in survey.stations}
    poses |= {s: given[s].value or Pose3() for s in ids if given[s].treatment != "free"}
    waiting = sorted((p for p in survey.pairs if p.used), key=lambda p: float(np.trace(p.cov)))
    while len(poses) < len(ids):
        usable = [p for p in waiting if (p.a.frame_id in poses) != (p.b.frame_id in poses)]
        if not usable:
            return None
        for pair in usable:
            a, b = pair.a.frame_id, pair.b.frame_id
            motion = pair.b_from_a
            b_from_a = Pose3(motion, np.zeros(3)) if isinstance(motion, Rot3) else motion
            if a in poses and b not in poses:
                poses[b] = poses[a].compose(b_from_a.inverse())
            elif b in poses and a not in poses:
                poses[a] = poses[b].compose(b_from_a)
        waiting = [p for p in waiting if p.a.frame_id not in poses or p.b.frame_id not in poses]
    return np.array([poses[s].rotation().matrix() for s in ids]), np.array([poses[s].translation() for s in ids])


def survey_start(survey: Survey, previous: Previous) -> StartValues | None:
    """Start values with what is known from before; None where images contradict it."""
    found = find_start(_with_known(survey, previous))
    if found.excluded_blocks:
        return None
    return start_values(found)


def _with_known(survey: Survey, previous: Previous) -> Survey:
    """The survey with previous values of free stations and points as their start."""

    def pose(parameter: PoseParameter, *name: str) -> PoseParameter:
        value = previous.poses.get(name)
        known = value is not None and parameter.treatment == "free"
        return replace(parameter, value=value) if known else parameter

    stations = tuple(
        replace(s, world_from_station=pose(s.world_from_station, "world_from_station", s.station_id))
        if s.motion == "fixed" else s
        for s in survey.stations
    )  # fmt: skip
    cameras = tuple(
        replace(c, station_from_camera=pose(c.station_from_camera, "station_from_camera", c.camera_id))
        for c in survey.cameras
    )
    points = tuple(
        replace(p, x_in_world=PointParameter(previous.points[p.point_id]))
        if p.x_in_world.treatment == "free" and p.point_id in previous.points else p
        for p in survey.points
    )  # fmt: skip
    return replace(survey, stations=stations, cameras=cameras, points=points)
