"""Gross errors of a linear system, found one after the other: data snooping by elimination.

With an observation's own directions C (whitened), ``g = C' e`` and ``R = C' (I - A Q A') C`` decide: T = g' R^-1 g. To
leave it out is to give it a bias of its own, which takes its share off the R and g of all others: one step of a
Cholesky factorisation of R with pivots chosen by the test (Baarda 1968; Kok 1984 for the iteration). Nothing is solved
again. What is out is tested with the others out, and comes back where it fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from adjust.distributions import chi2, fisher
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.statistics.single_tests import CONTROLLED, eigen2
from adjust.statistics.system import LinearSystem


@dataclass(frozen=True)
class Verdict:
    """Test of one observation: statistic with freedom over its variance factor, its limit, p, error in sigmas."""

    statistic: float
    freedom: int
    limit: float
    p: float
    error: float


@dataclass(eq=False)
class Snooping:
    """A linear system from which observations are left out, and to which they come back.

    candidates: (M,) may be left out. level: error probability of one test. factors: (G,) by which the typical test of
    a group is too large, 1 or more. posterior: tests with sigma0 of the remaining observations.
    """

    system: LinearSystem
    candidates: BoolArray
    level: float
    factors: FloatArray
    posterior: bool = False
    out: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        s = self.system
        self.A, self.e = s.A, s.e.copy()
        if s.joint:
            self._turn_joint()
        self.sizes = np.diff(s.ptr)
        self.g, self.R = self._start()
        self.columns: dict[int, tuple[FloatArray, FloatArray]] = {}
        self.omega = float(np.sum(s.e[s.used[s.row_of]] ** 2))
        self.left = int(s.used[s.row_of].sum()) - len(s.columns) + s.datum.shape[0]

    def _turn_joint(self) -> None:
        """Rows of joint readings by their own directions: W' over its lengths."""
        m = self.A.shape[0]
        kept = np.ones(m)
        kept[np.concatenate([j.rows for j in self.system.joint])] = 0.0
        turn = sparse.diags(kept).tocoo()
        parts = [(turn.row, turn.col, turn.data)]
        for joint in self.system.joint:
            C = joint.W / np.linalg.norm(joint.W, axis=0)
            k = len(joint.rows)
            parts.append((np.repeat(joint.rows, k), np.tile(joint.rows, k), C.T.ravel()))
        r, c, v = (np.concatenate(x) for x in zip(*parts, strict=True))
        turned = sparse.csr_matrix((v, (r, c)), shape=(m, m))
        self.A, self.e = (turned @ self.A).tocsr(), turned @ self.e

    def _start(self) -> tuple[FloatArray, list[FloatArray]]:
        """G (m,) and the own blocks of R by observation size.

        At the solution of the system itself, which is not where it was linearised if others are used.
        """
        s, A = self.system, self.A
        step = s.normal.solve(np.asarray(s.A[s.used[s.row_of]].T @ s.e[s.used[s.row_of]]))
        return self.e - A @ step, self._own_blocks()

    def _own_blocks(self) -> list[FloatArray]:
        s, out = self.system, []
        for k in np.unique(self.sizes):
            members = np.flatnonzero(self.sizes == k)
            blocks = np.tile(np.eye(int(k)), (len(members), 1, 1))
            for first in range(0, len(members), 512):
                part = members[first : first + 512]
                rows = (s.ptr[part][:, None] + np.arange(k)).ravel()
                A = self.A[rows]
                x = s.normal.solve(A.T.toarray()).T.reshape(len(part), int(k), -1)
                full = A.toarray().reshape(len(part), int(k), -1)
                blocks[first : first + 512] -= np.einsum("nij,nkj->nik", full, x)
            out.append(blocks)
        return out

    # -- tests -------------------------------------------------------------------------------------------------------

    def statistics(self) -> tuple[FloatArray, IntArray, BoolArray]:
        """T, freedom and whether all directions are controlled, of all observations (M,)."""
        T, freedom = np.zeros(len(self.sizes)), np.zeros(len(self.sizes), dtype=np.int64)
        whole = np.zeros(len(self.sizes), dtype=np.bool_)
        for k, R in zip(np.unique(self.sizes), self.R, strict=True):
            members = np.flatnonzero(self.sizes == k)
            g = self.g[(self.system.ptr[members][:, None] + np.arange(k))]
            if k == 2:
                values, vectors = eigen2(R)
            else:
                values, vectors = np.linalg.eigh(R)
            seen = values > CONTROLLED
            along = np.einsum("nij,ni->nj", vectors, g)
            T[members] = np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0).sum(axis=1)
            freedom[members], whole[members] = seen.sum(axis=1), seen.all(axis=1)
        return T, freedom, whole

    def _factor(self, rows: IntArray) -> FloatArray:
        return np.asarray(self.factors[self.system.group[rows]])

    def _excess(self, T: FloatArray, freedom: IntArray, rows: IntArray, inside: bool = True) -> FloatArray:
        """Tests over their limits, above 1 where they fail."""
        q = np.maximum(freedom, 1)
        if not self.posterior:
            return np.asarray(np.where(freedom > 0, T / (chi2.isf(self.level, q) * self._factor(rows)), 0.0))
        left = np.maximum(self.left - q if inside else np.full(len(q), self.left), 1)
        rest = np.maximum(self.omega - T if inside else np.full(len(T), self.omega), 1e-300)
        F = (T / q) / (rest / left)
        return np.asarray(np.where(freedom > 0, F / fisher.isf(self.level, q, left), 0.0))

    def excess_outside(self, T: FloatArray, freedom: IntArray, rows: IntArray) -> FloatArray:
        """Tests (k,) of observations that are out over their limits, above 1 where they fail."""
        return self._excess(T, freedom, rows, inside=False)

    def failing(self) -> tuple[FloatArray, BoolArray]:
        """Excess (M,) of all observations in use, and which of them (M,) can be left out."""
        T, freedom, whole = self.statistics()
        used = self.system.used.copy()
        used[self.out] = False
        excess = np.where(used, self._excess(T, freedom, np.arange(len(T))), 0.0)
        return excess, used & whole & self.candidates

    def verdict(self, observation: int) -> Verdict:
        """Of an observation that is out: its test with all others out. Of one in use: its test now."""
        k = int(self.sizes[observation])
        if observation in self.out:
            T, error = self._outside()[observation]
            freedom, inside = k, False
        else:
            number = int(np.flatnonzero(np.unique(self.sizes) == k)[0])
            at = int(np.searchsorted(np.flatnonzero(self.sizes == k), observation))
            R = self.R[number][at]
            g = self.g[self.system.ptr[observation] : self.system.ptr[observation + 1]]
            inverse = np.linalg.pinv(R, rcond=CONTROLLED, hermitian=True)
            T, error = float(g @ inverse @ g), float(np.linalg.norm(inverse @ g))
            freedom, inside = int(np.linalg.matrix_rank(R, tol=CONTROLLED, hermitian=True)), True
        rows, q = np.array([observation]), np.array([freedom])
        excess = float(self._excess(np.array([T]), q, rows, inside)[0])
        factor = float(self._factor(rows)[0])
        limit = T / excess if excess > 0.0 else float("nan")
        if self.posterior:
            left, rest = (self.left - freedom, self.omega - T) if inside else (self.left, self.omega)
            p = float(fisher.sf(T / freedom / (max(rest, 1e-300) / max(left, 1)), freedom, max(left, 1)))
        else:
            p = float(chi2.sf(T / factor, max(freedom, 1)))
        return Verdict(T, freedom, limit, p, error)

    # -- leaving out and taking back ---------------------------------------------------------------------------------

    def leave_out(self, observation: int) -> None:
        """Give the observation a bias of its own."""
        s = self.system
        rows = np.arange(int(s.ptr[observation]), int(s.ptr[observation + 1]))
        column = self.start_column(rows)
        for before in self.out:
            U = self.columns[before][0]
            column -= U @ U[rows].T
        own = column[rows]
        L = np.linalg.cholesky(0.5 * (own + own.T))
        U = np.linalg.solve(L, column.T).T
        share = np.linalg.solve(L, self.g[rows])
        self._take(U, share, 1.0)
        self.columns[observation] = U, share
        self.out.append(observation)

    def take_back(self, observations: Sequence[int]) -> None:
        """As if these had never been left out."""
        kept = [o for o in self.out if o not in set(observations)]
        for o in reversed(self.out):
            self._take(*self.columns.pop(o), -1.0)
        self.out = []
        for o in kept:
            self.leave_out(o)

    def start_column(self, rows: IntArray) -> FloatArray:
        """Columns (m, k) of R at the start."""
        s = self.system
        right = self.A[rows].T.toarray()
        out = -np.asarray(self.A @ s.normal.solve(right))
        joint = s.joint_of.get(int(s.row_of[rows[0]]))
        if joint is None:
            out[rows, np.arange(len(rows))] += 1.0
        else:
            C = joint[0].W / np.linalg.norm(joint[0].W, axis=0)
            out[joint[0].rows, 0] += C.T @ C[:, joint[1]]
        return out

    def _take(self, U: FloatArray, share: FloatArray, sign: float) -> None:
        self.g = self.g - sign * (U @ share)
        for number, k in enumerate(np.unique(self.sizes)):
            members = np.flatnonzero(self.sizes == k)
            own = U[self.system.ptr[members][:, None] + np.arange(k)]
            self.R[number] = self.R[number] - sign * np.einsum("nia,nja->nij", own, own)
        self.omega -= sign * float(share @ share)
        self.left -= int(sign) * len(share)

    def _outside(self) -> dict[int, tuple[float, float]]:
        """T of every observation that is out, with the others out, and its estimated error in sigmas."""
        rows = [np.arange(int(self.system.ptr[o]), int(self.system.ptr[o + 1])) for o in self.out]
        if not rows:
            return {}
        index = np.concatenate(rows)
        L = np.hstack([self.columns[o][0][index] for o in self.out])  # the Cholesky factor of their own R
        shares = np.concatenate([self.columns[o][1] for o in self.out])
        inverse_root = np.linalg.inv(L)
        bias, cov = inverse_root.T @ shares, inverse_root.T @ inverse_root
        found, at = {}, 0
        for o, r in zip(self.out, rows, strict=True):
            k = slice(at, at + len(r))
            at = k.stop
            found[o] = float(bias[k] @ np.linalg.solve(cov[k, k], bias[k])), float(np.linalg.norm(bias[k]))
        return found

    def fitting(self) -> list[int]:
        """Observations that are out, and fit."""
        found = self._outside()
        if not found:
            return []
        rows = np.array(list(found))
        T = np.array([found[int(r)][0] for r in rows])
        excess = self.excess_outside(T, self.sizes[rows], rows)
        return [int(r) for r, x in zip(rows, excess, strict=True) if x <= 1.0]


def robust_squares(system: LinearSystem, freedom: IntArray, factors: FloatArray, rounds: int = 20) -> FloatArray:
    """Weighted squares (M,), over the factors (G,) of the groups, where Cauchy weights settle (Huber 1981, 7.8).

    The constant is that of Zhang (1997).
    """
    used_rows, q = system.used[system.row_of], np.maximum(freedom, 1)
    weights = np.ones(len(system.used))
    squares = _squares(system, system.e, factors)
    for _ in range(rounds):
        new = 1.0 / (1.0 + squares / (_CAUCHY * q))
        for joint in system.joint:  # one weight for what is whitened together
            mine = system.row_of[joint.rows]
            new[mine] = new[mine].min()
        if np.abs(new - weights).max() < 1e-2:
            break
        weights = new
        of_rows = np.where(used_rows, (weights / factors[system.group])[system.row_of], 0.0)
        step = system.normal_of(of_rows).solve(np.asarray(system.A.T @ (of_rows * system.e)))
        squares = _squares(system, system.e - system.A @ step, factors)
    return squares


_CAUCHY = 2.385**2


def _squares(system: LinearSystem, e: FloatArray, factors: FloatArray) -> FloatArray:
    out = np.zeros(len(system.used))
    np.add.at(out, system.row_of, e**2)
    return out / factors[system.group]
