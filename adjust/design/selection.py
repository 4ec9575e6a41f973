"""Which observations to add next: greedy D- and A-optimal choice by rank-k updates of the covariance.

With the covariance Q of the design and the whitened rows J (k, n) of a candidate, ``S = I + J Q J'``:

    ln det Q - ln det Q' = ln det S                                   (matrix determinant lemma)
    Q - Q' = Q J' S^-1 J Q                                            (Woodbury)

so that no candidate needs a new adjustment (Fedorov 1972, Theory of Optimal Experiments; Pukelsheim 2006, Optimal
Design of Experiments). Of chosen unknowns w the gain is ``-ln det(I - G' inv(Q_ww) G)`` with ``G = Q_w J' S^-1/2``.

D: the determinant, that is the volume of the confidence ellipsoid; it does not depend on units. A: the mean variance,
here every unknown in units of its variance in the design as it is, so that angles and lengths can be added.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from adjust.design.candidates import Candidate, Informed, inform
from adjust.design.expectation import expect
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.precision.precision import precision_of
from adjust.testing.quadratic_forms import pseudo_half

Criterion = Literal["D", "A"]


@frozen
class Component:
    """A component of an unknown whose precision is wanted."""

    name: ParameterName
    component: str
    unit: str

    @property
    def text(self) -> str:
        """``lens.X.fx``."""
        return ".".join((*self.name, self.component))


@frozen(eq=False)
class Gain:
    """What one candidate brings to the covariance as it stands.

    ln_det: decrease of ln det of the covariance of the wanted components, ln_det_all: of all unknowns the candidates
    touch. mean_variance: decrease of the mean of their variances, in units of the first design's. sigmas: (p,) of the
    wanted components with the candidate, rad, m, px.
    """

    candidate_idx: int
    name: str
    kind: str
    ln_det: float
    ln_det_all: float
    mean_variance: float
    sigmas: FloatArray

    def value(self, criterion: Criterion) -> float:
        """The gain by which candidates are compared."""
        return self.ln_det if criterion == "D" else self.mean_variance


@frozen(eq=False)
class Selection:
    """The choice: ``first`` are the gains of all candidates to the design as it is, best first; ``steps`` the chosen.

    sigmas: (p,) of the wanted components before anything is added; after: with all that was chosen.
    """

    criterion: Criterion
    wanted: tuple[Component, ...]
    sigmas: FloatArray
    first: tuple[Gain, ...]
    steps: tuple[Gain, ...]

    @property
    def after(self) -> FloatArray:
        """(p,) sigmas with everything chosen."""
        return self.steps[-1].sigmas if self.steps else self.sigmas


class Updater:
    """The covariance of the unknowns that candidates touch, updated as they are taken."""

    def __init__(self, Q: FloatArray, informed: Informed, wanted: IntArray) -> None:
        self.Q, self.J, self.wanted = np.array(Q), informed.J, wanted
        self.reference = np.diag(Q)[wanted].copy()
        self.root = self._root()

    def gain(self, i: int) -> tuple[float, float, float, FloatArray]:
        """(ln det of the wanted, ln det of all, decrease of the mean relative variance, new variances (p,))."""
        G, ln_det_all = self._step(i)
        Gw = G[self.wanted]
        variances = np.diag(self.Q)[self.wanted]
        less = np.sum(Gw**2, axis=1)
        relative = np.divide(less, self.reference, out=np.zeros_like(less), where=self.reference > 0)
        return self._ln_det(Gw), ln_det_all, float(relative.mean()), np.maximum(variances - less, 0.0)

    def take(self, i: int) -> None:
        """Measure the candidate."""
        G, _ = self._step(i)
        self.Q = self.Q - G @ G.T
        self.root = self._root()

    def _step(self, i: int) -> tuple[FloatArray, float]:
        """G (n, k) with ``Q' = Q - G G'``, and ln det S."""
        J = self.J[i]
        if not len(J):
            return np.zeros((len(self.Q), 0)), 0.0
        QJ = self.Q @ J.T
        L = np.linalg.cholesky(np.eye(len(J)) + J @ QJ)
        return solve_triangular(L, QJ.T, lower=True).T, 2.0 * float(np.log(np.diag(L)).sum())

    def _ln_det(self, Gw: FloatArray) -> float:
        if not Gw.shape[1]:
            return 0.0
        s = np.linalg.svd(self.root.T @ Gw, compute_uv=False)
        return float(-np.log1p(-np.minimum(s**2, 1.0 - 1e-15)).sum())

    def _root(self) -> FloatArray:
        """(p, r) with ``root root' = pinv(Q_ww)``: a datum by inner constraints leaves it singular."""
        Qw = self.Q[np.ix_(self.wanted, self.wanted)]
        s = np.sqrt(np.diag(Qw))
        s = np.where(s > 0, s, 1.0)
        return np.asarray(pseudo_half(Qw / np.outer(s, s), 0.0, 1e-11)[0] / s[:, None])



def components_of(adjustment: Adjustment, names: Sequence[ParameterName]) -> tuple[Component, ...]:
    """Every component of these unknowns."""
    by_name = precision_of(adjustment).unknowns.by_name
    return tuple(
        Component(n, c, u) for n in names for c, u in zip(by_name[n].components, by_name[n].units, strict=True)
    )


def select(
    survey: Survey, start: StartValues, candidates: Sequence[Candidate], wanted: Sequence[Component],
    n: int, criterion: Criterion = "D", expected: Adjustment | None = None,
) -> Selection:  # fmt: skip
    """Choose up to ``n`` candidates one after the other, each the best beside those taken.

    survey: what is planned (or measured) anyway, which must determine everything. expected: its :func:`expect`, where
    it is there already. Raises SurveyError, IndeterminateError.
    """
    if not candidates:
        raise SurveyError("there is nothing to choose from; list candidates in plan.toml under [candidates]")
    base = expected if expected is not None else expect(survey, start)
    names = tuple(dict.fromkeys(c.name for c in wanted))
    informed = inform(survey, start, candidates, names)
    by_name, at, k = precision_of(base).unknowns.by_name, {}, 0
    for name in informed.names:
        at[name] = k
        k += by_name[name].dim
    index = np.array([at[c.name] + by_name[c.name].components.index(c.component) for c in wanted], dtype=np.int64)
    updater = Updater(base.precision.joint(informed.names), informed, index)
    before = np.sqrt(np.maximum(np.diag(updater.Q)[index], 0.0))
    left = list(range(len(candidates)))
    steps: list[Gain] = []
    first: tuple[Gain, ...] = ()
    for _ in range(min(n, len(candidates))):
        gains = sorted((_gain(updater, candidates, i) for i in left), key=lambda g: -g.value(criterion))
        first = first or tuple(gains)
        steps.append(gains[0])
        updater.take(gains[0].candidate_idx)
        left.remove(gains[0].candidate_idx)
    return Selection(criterion, tuple(wanted), before, first, tuple(steps))


def _gain(updater: Updater, candidates: Sequence[Candidate], i: int) -> Gain:
    ln_det, ln_det_all, mean_variance, variances = updater.gain(i)
    c = candidates[i]
    return Gain(i, c.name, c.kind, ln_det, ln_det_all, mean_variance, np.sqrt(variances))
