"""The distributions that tests and confidence regions need, by the names and signatures of ``scipy.stats``.

``scipy.stats`` takes longer to import than a small survey takes to adjust; SciPy's special functions compute the same.
Each tail is computed where it is small, so that a probability of 1e-300 keeps its digits. Numbers or arrays, broadcast.
"""

from typing import Any

import numpy as np
import scipy

Numbers = Any


class chi2:  # noqa: N801  # the name that statisticians and SciPy use
    """Chi-square with k degrees of freedom."""

    @staticmethod
    def ppf(p: Numbers, k: Numbers) -> Numbers:
        """Quantile of probability p below."""
        return 2.0 * scipy.special.gammaincinv(np.multiply(0.5, k), p)

    @staticmethod
    def isf(p: Numbers, k: Numbers) -> Numbers:
        """Quantile of probability p above."""
        return 2.0 * scipy.special.gammainccinv(np.multiply(0.5, k), p)

    @staticmethod
    def cdf(x: Numbers, k: Numbers) -> Numbers:
        """Probability below x."""
        return scipy.special.gammainc(np.multiply(0.5, k), np.maximum(0.0, np.multiply(0.5, x)))

    @staticmethod
    def sf(x: Numbers, k: Numbers) -> Numbers:
        """Probability above x."""
        return scipy.special.gammaincc(np.multiply(0.5, k), np.maximum(0.0, np.multiply(0.5, x)))


class ncx2:  # noqa: N801  # the name that statisticians and SciPy use
    """Non-central chi-square with k degrees of freedom and non-centrality c."""

    @staticmethod
    def sf(x: Numbers, k: Numbers, c: Numbers) -> Numbers:
        """Probability above x, to 1e-15: enough for the power of a test, not for far tails."""
        return 1.0 - scipy.special.chndtr(x, k, c)


class norm:  # noqa: N801  # the name that statisticians and SciPy use
    """The standard normal distribution."""

    @staticmethod
    def ppf(p: Numbers) -> Numbers:
        """Quantile of probability p below."""
        return scipy.special.ndtri(p)

    @staticmethod
    def isf(p: Numbers) -> Numbers:
        """Quantile of probability p above."""
        return -scipy.special.ndtri(p)

    @staticmethod
    def sf(x: Numbers) -> Numbers:
        """Probability above x."""
        return scipy.special.ndtr(np.negative(x))


class student:  # noqa: N801  # as the others
    """Student's t with k degrees of freedom."""

    @staticmethod
    def ppf(p: Numbers, k: Numbers) -> Numbers:
        """Quantile of probability p below."""
        return scipy.special.stdtrit(k, p)

    @staticmethod
    def sf(x: Numbers, k: Numbers) -> Numbers:
        """Probability above x."""
        return scipy.special.stdtr(k, np.negative(x))


class fisher:  # noqa: N801  # as the others
    """Fisher's F with m and n degrees of freedom."""

    @staticmethod
    def ppf(p: Numbers, m: Numbers, n: Numbers) -> Numbers:
        """Quantile of probability p below."""
        return scipy.special.fdtri(m, n, p)

    @staticmethod
    def sf(x: Numbers, m: Numbers, n: Numbers) -> Numbers:
        """Probability above x."""
        return scipy.special.fdtrc(m, n, x)


class beta:  # noqa: N801  # as the others
    """The beta distribution with shapes a and b: that of the order statistics of uniform numbers."""

    @staticmethod
    def ppf(p: Numbers, a: Numbers, b: Numbers) -> Numbers:
        """Quantile of probability p below."""
        return scipy.special.betaincinv(a, b, p)
