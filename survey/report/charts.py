"""Charts: residuals of a camera, quantiles, correlations, lines and dots over numbers, bars, what is seen when."""

from collections.abc import Callable, Sequence

import numpy as np
from markupsafe import Markup

from adjust.model.arrays import ranked
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import BoolArray, Camera, FloatArray, IntArray
from adjust.testing.distributions import beta, norm
from survey.report import drawing as d
from survey.report.language import esc, known, localised, t
from survey.report.markup import MINUS, count
from survey.solution.residual_tables import ImageRows
from survey.solution.statistics import CorrelationMatrix

WIDTH = 316.0
WIDE = 2 * WIDTH + 22.0
_MOST_ARROWS = 1500
_CELLS_ACROSS = 16
_ABOVE, _BELOW = 18.0, 26.0  # of the pictures of a camera
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 14.0, 26.0, 42.0  # of a chart over numbers


@frozen(eq=False)
class CameraResiduals:
    """Image points of one camera: ``uv``, ``residuals``, ``standardized`` (n, 2); ``used``, ``suspect`` (n,)."""

    camera_id: str
    size: tuple[int, int]
    uv: FloatArray
    residuals: FloatArray
    standardized: FloatArray
    used: BoolArray
    suspect: BoolArray


def camera_residuals(adjustment: Adjustment, rows: ImageRows, suspect: BoolArray, camera: Camera) -> CameraResiduals:
    """Of one of the cameras; ``suspect``: of all image points (N,)."""
    found = adjustment.image_residuals
    blocks = [i for i, b in enumerate(adjustment.survey.image_blocks) if b.camera_id == camera.camera_id]
    mine = _rows_of(blocks, found.block_ptr)
    return CameraResiduals(camera.camera_id, camera.image_size, rows.uv[mine], found.residuals[mine],
                           found.standardized[mine], found.used[mine], suspect[mine])  # fmt: skip


def _rows_of(blocks: Sequence[int], ptr: IntArray) -> IntArray | slice:
    """Rows of these blocks, as a slice where they follow each other: then nothing is copied."""
    if len(blocks) and blocks[-1] - blocks[0] == len(blocks) - 1:
        return slice(int(ptr[blocks[0]]), int(ptr[blocks[-1] + 1]))
    return np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(ptr[b], ptr[b + 1]) for b in blocks)])


def _frame(size: tuple[int, int], title: str) -> tuple[float, float, list[str]]:
    """Pixels of the picture per image pixel, height of the image, and the parts to start with."""
    scale = WIDTH / size[0]
    height = scale * size[1]
    frame = d.rect(0.5, _ABOVE, WIDTH - 1, height, d.FRAME, f' stroke="{d.FAINT}"')
    return scale, height, [d.heading(title), frame]


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
    ordinary = np.flatnonzero(c.used & ~c.suspect)
    n = len(ordinary)
    some = np.sort(np.random.default_rng(0).choice(n, _MOST_ARROWS, replace=False)) if n > _MOST_ARROWS else slice(None)
    shown = ordinary[some]
    grow = _arrow_scale(np.hypot(*c.residuals[shown].T), 15.0)
    origin = 0.5 * scale, _ABOVE + 0.5 * scale
    start = c.uv[shown] * scale + origin
    parts.append(d.arrows(start, start + grow * c.residuals[shown], d.ARROWS, 0.7))
    for mask, colour in ((~c.used, d.ORANGE), (c.used & c.suspect, d.RED)):
        few = np.flatnonzero(mask)[:_MOST_ARROWS]
        start, length = c.uv[few] * scale + origin, np.hypot(*c.residuals[few].T)[:, None]
        capped = start + grow * c.residuals[few] * np.minimum(1.0, 45.0 / np.maximum(grow * length, 1e-12))
        parts.append(d.arrows(start, capped, colour, 1.4, 4.0))
        parts += [d.dot(x, y, 1.8, colour) for x, y in start]
    said = "{shown} of {n} shown" if len(shown) < n else "all {n}"
    note = t(said, shown=count(len(shown)), n=count(n))
    parts += [_bar(_ABOVE + height + 14, grow), d.text(WIDTH, _ABOVE + height + 18, note, "end")]
    return d.svg(WIDTH, _ABOVE + height + _BELOW, parts, t("Residual vectors of camera {name}", name=c.camera_id))


def mean_field(c: CameraResiduals) -> Markup:
    """Mean residual per cell over the number of points per cell: what the lens model leaves over shows here."""
    scale, height, parts = _frame(c.size, t("Mean per cell, over the coverage"))
    nx = _CELLS_ACROSS
    ny = max(1, round(nx * c.size[1] / c.size[0]))
    cell = np.array([c.size[0] / nx, c.size[1] / ny])
    uv, residuals = c.uv[c.used], c.residuals[c.used]
    i, j = (np.clip(((uv[:, k] + 0.5) / cell[k]).astype(int), 0, most - 1) for k, most in ((0, nx), (1, ny)))
    flat = j * nx + i
    n = np.bincount(flat, minlength=nx * ny)
    total = np.column_stack([np.bincount(flat, residuals[:, k], nx * ny) for k in (0, 1)])
    peak, size = max(int(n.max(initial=0)), 1), cell * scale
    for k in np.flatnonzero(n):
        shade = 0.08 + 0.42 * np.sqrt(n[k] / peak)
        x, y = (k % nx) * size[0], _ABOVE + (k // nx) * size[1]
        parts.append(d.rect(x, y, size[0], size[1], d.BLUE, f' fill-opacity="{shade:.2f}"'))
    enough = np.flatnonzero(n >= 3)
    mean = total[enough] / n[enough, None]
    centre = np.column_stack([enough % nx + 0.5, enough // nx + 0.5]) * size + (0.0, _ABOVE)
    grow = _arrow_scale(np.hypot(*mean.T), 0.9 * size[0])
    parts.append(d.arrows(centre, centre + grow * mean, d.INK, 1.1, 3.5))
    filled = t("{k} of {n} cells hold points", k=np.count_nonzero(n), n=nx * ny)
    parts += [_bar(_ABOVE + height + 14, grow), d.text(WIDTH, _ABOVE + height + 18, filled, "end")]
    title = t("Mean residuals and coverage of camera {name}", name=c.camera_id)
    return d.svg(WIDTH, _ABOVE + height + _BELOW, parts, title)


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
    origin, base = np.array([0.5 * WIDE, _ABOVE + height]), _ABOVE + height
    parts = [d.heading(t("Standardized residuals, u and v"))]
    for left, tall in zip(edges[:-1], heights, strict=True):
        if tall > 0.0:
            at = origin + unit * (left, tall)
            parts.append(d.rect(at[0] + 0.3, at[1], WIDE / n_bins - 0.6, base - at[1], d.BARS))
    parts.append(d.polyline(origin + unit * np.column_stack([x, normal]), d.INK, 1.3))
    marks = ((origin[0] + unit[0] * tick, f"{tick}".replace("-", MINUS)) for tick in range(-4, 5))
    parts += d.axis_below(base, 0, WIDE, marks)
    outside = int(np.count_nonzero(np.abs(w) > reach))
    if outside:
        parts.append(d.text(WIDE, _ABOVE + 12, t("{n} beyond ±5", n=count(outside)), "end", colour=d.RED))
    label = origin + unit * (0.98, 0.27)
    parts.append(d.text(label[0], label[1], t("normal"), colour=d.INK, size=10))
    title = t("Histogram of standardized residuals of camera {name}", name=c.camera_id)
    return d.svg(WIDE, base + _BELOW, parts, title)


def heat_map(m: CorrelationMatrix) -> Markup:
    """The matrix as cells; labels where there is room for them."""
    n, left = len(m.labels), 150.0
    cell = min(18.0, 620.0 / max(n, 1))
    size = n * cell
    parts = [d.rect(left, 4, size, size, d.PAPER, f' stroke="{d.FAINT}"')]
    # one path per shade keeps a matrix of a hundred rows small
    across = [f"M{left + j * cell:.1f} " for j in range(n)]
    down = [f"{4 + i * cell:.1f}h{cell:.1f}v{cell:.1f}h-{cell:.1f}z" for i in range(n)]
    shade = np.clip(np.round(20.0 * m.matrix), -20, 20).astype(int)
    for value in np.unique(shade[shade != 0]).tolist():
        cells = "".join(across[j] + down[i] for i, j in np.argwhere(shade == value).tolist())
        colour = d.BLUE if value > 0 else d.RED
        parts.append(f'<path d="{cells}" fill="{colour}" fill-opacity="{abs(value) / 20.0:.2f}"/>')
    for at in (*m.starts, n):
        parts.append(d.line(left + at * cell, 4, left + at * cell, 4 + size, d.GREY, 0.6))
        parts.append(d.line(left, 4 + at * cell, left + size, 4 + at * cell, d.GREY, 0.6))
    ends = (*m.starts[1:], n)
    for name, start, end in zip(m.names, m.starts, ends, strict=True):
        if (end - start) * cell >= 9.0:
            y = 4 + 0.5 * (start + end) * cell + 3.5
            parts.append(d.text(left - 6, y, " ".join((known(name[0].replace("_", " ")), *name[1:])), "end", 9.5))
    return d.svg(left + size + 4, size + 8, parts, t("Correlations"))


def quantiles(name: str, w: FloatArray) -> Markup:
    """A Q-Q plot of values; the band is that of order statistics (beta distribution)."""
    n, side, pad = len(w), 240.0, 26.0
    keep = np.unique(np.concatenate([np.arange(min(n, 40)), np.linspace(0, n - 1, 160).astype(int),
                                     np.arange(max(0, n - 40), n)]))  # fmt: skip
    rank = keep + 1.0
    x = norm.ppf((rank - 0.375) / (n + 0.25))
    low, high = norm.ppf(beta.ppf([[0.025], [0.975]], rank, n + 1 - rank))
    reach = max(3.0, float(np.ceil(max(abs(x[0]), min(6.0, float(np.abs(w).max()))))))
    unit, middle = (side - 2 * pad) / (2 * reach), 0.5 * side

    def at(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.column_stack([middle + unit * a, middle + 8 - unit * np.clip(b, -reach, reach)])

    band = np.concatenate([at(x, low), at(x, high)[::-1]])
    parts = [
        d.heading(name),
        d.polygon(band, d.BAND, "none"),
        d.polyline(at(np.array([-reach, reach]), np.array([-reach, reach])), d.GREY, 0.9),
    ]
    parts += [d.dot(a, b, 1.7, d.BLUE) for a, b in at(x, ranked(w, keep))]
    for tick in range(-int(reach) + 1, int(reach), 2 if reach > 4 else 1):
        parts.append(d.text(middle + unit * tick, side - 4, f"{tick}".replace("-", MINUS), "middle", 9))
        parts.append(d.text(4, middle + 11 - unit * tick, f"{tick}".replace("-", MINUS), "start", 9))
    return d.svg(side, side, parts, t("Quantiles of group {name}", name=name))


@frozen(eq=False)
class Series:
    """Points (n,) over (n,); ``line`` joined, else dots; error: (n,) bars of one sigma, or None."""

    label: str
    x: FloatArray
    y: FloatArray
    colour: str
    line: bool = False
    error: FloatArray | None = None
    dashed: bool = False


def chart(
    series: Sequence[Series], title: str, x_label: str, y_label: str, width: float = 350.0, height: float = 260.0,
    least: float | None = 0.0,
) -> Markup:  # fmt: skip
    """A plot with linear axes. ``least``: where the y axis begins, None: at the data."""
    xs = np.concatenate([s.x for s in series])
    tops = np.concatenate([s.y + (0 if s.error is None else s.error) for s in series])
    lows = np.concatenate([s.y - (0 if s.error is None else s.error) for s in series])
    x0, x1 = (0.0 if least == 0.0 else float(xs.min())), float(xs.max())
    y0, y1 = (float(np.nanmin(lows)) if least is None else least), float(np.nanmax(tops))
    y1 += (16.0 + 14.0 * len(series)) / (height - _TOP - _BOTTOM) * (y1 - y0) or 1.0  # room for the labels
    x1 = x1 if x1 > x0 else x0 + 1.0

    across, up = d.Scale(x0, x1, _LEFT, width - _RIGHT), d.Scale(y0, y1, height - _BOTTOM, _TOP)

    def place(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.column_stack([across(x), up(y)])

    parts = [d.heading(title), *d.axis_left(_LEFT, up.ticks(), width - _RIGHT)]
    parts += d.axis_below(height - _BOTTOM, _LEFT, width - _RIGHT, across.ticks())
    parts.append(d.text(0.5 * (_LEFT + width), height - 8, x_label, "middle", 10.5, d.INK))
    parts.append(d.text(13, 0.5 * (height + _TOP - _BOTTOM), y_label, "middle", 10.5, d.INK,
                        f' transform="rotate(-90 13 {0.5 * (height + _TOP - _BOTTOM):.1f})"'))  # fmt: skip
    for s in series:
        parts += _drawn(s, place)
    named = [(s.label, s.colour, _dash(s) if s.line else None) for s in series if s.label]
    parts += d.legend(_LEFT + 8, _TOP + 9, named)
    return d.svg(width, height, parts, title)


def _dash(s: Series) -> str:
    return ' stroke-dasharray="5 3"' if s.dashed else ""


def _drawn(s: Series, place: Callable[[FloatArray, FloatArray], FloatArray]) -> list[str]:
    good = np.isfinite(s.y)
    xy = place(s.x[good], s.y[good])
    if s.line:
        return [d.polyline(xy, s.colour, 1.6, _dash(s))]
    parts = []
    if s.error is not None:
        low, high = place(s.x[good], (s.y - s.error)[good]), place(s.x[good], (s.y + s.error)[good])
        parts += [d.line(a[0], a[1], b[0], b[1], s.colour, 1.0) for a, b in zip(low, high, strict=True)]
    return parts + [d.dot(x, y, 2.6, s.colour) for x, y in xy]


def bars(names: Sequence[str], values: FloatArray, title: str, colours: Sequence[str], width: float = 560.0) -> Markup:
    """Horizontal bars, one a line, with their values."""
    high, left = max(float(np.max(values, initial=0.0)), 1e-300), 230.0
    parts = [d.heading(title)]
    for i, (name, value, colour) in enumerate(zip(names, values.tolist(), colours, strict=True)):
        y = 24 + 17 * i
        parts.append(d.text(left - 6, y + 10, name[:38], "end", 10.5, d.INK))
        parts.append(d.rect(left, y + 1, max(value, 0.0) / high * (width - left - 60), 12, colour))
        parts.append(d.text(left + max(value, 0.0) / high * (width - left - 60) + 5, y + 10, f"{value:.3g}", size=10))
    return d.svg(width, 30 + 17 * len(names), parts, title)


def seen_map(rows: Sequence[str], columns: Sequence[str], counts: FloatArray, title: str) -> Markup:
    """Which row (camera and target) shows how many points at which epoch (column); (r, c), zero is left blank."""
    left, cell, top = 150.0, max(6.0, min(16.0, 760.0 / max(len(columns), 1))), 22.0
    high = max(float(counts.max(initial=0.0)), 1.0)
    parts = [d.heading(title)]
    for i, row in enumerate(rows):
        y = top + 17 * i
        parts.append(d.text(left - 6, y + 12, row[:24], "end", 10.5, d.INK))
        for j, value in enumerate(counts[i].tolist()):
            look = f' fill-opacity="{0.25 + 0.75 * value / high:.2f}"' if value else ""
            tip = f"{row}, {columns[j]}: {int(value)} points" if value else f"{row}, {columns[j]}: nothing"
            box = d.rect(left + j * cell, y, cell - 1, 15, d.BLUE if value else d.EMPTY, look)
            parts.append(f"<g>{box}<title>{esc(tip)}</title></g>")
    step = max(1, int(np.ceil(34.0 / cell)))
    below = top + 17 * len(rows) + 12
    for j in range(0, len(columns), step):
        parts.append(d.text(left + (j + 0.5) * cell, below, columns[j], "middle", 9.5))
    return d.svg(max(left + cell * len(columns) + 20, 5.6 * len(title)), below + 6, parts, title)

