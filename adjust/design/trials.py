"""Monte Carlo of a whole design: simulated observations adjusted again and again, beside the predicted covariance.

Each trial draws from a generator of its own, seeded by (seed, trial), and is adjusted by one thread, so that the result
does not depend on how many processes share the trials.
"""

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor

import gtsam
import numpy as np

from adjust.design.expectation import shared_names
from adjust.design.noise import displaced, disturbed
from adjust.design.prediction import Predictor
from adjust.graph.assembly import StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import settled
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, Survey
from adjust.native.parallel import workers
from adjust.testing.distributions import chi2
from adjust.testing.quadratic_forms import pseudo_squares

_CHUNK = 8


@frozen(eq=False)
class Trials:
    """Errors of the unknowns of several epochs over the trials that converged.

    names: unknowns; errors: (t, p) in their tangents, in units inside; sigmas: (p,) predicted. omega: (t,) v'Pv.
    failed: messages of the trials that did not converge. mean_square: mean of d' inv(C) d with its band at 99 %;
    dof: its expectation.
    """

    names: tuple[ParameterName, ...]
    errors: FloatArray
    sigmas: FloatArray
    omega: FloatArray
    redundancy: int
    failed: tuple[str, ...]
    mean_square: float
    dof: int
    band: tuple[float, float]

    @property
    def ratios(self) -> FloatArray:
        """(p,) root mean square error over predicted sigma; 1 is expected, with a relative sigma of 1/sqrt(2 t)."""
        return np.asarray(np.sqrt(np.mean(self.errors**2, axis=0)) / self.sigmas)

    @property
    def passed(self) -> bool:
        """Whether the scatter agrees with the predicted covariance."""
        return self.band[0] <= self.mean_square <= self.band[1]


def run_trials(
    ideal: Survey, start: StartValues, expected: Adjustment, n: int, seed: int = 0,
    n_workers: int | None = None, progress: Callable[[int], None] | None = None,
) -> Trials:  # fmt: skip
    """Adjust ``n`` simulated surveys around ``ideal``, whose observations are exact at ``start``.

    n_workers: processes; None: one per core. progress: called with the number of trials done. Raises SurveyError where
    fewer than two trials converge.
    """
    # where an instrument stood is drawn anew in every trial: its unknown has no true value of its own
    names = tuple(n for n in shared_names(expected) if n[0] != "centring")
    jobs = [(seed, k, min(_CHUNK, n - k)) for k in range(0, n, _CHUNK)]
    count = min(n_workers or workers(), len(jobs))
    done: list[tuple[FloatArray, float] | str] = []
    task = _Task(ideal, start, names, Predictor(ideal, start).reading_sigmas())
    if count <= 1:
        for job in jobs:
            done += task(job)
            if progress:
                progress(len(done))
    else:
        context = multiprocessing.get_context("spawn")  # forks of a process with threads may hang
        with ProcessPoolExecutor(count, context, _prepare, (task,)) as pool:
            for part in pool.map(_run, jobs):
                done += part
                if progress:
                    progress(len(done))
    good = [d for d in done if not isinstance(d, str)]
    failed = tuple(d for d in done if isinstance(d, str))
    if len(good) < 2:
        raise SurveyError(f"only {len(good)} of {n} simulated surveys could be adjusted: {failed[0] if failed else ''}")
    return _summary(names, np.array([e for e, _ in good]), np.array([o for _, o in good]), failed, expected)


def _summary(
    names: tuple[ParameterName, ...], errors: FloatArray, omega: FloatArray, failed: tuple[str, ...],
    expected: Adjustment,
) -> Trials:  # fmt: skip
    Q = expected.precision.joint(names)
    s = np.sqrt(np.diag(Q))
    scale = np.where(s > 0, s, 1.0)
    squares, rank = pseudo_squares(errors / scale, Q / np.outer(scale, scale), 0.0, 1e-11)
    dof, t = int(rank), len(errors)
    low, high = chi2.ppf([0.005, 0.995], t * dof) / t
    mean = float(np.mean(squares))
    return Trials(names, errors, s, omega, expected.redundancy, failed, mean, dof, (float(low), float(high)))


@frozen(eq=False)
class _Task:
    """Some trials in a process of its own."""

    ideal: Survey
    start: StartValues
    names: tuple[ParameterName, ...]
    sigmas: FloatArray

    def __call__(self, job: tuple[int, int, int]) -> list[tuple[FloatArray, float] | str]:
        seed, first, n = job
        out: list[tuple[FloatArray, float] | str] = []
        # of the exact survey: readings with noise would start with other orientations
        truth = gtsam.Values(GraphBuilder(self.ideal, self.start.lenses).build(self.start).start)
        for k in range(first, first + n):
            rng = np.random.default_rng([seed, k])
            survey = disturbed(displaced(self.ideal, self.start, rng), rng, self.sigmas)
            try:
                graph = GraphBuilder(survey, self.start.lenses).build(self.start)
                _, found = settled(graph)
            except SurveyError as error:
                out.append(str(error))
                continue
            by_name, away = graph.unknowns.by_name, truth.localCoordinates(found.values)  # where the covariances are
            errors = [np.asarray(away.at(by_name[name].key)) for name in self.names]
            out.append((np.concatenate(errors), found.omega))
        return out


_task: Sequence[_Task] = ()


def _prepare(task: _Task) -> None:
    global _task
    os.environ["LABSURVEY_THREADS"] = "1"
    _task = (task,)


def _run(job: tuple[int, int, int]) -> list[tuple[FloatArray, float] | str]:
    return _task[0](job)
