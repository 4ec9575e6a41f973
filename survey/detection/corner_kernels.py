# mypy: ignore-errors
# (numba's decorator and its array arguments have no static types)
"""Compiled least-squares fit of two blurred edges that meet in a corner.

A Gaussian point spread turns the wedge between two edges into the bivariate normal distribution function of the
distances h, k to them (in units of the blur) with the cosine of their normals as correlation. That is exact for edges
at any angle, where the product of two error functions holds for perpendicular ones only.
"""

from math import asin, cos, erfc, exp, log, pi, sin, sqrt

import numpy as np
from numba import njit

from survey.detection.solve_kernels import scaled_solve

N_PARAMETERS = 9  # u, v, angle 1, angle 2, level, step, log(blur), slope u, slope v
_NODES = np.polynomial.legendre.leggauss(6)[0]
_WEIGHTS = np.polynomial.legendre.leggauss(6)[1]
_FAR = 4.5  # standard deviations beyond which an edge no longer bends the other one's profile (by 1e-5)


@njit(cache=True, nogil=True, error_model="numpy")
def _phi(x):
    return 0.5 * erfc(-x * 0.7071067811865476)


@njit(cache=True, nogil=True, error_model="numpy")
def _wedge(h, k, rho):
    """Bivariate normal distribution function and its derivatives by h, k, rho (Drezner and Wesolowsky 1990)."""
    p, q = _phi(h), _phi(k)
    if abs(h) > _FAR or abs(k) > _FAR:
        dh = 0.3989422804014327 * exp(-0.5 * h * h) * q if abs(h) <= 6.0 else 0.0
        dk = 0.3989422804014327 * exp(-0.5 * k * k) * p if abs(k) <= 6.0 else 0.0
        return p * q, dh, dk, 0.0, p, q
    top = asin(rho)
    total = 0.0
    for i in range(_NODES.size):
        t = 0.5 * top * (_NODES[i] + 1.0)
        c = cos(t)
        total += _WEIGHTS[i] * exp(-(h * h + k * k - 2.0 * h * k * sin(t)) / (2.0 * c * c))
    c = sqrt(1.0 - rho * rho)
    dh = 0.3989422804014327 * exp(-0.5 * h * h) * _phi((k - rho * h) / c)
    dk = 0.3989422804014327 * exp(-0.5 * k * k) * _phi((h - rho * k) / c)
    density = exp(-(h * h + k * k - 2.0 * rho * h * k) / (2.0 * c * c)) / (2.0 * pi * c)
    return p * q + total * top / (4.0 * pi), dh, dk, density, p, q


@njit(cache=True, nogil=True, error_model="numpy")
def corner_row(x, y, p, crossing, row):
    """Grey value at (x, y) px from the window's centre, and its derivatives (9,) by the parameters.

    crossing: the edges go on behind the corner (four quadrants, as on a checkerboard); otherwise they end there.
    """
    c1, s1, c2, s2 = cos(p[2]), sin(p[2]), cos(p[3]), sin(p[3])
    scale = exp(-p[6])
    dx, dy = x - p[0], y - p[1]
    h, k = (c1 * dy - s1 * dx) * scale, (s2 * dx - c2 * dy) * scale
    turn = sin(p[3] - p[2])
    rho = -cos(p[3] - p[2])
    f, dh, dk, dr, ph, pk = _wedge(h, k, min(max(rho, -0.95), 0.95))
    if crossing:
        f = 4.0 * f - 2.0 * ph - 2.0 * pk + 1.0
        gh, gk = 0.3989422804014327 * exp(-0.5 * h * h), 0.3989422804014327 * exp(-0.5 * k * k)
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
def _start_levels(p, crossing, offsets, values, n, row):
    """Level and step by linear regression on the shape of the start."""
    sf, sff, sv, sfv = 0.0, 0.0, 0.0, 0.0
    p[4], p[5], p[7], p[8] = 0.0, 1.0, 0.0, 0.0
    for i in range(n):
        corner_row(offsets[i, 0], offsets[i, 1], p, crossing, row)
        f = row[5]
        sf += f
        sff += f * f
        sv += values[i]
        sfv += f * values[i]
    det = n * sff - sf * sf
    p[5] = (n * sfv - sf * sv) / det if det > 1e-9 else 0.0
    p[4] = (sv - p[5] * sf) / n


@njit(cache=True, nogil=True, error_model="numpy")
def _normals(p, crossing, offsets, values, n, row, H, g):
    """Normal equations of the window; returns the sum of squared residuals."""
    H[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(n):
        e = values[i] - corner_row(offsets[i, 0], offsets[i, 1], p, crossing, row)
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
def _fit(p, n_free, crossing, offsets, values, n, row, H, trial_H, g, trial_g):
    """Levenberg-Marquardt over the first ``n_free`` parameters, in place; returns the cost, -1 without convergence."""
    damping = 1e-3
    cost = _normals(p, crossing, offsets, values, n, row, H, g)
    trial = np.empty(9)
    for _ in range(40):
        step = g.copy()
        if not scaled_solve(H, n_free, damping, step):
            damping = max(damping * 10.0, 1e-6)
            continue
        trial[:] = p
        for a in range(n_free):
            trial[a] += step[a, 0]
        trial[6] = min(max(trial[6], log(0.2)), log(12.0))
        trial_cost = _normals(trial, crossing, offsets, values, n, row, trial_H, trial_g)
        small = abs(trial[0] - p[0]) + abs(trial[1] - p[1]) < 2e-5
        if trial_cost <= cost:
            gain = cost - trial_cost
            p[:], H[:], g[:], cost = trial, trial_H, trial_g, trial_cost
            damping *= 0.2
            if small and gain <= 1e-6 * cost + 1e-12:
                return cost
        else:
            if small:
                return cost
            damping *= 6.0
    return -1.0


@njit(cache=True, nogil=True, error_model="numpy")
def fit_corners(image, start, directions, blur, shapes, crossing, max_shift):
    """Fits every corner.

    image: (h, w) float. start: (n, 2) px. directions: (n, 2) angles of the two edges, the second clockwise (in the
    image) of the first. blur: (n,) px. shapes: (n, 4), see ``_window``.
    Returns p (n, 9) with absolute u, v; covariance (n, 2, 2) of u, v; number of pixels; residual rms; status (n,)
    0 good, 1 at the border, 2 too few pixels, 3 no convergence, 4 went away from the start.
    """
    count = start.shape[0]
    out, cov = np.zeros((count, 9)), np.zeros((count, 2, 2))
    pixels, rms, status = np.zeros(count, np.int64), np.zeros(count), np.zeros(count, np.int64)
    offsets, values = np.empty((6000, 2)), np.empty(6000)
    row, H, trial_H, g, trial_g = np.empty(9), np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 1)), np.empty((9, 1))
    unit = np.empty((9, 2))
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
        n_free = 9 if n >= 45 else 7
        if n < 20:
            status[c] = 1 if n < 0 else 2
            continue
        _start_levels(p, crossing, offsets, values, n, row)
        cost = _fit(p, n_free, crossing, offsets, values, n, row, H, trial_H, g, trial_g)
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
        cov[c] = variance * unit[:2, :2]
        p[0] += cu
        p[1] += cv
        if abs(p[0] - start[c, 0]) + abs(p[1] - start[c, 1]) > max_shift:
            status[c] = 4
    return out, cov, pixels, rms, status
