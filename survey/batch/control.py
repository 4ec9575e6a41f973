"""Control charts: whether a number that should stay the same from epoch to epoch does.

Individuals charts after Shewhart with two pairs of limits: from the sigmas that every epoch claims for its number, and
from the scatter of the numbers themselves. Centre and limits come from the epochs in control (phase I: the worst epoch
outside is set aside, one at a time), so that one bad epoch does not hide itself or another. Sources: Montgomery 2013,
Introduction to Statistical Quality Control, sections 6.2 and 6.4; runs: Nelson 1984, J. Quality Technology 16 (4).
"""

from dataclasses import dataclass

import numpy as np

from adjust.distributions import chi2, norm
from adjust.model import BoolArray, FloatArray, IntArray

WIDTH = 3.0
"""Limits in sigmas."""
ONE_SIDE, TREND = 9, 6
"""Epochs in a row on one side of the mean, or steadily up or down, that make a run (Nelson's rules 2 and 3)."""
_MEDIAN_RANGE = 0.9538725524
"""Median of |x1 - x2| of two normal numbers in their sigmas: sqrt(2) times the 75 % quantile of the normal."""


@dataclass(frozen=True, eq=False)
class Series:
    """A number over the epochs: value and sigma (n,) in ``unit``, at ``epoch`` (n,), positions in the batch."""

    name: str
    unit: str
    epoch: IntArray
    value: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Run:
    """Neighbours ``first`` to ``last`` (positions in the series) that chance hardly makes.

    kind: ``one_side`` of the mean, or ``rising``, ``falling``.
    """

    kind: str
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Chart:
    """What the chart of a series says.

    mean, mean_sigma: weighted mean of the epochs in control, ``used`` (n,). by_sigma: (n,) half width of the limits
    from the epoch's own sigma; by_scatter: half width from the scatter, nan below three epochs. outside: (n,) beyond
    the limits of its own sigma; outside_scatter: (n,) beyond those of the scatter. runs: of Nelson.
    ratio: root mean square of deviations over their sigmas, of all epochs; 1 where sigmas can be believed. p: that
    chance makes it as large (chi-square, n - 1 degrees of freedom). slope, slope_sigma: per epoch; p_slope: of none.
    """

    series: Series
    used: BoolArray
    mean: float
    mean_sigma: float
    by_sigma: FloatArray
    by_scatter: float
    outside: BoolArray
    outside_scatter: BoolArray
    runs: tuple[Run, ...]
    ratio: float
    p: float
    slope: float
    slope_sigma: float
    p_slope: float

    @property
    def alarms(self) -> int:
        """Epochs outside of either pair of limits, and runs."""
        return int(np.count_nonzero(self.outside | self.outside_scatter)) + len(self.runs)


def chart(series: Series) -> Chart:
    """The control chart of a series of two epochs or more. Raises ValueError for fewer or a sigma that is not > 0."""
    x, s = series.value, series.sigma
    if len(x) < 2 or not (np.isfinite(x).all() and np.isfinite(s).all() and (s > 0.0).all()):
        raise ValueError(f"{series.name}: a chart needs two epochs or more, with values and sigmas")
    used = _in_control(x, s)
    mean, variance = _mean(x[used], s[used])
    scale = _scatter(x[used])
    all_mean, _ = _mean(x, s)
    squares = float(np.sum(((x - all_mean) / s) ** 2))
    slope, slope_sigma = _slope(series.epoch.astype(float), x, s)
    # with its own part in the mean taken out: var(x_i - mean) = s_i^2 - var(mean), and plus where it has no part
    by_sigma = WIDTH * np.sqrt(np.maximum(s**2 + np.where(used, -variance, variance), 0.0))
    deviation = np.abs(x - mean)
    with np.errstate(invalid="ignore"):
        outside_scatter = deviation > WIDTH * scale
    return Chart(
        series, used, mean, float(np.sqrt(variance)), by_sigma, WIDTH * scale, deviation > by_sigma, outside_scatter,
        runs(x, mean), float(np.sqrt(squares / (len(x) - 1))), float(chi2.sf(squares, len(x) - 1)), slope, slope_sigma,
        float(2.0 * norm.sf(abs(slope) / slope_sigma)) if slope_sigma > 0.0 else float("nan"),
    )  # fmt: skip


def _mean(x: FloatArray, s: FloatArray) -> tuple[float, float]:
    """Weighted mean and its variance."""
    w = s**-2.0
    return float(np.sum(w * x) / np.sum(w)), float(1.0 / np.sum(w))


def _in_control(x: FloatArray, s: FloatArray) -> BoolArray:
    """Epochs inside both pairs of limits; at least half of them stay, whatever they do."""
    used = np.ones(len(x), dtype=np.bool_)
    while np.count_nonzero(used) > max(2, (len(x) + 1) // 2):
        mean, variance = _mean(x[used], s[used])
        own = np.sqrt(np.maximum(s**2 - variance, 1e-300))
        scale = _scatter(x[used])
        # an epoch is set aside where it leaves both what it claims and what the others do
        spread = np.fmax(own, scale if np.isfinite(scale) else 0.0)
        distance = np.where(used, np.abs(x - mean) / spread, 0.0)
        worst = int(np.argmax(distance))
        if distance[worst] <= WIDTH:
            break
        used[worst] = False
    return used


def _scatter(x: FloatArray) -> float:
    """Sigma of single numbers from the median of the moving range, which single outliers do not move; nan below 3."""
    return float(np.median(np.abs(np.diff(x))) / _MEDIAN_RANGE) if len(x) > 2 else float("nan")


def _slope(t: FloatArray, x: FloatArray, s: FloatArray) -> tuple[float, float]:
    """Weighted straight line: slope per epoch and its sigma from the given ones; nan below three epochs."""
    if len(x) < 3:
        return float("nan"), float("nan")
    w = s**-2.0
    centred = t - np.sum(w * t) / np.sum(w)
    sxx = float(np.sum(w * centred**2))
    return float(np.sum(w * centred * x)) / sxx, sxx**-0.5


def runs(x: FloatArray, mean: float) -> tuple[Run, ...]:
    """The longest runs of each kind."""
    side, step = np.sign(x - mean), np.sign(np.diff(x))
    out = [Run("one_side", a, b) for a, b, sign in _stretches(side) if sign and b - a + 1 >= ONE_SIDE]
    for a, b, sign in _stretches(step):
        if sign and b - a + 2 >= TREND:  # k steps join k + 1 epochs
            out.append(Run("rising" if sign > 0 else "falling", a, b + 1))
    return tuple(sorted(out, key=lambda r: (r.first, r.last)))


def _stretches(signs: FloatArray) -> list[tuple[int, int, float]]:
    """First, last and sign of every stretch of equal signs."""
    if not len(signs):
        return []
    edges = np.flatnonzero(np.diff(signs)) + 1
    starts, ends = np.concatenate([[0], edges]), np.concatenate([edges, [len(signs)]]) - 1
    return [(int(a), int(b), float(signs[a])) for a, b in zip(starts, ends, strict=True)]
