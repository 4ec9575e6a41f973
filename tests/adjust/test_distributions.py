"""Distributions against SciPy's own, in both tails and with many or few degrees of freedom."""

import numpy as np
import pytest
import scipy.stats as st

from adjust.testing import distributions as d

P = np.array([1e-12, 1e-6, 1e-3, 0.05, 0.5, 0.95, 0.999])
K = np.array([1, 2, 3, 6, 40, 5000])[:, None]
X = np.array([1e-3, 0.5, 1.0, 3.0, 20.0, 200.0])


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (d.chi2.ppf(P, K), st.chi2.ppf(P, K)),
        (d.chi2.isf(P, K), st.chi2.isf(P, K)),
        (d.chi2.cdf(X, K), st.chi2.cdf(X, K)),
        (d.chi2.sf(X, K), st.chi2.sf(X, K)),
        (d.norm.ppf(P), st.norm.ppf(P)),
        (d.norm.isf(P), st.norm.isf(P)),
        (d.norm.sf(X), st.norm.sf(X)),
        (d.student.ppf(P, K), st.t.ppf(P, K)),
        (d.student.sf(X, K), st.t.sf(X, K)),
        (d.beta.ppf(P, 3, K), st.beta.ppf(P, 3, K)),
        (d.student.sf(2.0, np.inf), st.norm.sf(2.0)),
        (d.fisher.ppf(P, 3, K), st.f.ppf(P, 3, K)),
        (d.fisher.sf(X, 3, K), st.f.sf(X, 3, K)),
    ],
)
def test_same_as_scipy(ours: np.ndarray, theirs: np.ndarray) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=2e-8, atol=1e-290)


def test_power_of_a_test() -> None:
    np.testing.assert_allclose(d.ncx2.sf(X, 2.0, 12.0), st.ncx2.sf(X, 2.0, 12.0), rtol=1e-10, atol=1e-13)


def test_far_tails_keep_their_digits() -> None:
    assert d.chi2.sf(1300.0, 3) == pytest.approx(st.chi2.sf(1300.0, 3), rel=1e-9)
    assert 0.0 < d.chi2.sf(1300.0, 3) < 1e-270
    assert d.chi2.sf(-1.0, 2) == 1.0
    assert isinstance(float(d.chi2.isf(1e-290, 2)), float)
