"""Plots of times over sizes as SVG, both axes logarithmic, and the exponents of growth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adjust.model.survey import FloatArray
from survey.notebook.plots import standalone
from survey.report import drawing as d

WIDTH, HEIGHT = 660.0, 360.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 62.0, 226.0, 28.0, 44.0
_COLOURS = (*d.CAMERA_COLOURS, "#000000", "#999999")


@dataclass(frozen=True, eq=False)
class Line:
    """Values (n,) over sizes (n,), nan where there is none; ``ours`` is drawn thicker."""

    label: str
    sizes: FloatArray
    values: FloatArray
    ours: bool = False

    @property
    def exponent(self) -> float:
        """Power of the size with which the value grows: slope of the straight line through the logarithms."""
        good = np.isfinite(self.values) & (self.values > 0.0)
        if good.sum() < 2:
            return float("nan")
        return float(np.polyfit(np.log(self.sizes[good]), np.log(self.values[good]), 1)[0])

    @property
    def legend(self) -> str:
        """Label with the exponent."""
        return self.label if np.isnan(self.exponent) else f"{self.label} ({self.exponent:.2f})"


@dataclass(frozen=True)
class _Axes:
    x: tuple[float, float]
    y: tuple[float, float]

    def place(self, x: FloatArray, y: FloatArray) -> FloatArray:
        across = np.log(x / self.x[0]) / np.log(self.x[1] / self.x[0])
        up = np.log(y / self.y[0]) / np.log(self.y[1] / self.y[0])
        return np.column_stack([_LEFT + across * (WIDTH - _LEFT - _RIGHT), HEIGHT - _BOTTOM - up * _TALL])


_TALL = HEIGHT - _TOP - _BOTTOM


def loglog(lines: Sequence[Line], title: str, x_label: str, y_label: str) -> str:
    """A picture of all lines, those without a value left out; the exponents stand in the legend."""
    lines = [line for line in lines if np.isfinite(line.values).any()]
    sizes = np.concatenate([line.sizes for line in lines])
    values = np.concatenate([line.values[np.isfinite(line.values)] for line in lines])
    axes = _Axes((sizes.min() / 1.1, sizes.max() * 1.1 + 1e-12), (values.min() / 1.4, values.max() * 1.4))
    parts = [d.rect(0, 0, WIDTH, HEIGHT, "#ffffff"), d.text(_LEFT, 16, title, colour=d.INK, size=12.5)]
    parts += _grid(axes, np.unique(sizes))
    parts.append(d.text(_LEFT + 0.5 * (WIDTH - _LEFT - _RIGHT), HEIGHT - 8, x_label, "middle", 11, d.INK))
    middle = _TOP + 0.5 * _TALL
    parts.append(d.text(14, middle, y_label, "middle", 11, d.INK, f' transform="rotate(-90 14 {middle:.1f})"'))
    for i, line in enumerate(lines):
        colour, good = _COLOURS[i % len(_COLOURS)], np.isfinite(line.values)
        xy = axes.place(line.sizes[good], line.values[good])
        parts.append(d.polyline(xy, colour, 2.4 if line.ours else 1.3))
        parts += [d.dot(x, y, 3.4 if line.ours else 2.6, colour) for x, y in xy]
        y = _TOP + 12 + 17 * i
        parts.append(d.line(WIDTH - _RIGHT + 12, y - 4, WIDTH - _RIGHT + 32, y - 4, colour, 2.4 if line.ours else 1.3))
        parts.append(d.text(WIDTH - _RIGHT + 37, y, line.legend, size=10.5, colour=d.INK))
    return d.svg(WIDTH, HEIGHT, parts, title)


def _grid(axes: _Axes, sizes: FloatArray) -> list[str]:
    parts = []
    for power in range(int(np.floor(np.log10(axes.y[0]))), int(np.ceil(np.log10(axes.y[1]))) + 1):
        for mantissa in (1.0, 2.0, 5.0):
            v = mantissa * 10.0**power
            if axes.y[0] <= v <= axes.y[1]:
                y = axes.place(np.array([axes.x[0]]), np.array([v]))[0, 1]
                parts.append(d.line(_LEFT, y, WIDTH - _RIGHT, y, d.GREY if mantissa == 1.0 else d.FAINT, 0.6))
                parts.append(d.text(_LEFT - 5, y + 4, f"{v:g}", "end", 10))
    last = -np.inf
    for v in sizes.tolist():
        x = axes.place(np.array([v]), np.array([axes.y[0]]))[0, 0]
        parts.append(d.line(x, _TOP, x, HEIGHT - _BOTTOM, d.FAINT, 0.6))
        if x - last > 34.0:
            parts.append(d.text(x, HEIGHT - _BOTTOM + 15, f"{v:g}", "middle", 10))
            last = x
    return parts


def write(folder: Path, name: str, picture: str) -> None:
    """Write a picture as ``benchmark-NAME.svg``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"benchmark-{name}.svg").write_text(standalone(picture) + "\n", encoding="utf-8")
