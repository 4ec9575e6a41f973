"""Simulations by the thousand: table 1 of the relay paper, and the error analysis of the head's paper."""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import gtsam
import numpy as np

from adjust.model.survey import IntArray
from adjust.spatial.rigid import rotation_exp
from survey.planning.errors import error_analysis_job
from tests.adjust.relay_monte_carlo import MonteCarloOptions, simulate_complete
from tests.benchmarks.cases import Arrays
from tests.benchmarks.outcome import Competitor, Outcome


@dataclass(frozen=True, eq=False)
class Trials(Arrays):
    """n: trials, of four cameras, or of every point of the curves."""

    n: IntArray


def table_1(case: Trials) -> Competitor:
    """Simulated, adjusted with covariances and with equal weights, summed up."""

    def run() -> Outcome:
        t0 = perf_counter()
        found = simulate_complete(MonteCarloOptions(n_cameras=4, n_trials=int(case.n), seed=1))
        seconds = perf_counter() - t0
        return Outcome({"trials": seconds}, {}, f"rms {np.degrees(found.weighted.rms) * 60:.3f} arcmin")

    return run


def table_1_gtsam(case: Trials) -> Competitor:
    """The same networks, one graph a trial, adjusted once, with equal weights; nothing summed up."""
    n, sigma = int(case.n), float(np.radians(5.0 / 60.0))
    a, b = np.triu_indices(4, 1)

    def run() -> Outcome:
        rng = np.random.default_rng(1)
        turns = rotation_exp(rng.normal(size=(n, 4, 3)))
        true = np.swapaxes(turns[:, b], -1, -2) @ turns[:, a]
        measured = true @ rotation_exp(sigma * rng.normal(size=(n, len(a), 3)))
        t0 = perf_counter()
        square = 0.0
        for start, pairs in zip(turns, measured, strict=True):
            square += 2.0 * _one_graph(start, pairs, a, b, sigma)
        return Outcome({"trials": perf_counter() - t0}, {}, f"mean v'Pv {square / n:.2f}, expected 9")

    return run


def _one_graph(start, pairs, a: IntArray, b: IntArray, sigma: float) -> float:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    for i, j, R in zip(a.tolist(), b.tolist(), pairs, strict=True):
        graph.push_back(gtsam.BetweenFactorRot3(j, i, gtsam.Rot3(R), noise))
    for i, R in enumerate(start):
        values.insert(i, gtsam.Rot3(R))
    held = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    graph.push_back(gtsam.PriorFactorRot3(0, values.atRot3(0), held))
    result = gtsam.GaussNewtonOptimizer(graph, values).optimize()
    return float(graph.error(result))


def error_analysis(case: Trials) -> Competitor:
    """All curves of the three figures, with a nearest depth and without."""

    def run() -> Outcome:
        t0 = perf_counter()
        found = error_analysis_job(n_trials=int(case.n))
        points = sum(len(f.sigmas) for f in (*found.bounded, *found.paper))
        return Outcome({"trials": perf_counter() - t0}, {}, f"{points} points of 6 curves")

    return run


TABLE_1, TABLE_1_GTSAM, ERRORS = "ours: table 1", "GTSAM, one graph a trial", "ours: error analysis"
TRIALS: dict[str, Callable[[Trials], Competitor]] = {
    TABLE_1: table_1, TABLE_1_GTSAM: table_1_gtsam, ERRORS: error_analysis,
}  # fmt: skip
