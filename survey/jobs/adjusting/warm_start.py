"""Adjusting a project that has grown, from the values of its last solution.

The result is that of adjusting everything at once: the minimum does not depend on where the search begins. Where it
might (free networks, whose datum is that of the start), the search begins anew.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.graph.assembly import StartValues
from adjust.lenses.models import MODELS
from adjust.model.boards import BOARD
from adjust.model.clocks import CLOCK, clocks_of, epoch_times
from adjust.model.errors import NotConvergedError
from adjust.model.result import Adjustment, ParameterName
from adjust.model.rewriting import Rewriting, Vector
from adjust.model.survey import FloatArray, LensParameter, PointParameter, PoseParameter, Survey, VectorParameter
from adjust.model.tables import unit_of
from adjust.pose_network.from_survey import network_from_survey, network_of_pairs
from adjust.pose_network.start import carried
from adjust.start import find_start
from survey.jobs.adjusting.steps import adjust_project
from survey.project import Project
from survey.solution.earlier.previous import Previous

WARM, COLD = "from the previous solution", "from the beginning"


def warm_adjustment(
    project: Project, previous: Previous, cold: Callable[[Project], Adjustment], progress: bool
) -> tuple[Adjustment, str]:
    """Adjust a project that has grown or shrunk, and how that began. cold: adjusts a project from the beginning.

    What people left out and what the tables leave out is obeyed as always; what the previous run screened out by
    itself is tested anew, because what it contradicted may be gone.
    """
    survey = project.survey
    if survey.datum.kind == "inner" or project.options.pairs == "closed":
        return cold(project), COLD
    found: list[bool] = []

    def begin(part: Survey) -> StartValues | None:
        start = (survey_start if network_of_pairs(part) is None else network_start)(part, previous)
        found.append(start is not None)
        return start

    try:
        adjustment = adjust_project(project, progress, begin)
    except NotConvergedError:  # what is new may contradict what was there; the search from the beginning looks for that
        return cold(project), COLD
    return adjustment, WARM if all(found) else COLD


def network_start(survey: Survey, previous: Previous) -> StartValues | None:
    """Of a network of nothing but pairs; None where these do not reach all stations from those that are known."""
    poses = network_poses(survey, previous.poses)
    return None if poses is None else StartValues({}, {("world_from_station", s): p for s, p in poses.items()}, {})


def network_poses(survey: Survey, known: Mapping[ParameterName, Pose3]) -> dict[str, Pose3] | None:
    """``world_from_station`` of a pure network by station: known ones, the others by the best pairs.

    None where the pairs do not reach all stations.
    """
    ids = network_from_survey(survey).station_ids
    poses = {s: known["world_from_station", s] for s in ids if ("world_from_station", s) in known}
    given = {s.station_id: s.world_from_station for s in survey.stations}
    poses |= {s: given[s].value or Pose3() for s in ids if given[s].treatment != "free"}
    poses |= carried(poses, (p for p in survey.pairs if p.used))
    return {s: poses[s] for s in ids} if all(s in poses for s in ids) else None


def survey_start(survey: Survey, previous: Previous) -> StartValues | None:
    """Start values with what is known from before; None where images contradict it."""
    start = find_start(_Known(previous)(survey))
    if start.excluded_blocks:
        return None
    return replace(start, vectors={**start.vectors, **_known_vectors(survey, previous, start)})


def _known_vectors(survey: Survey, previous: Previous, start: StartValues) -> dict[ParameterName, FloatArray]:
    """Angles, axes, warps, changes of lenses and clocks from before; what is held keeps its value."""
    found: dict[ParameterName, FloatArray | None] = {}
    axes = {t.table_id: tuple(f"axis{i + 1}" for i in range(len(t.axes))) for t in survey.tables}
    for name in start.vectors:
        if name[0] == "table_angles":
            found[name] = previous.vector(name, axes[name[1]], ("rad",) * len(axes[name[1]]))
    for name, given, units in _terms(survey):
        value = previous.vector(name, given.names, units)
        free = [x in given.free for x in given.names]
        found[name] = None if value is None else np.where(free, value, given.values)
    for camera in survey.cameras:
        if (drift := camera.lens.drift) is not None:
            model, per = MODELS[camera.lens.model], "" if drift.reference_temperature is None else "/K"
            units = tuple(model.units[model.names.index(x)] + per for x in drift.parameters)
            for name in (n for n in previous.vectors if n[:2] == ("lens_drift", camera.camera_id)):
                found[name] = previous.vector(name, drift.parameters, units)
    return {name: value for name, value in found.items() if value is not None}


def _terms(survey: Survey) -> Iterator[tuple[ParameterName, VectorParameter, tuple[str, ...]]]:
    """Named scalars of owners that a start has no closed form for, with their units."""
    for table in survey.tables:
        yield ("table_geometry", table.table_id), table.geometry, tuple(unit_of(x) for x in table.geometry.names)
    for target in survey.targets:
        if target.warp is not None:
            yield ("warp", target.target_id), target.warp, tuple(BOARD[x] for x in target.warp.names)
    clocks = dict(clocks_of(survey))
    times = epoch_times(survey) if clocks else None
    for name, clock in clocks.items():
        unit = "s" if times is None else times.unit
        yield name, clock.parameters, tuple("1" if CLOCK[x] == "1" else unit for x in clock.parameters.names)
        if clock.jitter > 0.0 and times is not None:
            own = VectorParameter(("jitter",), np.zeros(1), ("jitter",))
            yield from (((*name, epoch), own, (unit,)) for epoch in times.of)


class _Known(Rewriting):
    """Previous values of free lenses, poses and points as their start."""

    def __init__(self, previous: Previous) -> None:
        self.previous = previous

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        value = self.previous.poses.get(name)
        known = value is not None and given.treatment == "free" and not given.held
        return replace(given, value=value) if known else given

    def epochs(
        self, name: ParameterName, given: Mapping[str, PoseParameter], usual: PoseParameter
    ) -> Mapping[str, PoseParameter]:
        found = (n for n in self.previous.poses if n[:2] == name and len(n) == 3)
        return {**given, **{n[2]: self.pose(n, given.get(n[2], usual)) for n in found}}

    def vector(self, name: ParameterName, given: Vector) -> Vector:
        """The lens with its values of before; what is held, tied or has a prior needs nothing of it."""
        if not isinstance(given, LensParameter) or not given.free:
            return given
        model = MODELS[given.model]
        found = self.previous.vector(name, model.names, model.units)
        if found is None or self.previous.vectors[name].get("model") != given.model:
            return given
        held = np.zeros(len(model.names)) if given.values is None else given.values
        return replace(given, values=np.where([n in given.free for n in model.names], found, held))

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        known = given.treatment == "free" and not given.held and name[1] in self.previous.points
        return replace(given, value=self.previous.points[name[1]]) if known else given
