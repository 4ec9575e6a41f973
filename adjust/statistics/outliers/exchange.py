"""The smallest set of gross errors that explains the data: good observations that went out for bad ones come back.

Which set S is out is judged by ``J(S) = omega(S) + sum of the limits of the tests of S``. One more out lowers omega by
its statistic T, so J is smaller if and only if its test fails: no single step improves what data snooping leaves.
Several errors near each other can still have changed places with good observations. Hence for every rejected one all
sets among those that share its residuals are compared, with ``omega(S) = omega(0) - g_S' inv(R_SS) g_S`` (Kok 1984;
Knight, Wang and Rizos 2010 for sets of errors). ``exp(-J/2)`` is the likelihood of an explanation, penalised by its
size: two of nearly the same J cannot be told apart.
"""

from collections.abc import Iterator
from itertools import chain, pairwise

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.statistics.outliers.snooping import Snooping
from adjust.testing.single_tests import CONTROLLED

_POOL = 12
"""Observations among which all sets are compared: 4095 sets."""
_MINE = (4, 7)
"""Of them, most that are out now: few with many others, then many with few."""
_LINKED = 0.15
"""Correlation of two tests from which an error of one shows in the other."""
_EVEN = 2.0 * float(np.log(20.0))
"""Difference of J up to which an explanation is less than 20 times as likely as another one."""
_MOST = 600
"""Rejected components beyond which sets are not compared any more: the survey itself is wrong then."""
_ROOM = 1e8
"""Numbers that these may put into the residuals of all observations."""


@frozen
class Exchange:
    """Another explanation: ``instead`` out and ``kept`` back in use; more: by how much its J is larger."""

    kept: tuple[int, ...]
    instead: tuple[int, ...]
    more: float


@frozen(eq=False)
class _Near:
    """Pool (p,) of observations, first the n that are out, and g (r,), R (r, r) of their rows with all of them in."""

    pool: list[int]
    n: int
    g: FloatArray
    R: FloatArray
    at: list[IntArray]


def better_set(snooping: Snooping, limits: FloatArray) -> Exchange | None:
    """The exchange that lowers J most at the first rejected observation that has one. limits: (M,) of the tests."""
    state = _state(snooping, limits)
    if state is None:
        return None
    every = ([x for x in found if x.more < -1e-6] for found in _exchanges(state))
    return next((min(found, key=lambda x: x.more) for found in every if found), None)


def equal_sets(snooping: Snooping, limits: FloatArray) -> list[Exchange]:
    """Other explanations that the data hardly tell from what is out now, the likeliest first; none in another."""
    state = _state(snooping, limits)
    if state is None:
        return []
    found: dict[tuple[frozenset[int], frozenset[int]], Exchange] = {}
    for x in chain.from_iterable(_exchanges(state)):
        if x.kept and x.instead and -1e-6 <= x.more < _EVEN:
            found[frozenset(x.kept), frozenset(x.instead)] = x
    smallest = [
        x for (kept, instead), x in found.items()
        if not any((k, i) != (kept, instead) and k <= kept and i <= instead for k, i in found)
    ]  # fmt: skip
    return sorted(smallest, key=lambda x: x.more)


@frozen(eq=False)
class _State:
    """A search with r rejected components. K: (r, r) covariance of their errors, bias: (r,) these themselves.

    rows: of every rejected observation among the r. U: (m, r) its columns; B: (m, r) what an error of each puts into
    the residuals of all observations. limits: (M,) of the tests. possible: (M,) may go out. link: (M, r) correlation of
    tests, 0 where it may not.
    """

    snooping: Snooping
    limits: FloatArray
    rows: dict[int, IntArray]
    K: FloatArray
    bias: FloatArray
    U: FloatArray
    B: FloatArray
    possible: BoolArray
    link: FloatArray


def _state(snooping: Snooping, limits: FloatArray) -> _State | None:
    out, ptr = snooping.out, snooping.ptr
    index = [np.arange(int(ptr[x]), int(ptr[x + 1])) for x in out]
    ends = np.cumsum([0] + [len(r) for r in index])
    if not out or ends[-1] > _MOST or ends[-1] * len(snooping.g) > _ROOM:
        return None
    U = np.hstack([snooping.columns[x][0] for x in out])
    inverse = np.linalg.inv(U[np.concatenate(index)])  # of the Cholesky factor of their own R
    K, B = inverse.T @ inverse, U @ inverse
    possible = snooping.used & snooping.candidates  # also what only the others left in place cannot check
    possible[out] = False
    bias = inverse.T @ np.concatenate([snooping.columns[x][1] for x in out])
    link = np.zeros((len(possible), len(K)))
    for members, at, R in _by_size(snooping, possible):
        shared = B[at] ** 2 / np.diag(K)  # (n, k, r), what R grows by when one of them is back in
        grown = np.einsum("nii->ni", R)[..., None] + shared
        seen = grown > CONTROLLED
        link[members] = np.sqrt(np.where(seen, shared, 0.0) / np.where(seen, grown, 1.0)).max(axis=1)
    rows = {x: np.arange(*ends[i : i + 2]) for i, x in enumerate(out)}
    return _State(snooping, limits, rows, K, bias, U, B, possible, link)


def _by_size(snooping: Snooping, wanted: BoolArray) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    """Observations (n,), their rows (n, k) and R (n, k, k), of each size k."""
    for members, R in zip(snooping.alike, snooping.R, strict=True):
        mine = wanted[members]
        if mine.any():
            yield members[mine], snooping.rows(members[mine]), R[mine]


def _exchanges(state: _State) -> Iterator[list[Exchange]]:
    """Of every rejected observation all sets near it, as exchanges with what is out now, but for those before it."""
    known = set[frozenset[int]]()
    for o in state.snooping.out:
        pools = {frozenset(n.pool): n for most in _MINE if (n := _near(state, o, most)) is not None}
        yield [x for pool, near in pools.items() if pool not in known for x in _exchanges_among(state, near)]
        known |= pools.keys()


def _exchanges_among(state: _State, near: _Near) -> list[Exchange]:
    sets, J = _criteria(near, state.limits[near.pool])
    n, here, out = near.n, sets == 2**near.n - 1, list[Exchange]()
    if here.any():
        more = J - J[here]
        for s, by in zip(sets[more < _EVEN].tolist(), more[more < _EVEN].tolist(), strict=True):
            kept, instead = (tuple(x for i, x in enumerate(near.pool) if (s >> i & 1) == goes and (i < n) != goes)
                             for goes in (False, True))  # fmt: skip
            out += [Exchange(kept, instead, by)] if kept or instead else []
    return out


def _criteria(near: _Near, limits: FloatArray) -> tuple[IntArray, FloatArray]:
    """Sets that leave nothing open, and J of each, less omega with all in use; bit i: observation i of the pool is out.

    One observation after the other goes out of all sets of those before it, and takes its share off the R and g of
    those behind it (as in :mod:`adjust.statistics.outliers.snooping`), and off omega, in the corner of R and g.
    """
    sets, J, corner = np.zeros(1, dtype=np.int64), np.zeros(1), np.append(near.g, 0.0)[:, None]
    R = np.block([[near.R, corner[:-1]], [corner.T]])[None]
    for i, (k, limit) in enumerate(zip(map(len, near.at), limits.tolist(), strict=True)):
        fine = _positive(R[:, :k, :k] - CONTROLLED * np.eye(k))
        out, behind = R if fine.all() else R[fine], R[:, k:, k:]
        own, across, back = out[:, :k, :k], out[:, :k, k:], out[:, k:, :k]
        less = back @ np.linalg.solve(own, across) if k > 1 else back * (across / own)
        sets, J = np.concatenate([sets, sets[fine] + 2**i]), np.concatenate([J, J[fine] + limit])
        R = np.concatenate([behind, out[:, k:, k:] - less])
    return sets, J + R[:, 0, 0]


def _positive(M: FloatArray) -> BoolArray:
    """Which of symmetric matrices (s, k, k) are positive definite: all pivots of their elimination are positive."""
    fine = np.ones(len(M), dtype=np.bool_)
    while M.shape[1]:
        pivot = M[:, :1, :1]
        fine &= pivot[:, 0, 0] > 0.0
        M = M[:, 1:, 1:] - M[:, 1:, :1] * (M[:, :1, 1:] / np.where(pivot > 0.0, pivot, 1.0))
    return fine


def _near(state: _State, o: int, most: int) -> _Near | None:
    """Whom an observation that is out could have changed places with; None where there is nobody."""
    links = _rejected_near(state, o)
    mine = sorted(links, key=lambda x: -links[x])[:most]
    N = np.concatenate([state.rows[x] for x in mine])
    of_N = np.linalg.inv(state.K[np.ix_(N, N)])  # their own R with the others out
    closeness = np.concatenate([np.full(len(state.rows[x]), links[x]) for x in mine])
    try:
        root = np.linalg.cholesky(of_N)
    except np.linalg.LinAlgError:  # by so far out that rounding is all that tells them apart
        return None
    free = _suspects(state, mine, N, of_N, root, (state.link[:, N] * closeness).max(axis=1))
    if not free and len(mine) == 1:
        return None
    return _joined(state, mine, free, N, of_N)


def _rejected_near(state: _State, o: int) -> dict[int, float]:
    """How close what is out is to this one: its error is correlated with this one's, or shows where this one's does."""
    own = state.rows[o]
    scale = np.sqrt(np.diag(state.K))
    between = np.abs(state.K[own] / np.outer(scale[own], scale)).max(axis=0)
    to_own = state.link[:, own].max(axis=1)
    shown = state.link[to_own > _LINKED]
    through = (to_own[to_own > _LINKED, None] * shown).max(axis=0, initial=0.0)
    links = {x: float(np.maximum(between, through)[at].max()) for x, at in state.rows.items()}
    return {o: 1.0} | {x: link for x, link in links.items() if link > _LINKED**2 and x != o}


def _suspects(
    state: _State, mine: list[int], N: IntArray, of_N: FloatArray, root: FloatArray, link: FloatArray
) -> list[int]:
    """In use and linked to one of those: half with the largest tests once all of these are in, half the closest."""
    T = np.zeros(len(link))
    B, g = state.B[:, N], state.snooping.g + state.B[:, N] @ (of_N @ state.bias[N])
    back = B @ root  # R grows by back back'
    for members, at, R in _by_size(state.snooping, state.possible & (link > _LINKED)):
        grown = R + np.einsum("nia,nja->nij", back[at], back[at]) + CONTROLLED**2 * np.eye(R.shape[1])
        T[members] = np.einsum("ni,ni->n", g[at], np.linalg.solve(grown, g[at][..., None])[..., 0])
    room = _POOL - len(mine)
    free = np.flatnonzero(link > _LINKED)
    by_test = free[np.argsort(-T[free], kind="stable")][: (room + 1) // 2]
    by_link = free[np.argsort(-link[free], kind="stable")]
    return list(dict.fromkeys([*by_test.tolist(), *by_link.tolist()]))[:room]


def _joined(state: _State, mine: list[int], free: list[int], N: IntArray, of_N: FloatArray) -> _Near:
    """G and R of all of them, with those that are out taken back."""
    snooping, ptr = state.snooping, state.snooping.ptr
    rows = [np.arange(int(ptr[x]), int(ptr[x + 1])) for x in free]
    F = np.concatenate([np.zeros(0, dtype=np.int64), *rows])
    cross = state.B[np.ix_(F, N)] @ of_N
    R_F = snooping.start_columns(F, F) - state.U[F] @ state.U[F].T + cross @ state.B[np.ix_(F, N)].T
    R = np.block([[of_N, cross.T], [cross, 0.5 * (R_F + R_F.T)]])
    g = np.concatenate([of_N @ state.bias[N], snooping.g[F] + cross @ state.bias[N]])
    pool = [*mine, *free]
    ends = np.cumsum([0] + [int(snooping.sizes[x]) for x in pool])
    return _Near(pool, len(mine), g, R, [np.arange(a, b) for a, b in pairwise(ends)])
