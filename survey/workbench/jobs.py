"""The other jobs of a project, from the page and from Python: what each says, and what of it is drawn in space."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, PoseParameter
from survey.folder.replacing import changing, replace_parts
from survey.project.project import DEFINITION_FILE, RESULTS
from survey.report.language import text_said
from survey.solution.earlier.runs import Clock, command_line, remove_empty
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import scale_of
from survey.workbench.pages.beginning import Drawn, Told
from survey.workbench.places import Places
from survey.workbench.resident import Resident

if TYPE_CHECKING:  # detection brings in OpenCV, planning much else
    from adjust.graph.assembly import StartValues
    from adjust.navigation.model import Beacons
    from survey.detection import ImageReport
    from survey.jobs.adjusting.outcome import AdjustOutcome
    from survey.jobs.cross_validation import CrossValidation
    from survey.planning.job import PlanningOutcome, PlanRequest

_MOST_LINES = 300


def save(bench: Resident) -> "AdjustOutcome":
    """Write ``results`` as ``labsurvey adjust`` does, and a run beside the others. Raises as :func:`exclude`."""
    from survey.jobs.adjusting.outcome import kept_run, made

    with bench.lock:
        bench.check()
        clock = Clock({"adjust": bench.situation.seconds})
        with changing(bench.folder) as place:
            bench.require_unchanged()
            said = command_line("open", bench.folder)
            outcome = made(bench.situation.project, bench.adjustment, place, clock, command=said)
            gone = kept_run(bench.folder, place, bench.situation.project, outcome)
            replace_parts(bench.folder, gone=gone)
        remove_empty(bench.folder, gone)
        bench.n_unsaved = 0
        return outcome.at(bench.folder)


def detect(bench: Resident, *, everything: bool = False, told: "Callable[[ImageReport], None] | None" = None) -> Told:
    """Find targets and spots in images that are new or have changed (everything: in all), and adjust again.

    told: called with what was found in each image as it comes.
    """
    from survey.jobs.detecting.job import detect_job

    bench.check()
    outcome = detect_job(bench.folder, progress=False, everything=everything, told=told)
    bench.reload()
    return Told(outcome.text(), outcome.summary())


def plan(bench: Resident, request: "PlanRequest | None" = None) -> Told:
    """Precision before measuring, and what to measure next, as ``plan.toml`` lists it; drawn: what was chosen."""
    from survey.planning.job import PlanRequest, planning_job

    bench.check()
    if not (bench.folder / "plan.toml").is_file():
        raise SurveyError(f"{bench.folder / 'plan.toml'}: there is no such file; it says what could be measured")
    outcome = planning_job(bench.folder, request or PlanRequest(), progress=False)
    return Told(outcome.text(), outcome.summary(), _chosen(outcome))


def navigate(bench: Resident, station: str = "", interval_s: float | None = None) -> Told:
    """A pose for every epoch that shows beacons and no target; drawn: the path with its covariances."""
    from survey.jobs.navigating.job import NavigateRequest, navigate_job

    bench.check()
    request = NavigateRequest(station or None, interval_s=interval_s)
    outcome = navigate_job(bench.folder, request, progress=False)
    poses = [(e, e.world_from_station) for e in outcome.trajectory.epochs]
    path = [(e.epoch_id, np.asarray(pose.translation()), _in_world(pose, e.cov), str(e.status))
            for e, pose in poses if pose is not None]  # fmt: skip
    alone = None if bench.situation.adjustment is not None else _beacons(outcome.calibration.beacons)
    return Told(outcome.text(), outcome.summary(), Drawn(path=path, scene=alone))


def add(bench: Resident, new: str | Path) -> Told:
    """Let the network grow by the stations or observations of another folder, and adjust again.

    It begins at the results: where they are not those of now, they are saved first.
    """
    from survey.jobs.network import add_job

    bench.check()
    if bench.n_unsaved or not (bench.folder / RESULTS / "solution.json").is_file():
        save(bench)
    outcome = add_job(bench.folder, bench.other_folder(new), progress=False)
    bench.reload()
    return Told(outcome.text(), outcome.summary())


def compare_with(bench: Resident, other: str | Path) -> Told:
    """The project as the later of two epochs, and what moved since the other; nothing is written.

    drawn: how points and stations moved.
    """
    from survey.jobs.comparing import compare_job

    outcome = compare_job(bench.other_folder(other), bench.folder, progress=False)
    before, after = (_positions(a) for a in outcome.adjustments)
    lines = [(name, [before[name], x]) for name, x in after.items() if name in before]
    return Told(outcome.text(), outcome.summary(), Drawn(lines=lines))


def cross_validate(bench: Resident, distance: float = float("inf")) -> "CrossValidation":
    """The lenses of two halves of the epochs compared, for points at ``distance`` (m); nothing is written."""
    from survey.jobs.cross_validation import cross_validate

    return cross_validate(bench.situation.project, distance)


def batch(bench: Resident, folders: Sequence[str | Path] = ()) -> Told:
    """Adjust several projects (none: all beside this one), side by side; each has its results afterwards.

    ``summary["rows"]``: of each its ``folder``, ``state``, ``verdict``, ``sigma0``, ``redundancy`` and ``error``.
    """
    from survey.batch.run import BatchOptions, run_batch
    from survey.batch.tables import summary_table

    bench.check()
    chosen = [bench.other_folder(f) for f in folders] or sorted(
        p.parent for p in bench.folder.resolve().parent.glob(f"*/{DEFINITION_FILE}"))  # fmt: skip
    found = run_batch(chosen, BatchOptions(progress=False))
    rows = [{"folder": str(r.folder), "state": str(r.state), "error": text_said(r.error),
             **{k: r.summary.get(k) for k in ("verdict", "sigma0", "redundancy")}} for r in found]  # fmt: skip
    return Told(summary_table(found), {"folders": [row["folder"] for row in rows],
                                       "states": [row["state"] for row in rows], "rows": rows})  # fmt: skip


def _positions(adjustment: Adjustment) -> dict[str, FloatArray]:
    """Adjusted points and stations (3,) m by name."""
    found = {n: e.value for n, e in adjustment.estimates.items() if n[0] in ("point", "world_from_station")}
    return {"/".join(n): np.asarray(v.translation() if isinstance(v, Pose3) else v) for n, v in found.items()}


def _beacons(known: "Beacons") -> dict[str, object]:
    """What a path is drawn beside where there is no solution."""
    from survey.report.scene import Scene, Spot, drawn_values

    covs = (known.cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(len(known.beacon_ids)))
    spots = (Spot(name, "point", x, cov) for name, x, cov in zip(known.beacon_ids, known.x_in_world, covs, strict=True))
    return drawn_values(Scene(list(spots)), 1.0)


def _in_world(pose: Pose3, cov: FloatArray) -> FloatArray:
    """The covariance (3, 3) of a pose's position in the world; cov: (6, 6) in the tangent of the pose."""
    R = pose.rotation().matrix()
    return np.asarray(R @ cov[3:, 3:] @ R.T)


class _PlannedFrames(AdjustedFrames):
    """Frames that are still to be: of what is not estimated yet by the values of the plan."""

    def __init__(self, adjustment: Adjustment, start: "StartValues") -> None:
        super().__init__(adjustment)
        self.start = start

    def pose(self, name: ParameterName, parameter: PoseParameter) -> Pose3 | None:
        """As of an adjustment, else as planned."""
        return self.start.poses.get(name) if name not in self.estimates and name in self.start.poses else \
            super().pose(name, parameter)  # fmt: skip


def _chosen(outcome: "PlanningOutcome") -> Drawn:
    """The candidates that a plan chose: cameras of new epochs, new points, lines of readings, pairs and distances."""
    from adjust.design.candidates import with_candidates
    from survey.report.scene import scene_values

    steps = () if outcome.selection is None else outcome.selection.steps
    chosen = [outcome.planned.candidates[s.candidate_idx] for s in steps]
    survey = with_candidates(outcome.planned.survey, chosen)
    frames = _PlannedFrames(replace(outcome.expected, survey=survey), outcome.planned.start)
    places = Places(frames, survey.points)
    images = {(b.camera_id, b.epoch_id): None for c in chosen for b in c.image_blocks}
    poses = {"/".join(key): frames.world_from(FrameRef("camera", *key)) for key in images}
    points = [(p.point_id, outcome.planned.start.points.get(p.point_id)) for c in chosen for p in c.points]
    lines = [(c.name, x) for c in chosen for kind in (c.pairs, c.distances, c.readings, c.coordinate_differences)
             for item in kind for x in places.lines(item)]  # fmt: skip
    known = {k: p for k, p in poses.items() if p is not None}
    everything = scene_values(outcome.expected, scale_of(outcome.expected, "a_priori"))
    return Drawn(known, [(k, x, np.zeros((3, 3))) for k, x in points if x is not None], lines[:_MOST_LINES],
                 scene=everything)  # fmt: skip
