"""Start values that came with a survey: which there are, the survey without them, and a start moved onto them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from gtsam import Pose3

from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, PointParameter, PoseParameter, Station, Survey, Target
from adjust.spatial.rigid import align
from adjust.start.search import Start

_P = TypeVar("_P", PoseParameter, PointParameter)
_IN_WORLD = ("world_from_station", "world_from_table")


@dataclass(frozen=True, eq=False)
class GivenStarts:
    """Values of parameters that are free in all components: points (3,) m by id, poses by parameter name."""

    points: Mapping[str, FloatArray]
    poses: Mapping[ParameterName, Pose3]

    def __bool__(self) -> bool:
        return bool(self.points or self.poses)


def given_starts(survey: Survey) -> GivenStarts:
    """The start values that came with a survey; those of held, partly held and known parameters are none."""
    points = {
        p.point_id: np.asarray(p.x_in_world.value, dtype=float)
        for p in survey.points
        if _is_start(p.x_in_world) and np.isfinite(np.asarray(p.x_in_world.value, dtype=float)).all()
    }
    poses = {name: parameter.value for name, parameter in _pose_parameters(survey).items() if _is_start(parameter)}
    return GivenStarts(points, {name: pose for name, pose in poses.items() if pose is not None})


def _is_start(parameter: PoseParameter | PointParameter) -> bool:
    return parameter.treatment == "free" and parameter.value is not None and not parameter.held


def _pose_parameters(survey: Survey) -> dict[ParameterName, PoseParameter]:
    """All poses by name; what holds for every epoch that is not listed goes without the epoch."""
    out: dict[ParameterName, PoseParameter] = {}
    _rewritten(survey, out.setdefault)
    return out


def without_starts(survey: Survey, points: bool, poses: bool) -> Survey:
    """The survey without the start values of its free points, of its free poses, or of both."""
    if points:
        kept = tuple(replace(p, x_in_world=_bare(p.x_in_world)) for p in survey.points)
        survey = replace(survey, points=kept)
    return _rewritten(survey, lambda name, parameter: _bare(parameter)) if poses else survey


def _bare(parameter: _P) -> _P:
    return replace(parameter, value=None) if _is_start(parameter) else parameter


def _rewritten(survey: Survey, new: Callable[[ParameterName, PoseParameter], PoseParameter]) -> Survey:
    """The survey with ``new(name, parameter)`` for every pose."""

    def moved(owner: Station | Target, kind: str, owner_id: str) -> dict[str, Any]:
        pose = getattr(owner, kind)
        epochs = {e: new((kind, owner_id, e), parameter) for e, parameter in owner.epochs.items()}
        return {kind: new((kind, owner_id), pose), "epochs": epochs}

    return replace(
        survey,
        cameras=tuple(
            replace(c, station_from_camera=new(("station_from_camera", c.camera_id), c.station_from_camera))
            for c in survey.cameras
        ),
        stations=tuple(
            replace(
                s, **moved(s, "world_from_station", s.station_id),
                mount_from_station=new(("mount_from_station", s.station_id), s.mount_from_station),
            )
            for s in survey.stations
        ),
        tables=tuple(
            replace(t, world_from_table=new(("world_from_table", t.table_id), t.world_from_table))
            for t in survey.tables
        ),
        targets=tuple(replace(t, **moved(t, "carrier_from_target", t.target_id)) for t in survey.targets),
    )  # fmt: skip


def moved_onto(start: Start, given: GivenStarts, survey: Survey) -> Start:
    """A start of a survey with a free datum, moved as a whole to where the given values lie; as it is if they are few.

    The inner constraints keep the mean place of the start values, and people expect their own.
    """
    in_world = {n: p for n, p in start.poses.items() if _is_in_world(n, survey)}
    pairs = [(x, start.points[n]) for n, x in given.points.items() if n in start.points]
    pairs += [(p.translation(), in_world[n].translation()) for n, p in given.poses.items() if n in in_world]
    if len(pairs) < 3:
        return start
    there, here = (np.array([pair[i] for pair in pairs], dtype=float) for i in (0, 1))
    if min(np.linalg.matrix_rank(x - x.mean(axis=0), tol=1e-6) for x in (there, here)) < 2:
        return start
    move = Pose3(np.ascontiguousarray(align(there, here)))
    poses = {n: move * p if n in in_world else p for n, p in start.poses.items()}
    return replace(start, poses=poses, points={n: np.asarray(move.transformFrom(x)) for n, x in start.points.items()})


def _is_in_world(name: ParameterName, survey: Survey) -> bool:
    if name[0] == "carrier_from_target":
        return next(t.station_id for t in survey.targets if t.target_id == name[1]) is None
    return name[0] in _IN_WORLD
