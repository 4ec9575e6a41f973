"""Corners of a flat target freed from what the lens's bending of its edges does to a fit of straight ones.

A straight line fitted to an edge of curvature kappa is displaced along the edge's normal by the mean of the parabola
under it, ``kappa * bend_px2`` (``CornerFit``). The curvature is that of the whole target: a homography keeps lines
straight, so it is the second derivative, along the edge, of what a homography leaves of the corners, taken as a cubic
of the place in the image.
"""

from dataclasses import replace

import cv2
import numpy as np

from adjust.model.survey import BoolArray, FloatArray
from survey.detection.corners import CornerFit

_PER_TERM = 2  # points for each coefficient of the cubic or the square


def unbent(fit: CornerFit, xy: FloatArray, keep: BoolArray) -> CornerFit:
    """The fit with its corners displaced by what the bending did, and the uncertainty of that in ``cov``.

    xy: (n, 2) of the corners in the target's plane, any unit. keep: (n,) corners to learn from. Unchanged where these
    are too few to tell bending from noise (20, or 12 for a constant bending); the fit's ``bent_px`` then covers it.
    """
    seen = _bending(fit.uv[keep], xy[keep])
    if seen is None:
        return replace(fit, cov=fit.cov + fit.bent_px**2 * np.eye(2))
    centre, scale, coefficients, unit_cov, variance = seen
    p = (fit.uv - centre) / scale
    normals = np.stack([-np.sin(fit.angles), np.cos(fit.angles)], axis=2)  # (n, edge, 2)
    rows = np.stack([_second_derivatives(p, angle, len(coefficients)) for angle in fit.angles.T], axis=1) / scale**2
    curvature = np.einsum("nek,kc,nec->ne", rows, coefficients, normals)
    # both edges are displaced along their normals: the corner goes where they meet
    back = np.linalg.inv(normals)
    weighted = back * fit.bend_px2[:, None, :]
    shift = np.einsum("nce,ne->nc", weighted, curvature)
    shared = np.einsum("nek,kl,nfl->nef", rows, unit_cov, rows) * np.einsum("nec,nfc->nef", normals, normals)
    cov = variance * np.einsum("nce,nef,ndf->ncd", weighted, shared, weighted)
    return replace(fit, uv=fit.uv - shift, cov=fit.cov + cov)


def _bending(uv: FloatArray, xy: FloatArray) -> tuple[FloatArray, float, FloatArray, FloatArray, float] | None:
    """Centre, scale, coefficients (k, 2) px of a polynomial of the place, their cofactors (k, k) and variance px^2."""
    if len(uv) < 4:
        return None
    centre, scale = uv.mean(0), float(np.abs(uv - uv.mean(0)).max())
    H, _ = cv2.findHomography(xy, uv, 0)
    if H is None:
        return None
    flat = np.column_stack([xy, np.ones(len(xy))]) @ np.asarray(H, float).T
    left = uv - flat[:, :2] / flat[:, 2:]
    for n_terms in (10, 6):
        A = _monomials((uv - centre) / scale)[:, :n_terms]
        if len(uv) < _PER_TERM * n_terms or np.linalg.cond(A) > 1e3:
            continue
        unit_cov = np.linalg.inv(A.T @ A)
        coefficients = unit_cov @ A.T @ left
        variance = float(((left - A @ coefficients) ** 2).sum() / (2 * (len(uv) - n_terms)))
        return np.asarray(centre), scale, np.asarray(coefficients), np.asarray(unit_cov, float), variance
    return None


def _monomials(p: FloatArray) -> FloatArray:
    """1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3 at places (n, 2): (n, 10)."""
    x, y = p.T
    return np.stack([x**0, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)


def _second_derivatives(p: FloatArray, angle: FloatArray, n_terms: int) -> FloatArray:
    """Those of the monomials at places (n, 2) in a direction (n,) rad, (n, n_terms)."""
    x, y = p.T
    c, s = np.cos(angle), np.sin(angle)
    zero = 0.0 * x
    by_xx, by_xy, by_yy = c * c, 2.0 * c * s, s * s
    columns = [zero, zero, zero, 2.0 * by_xx, by_xy, 2.0 * by_yy, 6.0 * x * by_xx]
    columns += [2.0 * y * by_xx + 2.0 * x * by_xy, 2.0 * x * by_yy + 2.0 * y * by_xy, 6.0 * y * by_yy]
    return np.stack(columns[:n_terms], axis=1)
