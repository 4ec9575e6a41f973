"""Whom to suspect among measured pairs, by their loops: what no start and no solution is needed for.

A wrong pair leaves all its loops open, a right one only those through wrong ones. Every loop is tested with the full
covariances of its pairs; the pairs of a loop that closes agree. What that sorts out is only a proposal: tests decide
(:mod:`adjust.statistics.outliers.search`).
"""

from collections import defaultdict
from collections.abc import Sequence
from itertools import count

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.result import ParameterName
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.observations.images.segments import ranges
from adjust.pose_network.cycles import flat, short_loops
from adjust.pose_network.from_survey import network_from_survey
from adjust.pose_network.loops import Loops, misclosures, walked
from adjust.pose_network.network import PoseNetwork, check_determined
from adjust.pose_network.solve import NetworkOptions, minimize
from adjust.pose_network.start import find_network_start
from adjust.spatial.rigid_motions import Motions
from adjust.testing.criteria import MANY, limits, typical_factor
from adjust.testing.distributions import chi2

_SEEN = 100
"""Stations among which another way is looked for between the ends of a pair."""
_SOUND = 0.1
"""Share of the loops that go through no wrong pair, at least: their tests tell whether the sigmas are too small."""
_PROPOSING = NetworkOptions(max_step=1e-2, covariances=False)
"""Sigmas: what is proposed is tested again at a minimum to the last digit."""


def agreeing(network: PoseNetwork, family_alpha: float = 0.001, factor: float = 1.0) -> BoolArray:
    """Pairs (E,) in use that are in a loop that closes, or in none that is short. factor: of all variances.

    Each of the others is looked at again with those alone that agree already, with one more at every station, and with
    all but one there, which take turns: a wrong pair may leave open the loops of all others at its end. So on until no
    more agree.
    """
    loops = pair_loops(network)
    fine = network.used.copy()
    fine[loops.pair_idx] = False
    if not len(loops):
        return fine
    test, freedom = _tests(network, loops)
    scale = max(factor, float(np.quantile(test / chi2.ppf(_SOUND, freedom), _SOUND)))
    limit = scale * limits(family_alpha, np.arange(7), len(loops))
    fine |= _in_closing(network, loops, limit)
    while True:
        before = int(np.count_nonzero(fine))
        turns = _in_turn(network, network.used & ~fine)
        for guests in (fine, *turns, *(network.used & ~mine for mine in turns)):
            fine |= _in_closing(network, _short_loops(network, network.used & ~fine, fine | guests), limit)
        if np.count_nonzero(fine) == before:
            return fine


def pair_loops(network: PoseNetwork) -> Loops:
    """A short loop through each pair in use, where there is one."""
    return _short_loops(network, network.used, network.used)


def loop_tests(
    network: PoseNetwork, loops: Loops, pair_idx: IntArray, others: Motions, sets: Sequence[IntArray]
) -> FloatArray:
    """(n, E) misclosures of each pair's loop, chi-square over its freedom; nan without one.

    pair_idx: (m,) pairs that may have other motions, and these; sets: n times the numbers (k,) of those taken. Only
    the loops through them are walked anew. loops: of :func:`pair_loops`.
    """
    size = network.n_pairs
    taken = np.tile(np.arange(size), (len(sets), 1))
    for row, some in zip(taken, sets, strict=True):
        row[pair_idx[some]] = size + some
    out = np.full(taken.shape, np.nan)
    if not len(sets) or not len(loops):
        return out
    test, freedom = _tests(network, loops)
    tests = np.tile(test / freedom, (len(sets), 1))
    set_of, of = np.nonzero(np.logical_or.reduceat(taken[:, loops.pair_idx] >= size, loops.ptr[:-1], axis=1))
    if len(of):
        rows = ranges(loops.ptr[of], loops.lengths[of])
        pairs = taken[np.repeat(set_of, loops.lengths[of]), loops.pair_idx[rows]]
        ptr = np.concatenate([[0], np.cumsum(loops.lengths[of])])
        changed = Loops(ptr, pairs, loops.sense[rows], loops.start_idx[of])
        every, known = np.append(np.arange(size), pair_idx), network.arrays.motions
        motions = Motions(np.concatenate([known.rotation, others.rotation]),
                          np.concatenate([known.shifts, others.shifts]))  # fmt: skip
        test, freedom = _tested(changed, motions, network.cov[every], network.sizes[every], network.dim)
        tests[set_of, of] = test / freedom
    out[:, loops.pair_idx[loops.ptr[:-1]]] = tests
    return out


def _in_closing(network: PoseNetwork, loops: Loops, limit: FloatArray) -> BoolArray:
    """Pairs (E,) of the loops whose test is not above its limit (7,), by degrees of freedom."""
    out = np.zeros(network.n_pairs, dtype=np.bool_)
    if len(loops):
        test, freedom = _tests(network, loops)
        out[loops.pair_idx[np.repeat(test <= limit[freedom], loops.lengths)]] = True
    return out


def _in_turn(network: PoseNetwork, pairs: BoolArray) -> list[BoolArray]:
    """These pairs (E,) in sets, no two of a set at the same station."""
    sets: list[BoolArray] = []
    of_station: dict[int, set[int]] = defaultdict(set)
    for e in np.flatnonzero(pairs).tolist():
        at_a, at_b = of_station[int(network.a_idx[e])], of_station[int(network.b_idx[e])]
        turn = next(k for k in count() if k not in at_a and k not in at_b)
        at_a.add(turn)
        at_b.add(turn)
        if turn == len(sets):
            sets.append(np.zeros(network.n_pairs, dtype=np.bool_))
        sets[turn][e] = True
    return sets


def _short_loops(network: PoseNetwork, pairs: BoolArray, through: BoolArray) -> Loops:
    """One for each of these pairs (E,), where there is one that goes through those (E,)."""
    a, b = network.a_idx, network.b_idx
    found = short_loops(network.n_stations, a, b, np.flatnonzero(pairs), np.flatnonzero(through), _SEEN)
    return walked(a, b, flat(found), a[np.array([loop[0] for loop in found], dtype=np.int64)])


def _tests(network: PoseNetwork, loops: Loops) -> tuple[FloatArray, IntArray]:
    """Of the misclosures (L,), chi-square with so many degrees of freedom (L,): 3 with a pair that is a rotation."""
    return _tested(loops, network.arrays.motions, network.cov, network.sizes, network.dim)


def _tested(loops: Loops, motions: Motions, cov: FloatArray, sizes: IntArray, d: int) -> tuple[FloatArray, IntArray]:
    w, C = misclosures(loops, motions.in_dim(d), np.nan_to_num(cov[:, :d, :d], posinf=0.0))
    test, freedom = np.zeros(len(loops)), np.minimum.reduceat(sizes[loops.pair_idx], loops.ptr[:-1])
    for k in np.unique(freedom).tolist():
        of = np.flatnonzero(freedom == k)
        test[of] = np.einsum("li,li->l", w[of, :k], np.linalg.solve(C[of, :k, :k], w[of, :k, None])[..., 0])
    return test, freedom


def agreeing_poses(survey: Survey) -> dict[ParameterName, Pose3]:
    """Start values of all stations of a survey of nothing but pairs, as :func:`agreeing_start` finds them.

    Raises IndeterminateError naming the stations that no pair ties to the others.
    """
    network = network_from_survey(survey, any_datum=True)
    check_determined(network)
    R, t = agreeing_start(network)
    return {("world_from_station", s): Pose3(Rot3(R[i]), t[i]) for i, s in enumerate(network.station_ids)}


def agreeing_start(network: PoseNetwork) -> tuple[FloatArray, FloatArray]:
    """``world_from_station`` (N, 3, 3), (N, 3) from the pairs that agree with each other."""
    return find_network_start(network.with_used(_connected(network, agreeing(network))))


def disagreeing(
    network: PoseNetwork, family_alpha: float, factor: float = 1.0
) -> tuple[BoolArray, tuple[FloatArray, FloatArray]] | None:
    """Pairs (E,) in use that do not agree with the others, and can all go at once; the solution of the others.

    None where all agree. Loops sort out; after the least squares of the rest what fits comes back, for a square of the
    residual that does not reach the limit of a test cannot fail it. factor: of all variances.
    """
    fine = agreeing(network, family_alpha, factor)
    if (fine == network.used).all():
        return None
    used = _connected(network, fine)
    found = minimize(network.with_used(used), options=_PROPOSING)
    squares = _squares(network, found.rotations, found.translations)
    typical = typical_factor(squares[used], network.sizes[used]) if used.sum() >= MANY else 1.0
    limit = max(factor, typical) * limits(family_alpha, network.sizes, int(network.used.sum()))
    return network.used & ~used & (squares > limit), (found.rotations, found.translations)


def _squares(network: PoseNetwork, R: FloatArray, t: FloatArray) -> FloatArray:
    """Whitened squares (E,) of all pairs with the stations there."""
    here, measured = (motions.in_dim(network.dim) for motions in (Motions(R, t), network.arrays.motions))
    residual = (measured.inverse() @ here[network.b_idx].inverse() @ here[network.a_idx]).log()
    return np.asarray(np.square(np.einsum("nij,nj->ni", network.whitening, residual)).sum(axis=1))


def _connected(network: PoseNetwork, agree: BoolArray) -> BoolArray:
    """The pairs (E,) that agree, and of the others as many as hold the network together."""
    used = agree.copy()
    for poses_only in (False, True):
        part = network.components(used, poses_only)
        if part.max(initial=0) == 0:
            continue
        whole = network.components(network.used, poses_only)
        for e in _likeliest_first(network, used):
            if poses_only and not network.is_pose[e]:
                continue
            a, b = part[network.a_idx[e]], part[network.b_idx[e]]
            if a != b and whole[network.a_idx[e]] == whole[network.b_idx[e]]:
                used[e] = True
                part[part == b] = a
    return used


def _likeliest_first(network: PoseNetwork, agree: BoolArray) -> IntArray:
    """The other pairs in use, the nearest to closing loops with one another first.

    In a loop of two wrong pairs there are the errors of both, in one of a wrong and a right pair only one.
    """
    others, size = network.used & ~agree, network.n_pairs
    total, number = np.zeros(size), np.zeros(size)
    for guests in _in_turn(network, others):
        loops = _short_loops(network, others, agree | guests)
        if len(loops):
            misfit = np.repeat(np.log1p(_tests(network, loops)[0]), loops.lengths)
            total += np.bincount(loops.pair_idx, misfit, size)
            number += np.bincount(loops.pair_idx, minlength=size)
    rows = np.flatnonzero(others)
    mean = np.where(number > 0, total / np.maximum(number, 1), np.inf)
    return np.asarray(rows[np.argsort(mean[rows], kind="stable")])
