"""Start values of surfaces and beams from positions that are already known."""

from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.survey import SURFACES, BoolArray, FloatArray, Surface, VectorParameter, tilt_axes
from adjust.spatial.rigid import inverse

_FLAT = 1e-6  # singular values below this share of the largest count as none


def fitted_surface(surface: Surface, x: FloatArray, offsets: FloatArray) -> Surface:
    """The surface with reference and start values, from positions (n, 3) m at ``offsets`` (n,) m from it.

    What is given stays. Raises SurveyError where the positions do not determine what is missing.
    """
    names = SURFACES[surface.kind]
    given = surface.parameters or VectorParameter(names, np.full(len(names), np.nan), free=names)
    reference = surface.reference
    if surface.kind != "sphere":
        if reference is None:
            reference = _direction(surface, x, offsets)
        reference = np.asarray(reference, dtype=float) / np.linalg.norm(reference)
    missing = np.isnan(given.values)
    values = np.where(missing, _parameters(surface, x, offsets, reference), given.values) if missing.any() else None
    return replace(
        surface, reference=reference, parameters=given if values is None else replace(given, values=values)
    )


def _direction(surface: Surface, x: FloatArray, offsets: FloatArray) -> FloatArray:
    """Normal of the plane, or direction of the line, nearest to positions (n, 3)."""
    if surface.kind == "plane" and np.any(offsets):
        raise SurveyError(
            f"surface {surface.surface_id!r}: positions lie at an offset from the plane, but on which side is not "
            "known; give its normal"
        )
    needed = 3 if surface.kind == "plane" else 2
    s, Vt = np.linalg.svd(x - x.mean(axis=0))[1:]
    if len(x) < needed or s[needed - 2] <= _FLAT * max(1.0, s[0]):
        raise SurveyError(
            f"surface {surface.surface_id!r}: {len(x)} position(s) do not show how the {surface.kind} lies; "
            f"observe {needed} that are apart{' and not in a row' if needed == 3 else ''}, or give its direction"
        )
    direction = np.asarray(Vt[2] if surface.kind == "plane" else Vt[0])
    return np.asarray(direction * np.sign(direction[np.argmax(np.abs(direction))]))


def _parameters(surface: Surface, x: FloatArray, offsets: FloatArray, reference: FloatArray | None) -> FloatArray:
    if surface.kind == "sphere" or reference is None:
        return _sphere(surface, x, offsets)
    if surface.kind == "plane":
        return np.array([0.0, 0.0, float(np.mean(x @ reference - offsets))])
    return np.array([0.0, 0.0, *np.mean(x @ tilt_axes(reference).T, axis=0)])


def _sphere(surface: Surface, x: FloatArray, offsets: FloatArray) -> FloatArray:
    """Centre and radius: |x|^2 = 2 c.x + (r + o)^2 - |c|^2, linear in c where all offsets are equal or small."""
    middle = x.mean(axis=0)
    y = x - middle
    A = np.hstack([2.0 * y, np.ones((len(y), 1)), 2.0 * offsets[:, None]])
    used = slice(0, 5 if np.ptp(offsets) > 0 else 4)
    solution, _, rank, _ = np.linalg.lstsq(A[:, used], (y**2).sum(axis=1) - offsets**2, rcond=1e-9)
    if rank < A[:, used].shape[1]:
        raise SurveyError(
            f"surface {surface.surface_id!r}: {len(x)} position(s) do not show the centre of the sphere; observe four "
            "that are not in a plane, or give its centre and radius"
        )
    centre = solution[:3]
    radius = float(np.sqrt(max(0.0, solution[3] + centre @ centre)))
    if np.ptp(offsets) == 0:
        radius = float(np.mean(np.linalg.norm(y - centre, axis=1)) - offsets[0])
    return np.array([*(centre + middle), radius])


def fitted_beam(
    values: FloatArray, free: BoolArray, axes: FloatArray, target_from_body: list[Pose3], xy: FloatArray
) -> FloatArray:
    """Parameters (4,) of a beam near spots ``xy`` (n, 2) m in targets; only those that are ``free`` (4,) change."""
    A, b = [], []
    for pose, spot in zip(target_from_body, xy, strict=True):
        in_body = inverse(np.asarray(pose.matrix())) @ np.array([*spot, 0.0, 1.0])
        p1, p2, p3 = axes.T @ in_body[:3]
        A += [[1.0, 0.0, p3, 0.0], [0.0, 1.0, 0.0, p3]]
        b += [p1, p2]
    design = np.array(A)
    step = np.linalg.lstsq(design[:, free], np.array(b) - design @ values, rcond=1e-9)[0]
    out = values.copy()
    out[free] += step
    return out
