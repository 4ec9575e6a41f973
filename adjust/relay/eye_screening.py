"""Epochs that contradict all others: found by test, left out one after the other, and listed."""

from dataclasses import replace

import numpy as np

from adjust.distributions import chi2
from adjust.model.errors import SurveyError
from adjust.model.survey import BoolArray, FloatArray
from adjust.relay.eye_checks import OutlierEpoch
from adjust.relay.eye_setup import EyeSetup
from adjust.relay.eye_solver import EyeProblem, EyeSolution, linearise, solve_eyes
from adjust.statistics.criteria import cautious

_MEDIAN = float(chi2.ppf(0.5, 6))


def solve_screened(setup: EyeSetup, reject: bool, alpha: float) -> tuple[EyeSolution, tuple[OutlierEpoch, ...]]:
    """Least squares of the epochs that agree, and the others, worst first.

    The worst epoch is left out while it fails (data snooping, Baarda 1968), then those that fit after all come back.
    The limit follows the scatter of most epochs where that is larger than the a priori sigmas say; where all are
    together far smaller, none is left out.
    Raises SurveyError where more than a third of the epochs contradict each other.
    """
    m = len(setup.problem.conditions)
    used: BoolArray = np.ones(m, dtype=np.bool_)
    single = float(chi2.isf(-np.expm1(np.log1p(-alpha) / m), 6))
    solution = solve_eyes(setup.problem)
    if not reject or cautious(solution.test, np.full(m, 6)):
        return solution, ()
    for _ in range(2 * m):
        test = _all_tests(setup.problem, solution, used)
        limit = single * max(1.0, float(np.median(test[used])) / _MEDIAN)
        again = used | (test <= limit)
        worst = int(np.argmax(np.where(used, test, -np.inf)))
        if test[worst] > limit:
            used[worst] = False
        elif (again != used).any():
            used = again
        else:
            break
        if used.sum() < max(1, 2 * m // 3):
            raise SurveyError(
                f"more than a third of the {m} epochs contradict each other, the worst is {setup.epoch_ids[worst]}; "
                "check that the eyes are rigid on the station, that targets did not move, and the time offsets"
            )
        solution = solve_eyes(
            replace(setup.problem, conditions=setup.problem.conditions[used], start=solution.unknowns)
        )
    else:
        raise SurveyError("the search for wrong epochs did not settle; leave the suspected epochs out by hand")
    return solution, _outliers(setup, solution, used)


def _misfits(problem: EyeProblem, solution: EyeSolution) -> tuple[FloatArray, FloatArray]:
    """Misclosures (m, 6) of all conditions, used or not, and their covariance as if none had been used."""
    at = linearise(problem, solution.unknowns, solution.scales, np.zeros((len(problem.observed), 6)))
    c, Q = problem.conditions, problem.cov
    if Q.ndim == 3:
        Qk, Ql = Q[c.k_idx], Q[c.l_idx]
    else:
        n = len(problem.observed)
        blocks = Q.reshape(n, 6, n, 6)
        Qk, Ql = blocks[c.k_idx, :, c.k_idx, :], blocks[c.l_idx, :, c.l_idx, :]
    own = at.by_k @ Qk @ np.swapaxes(at.by_k, -1, -2) + at.by_l @ Ql @ np.swapaxes(at.by_l, -1, -2)
    A = at.by.reshape(len(c), 6, -1)
    return at.f, own + A @ solution.cov @ np.swapaxes(A, -1, -2)


def _all_tests(problem: EyeProblem, solution: EyeSolution, used: BoolArray) -> FloatArray:
    """Tests (m,) of all conditions; those left out against what the others predict."""
    f, cov = _misfits(problem, solution)
    out = np.einsum("mi,mij,mj->m", f, np.linalg.inv(cov), f)
    out[used] = solution.test
    return np.asarray(out)


def _outliers(setup: EyeSetup, solution: EyeSolution, used: BoolArray) -> tuple[OutlierEpoch, ...]:
    f, _ = _misfits(setup.problem, solution)
    test = _all_tests(setup.problem, solution, used)
    c = setup.problem.conditions
    found = [
        OutlierEpoch(setup.epoch_ids[i], setup.eyes[int(c.eye_k[i])].frame_id, setup.eyes[int(c.eye_l[i])].frame_id,
                     float(test[i]), float(np.linalg.norm(f[i, :3])), float(np.linalg.norm(f[i, 3:])))
        for i in np.flatnonzero(~used)
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda o: -o.test))
