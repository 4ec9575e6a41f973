# mypy: ignore-errors
# (numba's decorator and its array arguments have no static types)
"""Compiled least-squares fit of two blurred edges that meet in a corner.

A Gaussian point spread turns the wedge between two edges into the bivariate normal distribution function of the
distances h, k to them (in units of the blur) with the cosine of their normals as correlation. That is exact for edges
at any angle, where the product of two error functions holds for perpendicular ones only.
"""

from math import asin, cos, erfc, exp, log, pi, sin, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from adjust.compiling import njit
from adjust.model import FloatArray, IntArray
from survey.detection.solve_kernels import put_state, scaled_solve

N_PARAMETERS = 9  # u, v, angle 1, angle 2, level, step, log(blur), slope u, slope v
ENOUGH_FOR_SLOPES = 45  # pixels from which the last two are free
_FAR = 4.5  # standard deviations beyond which an edge no longer bends the other one's profile (by 1e-5)
_OUT = 6.0  # standard deviations beyond which an edge is not seen at all (1e-9)
_FRAME = 28  # length of what does not change from pixel to pixel, see _frame


def _gauss_nodes():
    """Nodes on (0, 1) and weights of Gauss and Legendre with 3, 4 and 6 nodes, (3, 2, 6)."""
    out = np.zeros((3, 2, 6))
    for row, n in zip(out, (3, 4, 6), strict=True):
        nodes, weights = np.polynomial.legendre.leggauss(n)
        row[0, :n], row[1, :n] = 0.5 * (nodes + 1.0), weights
    return out


_GAUSS = _gauss_nodes()


_PER_SIGMA = 64
_NODE = np.arange(-int(_OUT) * _PER_SIGMA, int(_OUT) * _PER_SIGMA + 1) / _PER_SIGMA
_PHI_AT = np.array([0.5 * erfc(-x * 0.7071067811865476) for x in _NODE])
_DENSITY_AT = np.exp(-0.5 * _NODE**2) / sqrt(2.0 * pi)


@njit(cache=True, nogil=True, error_model="numpy")
def _normal(x):
    """Normal distribution function and density: third order about the nearest node of a table, good to 1e-9."""
    if not abs(x) < _OUT:
        return (1.0 if x > 0.0 else 0.0), 0.0
    i = int(x * _PER_SIGMA + (_OUT * _PER_SIGMA + 0.5))
    a, g = _NODE[i], _DENSITY_AT[i]
    d = x - a
    second = a * a - 1.0
    phi = _PHI_AT[i] + g * d * (1.0 + d * (second * d / 6.0 - 0.5 * a))
    return phi, g * (1.0 + d * (-a + d * (0.5 * second - d * a * (second - 2.0) / 6.0)))


@njit(cache=True, nogil=True, error_model="numpy")
def _frame(p, frame):
    """What a corner's pixels share: directions, 1 / blur, turn, rho, root of 1 - rho^2, and the nodes of the integral.

    frame: (28,). So many nodes that the integral is good to 1e-7 (3e-6 where edges meet at less than 20 degrees).
    """
    frame[0], frame[1], frame[2], frame[3] = cos(p[2]), sin(p[2]), cos(p[3]), sin(p[3])
    frame[4], frame[5] = exp(-p[6]), sin(p[3] - p[2])
    rho = min(max(-cos(p[3] - p[2]), -0.95), 0.95)
    frame[6], frame[7] = rho, sqrt(1.0 - rho * rho)
    which = 0 if abs(rho) < 0.3 else (1 if abs(rho) < 0.6 else 2)
    n = 3 if which == 0 else (4 if which == 1 else 6)
    top = asin(rho)
    frame[8], frame[9] = n, 0.0
    for i in range(n):
        t = top * _GAUSS[which, 0, i]
        c = cos(t)
        frame[10 + 3 * i] = -0.5 / (c * c)
        frame[11 + 3 * i] = 2.0 * sin(t)
        frame[12 + 3 * i] = _GAUSS[which, 1, i] * top / (4.0 * pi)


@njit(cache=True, nogil=True, error_model="numpy")
def _wedge(h, k, frame):
    """Bivariate normal distribution function, its derivatives by h, k, rho (Drezner and Wesolowsky 1990).

    Then distribution function and density of h alone, and of k alone.
    """
    p, gh = _normal(h)
    q, gk = _normal(k)
    if abs(h) > _FAR or abs(k) > _FAR:
        return p * q, gh * q, gk * p, 0.0, p, gh, q, gk
    square, product, total = h * h + k * k, h * k, 0.0
    for i in range(int(frame[8])):
        total += frame[12 + 3 * i] * exp((square - frame[11 + 3 * i] * product) * frame[10 + 3 * i])
    rho, c = frame[6], 1.0 / frame[7]
    by_h, density = _normal((k - rho * h) * c)
    by_k, _ = _normal((h - rho * k) * c)
    # the density of both is that of h times that of k where h is given
    return p * q + total, gh * by_h, gk * by_k, gh * density * c, p, gh, q, gk


@njit(cache=True, nogil=True, error_model="numpy")
def _row(x, y, p, frame, crossing, row):
    """As ``corner_row``, with what pixels share in ``frame``."""
    c1, s1, c2, s2, scale, turn = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5]
    dx, dy = x - p[0], y - p[1]
    h, k = (c1 * dy - s1 * dx) * scale, (s2 * dx - c2 * dy) * scale
    f, dh, dk, dr, ph, gh, pk, gk = _wedge(h, k, frame)
    if crossing:
        f = 4.0 * f - 2.0 * ph - 2.0 * pk + 1.0
        dh, dk, dr = 4.0 * dh - 2.0 * gh, 4.0 * dk - 2.0 * gk, 4.0 * dr
    b = p[5]
    row[0] = b * scale * (dh * s1 - dk * s2)
    row[1] = b * scale * (dk * c2 - dh * c1)
    row[2] = b * (-dh * scale * (c1 * dx + s1 * dy) - dr * turn)
    row[3] = b * (dk * scale * (c2 * dx + s2 * dy) + dr * turn)
    row[4] = 1.0
    row[5] = f
    row[6] = -b * (dh * h + dk * k)
    row[7] = x
    row[8] = y
    return p[4] + b * f + p[7] * x + p[8] * y


@njit(cache=True, nogil=True, error_model="numpy")
def corner_row(x, y, p, crossing, row):
    """Grey value at (x, y) px from the window's centre, and its derivatives (9,) by the parameters.

    crossing: the edges go on behind the corner (four quadrants, as on a checkerboard); otherwise they end there.
    """
    frame = np.empty(_FRAME)
    _frame(p, frame)
    return _row(x, y, p, frame, crossing, row)


@njit(cache=True, nogil=True, error_model="numpy")
def _window(image, centre_u, centre_v, p, shape, crossing, offsets, values):
    """Collects the pixels of a corner: a disc, and strips along its edges. Returns their number, -1 at the border.

    shape: radius of the disc, half width of the strips, length of strip 1, length of strip 2, in px.
    """
    radius, width = shape[0], shape[1]
    reach = int(np.ceil(max(radius, max(shape[2], shape[3]) + width)))
    c1, s1, c2, s2 = cos(p[2]), sin(p[2]), cos(p[3]), sin(p[3])
    n = 0
    for j in range(-reach, reach + 1):
        for i in range(-reach, reach + 1):
            dx, dy = i - p[0], j - p[1]
            inside = dx * dx + dy * dy <= radius * radius
            if not inside and width > 0.0:
                for a in range(2):
                    c, s, length = (c1, s1, shape[2]) if a == 0 else (c2, s2, shape[3])
                    along, across = c * dx + s * dy, c * dy - s * dx
                    low = -length if crossing else -width
                    inside = inside or (abs(across) <= width and low <= along <= length)
            if not inside:
                continue
            u, v = centre_u + i, centre_v + j
            if u < 0 or v < 0 or u >= image.shape[1] or v >= image.shape[0]:
                return -1
            if n == values.size:
                return n
            offsets[n, 0], offsets[n, 1], values[n] = i, j, image[v, u]
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _start_levels(p, crossing, offsets, values, n, row, frame):
    """Level and step by linear regression on the shape of the start."""
    _frame(p, frame)
    sf, sff, sv, sfv = 0.0, 0.0, 0.0, 0.0
    p[4], p[5], p[7], p[8] = 0.0, 1.0, 0.0, 0.0
    for i in range(n):
        _row(offsets[i, 0], offsets[i, 1], p, frame, crossing, row)
        f = row[5]
        sf += f
        sff += f * f
        sv += values[i]
        sfv += f * values[i]
    det = n * sff - sf * sf
    p[5] = (n * sfv - sf * sv) / det if det > 1e-9 else 0.0
    p[4] = (sv - p[5] * sf) / n


@njit(cache=True, nogil=True, error_model="numpy")
def _normals(p, crossing, offsets, values, n, row, frame, H, g):
    """Normal equations of the window; returns the sum of squared residuals."""
    _frame(p, frame)
    H[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(n):
        e = values[i] - _row(offsets[i, 0], offsets[i, 1], p, frame, crossing, row)
        cost += e * e
        for a in range(9):
            g[a, 0] += row[a] * e
            for b in range(a + 1):
                H[a, b] += row[a] * row[b]
    for a in range(9):
        for b in range(a):
            H[b, a] = H[a, b]
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(p, n_free, crossing, tolerance, offsets, values, n, row, frame, H, trial_H, g, trial_g):
    """Levenberg-Marquardt over the first ``n_free`` parameters, in place; returns the cost, -1 without convergence.

    tolerance: px that the corner may be off. Steps shrink at least as the damping does.
    """
    damping = 1e-3
    cost = _normals(p, crossing, offsets, values, n, row, frame, H, g)
    trial, step = np.empty(9), np.empty((9, 1))
    for _ in range(40):
        put_state(p, H, g, trial, trial_H, step)
        if not scaled_solve(H, n_free, damping, step):
            damping = max(damping * 10.0, 1e-6)
            continue
        for a in range(n_free):
            trial[a] += step[a, 0]
        trial[6] = min(max(trial[6], log(0.2)), log(12.0))
        trial_cost = _normals(trial, crossing, offsets, values, n, row, frame, trial_H, trial_g)
        small = abs(trial[0] - p[0]) + abs(trial[1] - p[1]) < tolerance
        if trial_cost <= cost:
            gain = cost - trial_cost
            put_state(trial, trial_H, trial_g, p, H, g)
            cost = trial_cost
            damping *= 0.2
            if small and gain <= 0.05 * tolerance * cost + 1e-12:
                return cost
        else:
            if small:
                return cost
            damping *= 6.0
    return -1.0


@njit(cache=True, nogil=True, error_model="numpy")
def fit_corners(
    image: npt.NDArray[Any], start: FloatArray, directions: FloatArray, blur: FloatArray, shapes: FloatArray,
    crossing: bool, max_shift: float, tolerance: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:  # fmt: skip
    """Fits every corner.

    image: (h, w) float. start: (n, 2) px. directions: (n, 2) angles of the two edges, the second clockwise (in the
    image) of the first. blur: (n,) px. shapes: (n, 4), see ``_window``. tolerance: px, where the fit may stop.
    Returns p (n, 9) with absolute u, v; covariance (n, 2, 2) of u, v; number of pixels; residual rms; status (n,)
    0 good, 1 at the border, 2 too few pixels, 3 no convergence, 4 went away from the start.
    """
    count = start.shape[0]
    out, cov = np.zeros((count, 9)), np.zeros((count, 2, 2))
    pixels, rms, status = np.zeros(count, np.int64), np.zeros(count), np.zeros(count, np.int64)
    offsets, values = np.empty((6000, 2)), np.empty(6000)
    row, H, trial_H, g, trial_g = np.empty(9), np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 1)), np.empty((9, 1))
    unit, frame = np.empty((9, 2)), np.empty(_FRAME)
    for c in range(count):
        p = out[c]
        cu, cv = int(np.rint(start[c, 0])), int(np.rint(start[c, 1]))
        p[0], p[1], p[2], p[3], p[6] = (
            start[c, 0] - cu,
            start[c, 1] - cv,
            directions[c, 0],
            directions[c, 1],
            log(blur[c]),
        )
        n = _window(image, cu, cv, p, shapes[c], crossing, offsets, values)
        pixels[c] = n
        # slopes of the illumination need a window that is large enough to tell them from the corner's own form
        n_free = 9 if n >= ENOUGH_FOR_SLOPES else 7
        if n < 20:
            status[c] = 1 if n < 0 else 2
            continue
        _start_levels(p, crossing, offsets, values, n, row, frame)
        cost = _fit(p, n_free, crossing, tolerance, offsets, values, n, row, frame, H, trial_H, g, trial_g)
        if cost < 0.0:
            status[c] = 3
            continue
        variance = cost / (n - n_free)
        rms[c] = sqrt(variance)
        unit[:] = 0.0
        unit[0, 0] = unit[1, 1] = 1.0
        if not scaled_solve(H, n_free, 0.0, unit):
            status[c] = 3
            continue
        for a in range(2):
            for b in range(2):
                cov[c, a, b] = variance * unit[a, b]
        p[0] += cu
        p[1] += cv
        if abs(p[0] - start[c, 0]) + abs(p[1] - start[c, 1]) > max_shift:
            status[c] = 4
    return out, cov, pixels, rms, status
