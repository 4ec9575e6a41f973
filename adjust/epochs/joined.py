"""Two epochs of a large network, compared through their normal equations: nothing here is a full matrix.

What of both is the same is one unknown: ``d' Q_d^+ d`` of it is what v'Pv of both rises by, the minimum of
``x1' N1 x1 + x2' N2 x2`` with ``x2 = x1 - d`` there. A name that is freed again takes ``g' M^-1 g`` of that back, its
share, with the gradient g by its displacement and the M that the other unknowns leave of its normal matrix.
"""

from collections.abc import Sequence
from dataclasses import field
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy
from scipy import sparse

from adjust.epochs.change import Change, Displaced, between
from adjust.epochs.states import EpochNormals
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.precision.s_transformation import moved
from adjust.spatial.motions import values_motions
from adjust.statistics.normal import Normal

_CANDIDATES = 12
"""Names of which the share is computed: those that would have the largest if all others were known."""
_PROBES = 64
"""Random displacements of all that stand for the mean precision of one; of fewer components each by itself."""
_APART = 1e-6
_ROOM = 64_000_000  # numbers of what was freed


@frozen(eq=False)
class _Together:
    """Both epochs with some ``names`` the same: their unknowns z (u,) are P y + D; K = P'NP of N (u, u) is factored.

    D: (u,). freed: by name of which the displacement was freed, how z (u, k) goes along at its minimum, N times that.
    """

    names: frozenset[int]
    N: sparse.csr_matrix
    P: sparse.csr_matrix
    K: Normal
    D: FloatArray
    freed: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict)

    @cached_property
    def z(self) -> FloatArray:
        """(u,) at the minimum."""
        return self.minimal(self.D[:, None])[:, 0]

    def minimal(self, D: FloatArray) -> FloatArray:
        """The z (u, k) with the smallest z'Nz, for given differences D (u, k)."""
        return np.asarray(D - self.P @ self.K.solve(np.asarray(self.P.T @ (self.N @ D))))

    def free(self, at: dict[int, IntArray]) -> None:
        """Free names by number, of which these unknowns (k,) are displaced, if that was not done before."""
        new = {i: unknowns for i, unknowns in at.items() if i not in self.freed}
        ends = np.cumsum([0, *map(len, new.values())]).tolist()
        unit = np.zeros((self.N.shape[0], ends[-1]))
        for (first, last), unknowns in zip(pairwise(ends), new.values(), strict=True):
            unit[unknowns, np.arange(first, last)] = 1.0
        z = self.minimal(unit)
        Nz = np.asarray(self.N @ z)
        self.freed.update({i: (z[:, a:b], Nz[:, a:b]) for i, (a, b) in zip(new, pairwise(ends), strict=True)})


@frozen(eq=False)
class _Rise:
    """What v'Pv rises by where names are the same. gradient: (u,) by the unknowns.

    at: unknowns (k,) that are displaced of what was freed. N_freed: (u, k), M: (k, k) of these.
    """

    value: float
    gradient: FloatArray
    at: IntArray
    N_freed: FloatArray
    M: FloatArray


@frozen(eq=False)
class JoinedChange(Change):
    """By the normal equations of both epochs.

    column: (n, 2) of a component in the first and in the second epoch, -1 where it is held. place: (n,) of all.
    """

    before: EpochNormals
    after: EpochNormals
    column: IntArray
    place: IntArray

    @classmethod
    def of(cls, before: EpochNormals, after: EpochNormals, directions: FloatArray) -> "JoinedChange":
        """Of two epochs of the same names. Raises SurveyError as :meth:`EpochNormals.normals`."""
        column: IntArray = np.stack([before.column, after.column], axis=1)
        fields, known = between(before, after, directions, (before.column >= 0) | (after.column >= 0))
        return cls(*fields, before, after, column[known], np.flatnonzero(known))

    @cached_property
    def _N(self) -> sparse.csr_matrix:
        return sparse.block_diag([self.before.normals(), self.after.normals()], format="csr")

    @cached_property
    def _at(self) -> IntArray:
        """The unknown (n,) of both, the first epoch's first, that a displacement moves: the second's, if it has one."""
        first, second = self.column.T
        return np.asarray(np.where(second >= 0, self.before.N.shape[0] + second, first))

    def _given(self, d: FloatArray, rows: IntArray) -> FloatArray:
        """D (u, k) of differences d (n, k) of these components: x2 = x1 - d."""
        out = np.zeros((self._N.shape[0], d.shape[1]))
        out[self._at[rows]] = np.where(self.column[rows, 1] >= 0, -1.0, 1.0)[:, None] * d[rows]
        return out

    @cached_property
    def _kept(self) -> list[_Together]:
        return []

    def _together(self, stable: Sequence[int]) -> _Together:
        """With these names the same, or a few more; kept, since a search goes on from there."""
        wanted = frozenset(stable)
        kept = self._kept[-1] if self._kept else None
        if kept is None or not kept.names.issuperset(wanted) or len(kept.names) - len(wanted) > self._most_freed:
            self._kept[:] = [kept := self._joined(wanted)]
        return kept

    @property
    def _most_freed(self) -> int:
        """Names of which displacements are kept."""
        return int(max(2 * _CANDIDATES, _ROOM // (12 * self._N.shape[0])))

    def _joined(self, names: frozenset[int]) -> _Together:
        N, rows, first = self._N, self.rows(sorted(names)), self.before.N.shape[0]
        a, b = self.column[rows].T
        both, place = (a >= 0) & (b >= 0), np.arange(N.shape[0])
        place[first + b[both]] = a[both]
        place[self._at[rows[~both]]] = -1  # what one epoch holds is given in the other
        left, y = np.unique(place, return_inverse=True)
        y -= int(left[0] < 0)
        free = np.flatnonzero(y >= 0)
        P = sparse.csr_matrix((np.ones(len(free)), (free, y[free])), (len(place), int(y.max()) + 1))
        K = (P.T @ N @ P).tocsc()
        still = y[a[both]][self._carrying(rows[both])]
        K += sparse.csc_matrix((K.diagonal()[still], (still, still)), K.shape)
        D = self._given(self.d[:, None], rows)[:, 0]
        return _Together(names, N, P, Normal(K, np.zeros((K.shape[0], 0))), D)

    def _carrying(self, rows: IntArray) -> IntArray:
        """Which of these components, as many as there are motions that both epochs leave open, to hold against them."""
        scale = np.array([1.0] * 3 + [self.before.extent] * 4)[:, None]
        ours, theirs = self.before.directions, self.after.directions
        _, s, V = np.linalg.svd(scale * np.hstack([ours, -theirs]))
        apart = int((s > _APART * s.max(initial=0.0)).sum())
        motions = ours @ V[apart:, : ours.shape[1]].T
        G = values_motions(self.before.values)[self.place[rows]] @ motions
        if not G.size:
            return np.zeros(0, dtype=np.int64)
        return np.asarray(scipy.linalg.qr(G.T, mode="r", pivoting=True)[1][: G.shape[1]], dtype=np.int64)

    def _rise(self, stable: Sequence[int]) -> tuple[_Together, _Rise]:
        both = self._together(stable)
        gone = {i: self._at[self.rows([i])] for i in sorted(both.names.difference(stable))}
        both.free(gone)
        none = np.zeros((self._N.shape[0], 0))
        at = np.concatenate([np.zeros(0, dtype=np.int64), *gone.values()])
        z, Nz = (np.hstack([none, *(both.freed[i][k] for i in gone)]) for k in (0, 1))
        M = Nz[at]
        x = both.z - z @ np.linalg.solve(M, (both.N @ both.z)[at])
        gradient = np.asarray(both.N @ x)
        return both, _Rise(float(x @ gradient), gradient, at, Nz, M)

    def square(self, stable: Sequence[int]) -> tuple[float, int]:
        """See :class:`Change`."""
        self.datum(stable)
        return self._rise(stable)[1].value, max(0, len(self.rows(stable)) - self.G.shape[1])

    def shares(self, stable: Sequence[int]) -> dict[int, float]:
        """See :class:`Change`; of the names alone that would have the largest if all others were known."""
        both, rise = self._rise(stable)
        largest = sorted(self._alone(stable, rise.gradient), key=lambda x: -x[0])[:_CANDIDATES]
        at = {i: self._at[self.rows([i])] for _, i in largest}
        both.free(at)
        out = {}
        for i, mine in at.items():
            Nz = both.freed[i][1]
            M = Nz[mine] - rise.N_freed[mine] @ np.linalg.solve(rise.M, Nz[rise.at])
            g = rise.gradient[mine]
            out[i] = float(g @ np.linalg.pinv(M, hermitian=True) @ g)
        if len(both.freed) > self._most_freed:
            for i in both.names.intersection(stable, both.freed):
                del both.freed[i]
        return out

    def _alone(self, stable: Sequence[int], gradient: FloatArray) -> list[tuple[float, int]]:
        """Of every name by itself, g' (inv(N1) + inv(N2)) g, with its number."""
        rows = self.rows(stable)
        names, first, n = np.unique(self.owner[rows], return_index=True, return_counts=True)
        value = np.zeros(len(names))
        for k in np.unique(n).tolist():
            mine = rows[first[n == k, None] + np.arange(k)]
            g, found = gradient[self._at[mine]], np.zeros(len(mine))
            for epoch, begin in enumerate((0, self.before.N.shape[0])):
                known = (self.column[mine, epoch] >= 0).all(axis=1)
                at = begin + self.column[mine[known], epoch]
                N = np.asarray(self._N[np.repeat(at, k, axis=1).ravel(), np.tile(at, k).ravel()]).reshape(-1, k, k)
                found[known] += np.einsum("pi,pij,pj->p", g[known], np.linalg.pinv(N, hermitian=True), g[known])
            value[n == k] = found
        return list(zip(value.tolist(), names.tolist(), strict=True))

    def _precision(self, rows: BoolArray) -> float:
        """See :class:`Change`; of many components from random displacements of all."""
        at = np.flatnonzero(rows)
        each = len(at) <= _PROBES
        probes = np.eye(len(at)) if each else np.random.default_rng(0).choice([-1.0, 1.0], (len(at), _PROBES))
        d = np.zeros((len(self.d), probes.shape[1]))
        d[at] = probes
        everything = np.unique(self.owner).tolist()
        z = self._together(everything).minimal(self._given(d, np.arange(len(self.d))))
        return float((z * (self._N @ z)).sum()) / len(at) / (1 if each else _PROBES)

    @cached_property
    def _own(self) -> list[FloatArray]:
        return [a + b for a, b in zip(self.before.own(), self.after.own(), strict=True)]

    def displaced(self, stable: Sequence[int]) -> Displaced:
        """See :class:`Change`."""
        G, d = self.G, self.d
        first = np.cumsum(self.before.sizes) - self.before.sizes
        W, C = np.zeros(G.shape), np.zeros((G.shape[1],) * 2)
        if G.shape[1]:
            EG = self.datum(stable)[:, None] * G
            right = np.zeros((len(self.before.column), G.shape[1]))
            right[self.place] = np.linalg.solve(G.T @ EG, EG.T).T
            W = (self.before.times(right) + self.after.times(right))[self.place]
            C = right[self.place].T @ W
            d = d - G @ (right[self.place].T @ d)

        def of(rows: IntArray) -> tuple[FloatArray, FloatArray]:
            names = self.owner[rows[:, 0]]
            inside = self.place[rows] - first[names, None]
            own = np.array([self._own[i] for i in names.tolist()])
            own = own[np.arange(len(names))[:, None, None], inside[:, :, None], inside[:, None]]
            return d[rows], moved(own, G[rows], W[rows], C)

        return of
