"""The job behind ``labsurvey navigate``: calibrate from everything else, then a pose for every navigation epoch."""

import csv
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3
from tqdm import tqdm

from adjust.adjustment import AdjustOptions, adjust
from adjust.errors import IndeterminateError, SurveyError
from adjust.model import Survey
from adjust.navigation import (
    EpochPose,
    Motion,
    NavigateOptions,
    NavigationEpoch,
    Spots,
    Trajectory,
    head_and_beacons,
    navigate,
)
from adjust.result import Adjustment
from survey.files import Project, atomic_write, read
from survey.files.table_writing import write_table
from survey.files.text import natural_key
from survey.parts import only_between, points_read
from survey.quantities import ARCSEC_PER_RAD, pose_dict

RESULTS = "results"
STATUSES = ("fixed", "bridged", "ambiguous", "undetermined", "none")


@dataclass(frozen=True)
class NavigateRequest:
    """What is navigated.

    station: None for the only one with cameras, or the one a table carries. epochs: None for all in which its cameras
    show beacons and no target. interval_s: time between epochs. times: instead, a table with columns epoch_id and
    time_s; epochs then come in the order of time. Without either motion is not used. unnamed: forget the names that
    spots have.
    """

    station: str | None = None
    epochs: tuple[str, ...] | None = None
    interval_s: float | None = None
    use_table: bool = True
    unnamed: bool = False
    times: Path | None = None


@dataclass(frozen=True, eq=False)
class NavigateOutcome:
    """A navigated project: trajectory, what it was calibrated with, and the files written."""

    folder: Path
    station: str
    calibration: Adjustment
    trajectory: Trajectory
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    paths: dict[str, Path] = field(default_factory=dict)

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
            "calibration_sigma0": self.calibration.sigma0 if self.calibration.redundancy > 0 else None,
            "notes": list(self.notes),
            "written": {name: str(path) for name, path in self.paths.items()},
        }

    def text(self) -> str:
        """The counts, the precision, and every epoch without a certain pose, for people."""
        s = self.summary()
        lines = [f"{self.folder}: {s['epochs']} poses of {self.station}"]
        lines.append("  " + ", ".join(f"{s[status]} {status}" for status in STATUSES if s[status]))
        if s["median_sigma_rotation_arcsec"] is not None:
            turn = "  ".join(f"{v:.0f}" for v in s["median_sigma_rotation_arcsec"])
            shift = "  ".join(f"{v:.3f}" for v in s["median_sigma_translation_mm"])
            lines.append(f"  median sigmas along the head's axes: {turn} arcsec,  {shift} mm")
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
    request: NavigateRequest = NavigateRequest(),
    *,
    out: Path | None = None,
    progress: bool = True,
) -> NavigateOutcome:
    """Navigate a project and write ``results/trajectory.csv`` and ``.json``. Raises SurveyError.

    The calibration is adjusted from the epochs that are not navigated, so that no spot is used twice, and its joint
    covariance of cameras, table and beacons goes into every pose.
    """
    begin = time.perf_counter()
    project = read(Path(folder))
    station = request.station or _station(project)
    epochs = _epochs(project, station, request)
    times = _times(epochs, request)
    calibration = _calibrate(project, station, epochs)
    calibrated = time.perf_counter()
    head, beacons = head_and_beacons(calibration, station)
    named = set(beacons.beacon_ids)
    missing = sorted({p.point_id for p in project.survey.points} - named, key=natural_key)
    notes = (f"beacons without coordinates, left out: {', '.join(missing)}",) if missing else ()
    order = range(len(epochs)) if times is None else sorted(range(len(epochs)), key=times.__getitem__)
    observed = [
        _observed(project, station, epochs[i], None if times is None else times[i], request, named) for i in order
    ]
    motion = Motion() if times is not None else None
    options = NavigateOptions(motion=motion, use_table=request.use_table, alpha=min(project.options.alpha, 1e-3))
    with tqdm(total=len(epochs), desc="navigating", unit="epoch", disable=not progress, file=sys.stderr) as bar:
        trajectory = navigate(head, beacons, observed, options, lambda _done, _all: bar.update() and None)
    seconds = {"calibrate": calibrated - begin, "navigate": time.perf_counter() - calibrated}
    outcome = NavigateOutcome(Path(folder), station, calibration, trajectory, notes, seconds)
    return replace(outcome, paths=_write(outcome, observed, (out or Path(folder)) / RESULTS))


def _station(project: Project) -> str:
    survey = project.survey
    carrying = list(dict.fromkeys(c.station_id for c in survey.cameras))
    turned = [s.station_id for s in survey.stations if s.station_id in carrying and s.motion == "table"]
    for choice in (turned, carrying):
        if len(choice) == 1:
            return choice[0]
    raise SurveyError(
        f"{project.folder}/survey.toml: {len(carrying)} stations carry cameras ({', '.join(carrying)}); say which one "
        "is to be navigated with --station"
    )


def _epochs(project: Project, station: str, request: NavigateRequest) -> list[str]:
    """Epochs to navigate, in natural order."""
    own = {c.camera_id for c in project.survey.cameras if c.station_id == station}
    if not own:
        raise SurveyError(f"{project.folder}/survey.toml: no camera is on station {station!r}")
    blocks = [b for b in project.survey.image_blocks if b.camera_id in own]
    lit = {s.epoch_id for s in project.spots if s.camera_id in own}
    lit |= {b.epoch_id for b in blocks if b.target_id is None}
    if request.epochs is not None:
        unknown = [e for e in request.epochs if e not in lit]
        if unknown:
            raise SurveyError(f"{project.folder}: no beacon was observed at epoch {', '.join(unknown)} from {station}")
        return list(request.epochs)
    found = sorted(lit - {b.epoch_id for b in blocks if b.target_id is not None}, key=natural_key)
    if not found:
        raise SurveyError(
            f"{project.folder}/observations: no epoch to navigate: none shows beacons to station {station} without a "
            "target; name epochs with --epochs, or detect spots first"
        )
    return found


def _times(epochs: Sequence[str], request: NavigateRequest) -> list[float] | None:
    """Time (s) of every epoch, None where nothing tells."""
    if request.times is None:
        step = request.interval_s
        return None if step is None else [i * step for i in range(len(epochs))]
    if request.interval_s is not None:
        raise SurveyError("give either the interval between epochs or a table of their times, not both")
    try:
        rows = list(csv.DictReader(request.times.read_text().splitlines()))
    except (OSError, UnicodeDecodeError) as error:
        raise SurveyError(f"{request.times}: cannot be read as a table of epoch_id and time_s ({error})") from error
    if not rows or not {"epoch_id", "time_s"} <= set(rows[0]):
        raise SurveyError(f"{request.times}:1: the columns epoch_id and time_s are needed")
    found: dict[str, float] = {}
    for line, row in enumerate(rows, 2):
        try:
            value = float(row["time_s"])
        except (TypeError, ValueError):
            value = float("nan")
        if not np.isfinite(value) or row["epoch_id"] in found:
            problem = "is there twice" if row["epoch_id"] in found else f"has the time {row['time_s']!r}, give seconds"
            raise SurveyError(f"{request.times}:{line}: epoch {row['epoch_id']!r} {problem}")
        found[row["epoch_id"]] = value
    missing = [e for e in epochs if e not in found]
    if missing:
        raise SurveyError(f"{request.times}: no time for epoch {', '.join(missing[:5])}; add it, or leave it out")
    times = [found[e] for e in epochs]
    if len(set(times)) < len(times):
        raise SurveyError(f"{request.times}: two of the epochs to navigate have the same time; times must differ")
    return times


def _calibrate(project: Project, station: str, epochs: Sequence[str]) -> Adjustment:
    """Adjust what the navigated epochs have no part in."""
    survey, out = project.survey, set(epochs)
    own = {c.camera_id for c in survey.cameras if c.station_id == station}
    blocks = tuple(b for b in survey.image_blocks if not (b.camera_id in own and b.epoch_id in out))
    carried = next(s for s in survey.stations if s.station_id == station).table_id
    readings = tuple(r for r in survey.table_readings if not (r.table_id == carried and r.epoch_id in out))
    kept = _with_known_points(replace(survey, image_blocks=blocks, table_readings=readings))
    options = AdjustOptions(project.options.alpha, project.options.reject_blocks, project.options.reject_points)
    try:
        return adjust(kept, options=options)
    except IndeterminateError as error:
        raise SurveyError(
            f"{project.folder}: the head is not calibrated without the epochs to navigate ({', '.join(epochs[:5])}"
            f"{', ...' if len(epochs) > 5 else ''}); navigate fewer with --epochs, or calibrate with a target"
            f"\n({error})"
        ) from error


def _with_known_points(survey: Survey) -> Survey:
    """Without the points that the remaining observations do not determine: seen by fewer than two images, or given."""
    seen: dict[int, set[tuple[str, str]]] = {}
    for b in survey.image_blocks:
        if b.target_id is None:
            for i in b.point_idx.tolist():
                seen.setdefault(i, set()).add((b.camera_id, b.epoch_id))
    given = {r.point_id for c in survey.coordinates if c.used for r in c.positions if r.frame is None}
    given |= points_read(survey)
    keep = [
        i for i, p in enumerate(survey.points)
        if len(seen.get(i, ())) >= 2 or p.point_id in given or p.x_in_world.treatment != "free"
    ]  # fmt: skip
    new = {old: k for k, old in enumerate(keep)}
    ids = {survey.points[i].point_id for i in keep}
    blocks = []
    for b in survey.image_blocks:
        if b.target_id is not None:
            blocks.append(b)
            continue
        rows = np.isin(b.point_idx, keep)
        if rows.any():
            used = None if b.used is None else b.used[rows]
            index = np.array([new[int(i)] for i in b.point_idx[rows]], dtype=np.int64)
            blocks.append(replace(b, point_idx=index, uv=b.uv[rows], cov=b.cov[rows], used=used))
    less = only_between(survey, lambda ref: ref.frame is not None or ref.point_id in ids)
    return replace(less, points=tuple(survey.points[i] for i in keep), image_blocks=tuple(blocks))


def _observed(
    project: Project, station: str, epoch_id: str, time_s: float | None, request: NavigateRequest, named: set[str]
) -> NavigationEpoch:
    """One epoch's spots, named or not, and its table reading."""
    survey = project.survey
    own = [c.camera_id for c in survey.cameras if c.station_id == station]
    spots = [Spots(s.camera_id, s.uv, s.cov) for s in project.spots if s.camera_id in own and s.epoch_id == epoch_id]
    for b in survey.image_blocks:
        if b.target_id is None and b.camera_id in own and b.epoch_id == epoch_id:
            ids = [survey.points[int(i)].point_id for i in b.point_idx]
            if request.unnamed:
                spots.append(Spots(b.camera_id, b.uv, b.cov))
                continue
            rows = [i for i, p in enumerate(ids) if p in named]
            spots.append(Spots(b.camera_id, b.uv[rows], b.cov[rows], tuple(ids[i] for i in rows)))
    carried = next(s for s in survey.stations if s.station_id == station).table_id
    reading = next((r for r in survey.table_readings if (r.table_id, r.epoch_id) == (carried, epoch_id)), None)
    if reading is None:
        return NavigationEpoch(epoch_id, tuple(spots), time_s)
    return NavigationEpoch(epoch_id, tuple(spots), time_s, reading.angles, reading.cov)


_POSE_COLUMNS = (
    *("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "euler_x_deg", "euler_y_deg", "euler_z_deg"),
    *("sigma_x_mm", "sigma_y_mm", "sigma_z_mm", "sigma_rx_arcsec", "sigma_ry_arcsec", "sigma_rz_arcsec"),
)


def _pose_row(epoch: EpochPose) -> list[float]:
    """Pose and sigmas for people: of the place along the world's axes, of the turn about the head's."""
    pose = epoch.world_from_station
    if pose is None:
        return [float("nan")] * len(_POSE_COLUMNS)
    values = pose_dict(pose)
    R = pose.rotation().matrix()
    open_shift = not np.isfinite(np.diag(epoch.cov)[3:]).all()
    place = np.full(3, np.inf) if open_shift else np.sqrt(np.diag(R @ epoch.cov[3:, 3:] @ R.T))
    return [
        *values["translation_mm"], *values["rotation_quaternion_wxyz"], *values["rotation_euler_xyz_deg"],
        *(1e3 * place), *(ARCSEC_PER_RAD * epoch.sigmas[:3]),
    ]  # fmt: skip


def _labels_text(epoch: EpochPose, observed: NavigationEpoch) -> str:
    parts = []
    for spots, labels in zip(observed.spots, epoch.labels, strict=True):
        parts.append(f"{spots.camera_id}: " + " ".join(label or "-" for label in labels))
    return "; ".join(parts)


def _write(outcome: NavigateOutcome, observed: Sequence[NavigationEpoch], folder: Path) -> dict[str, Path]:
    epochs = outcome.trajectory.epochs
    rows = np.array([_pose_row(e) for e in epochs])
    table = {
        "epoch_id": [e.epoch_id for e in epochs],
        "status": [e.status for e in epochs],
        "bridge": [e.bridge for e in epochs],
        "n_beacons": [str(e.n_beacons) for e in epochs],
        **dict(zip(_POSE_COLUMNS, rows.T, strict=True)),
        "chi_square": np.array([e.chi_square for e in epochs]),
        "redundancy": [str(e.redundancy) for e in epochs],
        "probability": np.array([e.probability for e in epochs]),
        "labels": [_labels_text(e, o) for e, o in zip(epochs, observed, strict=True)],
        "remarks": ["; ".join(e.undetermined) for e in epochs],
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "trajectory.json"
    paths = {"trajectory.csv": write_table(folder, "trajectory", table), "trajectory.json": path}
    summary = {k: v for k, v in outcome.summary().items() if k not in ("written", "folder")}
    content = {"summary": summary, "epochs": {e.epoch_id: _entry(e) for e in epochs}}
    atomic_write(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
    return paths


def _finite(matrix: Any) -> Any:
    return [[float(v) if np.isfinite(v) else None for v in row] for row in matrix]


def _entry(epoch: EpochPose) -> dict[str, Any]:
    """One epoch: pose, covariance (rad, m; tangent in the head; None where open), its sources, and other solutions."""
    entry: dict[str, Any] = {"status": epoch.status, "bridge": epoch.bridge, "labels": [list(x) for x in epoch.labels]}
    if isinstance(epoch.world_from_station, Pose3):
        entry |= {"world_from_station": pose_dict(epoch.world_from_station), "covariance": _finite(epoch.cov)}
    if epoch.shares is not None:
        shares = epoch.shares
        parts = {"spots": shares.spots, "beacons": shares.beacons, "calibration": shares.calibration,
                 "prior": shares.prior}  # fmt: skip
        entry["sigmas_by_source_rad_m"] = {k: np.sqrt(np.maximum(np.diag(v), 0.0)).tolist() for k, v in parts.items()}
    entry["rejected"] = [list(r) for r in epoch.rejected]
    entry["undetermined"] = list(epoch.undetermined)
    entry["alternatives"] = [
        {"world_from_station": pose_dict(s.world_from_station), "probability": s.probability, "score": s.score,
         "labels": [list(x) for x in s.labels]}
        for s in epoch.alternatives
    ]  # fmt: skip
    return entry
