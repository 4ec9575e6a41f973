"""Levels of tests, and biases that they find (Baarda 1968): by his B-method or at Sidak's (1967) family-wise level.

A bias of non-centrality ``lambda0`` is found by a chi-square test of q components at level alpha with the given power.
Baarda's B-method asks the same lambda0 of all tests, so that a bias is found equally well whatever it is tested with.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from adjust.distributions import chi2, ncx2
from adjust.statistics.result import Criteria, LevelOptions


def sidak(family_alpha: float, n_tests: int) -> float:
    """Level of one of ``n_tests`` independent tests that together have the level ``family_alpha``."""
    return float(-np.expm1(np.log1p(-family_alpha) / max(1, n_tests)))


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
    if options.method == "sidak":
        alpha = np.full(len(freedom), sidak(options.family_alpha, n_tests))
        lambda0 = np.array([noncentrality(float(alpha[0]), options.power, int(q)) for q in freedom])
        return Criteria(options, n_tests, alpha, np.asarray(chi2.isf(alpha, freedom)), lambda0)
    one = noncentrality(options.alpha0, options.power, 1)
    critical = np.array([_critical(one, options.power, int(q)) for q in freedom])
    return Criteria(options, n_tests, np.asarray(chi2.sf(critical, freedom)), critical, np.full(len(freedom), one))
