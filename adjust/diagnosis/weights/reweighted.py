"""Other sigmas of the pairs of a network, in the graph that its adjustment has: nothing else is built or read again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.solver import Progress, solve
from adjust.model.result import Adjustment, Named, Residuals
from adjust.model.survey import FloatArray
from adjust.observations.pairs import NoiseCache, PairBatch
from adjust.pose_network.solve import NetworkOptions, solve_options
from adjust.precision.precision import Precision


def reweighted(result: Adjustment, by: FloatArray, settled: float, paid: Callable[[], Progress]) -> Adjustment | None:
    """What residuals, v'Pv and sigma0 become where the sigmas of all pairs (n, 6) are multiplied by ``by``.

    A common factor changes no value; else it is solved from the values that are there, for which ``paid`` gives the
    progress. What else the adjustment has, its covariances as well, stays that of the old sigmas. None where anything
    but pairs between stations is observed. Raises SurveyError.
    """
    network = _network(result)
    if network is None:
        return None
    precision, graph, batch, named = network
    by = by[batch.rows]
    measured = np.isfinite(np.diagonal(batch.arrays.cov, axis1=1, axis2=2))
    factors = by[batch.arrays.used][measured[batch.arrays.used]]
    residual, omega = precision.pairs.residual, result.omega / float(factors[0]) ** 2
    if (factors != factors[0]).any():
        pairs = replace(batch, arrays=batch.arrays.with_sigmas_times(by), noise=NoiseCache(), _here=None)
        start = precision.solved.values
        how = replace(solve_options(NetworkOptions(settled=settled)), exact=False)
        solved = solve(replace(graph, pairs=pairs), how, paid(), start)
        residual = pairs.jacobians(solved.values)[0]
        white = np.einsum("nij,nj->ni", pairs.arrays.whitening, residual)
        omega = float((white[pairs.arrays.used] ** 2).sum())
    old = result.other_arrays
    arrays = replace(old, residual=residual[measured], sigma=old.sigma * by[measured])
    others = Residuals(arrays, named, 0)
    return replace(result, other_residuals=others, omega=omega, sigma0=float(np.sqrt(omega / result.redundancy)))


def _network(result: Adjustment) -> tuple[Precision, AdjustmentGraph, PairBatch, Callable[[int], Named]] | None:
    """Of a survey of nothing but pairs in a given datum, as its graph has them."""
    precision, others = result.precision, result.other_residuals
    if not isinstance(precision, Precision) or precision.by_conditions or precision.solved.datum is not None:
        return None
    graph = precision.graph
    if graph.pairs is None or not graph.only_pairs or graph.singles or len(graph.pairs) != len(result.survey.pairs):
        return None
    return (precision, graph, graph.pairs, others.named) if isinstance(others, Residuals) else None
