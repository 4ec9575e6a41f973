"""What is known of one camera: where in its images it observed, residuals, distortion, uncertainty, differences."""

from typing import Any

import numpy as np
from gtsam import Rot3

from adjust.lenses.compared import (
    GRID,
    Optics,
    compared_pixels,
    lens_difference,
    optics_of,
    projection_covariance,
    worst_sigma,
)
from adjust.lenses.models import principal_point_px
from adjust.model.arrays import FloatArray
from adjust.model.errors import SurveyError
from adjust.model.result import ParameterName
from adjust.model.survey import Camera
from survey.folder.plain import plain
from survey.folder.text import suggestion
from survey.solution.earlier.changes import Snapshot
from survey.solution.earlier.runs import load_run
from survey.workbench.resident import Resident


def camera_of(bench: Resident, camera_id: str) -> Camera:
    """A camera by its name. Raises SurveyError."""
    cameras = bench.adjustment.survey.cameras_by_id
    if camera_id not in cameras:
        raise SurveyError(f"there is no camera {camera_id!r} in the solution; {suggestion(camera_id, cameras)}")
    return cameras[camera_id]


def camera_view(bench: Resident, camera_id: str, distance: float = np.inf) -> dict[str, Any]:
    """Residual field, coverage, distortion and uncertainty of a camera; distance: m, of the point that is seen.

    cells: over the image, in rows: number of points in use, mean residual (px), rms (px). distortion: pixels without
    and with it. uncertainty: sigma px in the worst direction, of a point fixed to the body that carries the camera
    (``station``; None where the camera's pose on it is not estimated beside its lens) and of the lens by itself with
    the motion of the camera taken out (``camera``), sigmas as the solution gives them; nan beyond what the distortion
    allows. covered: whether a cell beside has points. Raises SurveyError.
    """
    camera = camera_of(bench, camera_id)
    lens, (width, height) = optics_of(camera, bench.adjustment.estimates), camera.image_size
    rows = max(2, round(GRID * height / width))
    points, residuals = _in_use(bench, camera_id)
    column = np.clip((points[:, 0] + 0.5) / width * GRID, 0, GRID - 1).astype(int)
    row = np.clip((points[:, 1] + 0.5) / height * rows, 0, rows - 1).astype(int)
    cell = row * GRID + column
    n = np.bincount(cell, minlength=rows * GRID)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.stack([np.bincount(cell, residuals[:, k], rows * GRID) / n for k in range(2)], axis=1)
        rms = np.sqrt(np.bincount(cell, (residuals**2).sum(axis=1), rows * GRID) / (2 * n))
    uv, near = compared_pixels([lens], camera.image_size, points)
    return dict(plain({
        "version": bench.version, "camera": camera_id, "size": camera.image_size, "model": lens.model.name,
        "distance_m": None if np.isinf(distance) else distance,
        "principal_point": principal_point_px(lens.model, lens.values, lens.constants),
        "cells": {"columns": GRID, "rows": rows, "n": n, "mean": mean, "rms": rms},
        "distortion": {"uv": uv, "without": _undistorted(lens, uv)},
        "uncertainty": {"uv": uv, **_uncertainty(bench, camera, lens, uv, distance), "covered": near},
    }))  # fmt: skip


def _in_use(bench: Resident, camera_id: str) -> tuple[FloatArray, FloatArray]:
    rows = bench.rows
    blocks = [(i, b) for i, b in enumerate(rows.survey.image_blocks) if b.camera_id == camera_id]
    parts = [(b.uv[u], rows.residuals[rows.ptr[i] : rows.ptr[i + 1]][u]) for i, b in blocks
             for u in (rows.used[rows.ptr[i] : rows.ptr[i + 1]],)]  # fmt: skip
    empty = np.zeros((0, 2))
    return np.concatenate([*(p for p, _ in parts), empty]), np.concatenate([*(r for _, r in parts), empty])


def _undistorted(lens: Optics, uv: FloatArray) -> FloatArray:
    """Where the same rays would be seen without distortion: by the principal point and focal lengths alone."""
    away = lens.points(uv, np.inf)
    centre = principal_point_px(lens.model, lens.values, lens.constants)
    if "fx" in lens.model.names:
        focal = np.array([lens.values[lens.model.names.index(k)] for k in ("fx", "fy")])
    else:
        focal = np.full(2, lens.values[0] / lens.constants[0])
    if lens.model.name == "fisheye":  # equidistant: its radius is the angle
        angle = np.arctan2(np.hypot(away[:, 0], away[:, 1]), away[:, 2])
        length = np.hypot(away[:, 0], away[:, 1])
        scale = np.divide(angle, length, out=np.ones_like(angle), where=length > 0)
        return centre + focal * away[:, :2] * scale[:, None]
    return np.asarray(centre + focal * away[:, :2] / away[:, 2:])


def _uncertainty(bench: Resident, camera: Camera, lens: Optics, uv: FloatArray, distance: float) -> dict[str, Any]:
    names: list[ParameterName] = [("lens", camera.camera_id), ("station_from_camera", camera.camera_id)]
    estimates, factor = bench.adjustment.estimates, bench.scale.factor
    free = np.array([s in ("free", "prior") for s in estimates[names[0]].status])
    lens_cov = estimates[names[0]].cov
    alone = worst_sigma(factor**2 * projection_covariance(lens, uv, distance, lens_cov))
    mount = estimates.get(names[1])
    station = None
    if mount is not None and mount.cov.any() and free.any() and "tied" not in estimates[names[0]].status:
        joint = np.zeros((len(free) + 6,) * 2)
        at = np.concatenate([np.flatnonzero(free), len(free) + np.arange(6)])
        joint[np.ix_(at, at)] = bench.adjustment.precision.joint(names)
        station = worst_sigma(factor**2 * projection_covariance(lens, uv, distance, joint))
    return {"camera": alone, "station": station}


def lens_change(
    bench: Resident, camera_id: str, before: int | None = None, other: str = "", distance: float = np.inf
) -> dict[str, Any]:
    """The lens of a camera against that of a run (``before``), or of another camera of the same image size.

    Each pixel's shift (px) from that one to this one, with the motion of the camera frame fitted over the pixels where
    points were observed; the angle (deg) and length (mm) of that motion beside it. Raises SurveyError.
    """
    camera = camera_of(bench, camera_id)
    now = optics_of(camera, bench.adjustment.estimates)
    if other:
        against = camera_of(bench, other)
        if against.image_size != camera.image_size:
            raise SurveyError(f"cameras {camera_id} and {other} have images of different sizes")
        then = optics_of(against, bench.adjustment.estimates)
    elif before is not None:
        kept: Snapshot = load_run(bench.folder, before)
        then = optics_of(camera, kept.estimates)
    else:
        raise SurveyError("name the run or the other camera that the lens is to be compared with")
    uv, near = compared_pixels([now, then], camera.image_size, _in_use(bench, camera_id)[0])
    found = lens_difference(then, now, uv, distance, near if near.sum() >= 6 else None)
    rotation = float(np.linalg.norm(Rot3.Logmap(found.second_from_first.rotation())))
    return dict(plain({
        "version": bench.version, "camera": camera_id, "uv": uv, "shift": found.shift, "covered": found.fitted,
        "distance_m": None if np.isinf(distance) else distance, "rotation_deg": np.degrees(rotation),
        "translation_mm": 1e3 * float(np.linalg.norm(found.second_from_first.translation())),
        "rms_px": float(np.sqrt((found.shift[found.fitted] ** 2).sum(axis=1).mean())),
    }))  # fmt: skip
