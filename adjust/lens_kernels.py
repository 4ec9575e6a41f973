"""The lens models as compiled scalar code: one image point in, its residual and derivatives out.

The residual is predicted minus observed in px, (r_u, r_v). ``q`` is the point in the camera frame (m), x right, y down,
z forward. Every model has a number (its kind), a parameter vector in a fixed order and a vector of constants
``[pixel_size_mm, centre_u, centre_v, r0_mm]`` of which it uses what it needs; ``adjust.lens`` names them all.

The functions are meant to be called from other compiled loops, once per point: straight lines, no allocation. A point
on or behind the camera's plane gives finite numbers without meaning; the caller tests the depth. The fisheye alone sees
behind that plane, and means it.

A compiled caller with ``cache=True`` keeps its own copy of these functions: after a change here its cache is stale
until its own file changes.
"""

import math

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray

BROWN = 0
FISHEYE = 1
BROWN_BACKWARD = 2
BROWN_BACKWARD_DBAT = 3
AICON = 4

N_LENS = (13, 9, 10, 9, 10)
N_CONSTANTS = 4
MAX_LENS = 14
N_COLUMNS = MAX_LENS + 3

SMALLEST_DEPTH = 1e-12
"""Depths nearer to zero (m) are moved here, so that nothing divides by zero."""
NEAR_AXIS = 0.01
"""Squared tangent of the angle to the axis below which the fisheye uses the series of atan(t) / t."""


@njit(cache=True, nogil=True, error_model="numpy")
def _depth(q2: float) -> float:
    """Depth that can be divided by."""
    if abs(q2) < SMALLEST_DEPTH:
        return SMALLEST_DEPTH
    return q2


@njit(cache=True, nogil=True, error_model="numpy")
def _brown_residual(lens: FloatArray, q0: float, q1: float, q2: float, u: float, v: float) -> tuple[float, float]:
    """OpenCV's forward Brown-Conrady model with rational radial part."""
    iz = 1.0 / _depth(q2)
    x = q0 * iz
    y = q1 * iz
    xx = x * x
    yy = y * y
    xy2 = 2.0 * x * y
    r2 = xx + yy
    numerator = 1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))
    denominator = 1.0 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12]))
    g = numerator / denominator
    xd = x * g + lens[7] * xy2 + lens[8] * (r2 + 2.0 * xx)
    yd = y * g + lens[7] * (r2 + 2.0 * yy) + lens[8] * xy2
    return lens[0] * xd + lens[2] * yd + lens[3] - u, lens[1] * yd + lens[4] - v


@njit(cache=True, nogil=True, error_model="numpy")
def _brown_row(
    lens: FloatArray, q0: float, q1: float, q2: float, u: float, v: float, row: FloatArray
) -> tuple[float, float]:
    """``_brown_residual`` with derivatives; parameters fx fy skew u0 v0 k1 k2 p1 p2 k3 k4 k5 k6."""
    fx = lens[0]
    fy = lens[1]
    skew = lens[2]
    p1 = lens[7]
    p2 = lens[8]
    iz = 1.0 / _depth(q2)
    x = q0 * iz
    y = q1 * iz
    xx = x * x
    yy = y * y
    xy2 = 2.0 * x * y
    r2 = xx + yy
    r4 = r2 * r2
    r6 = r4 * r2
    numerator = 1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))
    i_den = 1.0 / (1.0 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12])))
    g = numerator * i_den
    ax = r2 + 2.0 * xx
    ay = r2 + 2.0 * yy
    xd = x * g + p1 * xy2 + p2 * ax
    yd = y * g + p1 * ay + p2 * xy2

    # derivative of g by r2
    dg = i_den * (
        lens[5]
        + r2 * (2.0 * lens[6] + 3.0 * r2 * lens[9])
        - g * (lens[10] + r2 * (2.0 * lens[11] + 3.0 * r2 * lens[12]))
    )
    cross = xy2 * dg + 2.0 * (p1 * x + p2 * y)
    xd_x = g + 2.0 * xx * dg + 2.0 * p1 * y + 6.0 * p2 * x
    yd_y = g + 2.0 * yy * dg + 6.0 * p1 * y + 2.0 * p2 * x
    u_x = fx * xd_x + skew * cross
    u_y = fx * cross + skew * yd_y
    v_x = fy * cross
    v_y = fy * yd_y

    # radial columns: the shift of the image by a unit change of g, times the power of r
    gu = fx * x + skew * y
    gv = fy * y
    nu = gu * i_den
    nv = gv * i_den
    du = -nu * g
    dv = -nv * g

    row[0, 0] = xd
    row[1, 0] = 0.0
    row[0, 1] = 0.0
    row[1, 1] = yd
    row[0, 2] = yd
    row[1, 2] = 0.0
    row[0, 3] = 1.0
    row[1, 3] = 0.0
    row[0, 4] = 0.0
    row[1, 4] = 1.0
    row[0, 5] = nu * r2
    row[1, 5] = nv * r2
    row[0, 6] = nu * r4
    row[1, 6] = nv * r4
    row[0, 7] = fx * xy2 + skew * ay
    row[1, 7] = fy * ay
    row[0, 8] = fx * ax + skew * xy2
    row[1, 8] = fy * xy2
    row[0, 9] = nu * r6
    row[1, 9] = nv * r6
    row[0, 10] = du * r2
    row[1, 10] = dv * r2
    row[0, 11] = du * r4
    row[1, 11] = dv * r4
    row[0, 12] = du * r6
    row[1, 12] = dv * r6
    row[0, 14] = u_x * iz
    row[1, 14] = v_x * iz
    row[0, 15] = u_y * iz
    row[1, 15] = v_y * iz
    row[0, 16] = -(u_x * x + u_y * y) * iz
    row[1, 16] = -(v_x * x + v_y * y) * iz
    return fx * xd + skew * yd + lens[3] - u, fy * yd + lens[4] - v


@njit(cache=True, nogil=True, error_model="numpy")
def _atan_series(w: float) -> tuple[float, float]:
    """atan(t) / t and its derivative by w = t^2, for w < ``NEAR_AXIS`` (truncated below 1e-18)."""
    a = 1.0 - w * (
        1 / 3 - w * (1 / 5 - w * (1 / 7 - w * (1 / 9 - w * (1 / 11 - w * (1 / 13 - w * (1 / 15 - w / 17))))))
    )
    b = -(1 / 3 - w * (2 / 5 - w * (3 / 7 - w * (4 / 9 - w * (5 / 11 - w * (6 / 13 - w * (7 / 15 - w * 8 / 17)))))))
    return a, b


@njit(cache=True, nogil=True, error_model="numpy")
def _fisheye_angle(lens: FloatArray, rr: float, q2: float) -> tuple[float, float, float]:
    """Squared angle t2 to the axis, g = theta_d / r and theta / r, for squared distance ``rr`` from the axis."""
    if q2 > 0.0 and rr < NEAR_AXIS * q2 * q2:
        w = rr / (q2 * q2)
        a, _ = _atan_series(w)
        h = a / q2
        t2 = w * a * a
    else:
        r = max(math.sqrt(rr), SMALLEST_DEPTH)
        theta = math.atan2(r, q2)
        h = theta / r
        t2 = theta * theta
    g = h * (1.0 + t2 * (lens[5] + t2 * (lens[6] + t2 * (lens[7] + t2 * lens[8]))))
    return t2, g, h


@njit(cache=True, nogil=True, error_model="numpy")
def _fisheye_residual(lens: FloatArray, q0: float, q1: float, q2: float, u: float, v: float) -> tuple[float, float]:
    """OpenCV's equidistant fisheye."""
    _, g, _ = _fisheye_angle(lens, q0 * q0 + q1 * q1, q2)
    xd = q0 * g
    yd = q1 * g
    return lens[0] * xd + lens[2] * yd + lens[3] - u, lens[1] * yd + lens[4] - v


@njit(cache=True, nogil=True, error_model="numpy")
def _fisheye_row(
    lens: FloatArray, q0: float, q1: float, q2: float, u: float, v: float, row: FloatArray
) -> tuple[float, float]:
    """``_fisheye_residual`` with derivatives; parameters fx fy skew u0 v0 k1 k2 k3 k4.

    With g = theta_d / r the image is g (q0, q1). ``dg`` is (dg/dr) / r: near the axis from the series in r^2 / z^2,
    elsewhere from the quotient, which loses no more than two digits there.
    """
    fx = lens[0]
    fy = lens[1]
    skew = lens[2]
    rr = q0 * q0 + q1 * q1
    t2, g, h = _fisheye_angle(lens, rr, q2)
    polynomial = 1.0 + t2 * (lens[5] + t2 * (lens[6] + t2 * (lens[7] + t2 * lens[8])))
    by_t2 = lens[5] + t2 * (2.0 * lens[6] + t2 * (3.0 * lens[7] + t2 * 4.0 * lens[8]))
    theta_d_slope = polynomial + 2.0 * t2 * by_t2
    squared = max(rr + q2 * q2, SMALLEST_DEPTH * SMALLEST_DEPTH)
    if q2 > 0.0 and rr < NEAR_AXIS * q2 * q2:
        w = rr / (q2 * q2)
        a, b = _atan_series(w)
        dg = 2.0 * (b * polynomial + a * by_t2 * (a * a + 2.0 * w * a * b)) / (q2 * q2 * q2)
    else:
        dg = (theta_d_slope * q2 / squared - g) / max(rr, SMALLEST_DEPTH * SMALLEST_DEPTH)
    xd = q0 * g
    yd = q1 * g
    xd_x = g + q0 * q0 * dg
    yd_y = g + q1 * q1 * dg
    cross = q0 * q1 * dg
    by_z = -theta_d_slope / squared
    hu = (fx * q0 + skew * q1) * h
    hv = fy * q1 * h

    row[0, 0] = xd
    row[1, 0] = 0.0
    row[0, 1] = 0.0
    row[1, 1] = yd
    row[0, 2] = yd
    row[1, 2] = 0.0
    row[0, 3] = 1.0
    row[1, 3] = 0.0
    row[0, 4] = 0.0
    row[1, 4] = 1.0
    power = t2
    for i in range(4):
        row[0, 5 + i] = hu * power
        row[1, 5 + i] = hv * power
        power *= t2
    row[0, 14] = fx * xd_x + skew * cross
    row[1, 14] = fy * cross
    row[0, 15] = fx * cross + skew * yd_y
    row[1, 15] = fy * yd_y
    row[0, 16] = (fx * q0 + skew * q1) * by_z
    row[1, 16] = fy * q1 * by_z
    return fx * xd + skew * yd + lens[3] - u, fy * yd + lens[4] - v


@njit(cache=True, nogil=True, error_model="numpy")
def _brown_backward_residual(
    lens: FloatArray, constants: FloatArray, q0: float, q1: float, q2: float, u: float, v: float
) -> tuple[float, float]:
    """Correction of the measured point, as in Australis; the residual is formed in the corrected plane."""
    i_s = 1.0 / constants[0]
    x = (u - constants[1]) * constants[0] - lens[1]
    y = -(v - constants[2]) * constants[0] - lens[2]
    xy2 = 2.0 * x * y
    r2 = x * x + y * y
    k = r2 * (lens[3] + r2 * (lens[4] + r2 * lens[5]))
    xc = x + x * k + lens[6] * (r2 + 2.0 * x * x) + lens[7] * xy2 + lens[8] * x + lens[9] * y
    yc = y + y * k + lens[7] * (r2 + 2.0 * y * y) + lens[6] * xy2
    c_z = lens[0] / _depth(q2)
    return (c_z * q0 - xc) * i_s, (c_z * q1 + yc) * i_s


@njit(cache=True, nogil=True, error_model="numpy")
def _pinhole_columns(c: float, i_s: float, q0: float, q1: float, q2: float, row: FloatArray) -> None:
    """Columns of the camera constant (0) and of q for a residual (c q0 / q2, c q1 / q2) / s + ..."""
    iz = 1.0 / _depth(q2)
    x = q0 * iz
    y = q1 * iz
    f = c * i_s * iz
    row[0, 0] = x * i_s
    row[1, 0] = y * i_s
    row[0, 14] = f
    row[1, 14] = 0.0
    row[0, 15] = 0.0
    row[1, 15] = f
    row[0, 16] = -f * x
    row[1, 16] = -f * y


@njit(cache=True, nogil=True, error_model="numpy")
def _brown_backward_row(
    lens: FloatArray, constants: FloatArray, q0: float, q1: float, q2: float, u: float, v: float, row: FloatArray
) -> tuple[float, float]:
    """``_brown_backward_residual`` with derivatives; parameters c xp yp K1 K2 K3 P1 P2 B1 B2 (mm)."""
    i_s = 1.0 / constants[0]
    x = (u - constants[1]) * constants[0] - lens[1]
    y = -(v - constants[2]) * constants[0] - lens[2]
    p1 = lens[6]
    p2 = lens[7]
    xx = x * x
    yy = y * y
    xy2 = 2.0 * x * y
    r2 = xx + yy
    r4 = r2 * r2
    r6 = r4 * r2
    k = r2 * (lens[3] + r2 * (lens[4] + r2 * lens[5]))
    dk = lens[3] + r2 * (2.0 * lens[4] + 3.0 * r2 * lens[5])
    xc = x + x * k + p1 * (r2 + 2.0 * xx) + p2 * xy2 + lens[8] * x + lens[9] * y
    yc = y + y * k + p2 * (r2 + 2.0 * yy) + p1 * xy2
    cross = xy2 * dk + 2.0 * (p1 * y + p2 * x)

    _pinhole_columns(lens[0], i_s, q0, q1, q2, row)
    row[0, 1] = (1.0 + k + 2.0 * xx * dk + 6.0 * p1 * x + 2.0 * p2 * y + lens[8]) * i_s
    row[1, 1] = -cross * i_s
    row[0, 2] = (cross + lens[9]) * i_s
    row[1, 2] = -(1.0 + k + 2.0 * yy * dk + 6.0 * p2 * y + 2.0 * p1 * x) * i_s
    xs = x * i_s
    ys = y * i_s
    row[0, 3] = -xs * r2
    row[1, 3] = ys * r2
    row[0, 4] = -xs * r4
    row[1, 4] = ys * r4
    row[0, 5] = -xs * r6
    row[1, 5] = ys * r6
    row[0, 6] = -(r2 + 2.0 * xx) * i_s
    row[1, 6] = xy2 * i_s
    row[0, 7] = -xy2 * i_s
    row[1, 7] = (r2 + 2.0 * yy) * i_s
    row[0, 8] = -xs
    row[1, 8] = 0.0
    row[0, 9] = -ys
    row[1, 9] = 0.0
    c_z = lens[0] / _depth(q2)
    return (c_z * q0 - xc) * i_s, (c_z * q1 + yc) * i_s


@njit(cache=True, nogil=True, error_model="numpy")
def _dbat_residual(
    lens: FloatArray, constants: FloatArray, q0: float, q1: float, q2: float, u: float, v: float
) -> tuple[float, float]:
    """Correction of the measured point with DBAT's affinity and origin (no half-pixel shift, x alone stretched)."""
    i_s = 1.0 / constants[0]
    x = (u * constants[0] - lens[1]) * (1.0 + lens[3])
    y = lens[2] - v * constants[0]
    xy2 = 2.0 * x * y
    r2 = x * x + y * y
    k = r2 * (lens[4] + r2 * (lens[5] + r2 * lens[6]))
    xc = x + x * k + lens[7] * (r2 + 2.0 * x * x) + lens[8] * xy2
    yc = y + y * k + lens[8] * (r2 + 2.0 * y * y) + lens[7] * xy2
    c_z = lens[0] / _depth(q2)
    return (c_z * q0 - xc) * i_s, (c_z * q1 + yc) * i_s


@njit(cache=True, nogil=True, error_model="numpy")
def _dbat_row(
    lens: FloatArray, constants: FloatArray, q0: float, q1: float, q2: float, u: float, v: float, row: FloatArray
) -> tuple[float, float]:
    """``_dbat_residual`` with derivatives; parameters c px py as K1 K2 K3 P1 P2 (mm)."""
    i_s = 1.0 / constants[0]
    x0 = u * constants[0] - lens[1]
    stretch = 1.0 + lens[3]
    x = x0 * stretch
    y = lens[2] - v * constants[0]
    p1 = lens[7]
    p2 = lens[8]
    xx = x * x
    yy = y * y
    xy2 = 2.0 * x * y
    r2 = xx + yy
    r4 = r2 * r2
    r6 = r4 * r2
    k = r2 * (lens[4] + r2 * (lens[5] + r2 * lens[6]))
    dk = lens[4] + r2 * (2.0 * lens[5] + 3.0 * r2 * lens[6])
    xc = x + x * k + p1 * (r2 + 2.0 * xx) + p2 * xy2
    yc = y + y * k + p2 * (r2 + 2.0 * yy) + p1 * xy2
    cross = (xy2 * dk + 2.0 * (p1 * y + p2 * x)) * i_s
    ru_x = -(1.0 + k + 2.0 * xx * dk + 6.0 * p1 * x + 2.0 * p2 * y) * i_s

    _pinhole_columns(lens[0], i_s, q0, q1, q2, row)
    row[0, 1] = -ru_x * stretch
    row[1, 1] = -cross * stretch
    row[0, 2] = -cross
    row[1, 2] = (1.0 + k + 2.0 * yy * dk + 6.0 * p2 * y + 2.0 * p1 * x) * i_s
    row[0, 3] = ru_x * x0
    row[1, 3] = cross * x0
    xs = x * i_s
    ys = y * i_s
    row[0, 4] = -xs * r2
    row[1, 4] = ys * r2
    row[0, 5] = -xs * r4
    row[1, 5] = ys * r4
    row[0, 6] = -xs * r6
    row[1, 6] = ys * r6
    row[0, 7] = -(r2 + 2.0 * xx) * i_s
    row[1, 7] = xy2 * i_s
    row[0, 8] = -xy2 * i_s
    row[1, 8] = (r2 + 2.0 * yy) * i_s
    c_z = lens[0] / _depth(q2)
    return (c_z * q0 - xc) * i_s, (c_z * q1 + yc) * i_s


@njit(cache=True, nogil=True, error_model="numpy")
def _aicon_residual(
    lens: FloatArray, constants: FloatArray, q0: float, q1: float, q2: float, u: float, v: float
) -> tuple[float, float]:
    """AICON's forward model: balanced radial polynomial, evaluated at the ideal image point."""
    i_s = 1.0 / constants[0]
    c_z = lens[0] / _depth(q2)
    x = c_z * q0
    y = -c_z * q1
    r2 = x * x + y * y
    z2 = constants[3] * constants[3]
    d = r2 * (lens[3] + r2 * (lens[4] + r2 * lens[5])) - z2 * (lens[3] + z2 * (lens[4] + z2 * lens[5]))
    xy2 = 2.0 * x * y
    xd = lens[1] + x + x * d + lens[6] * (r2 + 2.0 * x * x) + lens[7] * xy2 + lens[8] * x + lens[9] * y
    yd = lens[2] + y + y * d + lens[7] * (r2 + 2.0 * y * y) + lens[6] * xy2
    return xd * i_s + constants[1] - u, -yd * i_s + constants[2] - v


@njit(cache=True, nogil=True, error_model="numpy")
def _aicon_row(
    lens: FloatArray, constants: FloatArray, q0: float, q1: float, q2: float, u: float, v: float, row: FloatArray
) -> tuple[float, float]:
    """``_aicon_residual`` with derivatives; parameters ck xh yh A1 A2 A3 B1 B2 C1 C2 (mm)."""
    i_s = 1.0 / constants[0]
    iz = 1.0 / _depth(q2)
    xn = q0 * iz
    yn = -q1 * iz
    c = lens[0]
    x = c * xn
    y = c * yn
    b1 = lens[6]
    b2 = lens[7]
    xx = x * x
    yy = y * y
    xy2 = 2.0 * x * y
    r2 = xx + yy
    r4 = r2 * r2
    z2 = constants[3] * constants[3]
    d = r2 * (lens[3] + r2 * (lens[4] + r2 * lens[5])) - z2 * (lens[3] + z2 * (lens[4] + z2 * lens[5]))
    dd = lens[3] + r2 * (2.0 * lens[4] + 3.0 * r2 * lens[5])
    xd = lens[1] + x + x * d + b1 * (r2 + 2.0 * xx) + b2 * xy2 + lens[8] * x + lens[9] * y
    yd = lens[2] + y + y * d + b2 * (r2 + 2.0 * yy) + b1 * xy2
    cross = xy2 * dd + 2.0 * (b1 * y + b2 * x)
    # derivatives of (r_u, r_v) by the ideal point (x, y)
    u_x = (1.0 + d + 2.0 * xx * dd + 6.0 * b1 * x + 2.0 * b2 * y + lens[8]) * i_s
    u_y = (cross + lens[9]) * i_s
    v_x = -cross * i_s
    v_y = -(1.0 + d + 2.0 * yy * dd + 6.0 * b2 * y + 2.0 * b1 * x) * i_s

    row[0, 0] = u_x * xn + u_y * yn
    row[1, 0] = v_x * xn + v_y * yn
    row[0, 1] = i_s
    row[1, 1] = 0.0
    row[0, 2] = 0.0
    row[1, 2] = -i_s
    xs = x * i_s
    ys = y * i_s
    row[0, 3] = xs * (r2 - z2)
    row[1, 3] = -ys * (r2 - z2)
    row[0, 4] = xs * (r4 - z2 * z2)
    row[1, 4] = -ys * (r4 - z2 * z2)
    row[0, 5] = xs * (r4 * r2 - z2 * z2 * z2)
    row[1, 5] = -ys * (r4 * r2 - z2 * z2 * z2)
    row[0, 6] = (r2 + 2.0 * xx) * i_s
    row[1, 6] = -xy2 * i_s
    row[0, 7] = xy2 * i_s
    row[1, 7] = -(r2 + 2.0 * yy) * i_s
    row[0, 8] = xs
    row[1, 8] = 0.0
    row[0, 9] = ys
    row[1, 9] = 0.0
    f = c * iz
    row[0, 14] = u_x * f
    row[1, 14] = v_x * f
    row[0, 15] = -u_y * f
    row[1, 15] = -v_y * f
    row[0, 16] = -(u_x * x + u_y * y) * iz
    row[1, 16] = -(v_x * x + v_y * y) * iz
    return xd * i_s + constants[1] - u, -yd * i_s + constants[2] - v


@njit(cache=True, nogil=True, error_model="numpy")
def lens_row(
    kind: int,
    lens: FloatArray,
    constants: FloatArray,
    q0: float,
    q1: float,
    q2: float,
    u: float,
    v: float,
    row: FloatArray,
) -> tuple[float, float]:
    """Residual (px) of one image point, its derivatives written into ``row`` (2, >= 17).

    Columns 0 .. N_LENS[kind] - 1: by the lens parameters (px per unit of each); 14 .. 16: by q (px/m). The columns
    between are left as they are.
    """
    if kind == BROWN:
        return _brown_row(lens, q0, q1, q2, u, v, row)
    if kind == FISHEYE:
        return _fisheye_row(lens, q0, q1, q2, u, v, row)
    if kind == BROWN_BACKWARD:
        return _brown_backward_row(lens, constants, q0, q1, q2, u, v, row)
    if kind == BROWN_BACKWARD_DBAT:
        return _dbat_row(lens, constants, q0, q1, q2, u, v, row)
    return _aicon_row(lens, constants, q0, q1, q2, u, v, row)


@njit(cache=True, nogil=True, error_model="numpy")
def lens_residual(
    kind: int,
    lens: FloatArray,
    constants: FloatArray,
    q0: float,
    q1: float,
    q2: float,
    u: float,
    v: float,
) -> tuple[float, float]:
    """Residual (px) of one image point, predicted minus observed."""
    if kind == BROWN:
        return _brown_residual(lens, q0, q1, q2, u, v)
    if kind == FISHEYE:
        return _fisheye_residual(lens, q0, q1, q2, u, v)
    if kind == BROWN_BACKWARD:
        return _brown_backward_residual(lens, constants, q0, q1, q2, u, v)
    if kind == BROWN_BACKWARD_DBAT:
        return _dbat_residual(lens, constants, q0, q1, q2, u, v)
    return _aicon_residual(lens, constants, q0, q1, q2, u, v)


@njit(cache=True, nogil=True, error_model="numpy")
def lens_rows(
    kind: int, lens: FloatArray, constants: FloatArray, q: FloatArray, uv: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``lens_row`` for n points q (n, 3) m and uv (n, 2) px: residuals (n, 2), derivatives (n, 2, 17)."""
    n = q.shape[0]
    residuals = np.empty((n, 2))
    rows = np.zeros((n, 2, N_COLUMNS))
    for i in range(n):
        ru, rv = lens_row(kind, lens, constants, q[i, 0], q[i, 1], q[i, 2], uv[i, 0], uv[i, 1], rows[i])
        residuals[i, 0] = ru
        residuals[i, 1] = rv
    return residuals, rows


@njit(cache=True, nogil=True, error_model="numpy")
def lens_residuals(kind: int, lens: FloatArray, constants: FloatArray, q: FloatArray, uv: FloatArray) -> FloatArray:
    """``lens_residual`` for n points q (n, 3) m and uv (n, 2) px: (n, 2)."""
    n = q.shape[0]
    residuals = np.empty((n, 2))
    for i in range(n):
        ru, rv = lens_residual(kind, lens, constants, q[i, 0], q[i, 1], q[i, 2], uv[i, 0], uv[i, 1])
        residuals[i, 0] = ru
        residuals[i, 1] = rv
    return residuals
