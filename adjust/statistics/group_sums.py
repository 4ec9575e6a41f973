"""What every group contributes to the normal equations, for any variance factors; a survey that has such factors.

Observations are ``e + A dx`` with covariance V(theta). Most blocks belong to one group: V = theta_g V_0. A block whose
components belong to several groups has V = D V_0 D, D = diag(sqrt(theta_g)): its correlations stay. The score and the
information of the restricted likelihood (Patterson and Thompson 1971; Koch 1999, 3.6) need of each group

    q_g = sum over its components of v_i (P v)_i,     r_g = sum of its redundancy numbers,
    S_gh = 1/2 sum over i in g, j in h of R_ij R_ji + (Q_vv)_ij (P Q_vv P)_ij,     R = Q_vv P,

which follow from normal matrices of the groups alone: E[q_g] = sum_h S_gh (theta_h true / theta_h), Helmert's (1924)
equations; the covariance of the estimated factors, relative to themselves, is 2 inv(S).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import scipy
from scipy import sparse

from adjust.model.frozen import frozen
from adjust.model.rewriting import Fields
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.statistics.normal import Normal, inverse_of_factor
from adjust.statistics.system import LinearSystem

_SMALL = 500
"""Unknowns up to which the normal matrices of the groups are full ones."""
_WITH_COVARIANCE = (
    "image_blocks", "table_readings", "pairs", "coordinates", "coordinate_differences", "alignments", "laser_spots",
)  # fmt: skip
_WITH_SIGMA = ("distances", "levels", "on_surfaces")
Matrix: TypeAlias = FloatArray | sparse.csr_matrix


@frozen(eq=False)
class MixedBlock:
    """A correlated block of several groups: A (k, n), e (k,) and cov (k, k) not whitened, group (k,) numbers."""

    A: FloatArray
    e: FloatArray
    cov: FloatArray
    group: IntArray


@frozen(eq=False)
class GroupSums:
    """Per group whitened A'A (n, n), A'e (n,), e'e and number of components; mixed blocks apart; rows of the datum.

    N: sparse, or dense in small systems, which is several times faster.
    """

    N: tuple[Matrix, ...]
    b: FloatArray
    c: FloatArray
    n: FloatArray
    mixed: tuple[MixedBlock, ...]
    datum: sparse.csr_matrix

    def merged(self, to: IntArray) -> "GroupSums":
        """With groups put together; to: (G,) number of the new group of every group."""
        k = int(to.max()) + 1
        N = tuple(sum((self.N[g] for g in np.flatnonzero(to == i)), 0.0 * self.N[0]) for i in range(k))
        b, c, n = np.zeros((k, self.b.shape[1])), np.zeros(k), np.zeros(k)
        np.add.at(b, to, self.b)
        np.add.at(c, to, self.c)
        np.add.at(n, to, self.n)
        mixed = tuple(MixedBlock(m.A, m.e, m.cov, to[m.group]) for m in self.mixed)
        return GroupSums(N, b, c, n, mixed, self.datum)


@frozen(eq=False)
class Moments:
    """At given factors: q (G,), r (G,) and S (G, G)."""

    q: FloatArray
    r: FloatArray
    S: FloatArray


def group_sums(
    system: LinearSystem, mixed: Sequence[tuple[IntArray, IntArray, FloatArray]] = ()
) -> GroupSums:
    """Sums of the used observations by the groups of the system.

    mixed: blocks of several groups, as (rows (k,) of the system, their groups (k,), back (k, k) the inverse of the
    square root information that they were whitened with).
    """
    G = len(system.group_names)
    kept = system.used[system.row_of]
    for rows, _, _ in mixed:
        kept[rows] = False
    group_of_row = system.group[system.row_of]
    N, b, c, n = [], np.zeros((G, len(system.columns))), np.zeros(G), np.zeros(G)
    for g in range(G):
        rows = np.flatnonzero((group_of_row == g) & kept)
        A, e = system.A[rows], system.e[rows]
        square = (A.T @ A).tocsr()
        N.append(square.toarray() if square.shape[0] <= _SMALL else square)
        b[g], c[g], n[g] = A.T @ e, float(e @ e), len(rows)
    blocks = []
    for rows, group, back in mixed:
        if system.used[system.row_of[rows[0]]]:
            blocks.append(MixedBlock(back @ system.A[rows].toarray(), back @ system.e[rows], back @ back.T, group))
    return GroupSums(tuple(N), b, c, n, tuple(blocks), system.datum)


def moments(sums: GroupSums, theta: FloatArray) -> Moments:
    """Squares, redundancies and information at variance factors ``theta`` (G,)."""
    G, n = len(theta), sums.b.shape[1]
    K: list[Matrix] = [N / t for N, t in zip(sums.N, theta, strict=True)]
    b = sums.b / theta[:, None]
    whitened = [_whitened(m, theta) for m in sums.mixed]
    of_datum = sums.datum.T @ sums.datum
    total = sum(K[1:], K[0]) + (of_datum if sparse.issparse(K[0]) else of_datum.toarray())
    right = b.sum(axis=0)
    for m, P in zip(sums.mixed, whitened, strict=True):
        total = total + (sparse.csr_matrix(m.A.T @ P @ m.A) if sparse.issparse(total) else m.A.T @ P @ m.A)
        right = right + m.A.T @ P @ m.e
        for g in np.unique(m.group):
            mine = m.group == g
            K[g] = np.asarray(K[g] + (P @ m.A)[mine].T @ m.A[mine])  # A' P E_g A, not symmetric
    Q = Normal(sparse.csc_matrix(total), np.zeros((n, 0))).inverse if sparse.issparse(total) else _inverse(total)
    dx = -Q @ right
    X = [np.asarray((k.T @ Q).T) for k in K]  # Q K_g
    q = np.array([(sums.c[g] + 2.0 * dx @ sums.b[g] + dx @ (sums.N[g] @ dx)) / theta[g] for g in range(G)])
    r = sums.n - np.array([np.trace(x) for x in X])
    S = np.diag(sums.n - 2.0 * np.array([float(_own_trace(sums.N[g], Q)) / theta[g] for g in range(G)]))
    S += _products(X, K, Q, bool(sums.mixed))
    for m, P in zip(sums.mixed, whitened, strict=True):
        _add_mixed(m, P, Q, dx, q, r, S)
    return Moments(q, r, 0.5 * (S + S.T))


def _inverse(N: FloatArray) -> FloatArray:
    scale = 1.0 / np.sqrt(np.diag(N))
    half = scipy.linalg.lapack.dpotrf(np.asfortranarray(N * np.outer(scale, scale)))
    if half[1] != 0:
        raise np.linalg.LinAlgError("the normal matrix of the groups is not positive definite")
    return inverse_of_factor(half[0], lower=False) * np.outer(scale, scale)


def _own_trace(N: Matrix, Q: FloatArray) -> float:
    """tr(Q N) of a symmetric N."""
    if isinstance(N, np.ndarray):
        return float(np.vdot(N, Q))
    entries = sparse.coo_matrix(N)
    return float(entries.data @ Q[entries.row, entries.col])


def _whitened(m: MixedBlock, theta: FloatArray) -> FloatArray:
    """Weight matrix (k, k) of a mixed block at these factors."""
    d = 1.0 / np.sqrt(theta[m.group])
    return np.asarray(np.linalg.inv(m.cov) * np.outer(d, d))


def _products(X: Sequence[FloatArray], K: Sequence[Matrix], Q: FloatArray, mixed: bool) -> FloatArray:
    """1/2 [tr(Q K_h Q K_g) + tr(Q K_h' Q K_g)], (G, G); both are the same for symmetric K."""
    G = len(X)
    out = np.zeros((G, G))
    turned = [np.asarray((k @ Q).T) for k in K] if mixed else list(X)  # Q K_g'
    for g in range(G):
        for h in range(g + 1):
            value = float(np.einsum("ij,ji->", X[h], X[g]))
            if mixed:
                value = 0.5 * (value + float(np.einsum("ij,ji->", turned[h], X[g])))
            out[g, h] = out[h, g] = value
    return out


def _add_mixed(
    m: MixedBlock, P: FloatArray, Q: FloatArray, dx: FloatArray, q: FloatArray, r: FloatArray, S: FloatArray
) -> None:
    """What a mixed block adds beyond the products of its normal matrices; changes q, r and S."""
    V, v = np.linalg.inv(P), m.e + m.A @ dx
    B = m.A @ Q @ m.A.T
    np.add.at(q, m.group, v * (P @ v))
    np.add.at(r, m.group, 1.0)  # the rest of its redundancy is in the normal matrices
    local = np.eye(len(v)) - 2.0 * np.diag(np.diag(B @ P)) + V * P - V * (P @ B @ P) - B * P
    np.add.at(S, (m.group[:, None], m.group[None, :]), 0.5 * local)


def scaled_survey(survey: Survey, factors: Mapping[str, float]) -> Survey:
    """The survey with every covariance of group g multiplied by ``factors[g]`` (1 where there is none).

    Readings of several groups that share a covariance get the root of the product of their factors.
    """

    def root(group: str) -> float:
        return float(np.sqrt(factors.get(group, 1.0)))

    def with_cov(item: Any) -> Any:  # of every kind, by the name of its field
        factor = root(item.group) ** 2
        return item if factor == 1.0 else replace(item, cov=factor * item.cov)

    def with_sigma(item: Any) -> Any:  # as above
        factor = root(item.group)
        return item if factor == 1.0 else replace(item, sigma=factor * item.sigma)

    changed: Fields = {f: tuple(with_cov(x) for x in getattr(survey, f)) for f in _WITH_COVARIANCE}
    changed |= {f: tuple(with_sigma(x) for x in getattr(survey, f)) for f in _WITH_SIGMA}
    readings = tuple(
        r if root(r.group) == 1.0 else replace(r, sigma=root(r.group) * r.sigma,
                                               target_centring_sigma=root(r.group) * r.target_centring_sigma)
        for r in survey.readings
    )  # fmt: skip
    group_of = {r.reading_id: r.group for r in survey.readings}
    joint = tuple(
        replace(c, cov=_scaled(c.cov, np.array([root(group_of.get(i, "")) for i in c.reading_ids])))
        for c in survey.reading_covariances
    )
    return replace(survey, readings=readings, reading_covariances=joint, **changed)


def _scaled(cov: FloatArray, roots: FloatArray) -> FloatArray:
    return np.asarray(cov * np.outer(roots, roots))
