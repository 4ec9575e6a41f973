"""Variance components of the groups of a survey, iterated until the residuals of each are as large as they say.

Helmert's equations are solved in every step, which is Fisher's scoring of the restricted likelihood (REML); where that
would leave the positive factors or go far, the scoring of their logarithms. In very large surveys it is Foerstner's
(1979) step ``factor * q / r``: the same fixed point without traces, but only for groups that share no correlated block.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues, values_of
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Component, VarianceComponents
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.precision.precision import precision_of
from adjust.statistics.group_sums import GroupSums, Moments, group_sums, moments, scaled_survey
from adjust.statistics.normal import DENSE
from adjust.statistics.system import LinearSystem, linear_system, mixed_blocks
from adjust.testing.distributions import chi2

_VANISHED = 1e-6
_SINGULAR = 1e-6
_LONGEST = 1.5
_MANY_POINTS = 300_000
_LINEAR_STEPS = 100
_FIXED = "prior"
"""A group that keeps its variance."""
_LEAST = 1.0
"""Redundancy below which a group is not estimated."""
_CONVERGENCE, _ROUNDS = 1e-4, 20
"""Relative change of all factors by one more solution of the survey, and solutions at most."""
_USUAL = AdjustOptions()
_LEVEL = 0.95
"""Of the confidence limits."""


@frozen(eq=False)
class Scaled:
    """A survey adjusted with its estimated variances, and the components that were found."""

    adjustment: Adjustment
    components: VarianceComponents


@frozen(eq=False)
class LinearComponents:
    """Factors of a linear system. theta: (G,) of all groups; estimated: (G,) which were; S: (k, k) of the sets.

    merged: (G,) number of the set that a group was estimated with, -1 for those that were not. vanished: (G,).
    """

    theta: FloatArray
    estimated: BoolArray
    merged: IntArray
    vanished: BoolArray
    S: FloatArray
    moments: Moments
    steps: int
    converged: bool


def estimate_variance_components(
    survey: Survey, start: StartValues | None = None, options: AdjustOptions = _USUAL,
    progress: Callable[[int, float], None] | None = None, first: Adjustment | None = None,
) -> Scaled:  # fmt: skip
    """Estimate the variance components of a survey's groups, and adjust it with them.

    first: an adjustment of this survey, where there is one. Raises as :func:`adjust.adjustment.adjust`.
    """
    now = first or adjust(survey, start, options, progress)
    survey = now.survey
    total: dict[str, float] = {}
    for iteration in range(1, _ROUNDS + 1):
        found = _of_adjustment(now)
        change = max((abs(np.log(c.factor)) for c in found.components if c.status in _CHANGED), default=0.0)
        if change < _CONVERGENCE:
            return Scaled(now, _totals(found, total, iteration, True))
        total = {c.group: total.get(c.group, 1.0) * c.factor for c in found.components}
        now = adjust(scaled_survey(survey, total), values_of(now), options, progress)
    return Scaled(now, _totals(_of_adjustment(now), total, _ROUNDS, False))


_CHANGED = ("estimated", "unseparable", "vanished")


def _totals(found: VarianceComponents, total: dict[str, float], iterations: int, converged: bool) -> VarianceComponents:
    """The last step's components with factors over the a priori variances."""
    components = []
    for c in found.components:
        factor = total.get(c.group, 1.0)
        status = "vanished" if c.status == "estimated" and factor < 10.0 * _VANISHED else c.status
        components.append(_tested(replace(c, factor=factor, sigma=c.sigma / c.factor * factor, status=status)))
    return replace(found, components=tuple(components), iterations=iterations, converged=converged)


def _of_adjustment(adjustment: Adjustment) -> VarianceComponents:
    wanted = tuple(g.group for g in adjustment.groups if g.group != _FIXED)
    large = precision_of(adjustment).graph.unknowns.n_unknowns > DENSE
    if large or len(adjustment.image_residuals.test) > _MANY_POINTS:
        return _simplified(adjustment, wanted)
    return components_of(linear_system(adjustment), wanted)


def _simplified(adjustment: Adjustment, wanted: Sequence[str]) -> VarianceComponents:
    """Foerstner's step from the sums of the adjustment; sigmas without the coupling of the groups."""
    out = []
    for g in adjustment.groups:
        enough = g.group in wanted and g.redundancy >= _LEAST
        status = "estimated" if enough else "no redundancy" if g.group in wanted else "fixed"
        factor = max(g.factor, _VANISHED) if enough else 1.0
        sigma = factor * np.sqrt(2.0 / g.redundancy) if enough else np.nan
        component = Component(g.group, factor, float(sigma), g.n_observations, g.redundancy, g.omega, status)
        out.append(_tested(component))
    names = tuple(c.group for c in out if c.status == "estimated")
    return VarianceComponents(tuple(out), names, np.eye(len(names)), (), 1, True, "foerstner")


def components_of(system: LinearSystem, wanted: Sequence[str]) -> VarianceComponents:
    """Variance components of a linear system: no new linearisation."""
    names = system.group_names
    mixed = [(rows, np.array([names.index(g) for g in of], dtype=np.int64), back)
             for rows, of, back in mixed_blocks(system)]  # fmt: skip
    sums = group_sums(system, mixed)
    chosen = np.array([g in wanted for g in names], dtype=np.bool_)
    return _named(names, sums, chosen, linear_components(sums, chosen))


def linear_components(sums: GroupSums, chosen: BoolArray) -> LinearComponents:
    """Factors of the ``chosen`` groups (G,); the others keep 1. Groups that cannot be told apart share one factor."""
    G = len(chosen)
    first = moments(sums, np.ones(G))
    chosen = chosen & (first.r >= _LEAST)
    sets = _sets(first.S, chosen)
    to = np.where(sets >= 0, sets, 0)
    k = int(sets.max(initial=-1)) + 1
    fixed = sets < 0
    to[fixed] = k  # all fixed ones together, last
    small = sums.merged(to) if G else sums
    n_sets = int(to.max(initial=-1)) + 1
    theta, converged, steps = np.ones(n_sets), k == 0, 0
    now = moments(small, theta)
    held = np.zeros(k, dtype=np.bool_)
    while not converged and steps < _LINEAR_STEPS:
        steps += 1
        step = _step(now, k, held)
        theta[:k] = np.maximum(theta[:k] * step, _VANISHED)
        held |= theta[:k] <= _VANISHED
        now = moments(small, theta)
        converged = bool(np.all(np.abs(np.log(step))[~held] < 1e-2 * _CONVERGENCE))
    factors = np.where(fixed, 1.0, theta[to])
    merged = np.where(fixed, -1, to)
    vanished = ~fixed & (factors <= _VANISHED)
    final = now if n_sets == G and k == G else moments(sums, factors)
    return LinearComponents(factors, ~fixed, merged, vanished, now.S[:k, :k], final, steps, converged)


def _step(now: Moments, k: int, held: BoolArray) -> FloatArray:
    """Relative change (k,) of the factors: Helmert's where it is positive and not far, else of their logarithms."""
    free = np.flatnonzero(~held)
    rest = np.setdiff1d(np.arange(len(now.q)), free)
    right = now.q[free] - now.S[np.ix_(free, rest)].sum(axis=1)
    out = np.ones(k)
    out[free] = np.linalg.lstsq(now.S[np.ix_(free, free)], right, rcond=1e-10)[0]
    if not (np.all(out[free] > 0.2) and np.all(out[free] < 5.0)):
        score = now.q[free] - now.r[free]
        logs = np.linalg.lstsq(now.S[np.ix_(free, free)], score, rcond=1e-10)[0]
        out[free] = np.exp(np.clip(logs, -_LONGEST, _LONGEST))
    return out


def _sets(S: FloatArray, chosen: BoolArray) -> IntArray:
    """Number (G,) of the set of groups that are estimated together, -1 for what is not estimated.

    Where a combination of factors leaves all expectations as they are, its groups cannot be told apart.
    """
    index = np.flatnonzero(chosen)
    sets = np.full(len(chosen), -1, dtype=np.int64)
    sets[index] = np.arange(len(index))
    if not len(index):
        return sets
    scale = 1.0 / np.sqrt(np.maximum(np.diag(S)[index], 1e-300))
    values, vectors = np.linalg.eigh(S[np.ix_(index, index)] * np.outer(scale, scale))
    for vector in vectors[:, values < _SINGULAR].T:
        together = index[np.abs(vector) > 0.05]
        sets[np.isin(sets, sets[together])] = sets[together].min()
    for new, old in enumerate(np.unique(sets[sets >= 0])):
        sets[sets == old] = new
    return sets


def _named(names: Sequence[str], sums: GroupSums, chosen: BoolArray, found: LinearComponents) -> VarianceComponents:
    k = len(found.S)
    cov = 2.0 * np.linalg.pinv(found.S, hermitian=True) if k else np.zeros((0, 0))
    counts = sums.n.copy()
    for m in sums.mixed:
        np.add.at(counts, m.group, 1.0)
    out = []
    shared = [tuple(np.array(names)[found.merged == i].tolist()) for i in range(k)]
    for g, name in enumerate(names):
        if counts[g] == 0:
            continue
        at = int(found.merged[g])
        sigma = found.theta[g] * np.sqrt(cov[at, at]) if at >= 0 else np.nan
        status = "fixed" if not chosen[g] else "no redundancy"
        if at >= 0:
            status = "unseparable" if len(shared[at]) > 1 else "vanished" if found.vanished[g] else "estimated"
        component = Component(name, float(found.theta[g]), float(sigma), int(counts[g]), float(found.moments.r[g]),
                              float(found.moments.q[g]), status)  # fmt: skip
        out.append(_tested(component))
    d = np.sqrt(np.diag(cov))
    correlation: FloatArray = np.asarray(cov / np.outer(d, d), dtype=float)
    return VarianceComponents(
        tuple(out), tuple(" + ".join(s) for s in shared), correlation, tuple(s for s in shared if len(s) > 1),
        found.steps, found.converged, "reml",
    )  # fmt: skip


def _tested(given: Component) -> Component:
    """With limits and test from chi-square with the equivalent degrees of freedom (Satterthwaite 1946)."""
    factor, sigma = given.factor, given.sigma
    if given.status == "vanished" or not (np.isfinite(sigma) and sigma > 0.0 and factor > 0.0):
        return replace(given, freedom=np.nan, p=np.nan, lower=np.nan, upper=np.nan)
    freedom = 2.0 * factor**2 / sigma**2
    low, high = chi2.ppf([0.5 - 0.5 * _LEVEL, 0.5 + 0.5 * _LEVEL], freedom)
    p = 2.0 * min(float(chi2.cdf(factor * freedom, freedom)), float(chi2.sf(factor * freedom, freedom)))
    return replace(given, freedom=freedom, p=min(1.0, p), lower=float(factor * freedom / high),
                   upper=float(factor * freedom / low))  # fmt: skip
