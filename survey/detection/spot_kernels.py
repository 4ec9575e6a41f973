# mypy: ignore-errors
# (numba's decorator and its array arguments have no static types)
"""Compiled least-squares fit of luminous spots: a Gaussian integrated over the pixels, or a disc with a soft edge."""

from math import erfc, exp, log, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from adjust.compiling import njit
from adjust.model import FloatArray, IntArray
from survey.detection.solve_kernels import put_state, scaled_solve

GAUSSIAN, DISC = 0, 1
_ROOT_HALF = 0.7071067811865476


@njit(cache=True, nogil=True, error_model="numpy")
def _pdf(x):
    return 0.3989422804014327 * exp(-0.5 * x * x)


@njit(cache=True, nogil=True, error_model="numpy")
def _pixel_share(d, sigma):
    """Share of a Gaussian on a pixel at distance d from it in one direction, and its derivatives by d and log sigma."""
    a, b = (d - 0.5) / sigma, (d + 0.5) / sigma
    pa, pb = _pdf(a), _pdf(b)
    return 0.5 * (erfc(-b * _ROOT_HALF) - erfc(-a * _ROOT_HALF)), (pb - pa) / sigma, a * pa - b * pb


@njit(cache=True, nogil=True, error_model="numpy")
def spot_row(x, y, p, profile, row):
    """Grey value at (x, y) and its derivatives by p: u, v, background, amplitude, log widths u, v, log softness.

    Gaussian: amplitude is the flux, widths are standard deviations (no softness). Disc: amplitude is the step, widths
    are radii and the softness is the standard deviation of the blurred rim.
    """
    row[2] = 1.0
    row[6] = 0.0
    if profile == GAUSSIAN:
        gx, gxd, gxs = _pixel_share(x - p[0], exp(p[4]))
        gy, gyd, gys = _pixel_share(y - p[1], exp(p[5]))
        f = gx * gy
        row[0], row[1], row[3] = -p[3] * gxd * gy, -p[3] * gx * gyd, f
        row[4], row[5] = p[3] * gxs * gy, p[3] * gx * gys
        return p[2] + p[3] * f
    ru, rv, s = exp(p[4]), exp(p[5]), exp(p[6])
    ex, ey = (x - p[0]) / ru, (y - p[1]) / rv
    rho = max(sqrt(ex * ex + ey * ey), 1e-9)
    scale = sqrt(ru * rv) / s
    t = (rho - 1.0) * scale
    f = 0.5 * erfc(t * _ROOT_HALF)
    g = -p[3] * _pdf(t)
    row[0], row[1], row[3] = -g * scale * ex / (ru * rho), -g * scale * ey / (rv * rho), f
    row[4] = g * (0.5 * t - scale * ex * ex / rho)
    row[5] = g * (0.5 * t - scale * ey * ey / rho)
    row[6] = -g * t
    return p[2] + p[3] * f


@njit(cache=True, nogil=True, error_model="numpy")
def _normals(p, profile, xy, values, n, row, H, g):
    H[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(n):
        e = values[i] - spot_row(xy[i, 0], xy[i, 1], p, profile, row)
        cost += e * e
        for a in range(7):
            g[a, 0] += row[a] * e
            for b in range(7):
                H[a, b] += row[a] * row[b]
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def _minimise(p, profile, xy, values, n):
    """Levenberg-Marquardt in place. Returns cost (-1 without convergence) and the covariance of u, v (2, 2)."""
    n_free = 6 if profile == GAUSSIAN else 7
    row, H, g = np.empty(7), np.empty((7, 7)), np.empty((7, 1))
    trial, trial_H, trial_g, step = np.empty(7), np.empty((7, 7)), np.empty((7, 1)), np.empty((7, 1))
    cov = np.zeros((2, 2))
    cost, damping, done = _normals(p, profile, xy, values, n, row, H, g), 1e-3, False
    for _ in range(60):
        put_state(p, H, g, trial, trial_H, step)
        if not scaled_solve(H, n_free, damping, step):
            damping *= 10.0
            continue
        for a in range(n_free):
            trial[a] += step[a, 0]
        for a in range(4, 7):
            trial[a] = min(max(trial[a], log(0.15)), log(100.0))
        trial_cost = _normals(trial, profile, xy, values, n, row, trial_H, trial_g)
        small = abs(trial[0] - p[0]) + abs(trial[1] - p[1]) < 2e-5
        if trial_cost <= cost:
            put_state(trial, trial_H, trial_g, p, H, g)
            cost = trial_cost
            damping *= 0.2
        else:
            damping *= 6.0
        if small:
            done = True
            break
    unit = np.zeros((7, 2))
    unit[0, 0] = unit[1, 1] = 1.0
    if not done or not scaled_solve(H, n_free, 0.0, unit):
        return -1.0, cov
    for a in range(2):
        for b in range(2):
            cov[a, b] = unit[a, b] * (cost / (n - n_free))
    return cost, cov


@njit(cache=True, nogil=True, error_model="numpy")
def fit_spots(
    gray: npt.NDArray[Any], labels: npt.NDArray[Any], saturation: float, start: FloatArray, label: IntArray,
    diameter: FloatArray, peak: FloatArray, background: FloatArray,
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray, IntArray]:  # fmt: skip
    """Fits each spot with both profiles and keeps the better one.

    gray: (h, w). labels: (h, w) component of each pixel, 0 none; pixels of other components are left out, and so are
    those at or above ``saturation``. start: (n, 2) px. label, diameter (px), peak, background: (n,) of each spot.
    Returns p (n, 7) with absolute u, v; profile (n,), -1 where none converged; covariance (n, 2, 2); residual rms (n,);
    number of saturated pixels (n,).
    """
    count = start.shape[0]
    out, cov, rms = np.zeros((count, 7)), np.zeros((count, 2, 2)), np.zeros(count)
    best, saturated = np.full(count, -1), np.zeros(count, np.int64)
    for c in range(count):
        cu, cv = int(np.rint(start[c, 0])), int(np.rint(start[c, 1]))
        reach = int(np.ceil(diameter[c] + 3.0))
        xy, values = np.empty(((2 * reach + 1) ** 2, 2)), np.empty((2 * reach + 1) ** 2)
        n = 0
        for j in range(max(-reach, -cv), min(reach, gray.shape[0] - 1 - cv) + 1):
            for i in range(max(-reach, -cu), min(reach, gray.shape[1] - 1 - cu) + 1):
                other = labels[cv + j, cu + i]
                if i * i + j * j > reach * reach or (other != 0 and other != label[c]):
                    continue
                if gray[cv + j, cu + i] >= saturation:
                    saturated[c] += 1
                    continue
                xy[n, 0], xy[n, 1], values[n] = i, j, gray[cv + j, cu + i]
                n += 1
        if n < 14:
            continue
        lowest = -1.0
        for profile in (GAUSSIAN, DISC):
            p = np.empty(7)
            p[0], p[1], p[2] = start[c, 0] - cu, start[c, 1] - cv, background[c]
            width = max(diameter[c] / 2.355, 0.4)
            p[3] = peak[c] * 2.0 * np.pi * width * width if profile == GAUSSIAN else peak[c]
            p[4] = p[5] = log(width) if profile == GAUSSIAN else log(max(diameter[c] / 2.0, 0.5))
            p[6] = log(0.8)
            cost, here = _minimise(p, profile, xy, values, n)
            variance = cost / (n - (6 if profile == GAUSSIAN else 7))
            if cost >= 0.0 and (lowest < 0.0 or variance < lowest):
                lowest, best[c], rms[c] = variance, profile, sqrt(variance)
                out[c], cov[c] = p, here
        out[c, 0] += cu
        out[c, 1] += cv
    return out, best, cov, rms, saturated
