"""A trajectory as files: ``trajectory.csv`` for people and spreadsheets, ``trajectory.json`` with everything."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.navigation import EpochPose, NavigationEpoch, Trajectory
from survey.folder.plain import plain
from survey.folder.text import json_text
from survey.project import atomic_write
from survey.project.tables.files import write_table
from survey.solution.quantities import ARCSEC_PER_RAD, pose_dict

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


def write_trajectory(
    trajectory: Trajectory, observed: Sequence[NavigationEpoch], summary: Mapping[str, Any], folder: Path
) -> dict[str, Path]:
    """Write both files into a folder; the paths by file name. summary: goes into the JSON as it is."""
    epochs = trajectory.epochs
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
    content = {"summary": dict(summary), "epochs": {e.epoch_id: _entry(e) for e in epochs}}
    atomic_write(path, json_text(content))
    return paths


def _entry(epoch: EpochPose) -> dict[str, Any]:
    """One epoch: pose, covariance (rad, m; tangent in the head; None where open), its sources, and other solutions."""
    entry: dict[str, Any] = {"status": epoch.status, "bridge": epoch.bridge, "labels": [list(x) for x in epoch.labels]}
    if isinstance(epoch.world_from_station, Pose3):
        entry |= {"world_from_station": pose_dict(epoch.world_from_station), "covariance": plain(epoch.cov)}
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
