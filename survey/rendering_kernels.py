# mypy: ignore-errors
# (numba's decorator and its array arguments have no static types)
"""Compiled inner loops of the renderer: rays of the pixels' corners, and grey values of planes of cells."""

from typing import Any

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray

_BLOCK = 6  # pixels; lens distortion is linear across a block to far below the size of a sub-pixel


@njit(cache=True, nogil=True, error_model="numpy")
def _distort(x, y, d):
    """OpenCV's forward model (k1 k2 p1 p2 k3 k4 k5 k6) and its Jacobian: xd, yd, dxx, dxy, dyx, dyy."""
    r2 = x * x + y * y
    a = 1.0 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))
    b = 1.0 + r2 * (d[5] + r2 * (d[6] + r2 * d[7]))
    da = d[0] + r2 * (2.0 * d[1] + 3.0 * r2 * d[4])
    db = d[5] + r2 * (2.0 * d[6] + 3.0 * r2 * d[7])
    g = a / b
    dg = 2.0 * (da * b - a * db) / (b * b)
    xd = x * g + 2.0 * d[2] * x * y + d[3] * (r2 + 2.0 * x * x)
    yd = y * g + d[2] * (r2 + 2.0 * y * y) + 2.0 * d[3] * x * y
    dxx = g + x * x * dg + 2.0 * d[2] * y + 6.0 * d[3] * x
    dxy = x * y * dg + 2.0 * d[2] * x + 2.0 * d[3] * y
    dyy = g + y * y * dg + 6.0 * d[2] * y + 2.0 * d[3] * x
    return xd, yd, dxx, dxy, dxy, dyy


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_corner_rays(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, d: FloatArray
) -> FloatArray:
    """Undistorted x/z, y/z of all pixel corners, (height + 1, width + 1, 2); NaN where the model cannot be inverted."""
    rays = np.empty((height + 1, width + 1, 2))
    for j in range(height + 1):
        yd = (j - 0.5 - cy) / fy
        for i in range(width + 1):
            xd = (i - 0.5 - cx) / fx
            # Newton from the distorted point approaches the first root monotonically for one dominating coefficient
            x, y, step = xd, yd, 1.0
            for _ in range(30):
                px, py, dxx, dxy, dyx, dyy = _distort(x, y, d)
                det = dxx * dyy - dxy * dyx
                if not det > 1e-3:
                    break
                ex, ey = xd - px, yd - py
                sx, sy = (dyy * ex - dxy * ey) / det, (dxx * ey - dyx * ex) / det
                x, y, step = x + sx, y + sy, abs(sx) + abs(sy)
                if step < 1e-13:
                    break
            if step > 1e-9:
                x, y = np.nan, np.nan
            rays[j, i, 0], rays[j, i, 1] = x, y
    return rays


@njit(cache=True, nogil=True, error_model="numpy")
def _cell(edges, n, value):
    """Index of the interval of ``edges[: n + 1]`` that holds ``value``, -1 outside."""
    if not (edges[0] <= value < edges[n]):
        return -1
    low, high = 0, n
    while high - low > 1:
        middle = (low + high) // 2
        if value < edges[middle]:
            high = middle
        else:
            low = middle
    return low


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(x, y, facet_from_ray, counts, x_edges, y_edges, cells, background, candidates, n_candidates):
    """Grey value of one ray: the nearest facet that it meets."""
    best, gray = 0.0, background
    for k in range(n_candidates):
        f = candidates[k]
        m = facet_from_ray[f]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2]
        if w <= best:
            continue
        i = _cell(x_edges[f], counts[f, 0], (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / w)
        if i < 0:
            continue
        j = _cell(y_edges[f], counts[f, 1], (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / w)
        if j < 0:
            continue
        best, gray = w, cells[f, j, i]
    return gray


@njit(cache=True, nogil=True, error_model="numpy")
def _footprint(corners, m, count, x_edges, y_edges):
    """How a pixel meets a facet: kind (0 not at all, 1 inside one cell, 2 mixed), 1 / depth, cell column and row."""
    x_low, x_high, y_low, y_high, depth = np.inf, -np.inf, np.inf, -np.inf, 0.0
    for k in range(4):
        x, y = corners[k, 0], corners[k, 1]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2]
        if not w > 0.0:
            return 2, 0.0, 0, 0
        a, b = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / w, (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / w
        x_low, x_high, y_low, y_high = min(x_low, a), max(x_high, a), min(y_low, b), max(y_high, b)
        depth += 0.25 * w
    n_x, n_y = count[0], count[1]
    if x_high <= x_edges[0] or x_low >= x_edges[n_x] or y_high <= y_edges[0] or y_low >= y_edges[n_y]:
        return 0, 0.0, 0, 0
    i, j = _cell(x_edges, n_x, x_low), _cell(y_edges, n_y, y_low)
    if i < 0 or j < 0 or x_high > x_edges[i + 1] or y_high > y_edges[j + 1]:
        return 2, depth, 0, 0
    return 1, depth, i, j


@njit(cache=True, nogil=True, error_model="numpy")
def _classify(corners, facet_from_ray, bounds, counts, x_edges, y_edges, cells, background, candidates):
    """What a quadrangle of rays (4, 2) sees: number of candidates, whether to sample them, else its grey value."""
    x_low, x_high = corners[:, 0].min(), corners[:, 0].max()
    y_low, y_high = corners[:, 1].min(), corners[:, 1].max()
    n, mixed, nearest, gray = 0, False, 0.0, background
    for f in range(facet_from_ray.shape[0]):
        if x_high < bounds[f, 0] or x_low > bounds[f, 1] or y_high < bounds[f, 2] or y_low > bounds[f, 3]:
            continue
        kind, depth, i, j = _footprint(corners, facet_from_ray[f], counts[f], x_edges[f], y_edges[f])
        if kind == 0:
            continue
        candidates[n] = f
        n += 1
        mixed = mixed or kind == 2
        if kind == 1 and depth > nearest:
            nearest, gray = depth, cells[f, j, i]
    return n, mixed, gray


@njit(cache=True, nogil=True, error_model="numpy")
def _inner(corners, s, t, out):
    """Ray at (s, t) in the unit square between four corner rays (bilinear)."""
    w0, w1, w2, w3 = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    out[0] = w0 * corners[0, 0] + w1 * corners[1, 0] + w2 * corners[2, 0] + w3 * corners[3, 0]
    out[1] = w0 * corners[0, 1] + w1 * corners[1, 1] + w2 * corners[2, 1] + w3 * corners[3, 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_pixel(corners, sub, n, facets, background, samples, candidates, ray, out):
    """Grey values of the n x n sub-pixels of one pixel."""
    facet_from_ray, bounds, counts, x_edges, y_edges, cells = facets
    for b in range(n):
        for a in range(n):
            for k in range(4):
                _inner(corners, (a + k % 2) / n, (b + k // 2) / n, sub[k])
            m, mixed, gray = _classify(
                sub, facet_from_ray, bounds, counts, x_edges, y_edges, cells, background, candidates
            )
            if mixed:
                gray = 0.0
                for k in range(samples.shape[0]):
                    _inner(sub, samples[k, 0], samples[k, 1], ray)
                    gray += _sample(
                        ray[0], ray[1], facet_from_ray, counts, x_edges, y_edges, cells, background, candidates, m
                    )
                gray /= samples.shape[0]
            out[b, a] = gray


@njit(cache=True, nogil=True, error_model="numpy")
def draw_facets(
    rays: FloatArray, n: int, facets: tuple[Any, ...], background: float, samples: FloatArray
) -> FloatArray:
    """Grey values (n * height, n * width) of sub-pixels, each integrated over its area.

    Blocks of pixels and pixels that see a single cell are filled at once. rays: of the pixel corners.
    facets: facet_from_ray (F, 3, 3), bounding boxes in x/z, y/z (F, 4), numbers of cells (F, 2), edges, grey values.
    samples: (S, 2) offsets in the unit square of a sub-pixel.
    """
    facet_from_ray, bounds, counts, x_edges, y_edges, cells = facets
    height, width = rays.shape[0] - 1, rays.shape[1] - 1
    image = np.full((n * height, n * width), np.float32(background), np.float32)
    corners, sub, ray = np.empty((4, 2)), np.empty((4, 2)), np.empty(2)
    candidates = np.empty(facet_from_ray.shape[0], np.int64)
    for v0 in range(0, height, _BLOCK):
        for u0 in range(0, width, _BLOCK):
            v1, u1 = min(v0 + _BLOCK, height), min(u0 + _BLOCK, width)
            corners[0], corners[1], corners[2], corners[3] = rays[v0, u0], rays[v0, u1], rays[v1, u0], rays[v1, u1]
            if not np.isnan(corners).any():
                _, mixed, gray = _classify(
                    corners, facet_from_ray, bounds, counts, x_edges, y_edges, cells, background, candidates
                )
                if not mixed:
                    image[n * v0 : n * v1, n * u0 : n * u1] = gray
                    continue
            for v in range(v0, v1):
                for u in range(u0, u1):
                    corners[0], corners[1] = rays[v, u], rays[v, u + 1]
                    corners[2], corners[3] = rays[v + 1, u], rays[v + 1, u + 1]
                    if np.isnan(corners).any():
                        continue
                    _, mixed, gray = _classify(
                        corners, facet_from_ray, bounds, counts, x_edges, y_edges, cells, background, candidates
                    )
                    pixel = image[n * v : n * v + n, n * u : n * u + n]
                    if mixed:
                        _draw_pixel(corners, sub, n, facets, background, samples, candidates, ray, pixel)
                    else:
                        pixel[:] = gray
    return image
