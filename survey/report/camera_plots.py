"""Three pictures of a camera's residuals: every vector, the mean per cell over the coverage, the histogram."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.model import BoolArray, FloatArray
from survey.report import drawing as d
from survey.report.language import localised, t
from survey.report.markup import MINUS, count

WIDTH = 316.0
WIDE = 2 * WIDTH + 22.0
_MOST_ARROWS = 1500
_CELLS_ACROSS = 16
_TOP, _BOTTOM = 18.0, 26.0


@dataclass(frozen=True, eq=False)
class CameraResiduals:
    """Image points of one camera: ``uv``, ``residuals``, ``standardized`` (n, 2); ``used``, ``suspect`` (n,)."""

    camera_id: str
    size: tuple[int, int]
    uv: FloatArray
    residuals: FloatArray
    standardized: FloatArray
    used: BoolArray
    suspect: BoolArray


def _frame(size: tuple[int, int], heading: str) -> tuple[float, float, list[str]]:
    """Pixels of the picture per image pixel, height of the image, and the parts to start with."""
    scale = WIDTH / size[0]
    height = scale * size[1]
    return (
        scale,
        height,
        [
            d.text(0, 11, heading, colour=d.INK, size=11.5),
            d.rect(0.5, _TOP, WIDTH - 1, height, d.FRAME, f' stroke="{d.FAINT}"'),
        ],
    )


def _arrow_scale(lengths: FloatArray, wanted: float) -> float:
    """Picture units per pixel of residual, so that long residuals (95 %) reach ``wanted``."""
    long = float(np.percentile(lengths, 95)) if lengths.size else 0.0
    return wanted / long if long > 0.0 else 1.0


def _bar(y: float, scale: float) -> str:
    step = d.round_below(60.0 / scale)
    return d.scale_bar(1, y, step * scale, localised(f"{step:g} px"))


def vector_field(c: CameraResiduals) -> Markup:
    """Residual vectors at the observed points; suspects red and all drawn, not used ones orange."""
    scale, height, parts = _frame(c.size, t("Residuals"))
    rank = np.random.default_rng(0).permutation(len(c.uv))
    ordinary = c.used & ~c.suspect
    shown = ordinary & np.isin(np.arange(len(c.uv)), rank[np.isin(rank, np.flatnonzero(ordinary))][:_MOST_ARROWS])
    grow = _arrow_scale(np.hypot(*c.residuals[ordinary].T), 15.0)
    start = c.uv * scale + (0.5 * scale, _TOP + 0.5 * scale)
    end = start + grow * c.residuals
    parts.append(d.arrows(start[shown], end[shown], d.ARROWS, 0.7))
    for mask, colour in ((~c.used, d.ORANGE), (c.used & c.suspect, d.RED)):
        few = np.flatnonzero(mask)[:_MOST_ARROWS]
        length = np.hypot(*c.residuals[few].T)[:, None]
        capped = start[few] + grow * c.residuals[few] * np.minimum(1.0, 45.0 / np.maximum(grow * length, 1e-12))
        parts.append(d.arrows(start[few], capped, colour, 1.4, 4.0))
        parts += [d.dot(x, y, 1.8, colour) for x, y in start[few]]
    note = (
        t("{shown} of {n} shown", shown=count(int(shown.sum())), n=count(int(ordinary.sum())))
        if shown.sum() < ordinary.sum()
        else t("all {n}", n=count(int(ordinary.sum())))
    )
    parts += [_bar(_TOP + height + 14, grow), d.text(WIDTH, _TOP + height + 18, note, "end")]
    return d.svg(WIDTH, _TOP + height + _BOTTOM, parts, t("Residual vectors of camera {name}", name=c.camera_id))


def mean_field(c: CameraResiduals) -> Markup:
    """Mean residual per cell over the number of points per cell: what the lens model leaves over shows here."""
    scale, height, parts = _frame(c.size, t("Mean per cell, over the coverage"))
    nx = _CELLS_ACROSS
    ny = max(1, round(nx * c.size[1] / c.size[0]))
    cell = np.array([c.size[0] / nx, c.size[1] / ny])
    uv, residuals = c.uv[c.used], c.residuals[c.used]
    ij = np.clip(((uv + 0.5) / cell).astype(int), 0, (nx - 1, ny - 1))
    flat = ij[:, 1] * nx + ij[:, 0]
    n = np.bincount(flat, minlength=nx * ny)
    total = np.column_stack([np.bincount(flat, residuals[:, k], nx * ny) for k in (0, 1)])
    peak, size = max(int(n.max(initial=0)), 1), cell * scale
    for k in np.flatnonzero(n):
        shade = 0.08 + 0.42 * np.sqrt(n[k] / peak)
        x, y = (k % nx) * size[0], _TOP + (k // nx) * size[1]
        parts.append(d.rect(x, y, size[0], size[1], d.BLUE, f' fill-opacity="{shade:.2f}"'))
    enough = np.flatnonzero(n >= 3)
    mean = total[enough] / n[enough, None]
    centre = np.column_stack([enough % nx + 0.5, enough // nx + 0.5]) * size + (0.0, _TOP)
    grow = _arrow_scale(np.hypot(*mean.T), 0.9 * size[0])
    parts.append(d.arrows(centre, centre + grow * mean, d.INK, 1.1, 3.5))
    filled = t("{k} of {n} cells hold points", k=np.count_nonzero(n), n=nx * ny)
    parts += [_bar(_TOP + height + 14, grow), d.text(WIDTH, _TOP + height + 18, filled, "end")]
    title = t("Mean residuals and coverage of camera {name}", name=c.camera_id)
    return d.svg(WIDTH, _TOP + height + _BOTTOM, parts, title)


def histogram(c: CameraResiduals) -> Markup:
    """Standardized residuals (u and v together) against the normal distribution they should have."""
    reach, n_bins, height = 5.0, 50, 118.0
    w = c.standardized[c.used].ravel()
    w = w[np.isfinite(w)]
    n, edges = np.histogram(w, n_bins, (-reach, reach))
    heights = n / max(w.size, 1) / (edges[1] - edges[0])
    x = np.linspace(-reach, reach, 101)
    normal = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    unit = np.array([WIDE / (2 * reach), -(height - 4) / (1.08 * max(float(heights.max()), float(normal.max())))])
    origin, base = np.array([0.5 * WIDE, _TOP + height]), _TOP + height
    parts = [d.text(0, 11, t("Standardized residuals, u and v"), colour=d.INK, size=11.5)]
    for left, tall in zip(edges[:-1], heights, strict=True):
        if tall > 0.0:
            at = origin + unit * (left, tall)
            parts.append(d.rect(at[0] + 0.3, at[1], WIDE / n_bins - 0.6, base - at[1], d.BARS))
    parts.append(d.polyline(origin + unit * np.column_stack([x, normal]), d.INK, 1.3))
    parts.append(d.line(0, base, WIDE, base))
    for tick in range(-4, 5):
        at = origin[0] + unit[0] * tick
        parts += [d.line(at, base, at, base + 3), d.text(at, base + 14, f"{tick}".replace("-", MINUS), "middle", 10)]
    outside = int(np.count_nonzero(np.abs(w) > reach))
    if outside:
        parts.append(d.text(WIDE, _TOP + 12, t("{n} beyond ±5", n=count(outside)), "end", colour=d.RED))
    label = origin + unit * (0.98, 0.27)
    parts.append(d.text(label[0], label[1], t("normal"), colour=d.INK, size=10))
    title = t("Histogram of standardized residuals of camera {name}", name=c.camera_id)
    return d.svg(WIDE, base + _BOTTOM, parts, title)
