"""The forward Brown model of many image points at once, column by column: short loops that are vectorised.

Every loop writes one array from a few others, which is what a compiler turns into vector instructions; the same
arithmetic as ``adjust.lens_kernels``, point by point, takes several times as long.
"""

from adjust.compiling import njit
from adjust.lens_kernels import SMALLEST_DEPTH
from adjust.model import FloatArray

RESIDUAL_U, RESIDUAL_V = 0, 1
BY_POINT_U, BY_POINT_V = 2, 5
_X, _Y, _R2, _XD, _YD, _NU, _NV, _G, _T1, _T2, _T3, _T4 = 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19
N_SCRATCH = 20
"""Arrays of scratch: residual, derivatives by the point in the camera frame (three each), then intermediate ones."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def combine(a: float, b: float, c: float, d: float, x: FloatArray, y: FloatArray, z: FloatArray, o: FloatArray) -> None:
    """Fill o with a x + b y + c z + d."""
    for p in range(o.size):
        o[p] = a * x[p] + b * y[p] + c * z[p] + d


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def cross(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, o: FloatArray) -> None:
    """Fill o with a b - c d."""
    for p in range(o.size):
        o[p] = a[p] * b[p] - c[p] * d[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def product(a: FloatArray, b: FloatArray, o: FloatArray) -> None:
    """Fill o with a b."""
    for p in range(o.size):
        o[p] = a[p] * b[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def products(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, o: FloatArray) -> None:
    """Fill o with a b + c d."""
    for p in range(o.size):
        o[p] = a[p] * b[p] + c[p] * d[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def add_products(
    f: float, a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, o: FloatArray
) -> None:  # fmt: skip
    """Add f (a b + c d) to o."""
    for p in range(o.size):
        o[p] += f * (a[p] * b[p] + c[p] * d[p])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def add_product(f: float, a: FloatArray, b: FloatArray, o: FloatArray) -> None:
    """Add f a b to o."""
    for p in range(o.size):
        o[p] += f * a[p] * b[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def add_multiple(f: float, a: FloatArray, o: FloatArray) -> None:
    """Add f a to o."""
    for p in range(o.size):
        o[p] += f * a[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _inverse_depth(z: FloatArray, o: FloatArray) -> None:
    for p in range(o.size):
        d = z[p] if abs(z[p]) >= SMALLEST_DEPTH else SMALLEST_DEPTH
        o[p] = 1.0 / d


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _squared_radius(x: FloatArray, y: FloatArray, o: FloatArray) -> None:
    for p in range(o.size):
        o[p] = x[p] * x[p] + y[p] * y[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _inverse_denominator(k4: float, k5: float, k6: float, r2: FloatArray, o: FloatArray) -> None:
    for p in range(o.size):
        r = r2[p]
        o[p] = 1.0 / (1.0 + r * (k4 + r * (k5 + r * k6)))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _gain(k1: float, k2: float, k3: float, r2: FloatArray, i_den: FloatArray, o: FloatArray) -> None:
    for p in range(o.size):
        r = r2[p]
        o[p] = (1.0 + r * (k1 + r * (k2 + r * k3))) * i_den[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _gain_slope(lens: FloatArray, r2: FloatArray, i_den: FloatArray, g: FloatArray, o: FloatArray) -> None:
    """Derivative of the gain by the squared radius."""
    k1, k2, k3, k4, k5, k6 = lens[5], 2.0 * lens[6], 3.0 * lens[9], lens[10], 2.0 * lens[11], 3.0 * lens[12]
    for p in range(o.size):
        r = r2[p]
        o[p] = i_den[p] * (k1 + r * (k2 + r * k3) - g[p] * (k4 + r * (k5 + r * k6)))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _distorted(p1: float, p2: float, x: FloatArray, y: FloatArray, g: FloatArray, o: FloatArray) -> None:
    """Distorted x; with p1, p2 and x, y exchanged, distorted y."""
    for p in range(o.size):
        a, b = x[p], y[p]
        o[p] = a * g[p] + 2.0 * p1 * a * b + p2 * (3.0 * a * a + b * b)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _own_slope(
    p1: float, p2: float, x: FloatArray, y: FloatArray, g: FloatArray, dg: FloatArray, o: FloatArray
) -> None:  # fmt: skip
    """Derivative of distorted x by x; exchanged as in ``_distorted``, of y by y."""
    for p in range(o.size):
        a = x[p]
        o[p] = g[p] + 2.0 * a * a * dg[p] + 2.0 * p1 * y[p] + 6.0 * p2 * a


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _cross_slope(p1: float, p2: float, x: FloatArray, y: FloatArray, dg: FloatArray, o: FloatArray) -> None:
    for p in range(o.size):
        a, b = x[p], y[p]
        o[p] = 2.0 * (a * b * dg[p] + p1 * a + p2 * b)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _by_xy(a: float, b: float, x: FloatArray, y: FloatArray, i_z: FloatArray, o: FloatArray) -> None:
    for p in range(o.size):
        o[p] = (a * x[p] + b * y[p]) * i_z[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _by_depth(by_x: FloatArray, by_y: FloatArray, x: FloatArray, y: FloatArray, o: FloatArray) -> None:
    for p in range(o.size):
        o[p] = -(by_x[p] * x[p] + by_y[p] * y[p])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _in_pixels(a: float, b: float, c: float, x: FloatArray, y: FloatArray, u: FloatArray, o: FloatArray) -> None:
    for p in range(o.size):
        o[p] = a * x[p] + b * y[p] + c - u[p]


@njit(cache=True, nogil=True, error_model="numpy")
def brown(
    lens: FloatArray, q0: FloatArray, q1: FloatArray, q2: FloatArray, u: FloatArray, v: FloatArray, S: FloatArray
) -> None:  # fmt: skip
    """Residuals and derivatives by the point (m,) into rows of S (N_SCRATCH, >= m); the rest for ``brown_parameter``.

    Formulas: ``adjust.lens_kernels``.
    """
    n = q0.size
    fx, fy, skew, p1, p2 = lens[0], lens[1], lens[2], lens[7], lens[8]
    x, y, r2, i_den, g = S[_X, :n], S[_Y, :n], S[_R2, :n], S[_T1, :n], S[_G, :n]
    i_z, dg, xd, yd = S[_T2, :n], S[_T3, :n], S[_XD, :n], S[_YD, :n]
    _inverse_depth(q2, i_z)
    product(q0, i_z, x)
    product(q1, i_z, y)
    _squared_radius(x, y, r2)
    _inverse_denominator(lens[10], lens[11], lens[12], r2, i_den)
    _gain(lens[5], lens[6], lens[9], r2, i_den, g)
    _gain_slope(lens, r2, i_den, g, dg)
    _distorted(p1, p2, x, y, g, xd)
    _distorted(p2, p1, y, x, g, yd)
    _in_pixels(fx, skew, lens[3], xd, yd, u, S[RESIDUAL_U, :n])
    _in_pixels(0.0, fy, lens[4], xd, yd, v, S[RESIDUAL_V, :n])
    # derivatives of the distorted point, until nu and nv take their places
    xd_x, yd_y, xd_y = S[_NU, :n], S[_NV, :n], S[_T4, :n]
    _own_slope(p1, p2, x, y, g, dg, xd_x)
    _own_slope(p2, p1, y, x, g, dg, yd_y)
    _cross_slope(p1, p2, x, y, dg, xd_y)
    u_x, u_y, v_x, v_y = S[BY_POINT_U, :n], S[BY_POINT_U + 1, :n], S[BY_POINT_V, :n], S[BY_POINT_V + 1, :n]
    _by_xy(fx, skew, xd_x, xd_y, i_z, u_x)
    _by_xy(fx, skew, xd_y, yd_y, i_z, u_y)
    _by_xy(0.0, fy, xd_x, xd_y, i_z, v_x)
    _by_xy(0.0, fy, xd_x, yd_y, i_z, v_y)
    _by_depth(u_x, u_y, x, y, S[BY_POINT_U + 2, :n])
    _by_depth(v_x, v_y, x, y, S[BY_POINT_V + 2, :n])
    _by_xy(fx, skew, x, y, i_den, S[_NU, :n])
    _by_xy(0.0, fy, x, y, i_den, S[_NV, :n])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _times_power(a: FloatArray, r2: FloatArray, power: int, o: FloatArray) -> None:
    if power == 1:
        for p in range(o.size):
            o[p] = a[p] * r2[p]
    elif power == 2:
        for p in range(o.size):
            o[p] = a[p] * r2[p] * r2[p]
    else:
        for p in range(o.size):
            o[p] = a[p] * r2[p] * r2[p] * r2[p]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _tangential(a: float, b: float, x: FloatArray, y: FloatArray, o: FloatArray) -> None:
    """Fill o with 2 a x y + b (x^2 + 3 y^2)."""
    for p in range(o.size):
        c, d = x[p], y[p]
        o[p] = 2.0 * a * c * d + b * (c * c + 3.0 * d * d)


@njit(cache=True, nogil=True, error_model="numpy")
def brown_parameter(
    k: int, f: float, lens: FloatArray, w00: FloatArray, w01: FloatArray, w11: FloatArray, S: FloatArray,
    out_u: FloatArray, out_v: FloatArray,
) -> None:  # fmt: skip
    """Add ``f`` times the whitened derivatives by parameter ``k`` to out_u and out_v (m,), after :func:`brown`."""
    n = out_u.size
    if k == 0:
        add_product(f, w00, S[_XD, :n], out_u)
    elif k == 1:
        add_product(f, w01, S[_YD, :n], out_u)
        add_product(f, w11, S[_YD, :n], out_v)
    elif k == 2:
        add_product(f, w00, S[_YD, :n], out_u)
    elif k == 3:
        add_multiple(f, w00, out_u)
    elif k == 4:
        add_multiple(f, w01, out_u)
        add_multiple(f, w11, out_v)
    else:
        by_u, by_v, x, y, r2 = S[_T1, :n], S[_T2, :n], S[_X, :n], S[_Y, :n], S[_R2, :n]
        if k == 7:
            _tangential(lens[0], lens[2], x, y, by_u)
            _tangential(0.0, lens[1], x, y, by_v)
        elif k == 8:
            _tangential(lens[2], lens[0], y, x, by_u)
            _tangential(lens[1], 0.0, x, y, by_v)
        else:
            power = 1 if k == 5 or k == 10 else (2 if k == 6 or k == 11 else 3)
            _times_power(S[_NU, :n], r2, power, by_u)
            _times_power(S[_NV, :n], r2, power, by_v)
            if k >= 10:  # the denominator
                f = -f
                product(by_u, S[_G, :n], S[_T3, :n])
                product(by_v, S[_G, :n], S[_T4, :n])
                by_u, by_v = S[_T3, :n], S[_T4, :n]
        add_products(f, w00, by_u, w01, by_v, out_u)
        add_product(f, w11, by_v, out_v)
