"""Control charts: whether a number that should stay the same from epoch to epoch does.

Individuals charts after Shewhart with two pairs of limits: from the sigmas that every epoch claims for its number, and
from the scatter of the numbers themselves. Centre and limits come from the epochs in control (phase I: the worst epoch
outside is set aside, one at a time), so that one bad epoch does not hide itself or another. Sources: Montgomery 2013,
Introduction to Statistical Quality Control, sections 6.2 and 6.4; runs: Nelson 1984, J. Quality Technology 16 (4).
A sigma a posteriori is itself estimated, by the sigma0 of its epoch: a deviation over it is Student's t with the
redundancy of that epoch, and is judged by the normal number that is as improbable.
"""


import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.testing.distributions import chi2, norm, student

WIDTH = 3.0
"""Limits in sigmas."""
ONE_SIDE, TREND = 9, 6
"""Epochs in a row on one side of the mean, or steadily up or down, that make a run (Nelson's rules 2 and 3)."""
_MEDIAN_RANGE = 0.9538725524
"""Median of |x1 - x2| of two normal numbers in their sigmas: sqrt(2) times the 75 % quantile of the normal."""


@frozen(eq=False)
class Series:
    """A number over the epochs: value and sigma (n,) in ``unit``, at ``epoch`` (n,), positions in the batch.

    freedom: (n,) of the sigma0 that scales each sigma; infinite where the sigma is known.
    """

    name: str
    unit: str
    epoch: IntArray
    value: FloatArray
    sigma: FloatArray
    freedom: FloatArray


@frozen
class Run:
    """Neighbours ``first`` to ``last`` (positions in the series) that chance hardly makes.

    kind: ``one_side`` of the mean, or ``rising``, ``falling``.
    """

    kind: str
    first: int
    last: int


@frozen(eq=False)
class Chart:
    """What the chart of a series says.

    mean, mean_sigma: weighted mean of the epochs in control, ``used`` (n,). deviation: (n,) from it over its sigma, as
    the normal number that is as improbable. by_sigma: (n,) half width of the limits
    from the epoch's own sigma; by_scatter: half width from the scatter, nan below three epochs. outside: (n,) beyond
    the limits of its own sigma; outside_scatter: (n,) beyond those of the scatter. runs: of Nelson.
    ratio: root mean square of deviations over their sigmas, of all epochs; 1 where sigmas can be believed. p: that
    chance makes it as large (chi-square, n - 1 degrees of freedom). slope, slope_sigma: per epoch; p_slope: of none.
    """

    series: Series
    used: BoolArray
    mean: float
    mean_sigma: float
    deviation: FloatArray
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


def chart(series: Series) -> Chart:
    """The control chart of a series of two epochs or more. Raises ValueError for fewer or a sigma that is not > 0."""
    x, s = series.value, series.sigma
    if len(x) < 2 or not (np.isfinite(x).all() and np.isfinite(s).all() and (s > 0.0).all()):
        raise ValueError(f"{series.name}: a chart needs two epochs or more, with values and sigmas")
    widths = _as_improbable(WIDTH, series.freedom)
    used = _in_control(x, s, widths / WIDTH)
    mean, variance = _mean(x[used], s[used])
    scale = _scatter(x[used])
    all_mean, _ = _mean(x, s)
    squares = float(np.sum(_as_normal((x - all_mean) / s, series.freedom) ** 2))
    slope, slope_sigma, slope_freedom = _slope(series.epoch.astype(float), x, s, series.freedom)
    # with its own part in the mean taken out: var(x_i - mean) = s_i^2 - var(mean), and plus where it has no part
    own = np.sqrt(np.maximum(s**2 + np.where(used, -variance, variance), 0.0))
    deviation = np.abs(x - mean)
    with np.errstate(invalid="ignore"):
        outside_scatter = deviation > WIDTH * scale
    return Chart(
        series, used, mean, float(np.sqrt(variance)), _as_normal((x - mean) / np.maximum(own, 1e-300), series.freedom),
        widths * own, WIDTH * scale, deviation > widths * own, outside_scatter,
        runs(x, mean), float(np.sqrt(squares / (len(x) - 1))), float(chi2.sf(squares, len(x) - 1)), slope, slope_sigma,
        2.0 * _tail(abs(slope) / slope_sigma, slope_freedom) if slope_sigma > 0.0 else float("nan"),
    )  # fmt: skip


def _tail(x: float, freedom: float) -> float:
    return float(student.sf(x, freedom) if np.isfinite(freedom) else norm.sf(x))


def _as_normal(x: FloatArray, freedom: FloatArray) -> FloatArray:
    """Numbers (n,) of Student's t as normal ones that are as improbable."""
    out, known = np.array(x, dtype=float), ~np.isfinite(freedom)
    tails = student.sf(np.abs(out[~known]), freedom[~known])
    out[~known] = np.sign(out[~known]) * norm.isf(np.maximum(tails, 1e-300))
    return out


def _as_improbable(width: float, freedom: FloatArray) -> FloatArray:
    """Half widths (n,) of Student's t that are as improbable as a normal one."""
    out, known = np.full(len(freedom), width), ~np.isfinite(freedom)
    out[~known] = -student.ppf(norm.sf(width), freedom[~known])
    return out


def _mean(x: FloatArray, s: FloatArray) -> tuple[float, float]:
    """Weighted mean and its variance."""
    w = s**-2.0
    return float(np.sum(w * x) / np.sum(w)), float(1.0 / np.sum(w))


def _in_control(x: FloatArray, s: FloatArray, wider: FloatArray) -> BoolArray:
    """Epochs inside both pairs of limits; at least half of them stay, whatever they do. wider: (n,) of own limits."""
    used = np.ones(len(x), dtype=np.bool_)
    while np.count_nonzero(used) > max(2, (len(x) + 1) // 2):
        mean, variance = _mean(x[used], s[used])
        own = wider * np.sqrt(np.maximum(s**2 - variance, 1e-300))
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


def _slope(at: FloatArray, x: FloatArray, s: FloatArray, freedom: FloatArray) -> tuple[float, float, float]:
    """Weighted straight line: slope per epoch, its sigma from the given ones, and the freedom of that.

    The freedom is that of Satterthwaite (Biometrics Bulletin 2, 1946). nan below three epochs.
    """
    if len(x) < 3:
        return float("nan"), float("nan"), float("inf")
    w = s**-2.0
    centred = at - np.sum(w * at) / np.sum(w)
    parts = w * centred**2
    sxx = float(np.sum(parts))
    unknown = float(np.sum(parts**2 / freedom))
    return float(np.sum(w * centred * x)) / sxx, sxx**-0.5, sxx**2 / unknown if unknown > 0.0 else float("inf")


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
