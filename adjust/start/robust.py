"""Gross errors among the image points: found by reweighting, confirmed by test, left out of a clean least squares.

Cauchy weights with a scale from the median (Huber 1981, section 7.8; Zhang 1997 for the constant) bring the solution to
what most points agree on; there every point is tested with the error probability of the whole family (Sidak). Where
the residuals are together far smaller than the sigmas say, nothing contradicts these and nothing is looked for.
"""


import gtsam
import numpy as np

from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.solver import Solved, SolveOptions, solve
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray
from adjust.precision.precision import Precision
from adjust.testing.criteria import cauchy_weights, limits, typical_factor
from adjust.testing.gross_errors import Search, State, Verdicts, all_at_once, one_group

_FAMILY = 0.001


@frozen(eq=False)
class Screened:
    """A clean solution with its precision, and which image points (N,), in the order of the blocks, it uses."""

    solved: Solved
    precision: Precision
    used: BoolArray


def limit(n: int) -> float:
    """Chi-square (2) that one of n good image points exceeds with probability 0.001."""
    return float(limits(_FAMILY, np.array(2), n))


def scale(test: FloatArray) -> float:
    """Variance factor of most points, not below the a priori 1."""
    return typical_factor(test, np.full(len(test), 2))


def screen(graph: AdjustmentGraph, solved: Solved, options: SolveOptions) -> Screened:
    """Look for gross errors; ends in a least squares of the points that are left. The graph keeps them."""
    given = graph.used()
    freedom = np.where(given, 2, 0)

    def tested(solved: Solved, used: BoolArray) -> tuple[Screened, Verdicts]:
        precision = Precision(graph, solved)
        return Screened(solved, precision, used), one_group(precision.image_residuals.test, freedom, used)

    def solved_without(used: BoolArray, before: State[Screened] | None) -> tuple[Screened, Verdicts]:
        graph.set_weights(used.astype(np.float64))
        return tested(solve(graph, options, start=None if before is None else before.solution.solved.values), used)

    search = Search(solved_without, _FAMILY, all_at_once, many=1)
    state = search.judged(*tested(solved, given))
    if state.failing.any() and not state.tests.cautious.any():
        used = given.copy()
        start = _reweighted(graph, solved, used, options)
        state = search.judged(*tested(solve(graph, options, start=start), used))  # the first one goes: it may be large
        state = search.settled(state)
    return state.solution


def _reweighted(graph: AdjustmentGraph, solved: Solved, used: BoolArray, options: SolveOptions) -> gtsam.Values:
    """Values near which Cauchy weights settle; leaves the points that agree there as the used ones."""
    values = solved.values
    e = graph.whitened_squares(values)
    for _ in range(15):
        factor = scale(e[used])
        graph.set_weights(used * cauchy_weights(e / factor))
        roughly = SolveOptions(max_step=1e-2, max_iterations=options.max_iterations)
        values = solve(graph, roughly, start=values).values
        before, e = e, graph.whitened_squares(values)
        if np.abs(np.sqrt(e[used]) - np.sqrt(before[used])).max() < 0.05 * np.sqrt(factor):
            break
    used &= e <= limit(int(used.sum())) * scale(e[used])
    graph.set_weights(used.astype(np.float64))
    return values
