"""Levels of tests, and biases that they find (Baarda 1968): by his B-method or at Sidak's (1967) family-wise level.

Beside them what every search for gross errors asks before it leaves something out: whether the residuals are so small
that nothing contradicts the sigmas, and whether sigmas that are too small explain them better than wrong observations.

A bias of non-centrality ``lambda0`` is found by a chi-square test of q components at level alpha with the given power.
Baarda's B-method asks the same lambda0 of all tests, so that a bias is found equally well whatever it is tested with.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Literal

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.testing.distributions import chi2, ncx2

Method = Literal["b", "sidak"]
CAUTIOUS = 0.5
"""Size of residuals over their sigmas, all together, below which no observation is left out."""
MANY = 20
"""Tests from which the typical one of a group, by itself, says whether its sigmas are too small."""
CLEARLY = 3.0
"""Sigmas of v'Pv up to which it may be noise."""
_OF_A_FACTOR = 0.001
_CAUCHY = 2.385**2


@frozen
class LevelOptions:
    """How observations are tested.

    family_alpha: error probability of all tests together, each of which has the same level (Sidak). alpha0: instead of
    that the level of a test of one component; tests of several components get the level at which they find the same
    non-centrality with the same power (Baarda's B-method). power: probability 1 - beta with which a minimal detectable
    bias is found.
    """

    family_alpha: float = 0.05
    alpha0: float | None = None
    power: float = 0.80

    @property
    def method(self) -> Method:
        """By whose levels."""
        return "sidak" if self.alpha0 is None else "b"


@frozen(eq=False)
class Criteria:
    """Levels, critical values of chi-square and non-centralities of tests with 1, 2, ... components; (q,), q >= 6."""

    options: LevelOptions
    n_tests: int
    alpha: FloatArray
    critical: FloatArray
    lambda0: FloatArray


def cautious(statistics: FloatArray, freedom: IntArray) -> bool:
    """Whether tests (n,), with all observations in, are together far smaller than chi-square (freedom (n,)) says.

    A single test presupposes the sigmas, and comes after that of the whole (Baarda 1968). Where residuals are less than
    half of what the sigmas allow, the largest does not contradict them, however far it stands out among the others.
    """
    known = np.isfinite(statistics) & (freedom > 0)
    total = float(freedom[known].sum())
    return total > 0.0 and float(statistics[known].sum()) < CAUTIOUS**2 * total


def variance_of(omega: float, redundancy: float) -> float:
    """The variance factor, 1 or more, by which a group's residuals are explained best.

    -2 ln likelihood is ``omega / f + redundancy ln f``, least at ``omega / redundancy``; a factor of its own costs what
    a wrong observation of one component costs.
    """
    if redundancy <= 0.0 or omega <= redundancy:
        return 1.0
    f = omega / redundancy
    return f if redundancy * (1.0 + np.log(f)) + float(chi2.isf(_OF_A_FACTOR, 1)) < omega else 1.0


def widening(omega: float, redundancy: float, statistics: FloatArray, freedom: IntArray) -> float:
    """What the limits of a group's tests (n,) grow by where its sigmas are taken as too small throughout; else 1.

    Only where its typical test says so too, and then by as much: what errors of other groups add to a test is in it.
    Nothing is said of a group with the redundancy of a single observation or two: there one error shows in all tests.
    """
    if redundancy < 2.0 * float(freedom.max(initial=0)) + 0.5:
        return 1.0
    typical = typical_factor(statistics, freedom)
    factor = variance_of(omega, redundancy)
    return max(factor, typical) if typical > 1.0 and factor > 1.0 else 1.0


def cost_of_leaving_out(statistics: FloatArray, freedom: IntArray, limits: FloatArray) -> float:
    """Of observations (n,) that are out, with their tests against what is left: each has a variance of its own.

    At least the limit of its test, so that with sigmas that are right an observation goes if and only if it fails.
    """
    T, q = np.nan_to_num(statistics), np.maximum(freedom, 1)
    own = q * (1.0 + np.log(np.maximum(T / q, 1.0))) + float(chi2.isf(_OF_A_FACTOR, 1))
    return float(np.sum(np.maximum(limits, own)))


def explanation_cost(groups: Iterable[tuple[float, float]], left_out: float) -> float:
    """-2 ln likelihood of what is left, (omega, redundancy) of every group, and the cost of what was left out.

    As ``J`` of :mod:`adjust.statistics.outliers.exchange`, where the sigmas of a group may also be too small
    throughout: the least cost tells wrong observations from wrong sigmas, also among few.
    """
    total = left_out
    for omega, redundancy in groups:
        f = variance_of(omega, redundancy)
        total += omega if f == 1.0 else redundancy * (1.0 + float(np.log(f))) + float(chi2.isf(_OF_A_FACTOR, 1))
    return total


def typical_factor(statistics: FloatArray, freedom: IntArray) -> float:
    """How much larger than chi-square's median the typical of tests (n,) is, at least 1; also without any.

    freedom: (n,), 0 where nothing is tested.
    """
    ratio = statistics / _of_kinds(lambda kinds: chi2.ppf(0.5, kinds), freedom)
    known = np.isfinite(ratio) & (freedom > 0)
    n, n_larger = int(np.count_nonzero(known)), int(np.count_nonzero(known & (ratio > 1.0)))
    if 2 * n_larger < max(1, n):  # neither is the middle one
        return 1.0
    return max(1.0, float(np.median(ratio[known])))


def _of_kinds(quantile: Callable[[FloatArray], FloatArray], freedom: IntArray) -> FloatArray:
    """A quantile for each of these degrees of freedom (n,), of 0 as of 1: of a million tests there are few kinds."""
    kinds = np.arange(int(freedom.max(initial=1)) + 1)
    found = np.asarray(quantile(np.maximum(kinds, 1)))
    if freedom.size and freedom.min() == kinds[-1]:
        return np.broadcast_to(found[-1], freedom.shape)
    return np.asarray(found[freedom])


def cauchy_weights(squares: FloatArray) -> FloatArray:
    """Of a robust solution, by squares over their expectation (Huber 1981, 7.8; the constant is Zhang's, 1997)."""
    return np.asarray(1.0 / (1.0 + squares / _CAUCHY))


def sidak(family_alpha: float, n_tests: int) -> float:
    """Level of one of ``n_tests`` independent tests that together have the level ``family_alpha``."""
    return float(-np.expm1(np.log1p(-family_alpha) / max(1, n_tests)))


def is_noise(omega: float, redundancy: float, sigmas: float) -> bool:
    """Whether a square sum is within so many of its own sigmas of what is expected of it (chi-square)."""
    r = max(redundancy, 1.0)
    return omega < r + sigmas * float(np.sqrt(2.0 * r))


def contradicting(whole: tuple[float, float], parts: Iterable[tuple[float, float]]) -> tuple[float, float]:
    """Square sum and redundancy of what contradicts: the whole, or where that is noise, its parts that are not, if any.

    A part that many others dilute shows by itself: beside what theirs may be by chance, nothing would explain it.
    """
    clear = [part for part in parts if not is_noise(*part, CLEARLY)] if is_noise(*whole, CLEARLY) else []
    return (sum(omega for omega, _ in clear), sum(r for _, r in clear)) if clear else whole


def limits(family_alpha: float, freedom: IntArray, n_tests: int) -> FloatArray:
    """What one of ``n_tests`` chi-square tests of these degrees of freedom (n,) exceeds at Sidak's level."""
    return _of_kinds(lambda kinds: chi2.isf(sidak(family_alpha, n_tests), kinds), freedom)


@lru_cache(maxsize=1024)
def noncentrality(alpha: float, power: float, q: int) -> float:
    """lambda0: chi-square (q, lambda0) exceeds the critical value of level ``alpha`` with probability ``power``."""
    critical = float(chi2.isf(alpha, q))
    high = 1.0
    while ncx2.sf(critical, q, high) < power:
        high *= 2.0
    return _crossing(lambda x: float(ncx2.sf(critical, q, x)) < power, high)


def _critical(lambda0: float, power: float, q: int) -> float:
    """What chi-square (q, lambda0) exceeds with probability ``power``."""
    high = lambda0 + q
    return _crossing(lambda x: float(ncx2.sf(x, q, lambda0)) > power, high)


def _crossing(beyond_low: Callable[[float], bool], high: float) -> float:
    """Where between 0 and ``high`` a predicate changes, to 1e-15 of ``high``, by bisection.

    ``scipy.optimize`` takes longer to load than a small survey to adjust.
    """
    low, at_low = 0.0, beyond_low(0.0)
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if beyond_low(middle) == at_low else (low, middle)
    return 0.5 * (low + high)


def criteria(options: LevelOptions, n_tests: int, most_components: int = 6) -> Criteria:
    """Of tests with 1 ... ``most_components`` (6 at least) components."""
    freedom = np.arange(1, max(6, most_components) + 1)
    if options.alpha0 is None:
        alpha = np.full(len(freedom), sidak(options.family_alpha, n_tests))
        lambda0 = np.array([noncentrality(float(alpha[0]), options.power, int(q)) for q in freedom])
        return Criteria(options, n_tests, alpha, np.asarray(chi2.isf(alpha, freedom)), lambda0)
    one = noncentrality(options.alpha0, options.power, 1)
    critical = np.array([_critical(one, options.power, int(q)) for q in freedom])
    return Criteria(options, n_tests, np.asarray(chi2.sf(critical, freedom)), critical, np.full(len(freedom), one))
