"""Sigmas that are too small throughout a group, told from wrong observations: then limits grow, and nothing goes.

Of many observations the typical test says it. Among few a wrong one shows in most of the others; there the search is
gone through once, worst first, and the state whose explanation is likeliest counts
(:func:`adjust.statistics.criteria.explanation_cost`): if that is one in which the variance of the group is larger, its
limits grow by the factor.
"""

from dataclasses import dataclass

import numpy as np

from adjust.distributions import chi2
from adjust.model.survey import BoolArray, FloatArray
from adjust.statistics.criteria import MANY, cautious, cost_of_leaving_out, explanation_cost, widening
from adjust.statistics.snooping import Snooping

_LONGEST = 60


def group_factors(snooping: Snooping, n_groups: int) -> FloatArray:
    """By how much the sigmas (squared) of every group (G,) are too small, where that cannot be chance; else 1."""
    factors = _of_many(snooping, n_groups)
    snooping.factors = factors
    failing, few = snooping.failing()[0] > 1.0, _few(snooping, n_groups)
    return _of_few(snooping, factors, few) if few[snooping.system.group[failing]].any() else factors


def cautious_groups(snooping: Snooping, n_groups: int) -> BoolArray:
    """Groups (G,) whose residuals are all together far smaller than their sigmas say: nothing contradicts these."""
    T, freedom, _ = snooping.statistics()
    used, group = _used(snooping), snooping.system.group
    return np.array([cautious(T[used & (group == g)], freedom[used & (group == g)]) for g in range(n_groups)])


def _used(snooping: Snooping) -> BoolArray:
    used = snooping.system.used.copy()
    used[snooping.out] = False
    return used


def _of_many(snooping: Snooping, n_groups: int) -> FloatArray:
    T, freedom, _ = snooping.statistics()
    out = np.ones(n_groups)
    for g in range(n_groups):
        mine = snooping.system.used & (snooping.system.group == g) & (freedom > 0)
        n = int(mine.sum())
        if n < MANY:
            continue
        ratio = T[mine] / chi2.ppf(0.5, freedom[mine])
        if np.mean(ratio > 1.0) > 0.5 + 1.5 / np.sqrt(n):  # three sigmas of a fair coin
            out[g] = max(1.0, float(np.median(ratio)))
    return out


def _few(snooping: Snooping, n_groups: int) -> BoolArray:
    """Groups (G,) too small for their typical test."""
    _, freedom, _ = snooping.statistics()
    tested = snooping.system.used & (freedom > 0)
    n = np.bincount(snooping.system.group[tested], minlength=n_groups)
    return np.asarray((n > 0) & (n < MANY))


@dataclass(frozen=True, eq=False)
class _State:
    """One explanation: its cost, and the factors (G,) of limits that go with it, 1 where none is needed."""

    cost: float
    supposed: FloatArray


def _of_few(snooping: Snooping, factors: FloatArray, few: BoolArray) -> FloatArray:
    """The factors, with those of ``few`` groups (G,) as in the likeliest state of the search; it ends as it began."""
    before, states = list(snooping.out), [_state(snooping, few)]
    group = snooping.system.group
    sizes = np.bincount(group[_used(snooping)], minlength=len(few))
    settled = False
    while len(states) <= _LONGEST:
        excess, possible = snooping.failing()
        excess = np.where(possible, excess, 0.0)
        worst = int(excess.argmax())
        g = int(group[worst])
        left = int(np.count_nonzero(group[_used(snooping)] == g))
        settled = bool(excess[worst] <= 1.0)
        if settled or (few[g] and 2 * (left - 1) < sizes[g]):
            break
        snooping.leave_out(worst)
        states.append(_state(snooping, few))
    else:
        return _restored(snooping, before, factors)  # far too much is wrong to judge a small group by it
    best = min(range(len(states)), key=lambda i: states[i].cost)
    if settled and best == len(states) - 1:
        return _restored(snooping, before, factors)
    return _restored(snooping, before, np.maximum(factors, np.where(few, states[best].supposed, 1.0)))


def _restored(snooping: Snooping, before: list[int], factors: FloatArray) -> FloatArray:
    snooping.take_back([o for o in snooping.out if o not in before])
    return factors


def _state(snooping: Snooping, few: BoolArray) -> _State:
    s, G = snooping.system, len(few)
    used, (T, freedom, _) = _used(snooping), snooping.statistics()
    rows = used[s.row_of]
    omega = np.bincount(s.group[s.row_of[rows]], weights=snooping.g[rows] ** 2, minlength=G)
    own = np.zeros(len(snooping.sizes))
    for k, R in zip(np.unique(snooping.sizes), snooping.R, strict=True):
        own[snooping.sizes == k] = np.einsum("nii->n", R)
    redundancy = np.bincount(s.group[used], weights=own[used], minlength=G)
    out = np.array(snooping.out, dtype=np.int64)
    limits = np.asarray(chi2.isf(snooping.level, snooping.sizes[out])) * snooping.factors[s.group[out]]
    statistics = np.array([snooping.verdict(o).statistic for o in snooping.out])
    left_out = cost_of_leaving_out(statistics, snooping.sizes[out], limits)
    cost = explanation_cost(zip(omega.tolist(), redundancy.tolist(), strict=True), left_out)
    supposed = np.ones(G)
    for g in np.flatnonzero(few).tolist():
        mine = used & (s.group == g)
        supposed[g] = widening(float(omega[g]), float(redundancy[g]), T[mine], freedom[mine])
    return _State(cost, supposed)
