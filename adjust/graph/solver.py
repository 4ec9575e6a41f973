"""Gauss-Newton with a Levenberg-Marquardt fallback over an :class:`~adjust.graph.assembly.AdjustmentGraph`.

Our own loop: GTSAM's optimisers copy all values for every Python callback, stop silently on constraints, and know
nothing of the unknowns hidden in a batch.
"""

from collections.abc import Callable, Iterator
from functools import cached_property

import gtsam
import numpy as np

from adjust.graph.assembly import AdjustmentGraph, Evaluation
from adjust.graph.bending import Bending, bending_of
from adjust.graph.cliques import SolvedTree
from adjust.graph.datum import InnerDatum, inner_datum
from adjust.graph.divergence import describe_divergence, stopped_at
from adjust.graph.elimination import EXACT
from adjust.graph.pair_normals import PairLinear
from adjust.graph.rank import unobserved_unknowns
from adjust.graph.system import System
from adjust.model.errors import GivenUpError, IndeterminateError, NotConvergedError, listed
from adjust.model.frozen import frozen

_SIGMA_ROUNDS, _SIGMA_CHANGE = 3, 1e-6
"""Sigmas that depend on distances (target centring) follow the solution until they change by no more than this."""

_SHORTEST = 0.125
"""Share of an undamped step below which damping leads on better: the whole system bends."""
_LEAST_GAIN = 0.1
"""Share of the promised decrease of chi-square that a step must bring."""
_PROMISED = 0.9  # of the decrease: from there on a long corridor need not be bent instead
_WORTH_QR = 0.1
"""Of the share that the weakest motion may lose: what it hardly moves may lose more, and GTSAM's QR takes but twice the
time of its Cholesky."""
_STATIONARY = 1e-2  # sigmas that a step moves at most where the rank of the system is judged
_MANY = 40
"""Steps that a right survey takes at most from closed forms on, nearly always."""
_CLOSE = (1.0, 0.25), (10.0, 0.1)
"""Sigmas that a step moves at most, and its share of the one before, where one factor of pairs serves the next step.

From farther off where the one before is known, and more was gained.
"""

Progress = Callable[[int, float], None]


@frozen
class SolveOptions:
    """max_step: convergence, what is left to go for any unknown in its own sigmas. max_iterations: steps tried.

    patience: whole steps that may fail to lower chi-square, one after the other, before the search goes back to where
    it was least. On long corridors of pairs the first ones raise it before it falls (watchdog technique: Chamberlain,
    Lemarechal, Pedersen and Powell 1982; Nocedal and Wright 2006, section 15.6). determined: what the observations
    determine was judged before; where GTSAM's Cholesky refuses, QR solves. settled: share of chi-square that two steps
    one after the other have to gain for the search to go on: of a survey that is only compared with others.
    covariances: whether they are wanted; the tree of nothing but pairs may else be that of a step before. hopeless:
    chi-square above which the search is given up once it has taken many steps. exact: as of ``PairNormals``.
    """

    max_step: float = 1e-6
    max_iterations: int = 200
    first_damping: float = 1e-4
    patience: int = 0
    determined: bool = False
    settled: float = 0.0
    covariances: bool = True
    hopeless: float = np.inf
    exact: bool = True


@frozen(eq=False)
class Solved:
    """The minimum and how it was reached. tree: what the system there was eliminated to, by QR or Cholesky.

    lost: share of its variance that the weakest motion of all has lost on the way, by rounding.
    """

    values: gtsam.Values
    tree: SolvedTree
    use_qr: bool
    omega: float
    iterations: int
    max_step: float
    datum: InnerDatum | None
    lost: float = 0.0


class _Loop(System):
    """Steps of Gauss-Newton, shortened where the whole one does not gain what it promises, else damped.

    What observations leave undetermined is judged at the start and at stationary points. In between a system without a
    solution is only damped: a state on the way out says nothing about the survey.
    """

    def __init__(
        self, graph: AdjustmentGraph, start: gtsam.Values, options: SolveOptions, progress: Progress | None
    ) -> None:
        super().__init__(graph, start, options.determined, options.covariances, options.exact)
        self.start, self.options, self.progress = start, options, progress
        self.length, self.asked = 1.0, False
        self.moved = self.before = np.inf
        self.behind = self._images_behind()
        self.best, self.waited, self.idle = (self.at, self.omega), 0, 0
        self.steps: list[float] = []

    def _by_rows(self) -> bool:
        """Whether the steps go on by rows, because their squares have lost digits; asked once, before damping."""
        if self.use_qr or self.pairs is not None or self.damping > 0.0 or self.asked or not self._prepared_here():
            return False
        self.asked = True
        found = self._tree()
        if found is None:
            return False
        return self._turned_to_rows(self._lost(SolvedTree(found[0], self.graph.unknowns.dims)))

    def _turned_to_rows(self, lost: float) -> bool:
        """By QR from here, with all poses in sight, where this is more than a solution may lose and that may help."""
        if lost <= _WORTH_QR * EXACT or self.use_qr:
            return False
        self.use_qr, self.reduced, self.moved, self.idle = True, False, np.inf, 0
        self.length, self.steps = 1.0, []
        return self._prepared_here()

    def run(self) -> Solved:
        for iteration in range(1, self.options.max_iterations + 1):
            try:
                delta, promised = self._proposed()
            except IndeterminateError:
                if self.judging:
                    raise
                self.at, self.omega = self.best
                self._damp(iteration)
                continue
            self.before, self.moved = self.moved, np.sqrt(max(0.0, promised))
            watched = self.options.patience > 0 and self.damping == 0.0
            found = self._watched(delta, promised) if watched else self._along(delta, promised)
            if found is None:
                self.at, self.omega = self.best
                if not self._by_rows():
                    self._damp(iteration)
                continue
            gained = abs(self.omega - found[1]) >= self.options.settled * found[1]
            self.idle = 0 if gained else self.idle + 1
            self.at, self.omega, gain = found
            if self.omega < self.best[1] or not watched:
                self.best, self.waited = (self.at, self.omega), 0
            if self.progress:
                self.progress(iteration, self.omega)
            if self._arrived() or (self.idle > 1 and self.damping == 0.0):
                solved = self._finish(iteration)
                if isinstance(self.linear, PairLinear) or not self._turned_to_rows(solved.lost):
                    return solved
                continue
            if iteration >= _MANY and self.omega > self.options.hopeless:
                raise self._stuck(iteration, GivenUpError)
            if self.idle > 1:
                break
            self._relax(gain)
        raise self._stuck(iteration)

    def _along(self, delta: gtsam.VectorValues, promised: float) -> tuple[Evaluation, float, float] | None:
        """Where the step leads: evaluated, its chi-square and the share of the promised decrease; None if nowhere.

        An undamped step is halved down to ``_SHORTEST``, until it keeps a part of its promise: the quadratic model
        falls by a (2 - a) of the whole at the length a. Source: Dennis and Schnabel 1996, section 6.3.
        """
        length = self.length
        while length >= (_SHORTEST if self.damping == 0.0 else 1.0):
            for values in self._ends(delta if length == 1.0 else delta.scale(length)):
                try:
                    at = self._evaluated(values)
                except IndeterminateError:
                    continue  # a step that made a point undetermined is no step
                new, behind = self.graph.objective(at), self._images_behind()
                if np.isfinite(new) and behind <= self.behind:
                    gain = (self.omega - new) / max(length * (2.0 - length) * promised, 1e-300)
                    if gain > _LEAST_GAIN or self._at_the_bottom(new, self.omega):
                        self.length, self.behind = length, behind
                        return at, new, gain
            length *= 0.5
        return None

    def _ends(self, delta: gtsam.VectorValues) -> Iterator[gtsam.Values]:
        """Where a step may lead: straight on, and where that is not enough, bent along a tree."""
        straight = self.at.values.retract(delta)
        yield straight
        if self.damping == 0.0 and self.bending is not None:
            yield self.bending.bent(self.at.values, delta, straight)

    @cached_property
    def bending(self) -> Bending | None:
        """How a step bends the survey; looked for where the first straight one fails."""
        return bending_of(self.graph) if self.pairs is None else self.pairs.bending

    def _watched(self, delta: gtsam.VectorValues, promised: float) -> tuple[Evaluation, float, float] | None:
        """The whole step, whether chi-square falls or not; None where it has not fallen for too long."""
        try:
            at = self._evaluated(self.at.values.retract(delta))
        except IndeterminateError:
            return None
        new = self.graph.objective(at)
        if self.pairs is not None and self.pairs.by_rows and not new < self.omega - _PROMISED * promised:
            bent = self._evaluated(self.pairs.bending.bent(self.at.values, delta, at.values))
            at, new = min((bent, self.graph.objective(bent)), (at, new), key=lambda x: x[1])
        self.waited += 1
        if not np.isfinite(new) or (self.waited >= self.options.patience and self.moved > 1e-3):
            return None
        return at, new, (self.omega - new) / max(promised, 1e-300)

    def _at_the_bottom(self, new: float, old: float) -> bool:
        """Where rounding decides whether chi-square falls."""
        return self.moved < 1e-4 or (self.moved**2 < 1e-11 * old and new <= old * (1.0 + 1e-11))

    def _arrived(self) -> bool:
        """Whether what is left to go is small: steps shrink at least linearly near the minimum."""
        if self.damping > 0.0:
            return False
        self.steps.append(self.moved)
        last = self.steps[-4:]
        if self.options.patience and len(self.steps) > 4 and max(last) < 1e-3 and last[-1] > 0.1 * last[0]:
            return True  # where rounding alone moves the unknowns the steps stay small
        ratio = min(1.0, self.moved / self.before) if np.isfinite(self.before) else 1.0
        return self.moved * max(ratio, 1.0 - self.length) < self.options.max_step

    def _relax(self, gain: float) -> None:
        """The next step's length and damping, from what the last one gained; ready to be linearised."""
        self.judging = self.moved < _STATIONARY
        used = self.damping
        if self.pairs is not None:
            close = _CLOSE[: 1 + bool(np.isfinite(self.before))]
            near = any(self.moved < min(s, share * self.before) for s, share in close)
            self.pairs.kept = used == 0.0 and near and not self.pairs.by_rows
        if used == 0.0:
            self.length = min(1.0, 2.0 * self.length) if gain > 0.75 else self.length
        elif gain > 0.5:
            self.damping = used / 10.0 if used > 1e-7 else 0.0
        elif gain < 0.1:
            self.damping = 4.0 * used
        if self.damping == used:
            self._linearize()
        elif not self._prepared_here():
            self.damping = used
            self._prepared_here()

    def _damp(self, iteration: int) -> None:
        """From the present values once more, with shorter steps."""
        self.length, self.waited, self.steps = 1.0, 0, []
        if self.pairs is not None:
            self.pairs.kept = False
        while True:
            self.damping = max(self.damping * 10.0, self.options.first_damping)
            if self.damping > 1e8:
                raise self._stuck(iteration)
            if self._prepared_here():
                return

    def _stuck(self, iteration: int, kind: type[NotConvergedError] = NotConvergedError) -> NotConvergedError:
        blocks = sorted({f"{camera} at {epoch}" for camera, epoch, _ in self.behind})
        what = f"; points behind the camera in {listed(blocks, 5)}" if blocks else ""
        head = (
            f"the adjustment did not converge in {iteration} steps: the last step moved an unknown by "
            f"{self.moved:.2g} sigma{what}; look for gross errors in the observations or a wrong start value"
        )
        if self.options.settled > 0.0:  # nobody reads why what is only compared does not converge
            return NotConvergedError(head)
        said = [head, *describe_divergence(self.graph, self.start, self.at.values)]
        stopped = stopped_at(self.graph, self.start, self.at.values, iteration, self.omega, float(self.moved))
        return kind("\n  - ".join(said), stopped)

    def _finish(self, iteration: int) -> Solved:
        if self.behind:
            raise self._stuck(iteration)
        self.judging = True
        if self.datum is not None:
            self.datum = inner_datum(self.graph, self.at)  # about the solution, where the covariances belong
        self._linearize()
        # the covariances need this linearisation anyway: its step costs one elimination and brings the last digits
        found = self._tree()
        if found is None:
            self.step()  # which judges, or finds how to eliminate
            found = self._tree()
        if found is None:
            raise IndeterminateError("the normal equations have no solution here")
        tree, step = found
        delta, _ = self.completed(step)
        leaves = None if self.at.reduction is None else self.at.reduction.leaves()
        eliminated = SolvedTree(tree, self.graph.unknowns.dims, leaves)
        return Solved(
            self.at.values.retract(delta), eliminated, self.use_qr, self.omega, iteration, self.moved, self.datum,
            self._lost(eliminated) if self.covariances else 0.0,
        )  # fmt: skip


def solve(
    graph: AdjustmentGraph, options: SolveOptions = SolveOptions(), progress: Progress | None = None,
    start: gtsam.Values | None = None,
) -> Solved:  # fmt: skip
    """Least squares on a graph, with its weights as they are, from its start or another one; neither is changed.

    Raises IndeterminateError (named), NotConvergedError, SurveyError.
    """
    nothing = unobserved_unknowns(graph)
    if nothing:
        raise IndeterminateError(
            "nothing observes " + ", ".join(nothing) + "; leave them out or hold them", tuple(nothing)
        )
    return _Loop(graph, graph.start if start is None else start, options, progress).run()


def settled(
    graph: AdjustmentGraph, options: SolveOptions = SolveOptions(), progress: Progress | None = None
) -> tuple[AdjustmentGraph, Solved]:
    """The same with sigmas that depend on distances: the graph with those of the solution, and the solution."""
    found = solve(graph, options, progress)
    for _ in range(_SIGMA_ROUNDS):
        graph, change = graph.with_sigmas_at(found.values)
        if change < _SIGMA_CHANGE:
            break
        found = solve(graph, options, progress, found.values)
    return graph, found
