"""Lens models in the core: their numbers, and points of one camera at once.

Every model has a number (its kind), a parameter vector in a fixed order and a vector of constants ``[pixel_size_mm,
centre_u, centre_v, r0_mm]`` of which it uses what it needs; ``adjust.lenses.models`` names them all. The formulas,
each written once for values and derivatives, are in ``lenses.h``. A point on or behind the camera's plane gives
finite numbers without meaning; the caller tests the depth. The fisheye alone sees behind that plane, and means it.
The fit of a lens together with the poses of what its camera sees is in ``calibration.h``.
"""

from typing import NamedTuple

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.blocks import run_ranges
from adjust.native.library import Function

BROWN = 0
FISHEYE = 1
BROWN_BACKWARD = 2
BROWN_BACKWARD_DBAT = 3
AICON = 4

N_LENS = (13, 9, 10, 9, 10)
MAX_LENS = 14
N_COLUMNS = MAX_LENS + 3

_lens_rows = Function("lens_rows", "kind lens[*] constants[4] q[n,3] uv[n,2] residuals[n,2] rows[*,2,17]")
_LENS = "first last kind lens[*] constants[4]"
_rays_of = Function("rays_of", f"{_LENS} uv[n,2] start[*,2] iterations small widest rays[n,3] solved[n]")
_image_points_of = Function("image_points_of", f"{_LENS} q[n,3] iterations small focal uv[n,2] solved[n]")
_radii_of = Function("radii_of", "first last numerator[*] denominator[*] limit target[n] radii[n] found[n]")
_fit_lens = Function(
    "fit_lens",
    "kind values[n] constants[4] directions[n,p] ptr[B+1] x[N,3] uv[N,2] iterations poses[B,4,4] squares[N] cov[p,p] "
    "work[*]",
)
class Lens(NamedTuple):
    """A lens as the core takes it: number of its model, parameters (n,), constants (4,)."""

    kind: int
    values: FloatArray
    constants: FloatArray


class Newton(NamedTuple):
    """How rays and image points are found: steps at most, and the relative size of the last one."""

    iterations: int
    small: float


_NO_ROWS, _NO_START = np.zeros((0, 2, N_COLUMNS)), np.zeros((0, 2))


def lens_rows(
    kind: int, lens: FloatArray, constants: FloatArray, q: FloatArray, uv: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, 2) px, predicted minus observed, of points q (n, 3) m in the camera seen at uv (n, 2) px.

    And their derivatives (n, 2, 17): columns 0 .. N_LENS[kind] - 1 by the parameters, 14 .. 16 by q (px/m), else zero.
    """
    _check(kind, lens)
    residuals, rows = np.empty((len(q), 2)), np.empty((len(q), 2, N_COLUMNS))
    if len(q):
        _lens_rows(kind, lens, constants, q, uv, residuals, rows)
    return residuals, rows


def lens_residuals(kind: int, lens: FloatArray, constants: FloatArray, q: FloatArray, uv: FloatArray) -> FloatArray:
    """The residuals (n, 2) px of :func:`lens_rows` alone."""
    _check(kind, lens)
    residuals = np.empty((len(q), 2))
    _lens_rows(kind, lens, constants, q, uv, residuals, _NO_ROWS)
    return residuals


def _check(kind: int, lens: FloatArray) -> None:
    if not 0 <= kind < len(N_LENS):
        raise ValueError(f"no lens model has the number {kind}")
    if len(lens) < N_LENS[kind]:
        raise ValueError(f"lens model {kind} has {N_LENS[kind]} parameters, {len(lens)} were given")


def rays_of(
    lens: Lens, uv: FloatArray, newton: Newton, widest: float, start: FloatArray | None = None,
    out: FloatArray | None = None,
) -> tuple[FloatArray, BoolArray]:  # fmt: skip
    """Unit rays (n, 3) of image points (n, 2) px, by Newton from tangents x/z, y/z (n, 2) or from the axis.

    And which (n,) were found, where the lens does not turn the image over, their tangent to the axis at most
    ``widest``. out: where the rays go.
    """
    _check(lens.kind, lens.values)
    rays, solved = np.empty((len(uv), 3)) if out is None else out, np.empty(len(uv), dtype=np.bool_)
    run_ranges(_rays_of, len(uv), *lens, uv, _NO_START if start is None else start, *newton, widest, rays, solved)
    return rays, solved


def image_points_of(
    lens: Lens, q: FloatArray, newton: Newton, focal_px: float, start: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Image points (n, 2) px of points q (n, 3) m in the camera, by Newton from those given, and which were found."""
    _check(lens.kind, lens.values)
    uv, solved = start.copy(), np.empty(len(q), dtype=np.bool_)
    run_ranges(_image_points_of, len(q), *lens, q, *newton, focal_px, uv, solved)
    return uv, solved


def radii_of(
    numerator: FloatArray, denominator: FloatArray, limit: float, target: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Radii r (n,) with r N(r^2) / D(r^2) = target, a function that grows from 0 to ``limit``, and which were found."""
    radii, found = np.empty(len(target)), np.empty(len(target), dtype=np.bool_)
    run_ranges(_radii_of, len(target), numerator, denominator, limit, target, radii, found)
    return radii, found


def fit_lens(
    lens: Lens, directions: FloatArray, ptr: IntArray, x: FloatArray, uv: FloatArray, iterations: int, poses: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Least squares over ``lens.values + directions @ p`` and the poses camera_from_target (B, 4, 4), both in place.

    directions: (n, p), what of the lens may move. x: (N, 3) m, uv: (N, 2) px, view after view by ``ptr`` (B + 1,).
    Huber weights at three times the median. Returns the squares (N,) px^2 of what is left, and the covariance (p, p) of
    the free components for residuals of variance one, infinite where they are not determined.
    """
    _check(lens.kind, lens.values)
    p, N, B = directions.shape[1], len(x), len(poses)
    if max(directions.shape) > MAX_LENS:
        raise ValueError(f"fit_lens: directions must be at most ({MAX_LENS}, {MAX_LENS}), not {directions.shape}")
    squares, cov = np.empty(N), np.empty((p, p))
    work = np.empty(3 * N + B * (16 + 12 * (p + 7)))
    _fit_lens(*lens, directions, ptr, x, uv, iterations, poses, squares, cov, work)
    return squares, cov
