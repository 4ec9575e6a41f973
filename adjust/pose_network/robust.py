"""Wrong pairs: found by graduated non-convexity, judged by their own tests, listed, and taken back where they fit.

Rotations first, then positions, each by a solver that needs no start, with the truncated least squares weights of Yang,
Antonante, Tzoumas and Carlone (Graduated non-convexity for robust spatial perception, RA-L 2020). What that sorts out
is only a proposal: a clean least squares over the rest decides (:mod:`adjust.statistics.gross_errors`), pair by pair,
by the chi-square test of the pair against all others.
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from adjust.distributions import chi2
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.survey import BoolArray, FloatArray
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
from adjust.statistics.criteria import CAUTIOUS, MANY
from adjust.statistics.gross_errors import Search, State, Verdicts, one_group

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
    """Least squares over the pairs that hold together, with the statistics of all."""

    network: PoseNetwork
    minimum: Minimum
    precision: NetworkPrecision
    rejected: tuple[RejectedPair, ...] = ()


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

    def solve(used: BoolArray, before: State[Cleaned] | None) -> tuple[Cleaned, Verdicts]:
        here = None if before is None else before.solution.minimum
        return _solved(network, used, options, progress, None if here is None else (here.rotations, here.translations))

    search = Search(solve, options.alpha, _step, MANY)
    first: State[Cleaned] | None = None
    if options.robust == "auto":
        with contextlib.suppress(NotConvergedError):  # by wrong pairs; without them the next attempt says more
            first = search.judged(*_solved(network, network.used, options, progress, start))
        if first is not None and (not first.failing.any() or _far_below(first.tests)):
            return _listed(first.solution, network.used)
    weights = graduated_weights(network, 1.0 if first is None else float(first.factor[0]))
    try:
        last = search.settled(search.judged(*solve(_connected(network, weights), None)), _ROUNDS)
        few = first is not None and int(network.used.sum()) < MANY
        best = search.likeliest(first, np.ones(1, dtype=np.bool_)) if first is not None and few else None
        if best is not None and best.cost < last.cost:
            wider = replace(search, factor=best.supposed)
            last = wider.settled(wider.judged(best.solution, best.tests), _ROUNDS)
    except (IndeterminateError, NotConvergedError):
        if first is None:
            raise
        last = first  # what contradicts is in its tests
    return _listed(last.solution, network.used)


def _far_below(tests: Verdicts) -> bool:
    """Whether residuals are together far smaller than their sigmas say, by v'Pv or by the tests of the pairs."""
    return bool(tests.omega[0] < CAUTIOUS**2 * tests.redundancy[0] or tests.cautious[0])


def _solved(
    network: PoseNetwork, used: BoolArray, options: NetworkOptions, progress: Progress | None,
    start: tuple[FloatArray, FloatArray] | None,
) -> tuple[Cleaned, Verdicts]:  # fmt: skip
    """Least squares of the pairs in ``used`` (E,), and the tests of all that the network uses."""
    part = network.with_used(used)
    minimum = minimize(part, start, options, progress=progress)
    precision = NetworkPrecision(part, minimum)
    pairs = precision.pairs
    freedom = np.where(network.used, pairs.freedom, 0)
    redundancy = float(pairs.redundancy[used].sum())
    tests = one_group(pairs.test, freedom, used, minimum.omega, redundancy)
    return Cleaned(part, minimum, precision), replace(tests, possible=network.used)


def _step(state: State[Cleaned], returned: BoolArray) -> tuple[BoolArray, BoolArray]:
    """The worst all over the network go at once, and all that fit, or that nothing checks, come back."""
    used = state.tests.used
    back = state.tests.possible & ~used & (state.over <= 1.0) & ~returned
    return _worst_around(state.solution.network, np.where(used, state.over, 0.0)), back


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


def _listed(found: Cleaned, candidates: BoolArray) -> Cleaned:
    """With the pairs that were left out, worst first."""
    out, network, pairs = [], found.network, found.precision.pairs
    for e in np.flatnonzero(candidates & ~network.used):
        loops, mark = loop_marks(network, network.used | (np.arange(network.n_pairs) == e))
        same = np.flatnonzero((mark == mark[e]) & (loops > 0)) if loops[e] else np.zeros(0, dtype=np.int64)
        alike = tuple(network.pair_ids[i] for i in same if i != e)
        out.append(
            RejectedPair(network.pair_ids[e], float(pairs.test[e]), int(pairs.freedom[e]), float(pairs.p_value[e]),
                         pairs.residual[e], alike)
        )  # fmt: skip
    return replace(found, rejected=tuple(sorted(out, key=lambda r: -r.test)))
