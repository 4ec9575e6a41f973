"""Wrong pairs: found by graduated non-convexity, judged by their own tests, listed, and taken back where they fit.

Rotations first, then positions, each by a solver that needs no start, with the truncated least squares weights of Yang,
Antonante, Tzoumas and Carlone (Graduated non-convexity for robust spatial perception, RA-L 2020). What that sorts out
is only a proposal: a clean least squares over the rest decides, pair by pair, by the chi-square test of the pair
against all others, at one level for the whole network (Sidak 1967). Where the residuals are far smaller than the
sigmas say, nothing is looked for; where sigmas that are too small throughout explain them better than wrong pairs, the
limits grow.
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adjust.distributions import chi2
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.survey import BoolArray, FloatArray
from adjust.observations.pairs import PairStatistics
from adjust.pose_network.network import PoseNetwork, loop_marks
from adjust.pose_network.precision import NetworkPrecision
from adjust.pose_network.solve import Minimum, NetworkOptions, Progress, minimize
from adjust.pose_network.start import (
    rotation_residuals,
    start_rotations,
    start_translations,
    translation_misfits,
    translation_sigmas,
)
from adjust.statistics.criteria import (
    CAUTIOUS,
    MANY,
    cautious,
    cost_of_leaving_out,
    explanation_cost,
    sidak,
    typical_factor,
    widening,
)

_TRUNCATION = float(chi2.isf(1e-4, 3))
_SLACK = 4.0  # positions inherit what is left in the rotations of the first stage
_LEAST = 1e-6  # pairs that are sorted out keep this weight, so that the network holds together
_GROWTH = 1.6
_ROUNDS = 40


@dataclass(frozen=True, eq=False)
class RejectedPair:
    """A pair that contradicts the rest: test against its prediction, chi-square with ``freedom`` degrees of freedom.

    residual: (dim,) Log(measured^-1 predicted). inseparable: pairs that might as well be the wrong one, since they
    share all their loops with it.
    """

    pair_id: str
    test: float
    freedom: int
    p_value: float
    residual: FloatArray
    inseparable: tuple[str, ...]

    def __str__(self) -> str:
        turn = np.degrees(np.linalg.norm(self.residual[:3]))
        shift = f" and {np.linalg.norm(self.residual[3:]):.4g} m" if len(self.residual) == 6 else ""
        alike = f"; {', '.join(self.inseparable)} could as well be wrong" if self.inseparable else ""
        return f"pair {self.pair_id}: off by {turn:.4g} deg{shift}, test {self.test:.1f}, p {self.p_value:.2g}{alike}"


@dataclass(frozen=True, eq=False)
class Cleaned:
    """Least squares over the pairs that hold together, with the statistics of all. variance_factor: see below."""

    network: PoseNetwork
    minimum: Minimum
    precision: NetworkPrecision
    rejected: tuple[RejectedPair, ...]
    variance_factor: float


@dataclass(frozen=True, eq=False)
class _State:
    """Least squares of some pairs. limit: (E,) of the tests, at variance factor 1; factor: what these are widened by.

    over: (E,) tests over their limits, 0 where untested. cost: of this explanation. supposed: the factor of
    the limits that goes with it.
    """

    network: PoseNetwork
    minimum: Minimum
    precision: NetworkPrecision
    limit: FloatArray
    factor: float
    over: FloatArray
    cost: float
    supposed: float


def variance_factor(pairs: PairStatistics, used: BoolArray) -> float:
    """How much larger than claimed the typical pair's test is, at least 1: median over chi-square's median.

    With sigmas that are too small throughout every pair would fail; a pair is wrong only beside the others. Of few
    pairs the median is no measure, for a wrong one shows in most of the others.
    """
    rows = used & (pairs.freedom > 0)
    return max(1.0, typical_factor(pairs.test[rows], pairs.freedom[rows])) if int(rows.sum()) >= MANY else 1.0


def _graduated(
    network: PoseNetwork, fit: Callable[[FloatArray], FloatArray], c2: float, weights: FloatArray
) -> FloatArray:
    """Weights (E,) after graduated non-convexity; ``fit`` gives the squared misfits (E,) of a weighted solution."""
    rows = network.used & (weights > 0.5)
    r2 = fit(np.maximum(weights, _LEAST))
    worst = float(r2[rows].max(initial=0.0))
    if 2.0 * worst <= c2:
        return weights
    mu = c2 / (2.0 * worst - c2)
    while True:
        with np.errstate(divide="ignore"):
            middle = np.sqrt(c2 * mu * (mu + 1.0) / np.maximum(r2, 1e-300)) - mu
        new = np.where(r2 >= (mu + 1.0) / mu * c2, 0.0, np.where(r2 <= mu / (mu + 1.0) * c2, 1.0, middle))
        new = np.where(rows, new, 0.0)
        if mu > 1e3 or (mu > 1.0 and not np.any((new > 0.01) & (new < 0.99))):
            return new
        mu *= _GROWTH
        r2 = fit(np.maximum(new, _LEAST))


def graduated_weights(network: PoseNetwork, factor: float = 1.0) -> FloatArray:
    """1 for the pairs (E,) that agree on rotations and positions, 0 for the others. factor: of all variances."""
    info = np.linalg.inv(network.cov[:, :3, :3])

    def rotations(weights: FloatArray) -> FloatArray:
        R = start_rotations(network, weights)
        e = rotation_residuals(network, R)
        return np.asarray(np.einsum("ni,nij,nj->n", e, info, e))

    weights = _graduated(network, rotations, factor * _TRUNCATION, network.used.astype(float))
    if not network.is_pose.any():
        return weights
    R = start_rotations(network, np.maximum(weights, _LEAST))
    sigma = translation_sigmas(network)

    def positions(w: FloatArray) -> FloatArray:
        t = start_translations(network, R, w)
        return np.asarray((translation_misfits(network, R, t) / sigma) ** 2)

    return _graduated(network, positions, factor * _SLACK * _TRUNCATION, weights)


def clean(
    network: PoseNetwork, options: NetworkOptions, start: tuple[FloatArray, FloatArray] | None = None,
    progress: Progress | None = None,
) -> Cleaned:  # fmt: skip
    """Least squares over the pairs that pass their tests. Raises as :func:`adjust.pose_network.solve.minimize`."""
    search = _Search(network, options, progress)
    first: _State | None = None
    if options.robust == "auto":
        with contextlib.suppress(NotConvergedError):  # by wrong pairs; without them the next attempt says more
            first = search.state(network.used, start)
        if first is not None and (not (first.over > 1.0).any() or _far_below(first)):
            return search.cleaned(first)
    weights = graduated_weights(network, 1.0 if first is None else first.factor)
    try:
        last = search.settled(_connected(network, weights))
        if first is not None and int(network.used.sum()) < MANY:
            search.descend(first)
            best = min(search.states, key=lambda state: state.cost)
            if best.cost < last.cost:
                last = search.settled(best.network.used, best.supposed)
    except (IndeterminateError, NotConvergedError):
        if first is None:
            raise
        last = first  # what contradicts is in its tests
    return search.cleaned(last)


def _far_below(state: _State) -> bool:
    """Whether residuals are together far smaller than their sigmas say, by v'Pv or by the tests of the pairs."""
    pairs, used = state.precision.pairs, state.network.used
    redundancy = float(pairs.redundancy[used].sum())
    return state.minimum.omega < CAUTIOUS**2 * redundancy or cautious(pairs.test[used], pairs.freedom[used])


class _Search:
    """The search in one network, and all states that it came through."""

    def __init__(self, network: PoseNetwork, options: NetworkOptions, progress: Progress | None) -> None:
        self.network, self.options, self.progress = network, options, progress
        self.candidates = network.used
        self.states: list[_State] = []

    def state(
        self, used: BoolArray, start: tuple[FloatArray, FloatArray] | None, least_factor: float = 1.0
    ) -> _State:
        """Least squares of the pairs in ``used`` (E,), judged."""
        network = self.network.with_used(used)
        minimum = minimize(network, start, self.options, progress=self.progress)
        precision = NetworkPrecision(network, minimum)
        pairs = precision.pairs
        tested = self.candidates & (pairs.freedom > 0)
        level = sidak(self.options.alpha, int(tested.sum()))
        limit = np.asarray(chi2.isf(level, np.maximum(pairs.freedom, 1)))
        factor = max(least_factor, variance_factor(pairs, used))
        over = np.where(tested, np.nan_to_num(pairs.test) / (factor * limit), 0.0)
        omega, redundancy = minimum.omega, float(pairs.redundancy[used].sum())
        gone = tested & ~used
        left_out = cost_of_leaving_out(pairs.test[gone], pairs.freedom[gone], limit[gone])
        cost = explanation_cost([(omega, redundancy)], left_out)
        supposed = widening(omega, redundancy, pairs.test[used], pairs.freedom[used])
        found = _State(network, minimum, precision, limit, factor, over, cost, supposed)
        self.states.append(found)
        return found

    def settled(self, used: BoolArray, least_factor: float = 1.0) -> _State:
        """From these pairs on: what fails goes, what fits comes back, until neither is left."""
        taken_back = np.zeros(self.network.n_pairs, dtype=np.bool_)
        poses: tuple[FloatArray, FloatArray] | None = None
        for _ in range(_ROUNDS):
            now = self.state(used, poses, least_factor)
            poses = now.minimum.rotations, now.minimum.translations
            back = self.candidates & ~used & (now.over <= 1.0) & ~taken_back
            out = _worst_around(now.network, np.where(used, now.over, 0.0))
            if not back.any() and not out.any():
                return now
            taken_back |= back
            used = (used | back) & ~out
        raise NotConvergedError(f"no set of pairs that agree was found in {_ROUNDS} rounds; the pairs contradict")

    def descend(self, state: _State) -> None:
        """One pair after the other, the worst first, down to half of them: every state is an explanation."""
        while (state.over[state.network.used] > 1.0).any():
            used = state.network.used.copy()
            over = np.where(used, state.over, 0.0)
            over[over < over.max()] = 0.0
            used &= ~_worst_around(state.network, over)
            if used.sum() == state.network.used.sum() or 2 * used.sum() < self.candidates.sum():
                return
            state = self.state(used, (state.minimum.rotations, state.minimum.translations))

    def cleaned(self, state: _State) -> Cleaned:
        """As the result."""
        rejected = _listed(state.network, state.precision, self.candidates)
        return Cleaned(state.network, state.minimum, state.precision, rejected, state.factor)


def _worst_around(network: PoseNetwork, over: FloatArray) -> BoolArray:
    """Pairs that fail worse than every other pair at their stations: an error shows in its neighbours too.

    Only as many as leave the network in one piece.
    """
    bad = np.flatnonzero(over > 1.0)
    out = np.zeros(network.n_pairs, dtype=np.bool_)
    blocked = np.zeros(network.n_stations, dtype=np.bool_)
    chosen = []
    for e in bad[np.argsort(-over[bad], kind="stable")].tolist():
        a, b = network.a_idx[e], network.b_idx[e]
        if not blocked[a] and not blocked[b]:
            chosen.append(e)
        blocked[a] = blocked[b] = True
    out[chosen] = True
    whole = _pieces(network, network.used)
    if chosen and _pieces(network, network.used & ~out) != whole:
        out[:] = False
        for e in chosen:  # worst first
            out[e] = True
            out[e] = _pieces(network, network.used & ~out) == whole
    return out


def _pieces(network: PoseNetwork, used: BoolArray) -> tuple[int, int]:
    """Into how many the network falls, by all pairs and by those that have a translation."""
    by_all, by_poses = (int(network.components(used, poses).max(initial=0)) for poses in (False, True))
    return by_all, by_poses


def _connected(network: PoseNetwork, weights: FloatArray) -> BoolArray:
    """The pairs of weight above one half, and of the others as many as hold the network together."""
    used = network.used & (weights > 0.5)
    for poses_only in (False, True):
        part = network.components(used, poses_only)
        if part.max(initial=0) == 0:
            continue
        whole = network.components(network.used, poses_only)
        for e in np.flatnonzero(network.used & ~used):
            if poses_only and not network.is_pose[e]:
                continue
            a, b = part[network.a_idx[e]], part[network.b_idx[e]]
            if a != b and whole[network.a_idx[e]] == whole[network.b_idx[e]]:
                used[e] = True
                part[part == b] = a
    return used


def _listed(network: PoseNetwork, precision: NetworkPrecision, candidates: BoolArray) -> tuple[RejectedPair, ...]:
    out = []
    pairs = precision.pairs
    for e in np.flatnonzero(candidates & ~network.used):
        loops, mark = loop_marks(network, network.used | (np.arange(network.n_pairs) == e))
        same = np.flatnonzero((mark == mark[e]) & (loops > 0)) if loops[e] else np.zeros(0, dtype=np.int64)
        alike = tuple(network.pair_ids[i] for i in same if i != e)
        out.append(
            RejectedPair(network.pair_ids[e], float(pairs.test[e]), int(pairs.freedom[e]), float(pairs.p_value[e]),
                         pairs.residual[e], alike)
        )  # fmt: skip
    return tuple(sorted(out, key=lambda r: -r.test))
