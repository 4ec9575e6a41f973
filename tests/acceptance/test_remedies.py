"""Terms beside the usual unknowns against the truth: ``tests/acceptance/remedies.py`` at length."""

import pytest
from scipy.stats import binom, chi2

from tests.acceptance.remedies import REMEDIES, outcome
from tests.sizes import size

REPEATS = size(100)
LEVEL = 1e-3  # of every statement here


@pytest.mark.slow
@pytest.mark.parametrize("name", list(REMEDIES))
def test_terms_are_found_with_true_sigmas_and_not_where_there_are_none(name: str) -> None:
    o = outcome(REMEDIES[name](), REPEATS)
    low, high = chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], o.k * REPEATS)
    assert low <= o.squares.sum() <= high
    assert o.covered >= binom.ppf(LEVEL, REPEATS, 0.95)
    assert o.found >= binom.ppf(LEVEL, REPEATS, 0.8)
    assert o.false <= binom.isf(LEVEL, REPEATS, 0.05)
