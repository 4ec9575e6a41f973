"""A control chart as SVG."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from adjust.model.survey import FloatArray
from survey.batch.control import WIDTH, Chart
from survey.report import drawing as d
from survey.report.language import esc, localised, t
from survey.report.markup import MINUS, value_text

_WIDE, _HIGH = 540.0, 178.0
_LEFT, _RIGHT, _TOP, _BASE = 58.0, 8.0, 22.0, 26.0


def control_chart(c: Chart, names: Sequence[str], failed: Sequence[int], title: str) -> Markup:
    """Values as deviations from the mean, limits from sigmas (band) and from the scatter (dashed), alarms in red.

    names: of all epochs of the batch. failed: positions of epochs that have no result, crossed at the bottom.
    """
    n = len(names)
    step = (_WIDE - _LEFT - _RIGHT) / max(n, 1)
    deviation = c.series.value - c.mean
    reach = _reach(c, deviation)
    middle = _TOP + 0.5 * (_HIGH - _TOP - _BASE)
    unit = 0.5 * (_HIGH - _TOP - _BASE) / reach
    x = np.asarray(_LEFT + (c.series.epoch + 0.5) * step, dtype=float)
    y = np.asarray(middle - unit * np.clip(deviation, -reach, reach), dtype=float)
    parts = [_heading(c, title), _band(x, middle, unit * np.minimum(c.by_sigma, reach), step)]
    parts += _lines(c, middle, unit, reach)
    parts += _runs(c, x, y)
    parts += [d.polyline(np.column_stack([x, y]), d.TRACE, 0.8)]
    for i in range(len(x)):
        bar = unit * c.series.sigma[i]
        ends = np.clip([y[i] - bar, y[i] + bar], _TOP, _HIGH - _BASE)
        out = c.outside[i] or (np.isfinite(c.by_scatter) and c.outside_scatter[i])
        colour = d.RED if c.outside[i] else d.ORANGE if out else d.BLUE
        parts += [d.line(x[i], ends[0], x[i], ends[1], colour, 0.9), _point(c, i, x[i], y[i], colour, names)]
    parts += _names(c, x, y, names)
    parts += [_cross(_LEFT + (k + 0.5) * step, _HIGH - _BASE + 5) for k in failed]
    parts += _ticks(names, step)
    return d.svg(_WIDE, _HIGH, parts, t("Control chart of {name}", name=title))


def _reach(c: Chart, deviation: FloatArray) -> float:
    """Half the height in the series' unit: all limits, and what is outside up to six times as far."""
    limits = [float(np.max(c.by_sigma)), c.by_scatter if np.isfinite(c.by_scatter) else 0.0]
    most = float(np.max(np.abs(deviation) + c.series.sigma))
    return max(1.08 * min(max(most, *limits), 6.0 * max(limits)), 1e-300)


def _heading(c: Chart, title: str) -> str:
    mean = value_text(c.mean, c.mean_sigma)
    said = t("mean {mean} {unit}", mean=mean, unit=c.series.unit)
    return d.heading(title) + d.text(_WIDE - _RIGHT, 12, said, "end")


def _band(x: FloatArray, middle: float, half: FloatArray, step: float) -> str:
    """Three own sigmas of each epoch about the mean, stepped."""
    at = np.column_stack([x - 0.5 * step, x + 0.5 * step]).ravel()
    up, down = np.repeat(middle - half, 2), np.repeat(middle + half, 2)
    outline = np.concatenate([np.column_stack([at, up]), np.column_stack([at, down])[::-1]])
    return d.polygon(outline, d.BAND, "none")


def _lines(c: Chart, middle: float, unit: float, reach: float) -> list[str]:
    right = _WIDE - _RIGHT
    parts = [d.line(_LEFT, middle, right, middle, d.GREY, 0.9), d.text(_LEFT - 5, middle + 4, "0", "end", 10)]
    if np.isfinite(c.by_scatter) and 0.0 < c.by_scatter <= reach:
        for sign in (1.0, -1.0):
            at = middle - sign * unit * c.by_scatter
            parts.append(d.line(_LEFT, at, right, at, d.ORANGE, 0.9, ' stroke-dasharray="5 4"'))
    tick = d.round_below(0.8 * reach)
    shown = localised(f"{tick:.4g}")
    marks = ((middle - unit * tick, "+" + shown), (middle + unit * tick, MINUS + shown))
    return [*parts, *d.axis_left(_LEFT, marks), d.text(_LEFT - 5, _TOP + 1, c.series.unit, "end", 10)]


def _runs(c: Chart, x: FloatArray, y: FloatArray) -> list[str]:
    return [
        d.polyline(np.column_stack([x, y])[r.first : r.last + 1], d.RUN, 4.0, ' stroke-opacity="0.6"')
        for r in c.runs
    ]


def _point(c: Chart, i: int, x: float, y: float, colour: str, names: Sequence[str]) -> str:
    value, sigma = c.series.value[i], c.series.sigma[i]
    words = f"{names[int(c.series.epoch[i])]}: {value_text(value, sigma)} ± {value_text(sigma, sigma)} {c.series.unit}"
    hollow = "" if c.used[i] else f' stroke="{colour}" stroke-width="1.2"'
    dot = d.dot(x, y, 2.6, colour if c.used[i] else d.PAPER, hollow)
    return dot.replace("/>", f"><title>{esc(words)}</title></circle>")


def _names(c: Chart, x: FloatArray, y: FloatArray, names: Sequence[str]) -> list[str]:
    """The names of what is outside, worst first, where there is room."""
    own = WIDTH * np.abs(c.series.value - c.mean) / np.maximum(c.by_sigma, 1e-300)
    out: list[str] = []
    taken: list[float] = []
    for i in np.argsort(-own).tolist():
        if not c.outside[i] or len(out) == 6:
            break
        if all(abs(x[i] - k) > 72 for k in taken):
            taken.append(x[i])
            side = "end" if x[i] > 0.7 * _WIDE else "start"
            below = y[i] < _TOP + 12
            at = x[i] + (5 if side == "start" else -5), y[i] + (11 if below else -4)
            out.append(d.text(at[0], at[1], names[int(c.series.epoch[i])], side, 9.5, d.RED))
    return out


def _cross(x: float, y: float) -> str:
    return d.line(x - 3, y - 3, x + 3, y + 3, d.RED, 1.2) + d.line(x - 3, y + 3, x + 3, y - 3, d.RED, 1.2)


def _ticks(names: Sequence[str], step: float) -> list[str]:
    """Names of a few epochs below."""
    n = len(names)
    marks = ((_LEFT + (k + 0.5) * step, names[k]) for k in sorted({0, n // 2, n - 1} if n > 2 else set(range(n))))
    return d.axis_below(_HIGH - _BASE, _LEFT, _WIDE - _RIGHT, marks, ends=n > 2)
