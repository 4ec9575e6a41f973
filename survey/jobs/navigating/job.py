"""The job behind ``labsurvey navigate``: calibrate from everything else, then a pose for every navigation epoch."""

import contextlib
import sys
import time
from collections.abc import Sequence
from dataclasses import field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from adjust.adjustment import AdjustOptions, adjust
from adjust.diagnosis.trajectory import OfTrajectory, causes_of_trajectory
from adjust.model.errors import IndeterminateError, SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from adjust.navigation import EpochPose, Motion, NavigateOptions, Trajectory, head_and_beacons, navigate
from survey.folder.plain import attributes
from survey.folder.replacing import changing, replace_parts
from survey.jobs.adjusting.outcome import run_info
from survey.jobs.adjusting.probable_causes import explaining, with_probable_causes
from survey.jobs.navigating.calibration import Calibration, digest, keep, kept
from survey.jobs.navigating.lenses import lenses_taken
from survey.jobs.navigating.task import (
    NavigateRequest,
    calibrating,
    chosen_epochs,
    chosen_station,
    chosen_times,
    observed_epochs,
    others_to_navigate,
    require_one_time,
)
from survey.project import Project, read
from survey.report.results import RESULTS
from survey.solution.quantities import ARCSEC_PER_RAD, SigmaKind
from survey.solution.trajectories import write_trajectory

__all__ = ["STATUSES", "NavigateOutcome", "NavigateRequest", "navigate_job"]

_EVERYTHING = NavigateRequest()
CALIBRATION = "navigation_calibration.npz"
STATUSES = ("fixed", "bridged", "ambiguous", "undetermined", "none")


@frozen(eq=False)
class NavigateOutcome:
    """A navigated project: trajectory, what it was calibrated with, and the files written."""

    folder: Path
    station: str
    calibration: Calibration
    trajectory: Trajectory
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    paths: dict[str, Path] = field(default_factory=dict)
    sigmas: SigmaKind = "a_priori"
    causes: tuple[OfTrajectory, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Counts and median sigmas as plain values."""
        rot, trans = _median_sigmas(self.trajectory)
        return {
            "folder": str(self.folder),
            "station": self.station,
            "epochs": len(self.trajectory.epochs),
            **{status: self.trajectory.count(status) for status in STATUSES},  # type: ignore[arg-type]  # the same words
            "median_sigma_rotation_arcsec": rot,
            "median_sigma_translation_mm": trans,
            "calibration_sigma0": self.calibration.sigma0,
            "sigmas": self.sigmas,
            "diagnosis": [
                attributes(c, "name", "cause", "change", "kind") | {"ids": list(c.ids)}
                | attributes(c, "explained", "statistic", "critical") for c in self.causes
            ],
            "notes": list(self.notes),
            "written": {name: str(path) for name, path in self.paths.items()},
        }

    def text(self) -> str:
        """The counts, the precision, and every epoch without a certain pose, for people."""
        s = self.summary()
        lines = [f"{self.folder}: {s['epochs']} poses of {self.station}"]
        lines += [f"  ! probable cause: {c.cause}; {c.change} (explains {100.0 * c.explained:.0f} % of the misfit)"
                  for c in self.causes]  # fmt: skip
        lines.append("  " + ", ".join(f"{s[status]} {status}" for status in STATUSES if s[status]))
        if s["median_sigma_rotation_arcsec"] is not None:
            turn = "  ".join(f"{v:.0f}" for v in s["median_sigma_rotation_arcsec"])
            shift = "  ".join(f"{v:.3f}" for v in s["median_sigma_translation_mm"])
            kind = self.sigmas.replace("_", " ")
            lines.append(f"  median sigmas ({kind}) along the head's axes: {turn} arcsec,  {shift} mm")
        for epoch in self.trajectory.epochs:
            if epoch.status in ("ambiguous", "undetermined", "none"):
                lines.append(f"  {epoch.epoch_id}: {epoch.status}: {_why(epoch)}")
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])


def _why(epoch: EpochPose) -> str:
    if epoch.status == "ambiguous":
        shown = ", ".join(f"{s.probability:.3f}" for s in epoch.alternatives[:4])
        return f"{len(epoch.alternatives)} solutions cannot be told apart (probabilities {shown})"
    return "; ".join(epoch.undetermined)


def _median_sigmas(trajectory: Trajectory) -> tuple[list[float] | None, list[float] | None]:
    known = [e.sigmas for e in trajectory.epochs if e.status in ("fixed", "bridged")]
    if not known:
        return None, None
    median = np.median(known, axis=0)
    return (ARCSEC_PER_RAD * median[:3]).tolist(), (1e3 * median[3:]).tolist()


def navigate_job(
    folder: Path,
    request: NavigateRequest = _EVERYTHING,
    *,
    out: Path | None = None,
    progress: bool = True,
) -> NavigateOutcome:
    """Navigate a project and write ``results/trajectory.csv`` and ``.json``. Raises SurveyError.

    The calibration is adjusted without the epochs that are navigated, or could be (those that show beacons and no
    target), so that no spot is used twice and every choice of epochs has the same; its joint covariance of cameras,
    table and beacons goes into every pose. It is kept in ``results`` and used again while
    that survey, options and versions are the same. (The solution of ``adjust`` has the navigated spots in it.)
    """
    target = Path(out or folder)
    with changing(target) as place:
        outcome = _navigated(Path(folder), request, target / RESULTS, place / RESULTS, progress)
        replace_parts(target)
    return replace(outcome, paths={name: target / RESULTS / name for name in outcome.paths})


def _navigated(folder: Path, request: NavigateRequest, there: Path, place: Path, progress: bool) -> NavigateOutcome:
    """With its files in ``place``; what was kept from before is ``there``."""
    begin = time.perf_counter()
    project = read(folder)
    station = request.station or chosen_station(project)
    epochs = chosen_epochs(project, station, request)
    times = chosen_times(epochs, request)
    late = require_one_time(project.survey, station)
    calibration = _calibrate(project, station, epochs, there / CALIBRATION, place / CALIBRATION)
    calibrated = time.perf_counter()
    named = set(calibration.beacons.beacon_ids)
    if times is not None:
        times, epochs = map(list, zip(*sorted(zip(times, epochs, strict=True)), strict=True))
    observed = observed_epochs(project, station, epochs, times, request, named)
    motion = Motion() if times is not None else None
    options = NavigateOptions(motion=motion, use_table=request.use_table, alpha=min(project.options.alpha, 1e-3))
    with tqdm(total=len(epochs), desc="navigating", unit="epoch", disable=not progress, file=sys.stderr) as bar:
        trajectory = navigate(
            calibration.head, calibration.beacons, observed, options, lambda _done, _all: bar.update() and None
        )
    sigmas: SigmaKind = "a_priori"
    if project.options.sigmas == "a_posteriori" and calibration.sigma0 is not None:
        sigmas, trajectory = "a_posteriori", _scaled(trajectory, calibration.sigma0)
    seconds = {"calibrate": calibrated - begin, "navigate": time.perf_counter() - calibrated}
    notes = (*_notes(project, calibration), *late)
    sizes = {c.camera_id: c.image_size for c in project.survey.cameras}
    causes = causes_of_trajectory(calibration.head, calibration.beacons, observed, trajectory, options, sizes)
    outcome = NavigateOutcome(folder, station, calibration, trajectory, notes, seconds, sigmas=sigmas, causes=causes)
    summary = {k: v for k, v in outcome.summary().items() if k not in ("written", "folder", "notes", "diagnosis")}
    return replace(outcome, paths=write_trajectory(trajectory, observed, summary, place))


def _scaled(trajectory: Trajectory, sigma0: float) -> Trajectory:
    """All covariances times sigma0 of the calibration, squared; tests and choices were made a priori."""

    def one(epoch: EpochPose) -> EpochPose:
        others = tuple(replace(s, cov=sigma0**2 * s.cov) for s in epoch.alternatives)
        shares = epoch.shares
        if shares is not None:
            shares = replace(shares, **{f.name: sigma0**2 * getattr(shares, f.name) for f in fields(shares)})
        return replace(epoch, cov=sigma0**2 * epoch.cov, alternatives=others, shares=shares)

    return Trajectory(tuple(one(e) for e in trajectory.epochs))


def _notes(project: Project, calibration: Calibration) -> tuple[str, ...]:
    notes = [*(f"calibration: {c}" for c in calibration.causes), *project.notes, *project.image_notes]
    missing = sorted({p.point_id for p in project.survey.points} - set(calibration.beacons.beacon_ids), key=natural_key)
    if missing:
        notes.append(f"beacons without coordinates, left out: {', '.join(missing)}")
    if calibration.helped_by:
        notes.append(
            f"calibration: with epochs that were not asked for ({listed(calibration.helped_by, 5)}), because the "
            "others do not determine the head"
        )
    if calibration.reused:
        notes.append(f"calibration: that of {RESULTS}/{CALIBRATION}; what it came from has not changed")
    return tuple(notes)


def _calibrate(project: Project, station: str, epochs: Sequence[str], there: Path, new: Path) -> Calibration:
    """Head and beacons, from the file ``there`` where it was made from the same survey, options and versions.

    Epochs that could be navigated too, but were not asked for, calibrate only where nothing else does.
    """
    others = others_to_navigate(project, station, epochs)
    try:
        return _calibrated(project, station, epochs, [*epochs, *others], there, new)
    except SurveyError as error:
        if others:
            with contextlib.suppress(SurveyError):
                return replace(_calibrated(project, station, epochs, epochs, there, new), helped_by=tuple(others))
        if not isinstance(error, IndeterminateError):
            raise
        raise SurveyError(
            f"{project.folder}: the head is not calibrated without the epochs to navigate ({listed(epochs, 5)}); "
            f"navigate fewer with --epochs, or calibrate with a target\n({error})"
        ) from error


def _calibrated(
    project: Project, station: str, epochs: Sequence[str], without: Sequence[str], there: Path, new: Path
) -> Calibration:
    """From everything but some epochs of the station, with the lenses of those that are navigated."""
    survey = calibrating(project, station, without)
    taken = lenses_taken(project.survey, survey, station, epochs)
    run = run_info(project, {})
    options = AdjustOptions(project.options.alpha, project.options.reject_blocks, project.options.reject_points)
    key = digest(survey, options, run.versions, station, taken)
    found = kept(there, key)
    if found is not None:
        return found
    with explaining(survey, project):
        adjustment = with_probable_causes(survey, adjust(survey, options=options), project)
    head, beacons = head_and_beacons(adjustment, station, None, taken.epochs, taken.crops)
    said_of = tuple(w for w in adjustment.warnings if w.startswith("probable cause"))
    calibration = Calibration(head, beacons, adjustment.sigma0 if adjustment.redundancy > 0 else None, causes=said_of)
    if not said_of:  # what is wrong is told every time
        keep(new, key, calibration)
    return calibration
