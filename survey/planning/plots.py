"""Plots of plans as SVG: lines and dots over numbers, bars of gains, a map of what is seen at which epoch."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.model import FloatArray
from survey.report import drawing as d
from survey.report.language import esc

_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 14.0, 26.0, 42.0


@dataclass(frozen=True, eq=False)
class Series:
    """Points (n,) over (n,); ``line`` joined, else dots; error: (n,) bars of one sigma, or None."""

    label: str
    x: FloatArray
    y: FloatArray
    colour: str
    line: bool = False
    error: FloatArray | None = None
    dashed: bool = False


def ticks(low: float, high: float, most: int = 5) -> FloatArray:
    """Round numbers between two values."""
    step = d.round_below((high - low) / max(most - 1, 1))
    while (high - low) / step > most:
        step = d.round_below(step * 2.6)
    marks = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step
    return np.asarray(marks + 0.0)  # adding zero takes the sign off a negative one


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

    def place(x: FloatArray, y: FloatArray) -> FloatArray:
        px = _LEFT + (x - x0) / (x1 - x0) * (width - _LEFT - _RIGHT)
        py = height - _BOTTOM - (y - y0) / (y1 - y0) * (height - _TOP - _BOTTOM)
        return np.column_stack([px, py])

    parts = [d.text(0, 12, title, colour=d.INK, size=11.5)]
    for v in ticks(y0, y1):
        y = place(np.array([x0]), np.array([v]))[0, 1]
        parts += [d.line(_LEFT, y, width - _RIGHT, y, d.FAINT, 0.8), d.text(_LEFT - 5, y + 4, f"{v:g}", "end", 10)]
    for v in ticks(x0, x1):
        x = place(np.array([v]), np.array([y0]))[0, 0]
        parts.append(d.line(x, height - _BOTTOM, x, height - _BOTTOM + 4, d.GREY))
        parts.append(d.text(x, height - _BOTTOM + 16, f"{v:g}", "middle", 10))
    parts.append(d.line(_LEFT, height - _BOTTOM, width - _RIGHT, height - _BOTTOM, d.GREY))
    parts.append(d.text(0.5 * (_LEFT + width), height - 8, x_label, "middle", 10.5, d.INK))
    parts.append(d.text(13, 0.5 * (height + _TOP - _BOTTOM), y_label, "middle", 10.5, d.INK,
                        f' transform="rotate(-90 13 {0.5 * (height + _TOP - _BOTTOM):.1f})"'))  # fmt: skip
    for s in series:
        parts += _drawn(s, place)
    for i, s in enumerate(s for s in series if s.label):
        y = _TOP + 9 + 14 * i
        mark = d.line(_LEFT + 8, y - 4, _LEFT + 24, y - 4, s.colour, 1.6, _dash(s)) if s.line else ""
        mark = mark or d.dot(_LEFT + 16, y - 4, 2.6, s.colour)
        parts += [mark, d.text(_LEFT + 29, y, s.label, size=10, colour=d.INK)]
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
    parts = [d.text(0, 12, title, colour=d.INK, size=11.5)]
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
    parts = [d.text(0, 12, title, colour=d.INK, size=11.5)]
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

