"""Pieces of SVG: lines, labels, ellipses, axes, legends, scale bars, in coordinates of the picture, y down."""

from collections.abc import Iterable, Sequence

import numpy as np
from markupsafe import Markup

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.report.language import esc

# every colour of a picture has its counterpart on a dark page; a picture names no other one
INK, GREY, FAINT, PAPER, FRAME = "#1c2733", "#66727f", "#d5dbe1", "#ffffff", "#fbfcfd"
BLUE, RED, ORANGE, GREEN, PURPLE = "#2166ac", "#c0392b", "#d98200", "#2f7d4f", "#7a3e9d"
GRID, BAND, EMPTY, BODY = "#e3e8ed", "#e3ebf3", "#eef1f4", "#4d5b69"
ARROWS, BARS, TRACE, RUN = "#5b87b5", "#9dbbda", "#9db4cc", "#f0b45c"
X_AXIS, Y_AXIS, Z_AXIS = "#b03030", GREEN, "#2b50a8"
CAMERA_COLOURS = (BLUE, "#b2560d", GREEN, PURPLE, "#a8324a", "#00798c", "#6b6b00", "#4a4a8a")
DARK = {
    INK: "#e4eaf0", GREY: "#9aa7b4", FAINT: "#3a4653", PAPER: "#12181f", FRAME: "#18202a",
    BLUE: "#6aa9e9", RED: "#f0776a", ORANGE: "#f2a93b", GREEN: "#63bd86", PURPLE: "#c293e4",
    GRID: "#2a343f", BAND: "#223040", EMPTY: "#222c37", BODY: "#a9b7c5",
    ARROWS: "#7fb0e0", BARS: "#41678d", TRACE: "#5f7d9c", RUN: "#b97a1c",
    X_AXIS: "#f08080", Z_AXIS: "#8ea8f5",
    "#b2560d": "#f0985a", "#a8324a": "#ee7f97", "#00798c": "#4fc3d6", "#6b6b00": "#c9c95a", "#4a4a8a": "#a5a5ee",
}  # fmt: skip
"""What each colour becomes where the reader's screen is dark: attributes of pictures stay those of paper."""


_ARROW = "M%.1f %.1fl%.1f %.1f"


def svg(width: float, height: float, parts: Iterable[str], title: str) -> Markup:
    """A picture with its accessible title."""
    return Markup(
        f'<svg viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}" role="img" '
        f'aria-label="{esc(title)}">{"".join(parts)}</svg>'
    )


ON_WHITE = "background:#fff;font-family:'Inter', 'Segoe UI', 'Helvetica Neue', 'Liberation Sans', Arial, sans-serif"
"""A font and a white ground for a picture by itself, also in a dark notebook."""


def standalone(picture: Markup, style: str = "") -> str:
    """A picture as a file of its own."""
    look = f' style="{style}"' if style else ""
    return str(picture).replace("<svg ", f'<svg xmlns="http://www.w3.org/2000/svg"{look} ', 1)


def text(
    x: float, y: float, words: str, anchor: str = "start", size: float = 11, colour: str = GREY, more: str = ""
) -> str:
    """A label; ``words`` are escaped here."""
    place = f'x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{colour}" text-anchor="{anchor}"'
    return f"<text {place}{more}>{esc(words)}</text>"


def line(x1: float, y1: float, x2: float, y2: float, colour: str = GREY, width: float = 1, more: str = "") -> str:
    """A straight line."""
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="{width:g}"{more}/>'


def rect(x: float, y: float, w: float, h: float, fill: str, more: str = "") -> str:
    """A rectangle."""
    return f'<rect x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}" fill="{fill}"{more}/>'


def _each(form: str, *columns: FloatArray) -> str:
    """A form filled with each row of numbers of the columns (n, k)."""
    rows = np.column_stack(columns)
    return form * len(rows) % tuple(rows.ravel().tolist())


def polygon(xy: FloatArray, fill: str, stroke: str, width: float = 1, more: str = "") -> str:
    """A closed outline."""
    points = _each(" %.1f,%.1f", xy)[1:]
    look = f'fill="{fill}" stroke="{stroke}" stroke-width="{width:g}" stroke-linejoin="round"'
    return f'<polygon points="{points}" {look}{more}/>'


def polyline(xy: FloatArray, stroke: str, width: float = 1, more: str = "") -> str:
    """An open line."""
    return polylines(xy[None], stroke, width, more)


def polylines(xy: FloatArray, stroke: str, width: float = 1, more: str = "") -> str:
    """Open lines (n, k, 2) of one look."""
    points = " ".join(["%.1f,%.1f"] * xy.shape[1])
    form = f'<polyline points="{points}" fill="none" stroke="{stroke}" stroke-width="{width:g}"{more}/>'
    return _each(form, xy.reshape(len(xy), 2 * xy.shape[1]))


def dot(x: float, y: float, radius: float, fill: str, more: str = "") -> str:
    """A filled circle."""
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}"{more}/>'


def half_axes(cov: FloatArray) -> FloatArray:
    """Half axes, the larger first, and direction (degrees) of the ellipses ``x' inv(cov) x = 1``: (n, 3)."""
    variances, vectors = np.linalg.eigh(cov)
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    return np.column_stack([np.sqrt(np.clip(variances, 0.0, None))[:, ::-1], angle])


def ellipse(centre: Sequence[float], axes: Sequence[float], fill: str, stroke: str) -> str:
    """One of the :func:`half_axes` about a centre, in the picture's units."""
    a, b, angle = axes
    return (
        f'<ellipse rx="{a:.1f}" ry="{b:.1f}" fill="{fill}" fill-opacity="0.16" stroke="{stroke}" stroke-width="0.9" '
        f'transform="translate({centre[0]:.1f} {centre[1]:.1f}) rotate({angle:.1f})"/>'
    )


def arrows(start: FloatArray, end: FloatArray, colour: str, width: float, head: float = 0.0) -> str:
    """Many arrows (n, 2) as one path; ``head`` is the length of the barbs, 0 for none."""
    if not len(start):
        return ""
    d = _each(_ARROW, start, end - start)
    if head > 0.0:
        delta = end - start
        angle = np.arctan2(delta[:, 1], delta[:, 0])
        size = np.minimum(head, 0.45 * np.hypot(delta[:, 0], delta[:, 1]))
        for side in (2.65, -2.65):
            barb = size[:, None] * np.column_stack([np.cos(angle + side), np.sin(angle + side)])
            d += _each(_ARROW, end, barb)
    return f'<path d="{d}" fill="none" stroke="{colour}" stroke-width="{width:g}" stroke-linecap="round"/>'


def round_below(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above ``value``."""
    if not (np.isfinite(value) and value > 0.0):
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value * (1 + 1e-9)))


def scale_bar(x: float, y: float, length: float, words: str) -> str:
    """A bar of ``length`` with its meaning to the right."""
    ends = line(x, y - 3, x, y + 3, INK) + line(x + length, y - 3, x + length, y + 3, INK)
    return line(x, y, x + length, y, INK, 1.4) + ends + text(x + length + 6, y + 3.8, words, colour=INK)


def heading(words: str) -> str:
    """The title of a picture, in its upper left corner."""
    return text(0, 12, words, colour=INK, size=11.5)


@frozen
class Scale:
    """A linear axis: values from ``low`` to ``high`` stand at ``start`` to ``end`` of the picture."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, values: FloatArray) -> FloatArray:
        """Where values stand."""
        return self.start + (values - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self, most: int = 5) -> list[tuple[float, str]]:
        """Round values on the axis, at most so many or one more: where they stand, and in words."""
        marks = ticks(self.low, self.high, most)
        return list(zip(self(marks).tolist(), (f"{v:g}" for v in marks), strict=True))


def ticks(low: float, high: float, most: int = 5) -> FloatArray:
    """Round numbers between two values."""
    step = round_below((high - low) / max(most - 1, 1))
    while (high - low) / step > most:
        step = round_below(step * 2.6)
    marks = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step
    return np.asarray(marks + 0.0)  # adding zero takes the sign off a negative one


def axis_below(
    y: float, left: float, right: float, marks: Iterable[tuple[float, str]], ends: bool = False
) -> list[str]:
    """A horizontal axis with words below its marks; ``ends``: those of the first and last stay between the marks."""
    marks = list(marks)
    parts = [line(left, y, right, y)]
    for i, (x, words) in enumerate(marks):
        side = "middle" if not ends or 0 < i < len(marks) - 1 else "end" if i else "start"
        parts += [line(x, y, x, y + 4), text(x, y + 16, words, side, 10)]
    return parts


def axis_left(x: float, marks: Iterable[tuple[float, str]], right: float | None = None) -> list[str]:
    """Words to the left of a vertical axis, beside short marks or, up to ``right``, lines of a grid."""
    parts = []
    for y, words in marks:
        parts.append(line(x - 3, y, x, y) if right is None else line(x, y, right, y, FAINT, 0.8))
        parts.append(text(x - 5, y + 4, words, "end", 10))
    return parts


def legend(x: float, y: float, entries: Sequence[tuple[str, str, str | None]]) -> list[str]:
    """Words with their colours, one below the other; the third is the look of a line, None for a dot."""
    parts = []
    for i, (words, colour, look) in enumerate(entries):
        at = y + 14 * i
        mark = dot(x + 8, at - 4, 2.6, colour) if look is None else line(x, at - 4, x + 16, at - 4, colour, 1.6, look)
        parts += [mark, text(x + 21, at, words, size=10, colour=INK)]
    return parts
