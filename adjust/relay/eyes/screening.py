"""Epochs that contradict all others: found by test, left out one after the other, and listed."""

from dataclasses import replace

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import BoolArray, FloatArray
from adjust.relay.eyes.checks import OutlierEpoch
from adjust.relay.eyes.setup import EyeSetup
from adjust.relay.eyes.solver import EyeProblem, EyeSolution, linearise, own_blocks, solve_eyes
from adjust.testing.gross_errors import Search, State, Verdicts, one_group

_FAMILY = 0.001
"""Error probability of the tests of all epochs together."""


def solve_screened(setup: EyeSetup, reject: bool) -> tuple[EyeSolution, tuple[OutlierEpoch, ...]]:
    """Least squares of the epochs that agree, and the others, worst first.

    The limit follows the scatter of most epochs where that is larger than the a priori sigmas say; where all are
    together far smaller, none is left out.
    Raises SurveyError where more than a third of the epochs contradict each other.
    """
    m = len(setup.problem.conditions)

    def solve(used: BoolArray, before: State[EyeSolution] | None) -> tuple[EyeSolution, Verdicts]:
        problem = setup.problem
        if before is not None:
            if used.sum() < max(1, 2 * m // 3):
                raise SurveyError(
                    f"more than a third of the {m} epochs contradict each other, the worst is "
                    f"{setup.epoch_ids[before.worst]}; check that the eyes are rigid on the station, that targets did "
                    "not move, and the time offsets"
                )
            problem = replace(problem, conditions=problem.conditions[used])
        solution = solve_eyes(problem, None if before is None else before.solution)
        return solution, one_group(_all_tests(setup.problem, solution, used), np.full(m, 6), used)

    search = Search(solve, _FAMILY, many=1)
    first = search.judged(*solve(np.ones(m, dtype=np.bool_), None))
    if not reject or first.tests.cautious[0]:
        return first.solution, ()
    last = search.settled(first)
    return last.solution, _outliers(setup, last)


def _misfits(problem: EyeProblem, solution: EyeSolution) -> tuple[FloatArray, FloatArray]:
    """Misclosures (m, 6) of all conditions, used or not, and their covariance as if none had been used."""
    at = linearise(problem, solution.unknowns, solution.scales, np.zeros((len(problem.observed), 6)))
    A = at.by.reshape(len(at.f), 6, -1)
    return at.f, own_blocks(problem, at) + A @ solution.cov @ np.swapaxes(A, -1, -2)


def _all_tests(problem: EyeProblem, solution: EyeSolution, used: BoolArray) -> FloatArray:
    """Tests (m,) of all conditions; those left out against what the others predict."""
    f, cov = _misfits(problem, solution)
    out = np.einsum("mi,mij,mj->m", f, np.linalg.inv(cov), f)
    out[used] = solution.test
    return np.asarray(out)


def _outliers(setup: EyeSetup, last: State[EyeSolution]) -> tuple[OutlierEpoch, ...]:
    f, _ = _misfits(setup.problem, last.solution)
    c = setup.problem.conditions
    found = [
        OutlierEpoch(setup.epoch_ids[i], setup.eyes[int(c.eye_k[i])].frame_id, setup.eyes[int(c.eye_l[i])].frame_id,
                     float(last.tests.statistic[i]), float(np.linalg.norm(f[i, :3])), float(np.linalg.norm(f[i, 3:])))
        for i in np.flatnonzero(~last.tests.used)
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda o: -o.test))
