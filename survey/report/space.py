"""The survey in space, to be turned around on the screen: lines, points and ellipsoids as plain values for the page."""

from typing import Any

import numpy as np
from markupsafe import Markup

from adjust.model import FloatArray
from survey.report import drawing as d
from survey.report.markup import json_script, part
from survey.report.picture import enlargement
from survey.report.scene import Scene, Shot

_MOST_LABELS = 80


def space(scene: Scene, ellipsoid: float) -> Markup:
    """Canvas, slider and data; nothing for an empty scene. ``ellipsoid``: semi-axes of the region, in sigmas."""
    everything = scene.positions()
    if not len(everything):
        return Markup()
    low, high = everything.min(axis=0), everything.max(axis=0)
    reach = max(float(np.linalg.norm(high - low)) / 2.0, 1e-3)
    data = {
        "middle": rounded(0.5 * (low + high)),
        "reach": reach,
        "enlarged": enlargement(scene, ellipsoid, 2.0 * reach),
        "lines": _ground(low, high) + _lines(scene, reach),
        "spots": [_spot(s.x, s.cov, ellipsoid, s.kind) for s in scene.spots],
        "labels": _labels(scene),
    }
    return part("space", of="report.html") + json_script("space-data", data)


def rounded(x: FloatArray) -> Any:
    """Coordinates to a hundredth of a millimetre: enough for a picture."""
    return np.round(x, 5).tolist()


def _spot(x: FloatArray, cov: FloatArray, ellipsoid: float, kind: str) -> dict[str, Any]:
    variances, vectors = np.linalg.eigh(cov)
    axes = (vectors * (ellipsoid * np.sqrt(np.clip(variances, 0.0, None)))).T
    # seven significant digits: enlarged ellipsoids stay round, and equal input gives equal bytes
    shown = [[float(f"{a:.7g}") for a in axis] for axis in axes]
    return {"x": rounded(x), "axes": shown, "colour": d.RED if kind == "point" else d.GREEN}


def _line(x: FloatArray, colour: str, width: float, alpha: float = 1.0) -> dict[str, Any]:
    return {"x": rounded(x), "colour": colour, "width": width, "alpha": alpha}


def _ground(low: FloatArray, high: FloatArray) -> list[dict[str, Any]]:
    step = d.round_below(float((high - low)[:2].max()) / 4.0)
    out = []
    for axis in (0, 1):
        other = 1 - axis
        for at in np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1) * step:
            ends = np.array([low, low])
            ends[:, axis], ends[1, other] = at, high[other]
            out.append(_line(ends, d.GRID, 1.0))
    return out


def _lines(scene: Scene, reach: float) -> list[dict[str, Any]]:
    out = [_line(np.vstack([x, x[:1]]), d.INK, 1.2) for _, x in scene.outlines]
    for i, colour in enumerate((d.X_AXIS, d.Y_AXIS, d.Z_AXIS)):
        out.append(_line(np.array([np.zeros(3), 0.14 * reach * np.eye(3)[i]]), colour, 2.0))
    for _, pose, axes in scene.tables:
        for axis in axes:
            end = 0.12 * reach * np.eye(3)["xyz".index(axis)]
            out.append(_line(pose.transformFrom(np.column_stack([-end, end])).T, d.INK, 1.2))
    for shot in scene.shots:
        colour = d.CAMERA_COLOURS[shot.camera_idx % len(d.CAMERA_COLOURS)]
        out += [_line(x, colour, 1.1 if shot.main else 0.8, 1.0 if shot.main else 0.4) for x in _frustum(shot, reach)]
    cross = 0.006 * reach * np.eye(3)
    for _, cloud in scene.clouds:
        out += [_line(np.array([x - c, x + c]), d.INK, 1.0) for x in cloud for c in cross]
    return out


def _frustum(shot: Shot, reach: float) -> list[FloatArray]:
    depth = 0.15 * reach
    if not shot.main:
        return [shot.pose.transformFrom(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 1.3 * depth)]).T).T]
    tx, ty = np.tan(shot.half_angles)
    rim = depth * np.array([(-tx, -ty, 1.0), (tx, -ty, 1.0), (tx, ty, 1.0), (-tx, ty, 1.0), (-tx, -ty, 1.0)])
    corners = shot.pose.transformFrom(rim.T).T
    eye = np.asarray(shot.pose.translation())
    return [corners, *(np.array([eye, corner]) for corner in corners[:4])]


def _labels(scene: Scene) -> list[dict[str, Any]]:
    out = [(label, x.mean(axis=0), d.INK) for label, x in scene.outlines + scene.clouds if label]
    for shot in scene.shots:
        if shot.main:
            colour = d.CAMERA_COLOURS[shot.camera_idx % len(d.CAMERA_COLOURS)]
            out.append((shot.label, np.asarray(shot.pose.translation()), colour))
    out += [(table_id, np.asarray(pose.translation()), d.INK) for table_id, pose, _ in scene.tables]
    out += [(s.label, s.x, d.RED if s.kind == "point" else d.GREEN) for s in scene.spots if s.label]
    return [{"text": text, "x": rounded(x), "colour": colour} for text, x, colour in out[:_MOST_LABELS]]
