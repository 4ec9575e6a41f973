"""Focal lengths and principal point from homographies of a plane."""


import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray

_CONDITION = 2e-3  # smallest against largest useful singular value at which a parameter still counts as determined


@frozen(eq=False)
class PinholeStart:
    """fx, fy, u0, v0 in pixels; ``variant`` says what was assumed: full, centred or square (centred, fx = fy)."""

    values: FloatArray
    variant: str


def pinhole_from_homographies(
    homographies: FloatArray, image_size: tuple[int, int], variants: tuple[str, ...] = ("full", "centred", "square")
) -> PinholeStart:
    """fx, fy, u0, v0 from homographies (m, 3, 3) of planes, without skew; the richest variant the images determine.

    Source: Zhang, PAMI 22(11), 2000, eq. 3-9: h1' B h2 = 0, h1' B h1 = h2' B h2 with B = K^-T K^-1, in pixels shifted
    to the image centre and scaled. Homographies should come from targets scaled to unit size. OpenCV's
    initCameraMatrix2D holds the principal point in the middle: from views turned about one axis that starts far off.
    Raises SurveyError where not even the focal length is determined (all planes parallel to the image).
    """
    width, height = image_size
    centre, scale = np.array([(width - 1) / 2.0, (height - 1) / 2.0]), max(width, height) / 2.0
    to_unit = np.array([[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1]])
    rows = _constraints(to_unit @ homographies)
    for variant in variants:
        if variant == "full" and len(homographies) < 3:
            continue
        values = _solve(rows, variant)
        if values is not None and _plausible(values, image_size, scale):
            return PinholeStart(np.append(values[:2] * scale, centre + values[2:] * scale), variant)
    raise SurveyError(
        f"{len(homographies)} image(s) of planar targets do not determine a focal length: the planes are parallel to"
        " the image or the points mis-ordered; tilt the target by 30 degrees or more, or give the lens a start"
    )


def _constraints(h: FloatArray) -> FloatArray:
    """Two rows for each of h (m, 3, 3) in (B11, B22, B13, B23, B33), each of unit scale."""
    a, b = (h[:, :, i] / np.sqrt(np.linalg.norm(h[:, :, 0], axis=1) * np.linalg.norm(h[:, :, 1], axis=1))[:, None]
            for i in (0, 1))  # fmt: skip

    def v(a: FloatArray, b: FloatArray) -> FloatArray:
        a0, a1, a2, b0, b1, b2 = *a.T, *b.T
        return np.column_stack([a0 * b0, a1 * b1, a2 * b0 + a0 * b2, a2 * b1 + a1 * b2, a2 * b2])

    return np.concatenate([v(a, b), v(a, a) - v(b, b)])


def _solve(rows: FloatArray, variant: str) -> FloatArray | None:
    """(fx, fy, u0, v0) in scaled pixels, or None where the rows do not determine them."""
    square = np.stack([rows[:, 0] + rows[:, 1], rows[:, 4]], axis=1)
    m = {"full": rows, "centred": rows[:, [0, 1, 4]], "square": square}[variant]
    norms = np.linalg.norm(m, axis=0)
    if np.any(norms < 1e-9):
        return None
    _, s, vt = np.linalg.svd(m / norms, full_matrices=len(m) < m.shape[1])
    if len(s) < m.shape[1] - 1 or s[m.shape[1] - 2] < _CONDITION * s[0]:
        return None
    b = vt[-1] / norms
    b = b if b[0] > 0 else -b
    if variant == "square":
        f2 = b[1] / b[0]
        return np.array([np.sqrt(f2), np.sqrt(f2), 0.0, 0.0]) if f2 > 0 else None
    b11, b22 = b[0], b[1]
    b13, b23, b33 = (b[2], b[3], b[4]) if variant == "full" else (0.0, 0.0, b[2])
    if b22 <= 0:
        return None
    level = b33 - b13**2 / b11 - b23**2 / b22
    if level <= 0:
        return None
    return np.array([np.sqrt(level / b11), np.sqrt(level / b22), -b13 / b11, -b23 / b22])


def _plausible(values: FloatArray, image_size: tuple[int, int], scale: float) -> bool:
    """Focal lengths from a tenth to fifty half-images, pixels within 1:2, the principal point inside the image."""
    fx, fy, u0, v0 = values
    inside = abs(u0) < 0.5 * image_size[0] / scale and abs(v0) < 0.5 * image_size[1] / scale
    return bool(0.1 < fx < 50 and 0.1 < fy < 50 and 0.5 < fx / fy < 2.0 and inside)
