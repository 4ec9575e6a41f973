"""Gauss-Newton with a Levenberg-Marquardt fallback over an :class:`~adjust.graph.AdjustmentGraph`.

Our own loop: GTSAM's optimisers copy all values for every Python callback, stop silently on constraints, and know
nothing of the unknowns hidden in a batch.
"""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from adjust.datum import InnerDatum, inner_datum, normal_diagonal, stacking, visible_keys
from adjust.errors import IndeterminateError, NotConvergedError, SurveyError
from adjust.graph import AdjustmentGraph
from adjust.rank import describe_null_space, unobserved_unknowns
from adjust.tree_covariance import Leaves

_SIGMA_ROUNDS, _SIGMA_CHANGE = 3, 1e-6
"""Sigmas that depend on distances (target centring) follow the solution until they change by no more than this."""

_LATE = frozenset((
    "lens", "station_from_camera", "mount_from_station", "world_from_table", "table_geometry", "warp", "instrument",
    "vertical", "beam", "surface",
))  # fmt: skip
"""What many observations share is eliminated last."""

Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class SolveOptions:
    """max_step: convergence, what is left to go for any unknown in its own sigmas. max_iterations: steps tried."""

    max_step: float = 1e-6
    max_iterations: int = 200
    first_damping: float = 1e-4


@dataclass(frozen=True, eq=False)
class Solved:
    """The minimum and how it was reached. linear: GTSAM's linearised graph there, eliminated in ``ordering``."""

    values: gtsam.Values
    linear: gtsam.GaussianFactorGraph
    ordering: gtsam.Ordering
    use_qr: bool
    omega: float
    iterations: int
    max_step: float
    datum: InnerDatum | None
    leaves: Leaves | None = None
    """The poses that were reduced before, as cliques of the Bayes tree of ``linear``."""


class _Loop:
    def __init__(self, graph: AdjustmentGraph, options: SolveOptions, progress: Progress | None) -> None:
        self.graph, self.options, self.progress = graph, options, progress
        self.values = graph.start
        self._set_datum()
        self.damping = 0.0
        self.use_qr = False
        self._ordering: tuple[gtsam.NonlinearFactorGraph, gtsam.Ordering] | None = None

    def _set_datum(self) -> None:
        self.datum = inner_datum(self.graph, self.values)

    def linearize(self) -> None:
        """``linear``: the system at the present values, with the minimal datum where the survey has an inner one."""
        self.linear = self.graph.system.linearize(self.values)
        if self.datum is not None:
            self.datum.add_to(self.linear)

    def completed(self, delta: gtsam.VectorValues) -> tuple[gtsam.VectorValues, float]:
        """The step of all unknowns in the survey's datum, from that of the visible ones in the minimal datum.

        Also by how much what was hidden lowers chi-square (to first order) beside what the visible step does.
        """
        decrease = 0.0
        if self.graph.reduction is not None:
            decrease += self.graph.reduction.complete(delta)
        if self.graph.bundle is not None:
            self.graph.bundle.complete(delta)
            decrease += self.graph.bundle.hidden_decrease
        if self.datum is not None:
            delta = self.datum.completed(self.graph, self.values, delta)
        return delta, decrease

    def evaluate(self, values: gtsam.Values) -> float:
        """Weighted square sum at ``values``; everything is ready to be linearised there, since most steps are good."""
        try:
            self.graph.prepare(values, True, self.damping)
        except IndeterminateError:
            if values is self.values:
                raise
            return np.inf  # a step that made a point undetermined is no step
        return self.graph.objective(values)

    @property
    def ordering(self) -> gtsam.Ordering:
        """In which GTSAM eliminates the system as it is now."""
        system = self.graph.system
        if self._ordering is None or self._ordering[0] is not system:
            last = self._last_keys()
            self._ordering = system, gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(system, last)
        return self._ordering[1]

    def step(self) -> gtsam.VectorValues:
        """The (damped) step of ``linear``; raises IndeterminateError by name where there is none."""
        system = self.linear if self.damping == 0.0 else damped(self.graph, self.linear, self.damping)
        try:
            how = (self.ordering, gtsam.EliminateQR) if self.use_qr else (self.ordering,)
            delta = system.optimize(*how)
        except RuntimeError as error:
            if "ndetermin" not in str(error) or self.use_qr:
                raise
            if self.graph.reduction is not None:  # what is weak is judged, and named, with all unknowns in sight
                self.graph.reduction = None
                self.graph.prepare(self.values, True, self.damping)
                self.linearize()
                return self.step()
            names = describe_null_space(self.graph, self.linear, self.values)
            if names is not None:
                raise names from None
            self.use_qr = True  # weak, but determined: GTSAM's Cholesky refuses pivots that QR still resolves
            return self.step()
        if not np.isfinite(delta.norm()):
            raise SurveyError("the normal equations have no finite solution; check the sigmas and start values")
        return delta

    def _last_keys(self) -> list[int]:
        by_key, all_keys = self.graph.unknowns.by_key, list(self.graph.system.keyVector())
        keys = [k for k in all_keys if k in by_key and by_key[k].name[0] in _LATE]
        keys += [k for k in (self.datum.minimal if self.datum is not None else ()) if k not in keys]
        return keys if len(keys) < len(all_keys) else []

    def run(self) -> Solved:
        omega = self.evaluate(self.values)
        self.linearize()
        moved = before = np.inf
        for iteration in range(1, self.options.max_iterations + 1):
            delta = self.step()
            decrease = -float(delta.dot(self.linear.gradientAtZero()))
            delta, hidden = self.completed(delta)
            decrease += hidden
            before, moved = moved, np.sqrt(max(0.0, decrease))
            trial = self.values.retract(delta)
            used, new = self.damping, self.evaluate(trial)
            behind = self.graph.behind_camera()
            if self._accept(new, omega, moved, bool(behind)):
                self.values, omega = trial, new
                if self.progress:
                    self.progress(iteration, omega)
                # steps shrink at least linearly near the minimum: what is left is below the next step
                left = moved * min(1.0, moved / before if np.isfinite(before) else 1.0)
                if self.damping == 0.0 and left < self.options.max_step:
                    return self._finish(omega, iteration, moved)
                self.damping = self.damping / 10.0 if self.damping > 1e-8 else 0.0
            else:
                self.damping = max(self.damping * 10.0, self.options.first_damping)
                if self.damping > 1e8:
                    raise self._stuck(iteration, moved)
            if self.damping != used or self.values is not trial:
                self.graph.prepare(self.values, True, self.damping)
            self.linearize()
        raise self._stuck(self.options.max_iterations, moved)

    @staticmethod
    def _accept(new: float, old: float, moved: float, behind: bool) -> bool:
        """Downhill, or at the bottom where rounding decides; never behind a camera."""
        return np.isfinite(new) and not behind and (new <= old * (1.0 + 1e-12) or moved < 1e-4)

    def _stuck(self, iteration: int, moved: float) -> NotConvergedError:
        blocks = sorted({f"{b.camera_id} at {b.epoch_id}" for b in self.graph.behind_camera()})
        what = f"; points behind the camera in {', '.join(blocks[:5])}" if blocks else ""
        return NotConvergedError(
            f"the adjustment did not converge in {iteration} steps: the last step moved an unknown by {moved:.2g} sigma"
            f"{what}; look for gross errors in the observations or a wrong start value"
        )

    def _finish(self, omega: float, iteration: int, moved: float) -> Solved:
        if self.datum is not None:
            self._set_datum()  # about the solution, where the covariances belong; the solution stays
            self.graph.prepare(self.values, True)
        self.linearize()
        # the covariances need this linearisation anyway: its step costs one elimination and brings the last digits
        delta, _ = self.completed(self.step())
        self.values = self.values.retract(delta)
        leaves = None if self.graph.reduction is None else self.graph.reduction.leaves()
        return Solved(
            self.values, self.linear, self.ordering, self.use_qr, omega, iteration, moved, self.datum, leaves
        )


def damped(graph: AdjustmentGraph, linear: gtsam.GaussianFactorGraph, damping: float) -> gtsam.GaussianFactorGraph:
    """The graph with Marquardt's damping: every unknown held with ``damping`` times its own diagonal."""
    stack = stacking(graph, visible_keys(graph))
    root = np.sqrt(damping * np.maximum(normal_diagonal(linear, stack), 1e-12))
    out = linear.clone()
    for key, place in stack.at.items():
        n = place.stop - place.start
        out.add(key, np.diag(root[place]), np.zeros(n), gtsam.noiseModel.Unit.Create(n))
    return out


def solve(graph: AdjustmentGraph, options: SolveOptions = SolveOptions(), progress: Progress | None = None) -> Solved:
    """Adjust. Raises IndeterminateError (named), NotConvergedError, SurveyError."""
    nothing = unobserved_unknowns(graph)
    if nothing:
        raise IndeterminateError(
            "nothing observes " + ", ".join(nothing) + "; leave them out or hold them", tuple(nothing)
        )
    found = _Loop(graph, options, progress).run()
    for _ in range(_SIGMA_ROUNDS):
        if graph.terrestrial is None or graph.terrestrial.update_sigmas(found.values) < _SIGMA_CHANGE:
            break
        graph.start = found.values
        found = _Loop(graph, options, progress).run()
    return found
