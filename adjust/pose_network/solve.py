"""Least squares over a pose network: Gauss-Newton over native factors, in our own loop.

On long corridors the first steps raise the weighted square sum before it falls, so steps are not tested one by one;
damping comes in only where the sum stays up.
"""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.survey import FloatArray
from adjust.pose_network.graph import network_graph, network_ordering, network_values, values_arrays
from adjust.pose_network.network import PoseNetwork, check_determined
from adjust.pose_network.start import find_network_start

_MOST_DAMPED = 1e10
Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class NetworkOptions:
    """How a network is solved.

    robust: look for wrong pairs never ("off"), where the first solution shows some ("auto"), or from the start ("on").
    alpha: probability that any pair of a network without wrong ones is rejected. max_step: convergence, what is left to
    go in sigmas. patience: steps that may fail to lower the weighted square sum before damping begins.
    """

    robust: str = "auto"
    alpha: float = 0.01
    max_step: float = 1e-6
    max_iterations: int = 100
    patience: int = 8


DEFAULTS = NetworkOptions()


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where least squares ended: poses (N, 3, 3), (N, 3), v'Pv, steps taken, last step in sigmas, and GTSAM's graph.

    history: v'Pv before the first and after every step.
    """

    rotations: FloatArray
    translations: FloatArray
    omega: float
    iterations: int
    max_step: float
    linear: gtsam.GaussianFactorGraph
    ordering: gtsam.Ordering
    use_qr: bool
    history: tuple[float, ...]


class GaussNewton:
    """The loop, its order of elimination and its way out of weak systems."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering) -> None:
        self.graph, self.values, self.ordering = graph, values, ordering
        self.use_qr = False
        self.damping = 0.0

    def solve(self, linear: gtsam.GaussianFactorGraph) -> gtsam.VectorValues:
        """The step. Raises IndeterminateError where there is none."""
        system = linear if self.damping == 0.0 else self._damped(linear)
        if not self.use_qr:
            try:
                return system.optimize(self.ordering)
            except RuntimeError as error:
                if "ndetermin" not in str(error):
                    raise
                self.use_qr = True  # weak, but determined: GTSAM's Cholesky refuses pivots that QR still resolves
        try:
            delta = system.optimize(self.ordering, gtsam.EliminateQR)
        except RuntimeError as error:
            if "ndetermin" not in str(error):
                raise
            delta = None
        if delta is None or not np.isfinite(delta.norm()):
            raise IndeterminateError("the pairs do not determine the stations; look for pairs with absurd covariances")
        return delta

    def _damped(self, linear: gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
        """Marquardt's damping with the block diagonal of the normal matrix."""
        diagonal: dict[int, FloatArray] = {}
        for i in range(linear.size()):
            factor = linear.at(i)
            A = factor.jacobian()[0]
            square, at = (A * A).sum(axis=0), 0
            width = len(square) // len(factor.keys())
            for key in list(factor.keys()):
                diagonal[key] = diagonal.get(key, 0.0) + square[at : at + width]
                at += width
        out = linear.clone()
        for key, d in diagonal.items():
            unit = gtsam.noiseModel.Unit.Create(len(d))
            out.add(key, np.diag(np.sqrt(self.damping * np.maximum(d, 1e-12))), np.zeros(len(d)), unit)
        return out

    def run(self, options: NetworkOptions, progress: Progress | None = None) -> tuple[int, float, list[float]]:
        """Iterate to the minimum: steps, last step in sigmas, v'Pv before and after every step."""
        history = [2.0 * float(self.graph.error(self.values))]
        best, best_values, waited = history[0], self.values, 0
        steps: list[float] = []
        for iteration in range(1, options.max_iterations + 1):
            linear = self.graph.linearize(self.values)
            try:
                delta = self.solve(linear)
            except IndeterminateError:
                if iteration == 1:
                    raise
                # what the pairs determine was judged at the start: on the way out it is the place that is bad
                self.values, steps = best_values, []
                self.damping = max(10.0 * self.damping, 1e-5)
                if self.damping > _MOST_DAMPED:
                    break
                continue
            moved = float(np.sqrt(max(0.0, -delta.dot(linear.gradientAtZero()))))
            self.values = self.values.retract(delta)
            history.append(2.0 * float(self.graph.error(self.values)))
            if progress:
                progress(iteration, history[-1])
            steps.append(moved)
            if self.damping == 0.0 and self._arrived(steps, options):
                return iteration, moved, history
            if history[-1] < best:
                best, best_values, waited = history[-1], self.values, 0
                self.damping = self.damping / 10.0 if self.damping > 1e-7 else 0.0
                continue
            waited += 1
            if (self.damping > 0.0 or waited >= options.patience) and not moved < 1e-3:
                self.values, steps = best_values, []
                self.damping = max(10.0 * self.damping, 1e-5)
            if not np.isfinite(history[-1]) or self.damping > _MOST_DAMPED:
                break
        raise NotConvergedError(
            f"the network did not converge in {iteration} steps (the last moved {moved:.2g} sigma); "
            "look for wrong pairs, or let the program look for them (robust)"
        )

    @staticmethod
    def _arrived(steps: list[float], options: NetworkOptions) -> bool:
        """Steps shrink at least linearly near the minimum; where rounding alone moves the unknowns they stay small."""
        ratio = min(1.0, steps[-1] / steps[-2]) if len(steps) > 1 and steps[-2] > 0.0 else 1.0
        if steps[-1] * ratio < options.max_step:
            return True
        return len(steps) > 4 and max(steps[-4:]) < 1e-3 and steps[-1] > 0.1 * steps[-4]


def minimize(
    network: PoseNetwork, start: tuple[FloatArray, FloatArray] | None = None,
    options: NetworkOptions = DEFAULTS, weights: FloatArray | None = None, progress: Progress | None = None,
) -> Minimum:  # fmt: skip
    """Least squares over the pairs in use, weighted (E,) if asked, from a start or from nothing.

    Raises IndeterminateError naming the stations that float, NotConvergedError.
    """
    check_determined(network, None if weights is None else network.used & (weights > 0.0))
    R, t = find_network_start(network, weights) if start is None else (start[0].copy(), start[1].copy())
    held = network.held
    R[held], t[held] = network.station_rotations[held], np.nan_to_num(network.station_translations[held])
    graph = network_graph(network, R, t, weights)
    values = network_values(network, R, t)
    used = network.used if weights is None else network.used & (weights > 0.0)
    loop = GaussNewton(graph, values, network_ordering(network, graph, used))
    iterations, moved, history = loop.run(options, progress)
    R, t = values_arrays(network, loop.values, R, t)
    linear = graph.linearize(loop.values)
    return Minimum(R, t, history[-1], iterations, moved, linear, loop.ordering, loop.use_qr, tuple(history))
