"""What is to be thought of an adjustment: which observations are suspect, and the verdict in words."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.result import CAUTIOUS_SIGMAS, Adjustment
from adjust.statistics.result import Consistency
from adjust.testing.criteria import limits


@frozen
class Suspects:
    """Observations whose test exceeds its limit, all of them taken together at the level alpha (Sidak 1967).

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
    image, others = adjustment.image_residuals, adjustment.other_arrays
    n = max(int(image.used.sum()) + int(others.n_components[others.used].sum()), 1)
    alpha = test.alpha if test is not None else 0.05
    spread = adjustment.sigma0 if test is not None and test.omega > test.upper else 1.0
    of_image, of_component = limits(alpha, np.array([2, 1]), n)
    image_limit, w_limit = spread**2 * float(of_image), spread * float(np.sqrt(of_component))
    n_not_used = int((~image.used).sum()) + int((~others.used).sum())
    n_other = int(np.count_nonzero(others.largest[others.used] > w_limit))
    n_image = int(((image.test > image_limit) & image.used).sum())
    return Suspects(alpha, image_limit, w_limit, n_image, n_other, n_not_used)


FITS, CAUTIOUS, MISFIT, UNTESTED = "fits", "cautious", "does_not_fit", "untested"
"""What ``summary.fit`` in a result file may be."""
_MOST_PARTS = 8


def fit_of(adjustment: Adjustment, tested: Consistency | None = None) -> str:
    """Whether residuals agree with the sigmas: as a whole, in every part, and through time.

    They do not where what does not fit was left out, and has a cause that concerns what was kept as well. Residuals
    that are smaller than the sigmas say are cautious sigmas, and mislead nobody.
    """
    test = adjustment.global_test
    if test is None:
        return UNTESTED
    spoilt = adjustment.diagnosis is not None and adjustment.diagnosis.spoils
    if test.status == "failed" or spoilt or (tested is not None and not tested.fits):
        return MISFIT
    return CAUTIOUS if test.status == "cautious" else FITS


def misfits(summary: Mapping[str, Any]) -> bool:
    """Whether the ``summary`` of a result file says that something does not fit."""
    test = summary["global_test"]
    before = MISFIT if test is not None and test["omega"] > test["upper"] else FITS  # files of earlier versions
    return bool(summary.get("fit", before) == MISFIT)


def warnings_with(adjustment: Adjustment, tested: Consistency | None) -> tuple[str, ...]:
    """For people: causes that were tried and values that cannot be, then what tests of parts found, then the rest."""
    tried = len(adjustment.diagnosis.lines) if adjustment.diagnosis is not None else 0
    first = (*adjustment.warnings[:tried], *adjustment.doubtful)
    found = () if tested is None else _findings(tested)
    return (*first, *found, *(w for w in adjustment.warnings[tried:] if w not in adjustment.doubtful))


def _findings(tested: Consistency) -> tuple[str, ...]:
    """For people: changes, and the parts that do not fit, the clearest first."""
    out = [c.text() for c in tested.changes[:_MOST_PARTS]] + [p.text() for p in tested.failing[:_MOST_PARTS]]
    more = len(tested.changes) + len(tested.failing) - len(out)
    return (*out, f"and {more} more parts do not fit") if more else tuple(out)


def verdict(
    adjustment: Adjustment, found: Suspects, n_unmet: int = 0, tested: Consistency | None = None
) -> tuple[str, str]:
    """``passed``, ``check`` or ``failed``, and the reason in words; ``n_unmet``: tolerances that are not met."""
    test, fit = adjustment.global_test, fit_of(adjustment, tested)
    if not adjustment.converged:
        return "failed", "The adjustment did not converge: the numbers below are no solution."
    if test is not None and test.status == "failed":
        return "failed", (
            f"Global test failed: residuals are {adjustment.sigma0:.2f} times what the sigmas of the observations "
            "allow. Look for blunders, wrong sigmas or a model that lacks something, starting with the groups."
        )
    if adjustment.diagnosis is not None and adjustment.diagnosis.spoils:
        if not any(d.action == "rejected" for d in adjustment.decisions):
            return "failed", (
                "Everything fits, but was read in another unit than it was written in, so that the numbers below are "
                "wrong; what it is is named first among the warnings."
            )
        return "failed", (
            "What was left out has a cause that concerns what was kept as well, so that the numbers below are wrong; "
            "it is named first among the warnings."
        )
    if fit == MISFIT:
        return "failed", (
            "The survey as a whole fits its sigmas, but not every part of it; what does not fit is named first among "
            "the warnings."
        )
    if any(w.startswith("probable cause") for w in adjustment.warnings):
        return "check", "Observations contradict each other; the probable cause is named first among the warnings."
    if any(d.action == "rejected" for d in adjustment.decisions):
        return "check", "Gross errors were left out; what is left agrees. They are named among the warnings."
    if test is None:
        return "check", "Nothing was tested: the survey has no redundant observations."
    if n_unmet:
        return "check", "Global test passed, but tolerances are not met; see the tolerances."
    if found.n_image + found.n_other:
        return "check", "Global test passed, but some observations disagree with the others; see the suspects."
    if any(not w.startswith(CAUTIOUS_SIGMAS) for w in adjustment.warnings):
        return "check", "Global test passed; please read the warnings."
    if fit == CAUTIOUS:
        return "passed", (
            f"Observations and model agree, with cautious sigmas: residuals are {adjustment.sigma0:.3f} times what the "
            "sigmas of the observations claim."
        )
    return "passed", "Observations, sigmas and model agree."
