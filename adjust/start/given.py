"""Start values that came with a survey: which there are, the survey without them, and a start moved onto them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.frames.tree import in_world
from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.rewriting import Rewriting
from adjust.model.survey import FloatArray, PointParameter, PoseParameter, Survey
from adjust.spatial.rigid import align, as_pose3
from adjust.start.search import Start


@frozen(eq=False)
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
    listed = _Listed()
    listed(survey)
    poses = {name: parameter.value for name, parameter in listed.found.items() if _is_start(parameter)}
    return GivenStarts(points, {name: pose for name, pose in poses.items() if pose is not None})


def _is_start(parameter: PoseParameter | PointParameter) -> bool:
    return parameter.treatment == "free" and parameter.value is not None and not parameter.held


class _Listed(Rewriting):
    """Collects all poses by name."""

    def __init__(self) -> None:
        self.found: dict[ParameterName, PoseParameter] = {}

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        self.found[name] = given
        return given


class _Bare(Rewriting):
    """No start values of free points, of free poses, or of both."""

    def __init__(self, points: bool, poses: bool) -> None:
        self.points, self.poses = points, poses

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        return replace(given, value=None) if self.poses and _is_start(given) else given

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        return replace(given, value=None) if self.points and _is_start(given) else given


def without_starts(survey: Survey, points: bool, poses: bool) -> Survey:
    """The survey without the start values of its free points, of its free poses, or of both."""
    return _Bare(points, poses)(survey)


def moved_onto(start: Start, given: GivenStarts, survey: Survey) -> Start:
    """A start of a survey with a free datum, moved as a whole to where the given values lie; as it is if they are few.

    The inner constraints keep the mean place of the start values, and people expect their own.
    """
    placed = {n: p for n, p in start.poses.items() if in_world(survey, n)}
    pairs = [(x, start.points[n]) for n, x in given.points.items() if n in start.points]
    pairs += [(p.translation(), placed[n].translation()) for n, p in given.poses.items() if n in placed]
    if len(pairs) < 3:
        return start
    there, here = (np.array([pair[i] for pair in pairs], dtype=float) for i in (0, 1))
    if min(np.linalg.matrix_rank(x - x.mean(axis=0), tol=1e-6) for x in (there, here)) < 2:
        return start
    move = as_pose3(align(there, here))
    poses = {n: move * p if n in placed else p for n, p in start.poses.items()}
    return replace(start, poses=poses, points={n: np.asarray(move.transformFrom(x)) for n, x in start.points.items()})
