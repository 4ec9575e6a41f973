"""Adjusting a project that has grown, from the values of its last solution.

The result is that of adjusting everything at once: the minimum does not depend on where the search begins. Where it
might (free networks, whose datum is that of the start), the search begins anew.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.graph.assembly import StartValues, values_of
from adjust.lenses.models import MODELS
from adjust.model.clocks import CLOCKS, INTERVALS, clocks_of, epoch_times
from adjust.model.errors import NotConvergedError
from adjust.model.result import Adjustment, ParameterName
from adjust.model.rewriting import Rewriting, Vector
from adjust.model.survey import FloatArray, LensParameter, PointParameter, PoseParameter, Survey
from adjust.pose_network.from_survey import network_from_survey, network_of_pairs
from adjust.pose_network.start import carried
from adjust.start import find_start
from survey.jobs.adjusting.steps import adjust_project
from survey.project import Project
from survey.solution.earlier.changes import Snapshot

_TERMS = ("table_geometry", "warp", "lens_drift", *CLOCKS)
"""Vectors that a start has no closed form for."""
WARM, COLD = "from the previous solution", "from the beginning"


def warm_adjustment(project: Project, before: Snapshot | None, progress: bool) -> tuple[Adjustment, str]:
    """Adjust a project that has grown or shrunk, and how that began; where nothing was before, from the beginning.

    What people left out and what the tables leave out is obeyed as always; what the previous run screened out by
    itself is tested anew, because what it contradicted may be gone.
    """
    found: list[bool] = []
    free = project.survey.datum.kind == "inner" or project.options.pairs == "closed"

    def begin(part: Survey) -> StartValues | None:
        if before is None or free:
            return None
        start = (survey_start if network_of_pairs(part) is None else network_start)(part, before)
        found.append(start is not None)
        return start

    try:
        adjustment = adjust_project(project, progress, begin)
    except NotConvergedError:  # what is new may contradict what was there; the search from the beginning looks for that
        if not any(found):
            raise
        return adjust_project(project, progress), COLD
    return adjustment, WARM if found and all(found) else COLD


def network_start(survey: Survey, before: Snapshot) -> StartValues | None:
    """Of a network of nothing but pairs; None where these do not reach all stations from those that are known."""
    poses = network_poses(survey, values_of(before).poses)
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


def survey_start(survey: Survey, before: Snapshot) -> StartValues | None:
    """Start values with what is known from before; None where images contradict it."""
    start = find_start(_Known(before)(survey))
    if start.excluded_blocks:
        return None
    return replace(start, vectors={**start.vectors, **_known_vectors(survey, before, start)})


def _known_vectors(survey: Survey, before: Snapshot, start: StartValues) -> dict[ParameterName, FloatArray]:
    """Angles, axes, warps, changes of lenses and clocks from before; what is held keeps its value."""
    in_seconds = any(clocks_of(survey)) and epoch_times(survey).unit != INTERVALS
    other = INTERVALS if in_seconds else "s"
    elsewhen = {n for n, e in before.estimates.items() if n[0] in CLOCKS and other in e.units}
    return {n: x for n, x in values_of(before, survey).vectors.items()
            if (n[0] in _TERMS or (n[0] == "table_angles" and n in start.vectors)) and n not in elsewhen}  # fmt: skip


class _Known(Rewriting):
    """Previous values of free lenses, poses and points as their start."""

    def __init__(self, before: Snapshot) -> None:
        self.estimates = before.estimates
        self.values = values_of(before)

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        known = name in self.values.poses and given.treatment == "free" and not given.held
        return replace(given, value=self.values.poses[name]) if known else given

    def epochs(
        self, name: ParameterName, given: Mapping[str, PoseParameter], usual: PoseParameter
    ) -> Mapping[str, PoseParameter]:
        found = (n for n in self.values.poses if n[:2] == name and len(n) == 3)
        return {**given, **{n[2]: self.pose(n, given.get(n[2], usual)) for n in found}}

    def vector(self, name: ParameterName, given: Vector) -> Vector:
        """The lens with its values of before; what is held, tied or has a prior needs nothing of it."""
        if not isinstance(given, LensParameter) or not given.free or name not in self.estimates:
            return given
        names = MODELS[given.model].names
        if self.estimates[name].components != names:
            return given
        held = np.zeros(len(names)) if given.values is None else given.values
        return replace(given, values=np.where([n in given.free for n in names], self.values.lenses[name[1]], held))

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        known = given.treatment == "free" and not given.held and name[1] in self.values.points
        return replace(given, value=self.values.points[name[1]]) if known else given
