"""What is to be thought of an adjustment: which observations are suspect, and the verdict in words."""

from dataclasses import dataclass

import numpy as np

from adjust.distributions import chi2, norm
from adjust.result import Adjustment


@dataclass(frozen=True)
class Suspects:
    """Observations whose test exceeds its limit, all of them taken together at the level alpha (Bonferroni).

    Where sigma0 is above its limit, wrong sigmas would make everything suspect: the limits then grow with sigma0.

    image_limit: of the chi-square test with 2 degrees of freedom; w_limit: of |standardized residual| (Baarda).
    """

    alpha: float
    image_limit: float
    w_limit: float
    n_image: int
    n_other: int
    n_not_used: int


def suspects(adjustment: Adjustment) -> Suspects:
    """Count observations that disagree with the others more than chance allows."""
    test = adjustment.global_test
    image, others = adjustment.image_residuals, adjustment.other_residuals
    used = [o for o in others if o.used]
    n = max(int(image.used.sum()) + sum(len(o.components) for o in used), 1)
    alpha = test.alpha if test is not None else 0.05
    spread = adjustment.sigma0 if test is not None and test.omega > test.upper else 1.0
    image_limit, w_limit = spread**2 * float(chi2.isf(alpha / n, 2)), spread * float(norm.isf(alpha / (2 * n)))
    n_not_used = int((~image.used).sum()) + len(others) - len(used)
    n_other = sum(bool(np.nanmax(np.abs(o.standardized), initial=0.0) > w_limit) for o in used)
    n_image = int(((image.test > image_limit) & image.used).sum())
    return Suspects(alpha, image_limit, w_limit, n_image, n_other, n_not_used)


def verdict(adjustment: Adjustment, found: Suspects, n_unmet: int = 0) -> tuple[str, str]:
    """``passed``, ``check`` or ``failed``, and the reason in words; ``n_unmet``: tolerances that are not met."""
    test = adjustment.global_test
    if not adjustment.converged:
        return "failed", "The adjustment did not converge: the numbers below are no solution."
    if test is not None and test.omega > test.upper:
        return "failed", (
            f"Global test failed: residuals are {adjustment.sigma0:.2f} times what the sigmas of the observations "
            "allow. Look for blunders, wrong sigmas or a model that lacks something, starting with the groups."
        )
    if any(w.startswith("probable cause") for w in adjustment.warnings):
        return "check", "Observations contradict each other; the probable cause is named first among the warnings."
    if any(d.action == "rejected" for d in adjustment.decisions):
        return "check", "Gross errors were left out; what is left agrees. They are named among the warnings."
    if test is not None and test.omega < test.lower:
        return "check", (
            f"Global test failed on the low side: residuals are only {adjustment.sigma0:.2f} times the sigmas of the "
            "observations. The sigmas given are too large."
        )
    if test is None:
        return "check", "Nothing was tested: the survey has no redundant observations."
    if n_unmet:
        return "check", "Global test passed, but tolerances are not met; see the tolerances."
    if found.n_image + found.n_other:
        return "check", "Global test passed, but some observations disagree with the others; see the suspects."
    if adjustment.warnings:
        return "check", "Global test passed; please read the warnings."
    return "passed", "Observations, sigmas and model agree."
