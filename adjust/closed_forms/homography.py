"""The plane-to-plane projective map between target and image."""

import numpy as np

from adjust.errors import SurveyError
from adjust.model import FloatArray


def normalisation(xy: FloatArray) -> FloatArray:
    """Similarity (3, 3) that moves points (n, 2) to mean zero and mean distance sqrt(2) (Hartley, PAMI 19(6), 1997)."""
    mean = xy.mean(axis=0)
    size = float(np.mean(np.linalg.norm(xy - mean, axis=1)))
    s = np.sqrt(2.0) / size if size > 0 else 1.0
    return np.array([[s, 0.0, -s * mean[0]], [0.0, s, -s * mean[1]], [0.0, 0.0, 1.0]])


def apply_homography(h: FloatArray, xy: FloatArray) -> FloatArray:
    """Points (n, 2) mapped by h (3, 3)."""
    p = xy @ h[:, :2].T + h[:, 2]
    return np.asarray(p[:, :2] / p[:, 2:])


def homography(xy: FloatArray, uv: FloatArray, refinements: int = 3) -> tuple[FloatArray, float]:
    """``h`` (3, 3) with uv ~ h (x, y, 1) and the rms of its residuals in the unit of uv.

    Source: direct linear transformation on normalised points (Hartley and Zisserman, Multiple View Geometry, alg. 4.2),
    then Gauss-Newton steps on the distance in the image. Raises SurveyError for fewer than four points or for points on
    one line.
    """
    if len(xy) < 4:
        raise SurveyError(f"a homography needs 4 points, got {len(xy)}: show more of the target")
    tx, tu = normalisation(xy), normalisation(uv)
    x, u = apply_homography(tx, xy), apply_homography(tu, uv)
    h = _direct(x, u)
    best = _rms(h, x, u)
    for _ in range(refinements):
        step = _newton_step(h, x, u)
        error = _rms(h + step, x, u)
        if not error < best:
            break
        h, best = h + step, error
    return np.asarray(np.linalg.solve(tu, h @ tx), dtype=float), best / float(tu[0, 0])


def _direct(x: FloatArray, u: FloatArray) -> FloatArray:
    one = np.column_stack([x, np.ones(len(x))])
    zero = np.zeros_like(one)
    a = np.vstack([np.hstack([one, zero, -u[:, :1] * one]), np.hstack([zero, one, -u[:, 1:] * one])])
    values, vectors = np.linalg.eigh(a.T @ a)
    if values[1] < 1e-13 * values[-1]:
        raise SurveyError(
            "the points of a planar target lie on one line: no homography is determined; show more points"
        )
    h = vectors[:, 0].reshape(3, 3)
    return np.asarray(h / np.linalg.norm(h) * (1.0 if np.linalg.det(h) > 0 else -1.0))


def _rms(h: FloatArray, x: FloatArray, u: FloatArray) -> float:
    with np.errstate(all="ignore"):
        return float(np.sqrt(np.mean(np.sum((apply_homography(h, x) - u) ** 2, axis=1))))


def _newton_step(h: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
    one = np.column_stack([x, np.ones(len(x))])
    p = one @ h.T
    w = 1.0 / p[:, 2:]
    v = p[:, :2] * w
    zero = np.zeros_like(one)
    j = np.vstack([np.hstack([one, zero, -v[:, :1] * one]) * w, np.hstack([zero, one, -v[:, 1:] * one]) * w])
    r = np.concatenate([v[:, 0] - u[:, 0], v[:, 1] - u[:, 1]])
    # the scale of h has no effect: one more row holds it
    scale = h.reshape(1, 9)
    return np.asarray(np.linalg.lstsq(np.vstack([j, scale]), -np.append(r, 0.0), rcond=None)[0].reshape(3, 3))
