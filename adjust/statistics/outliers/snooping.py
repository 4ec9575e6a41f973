"""A linear system from which observations are left out one after the other, and to which they come back.

With an observation's own directions C (whitened), ``g = C' e`` and ``R = C' (I - A Q A') C`` decide: T = g' R^-1 g. To
leave it out is to give it a bias of its own, which takes its share off the R and g of all others: one step of a
Cholesky factorisation of R with pivots chosen by the test (Baarda 1968). Nothing is solved again. What is out is tested
with the others out.
"""

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse

from adjust.model.errors import IndeterminateError
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.observations.terrestrial.statistics import influences as influences_of_readings
from adjust.precision.precision import Precision
from adjust.statistics.system import LinearSystem
from adjust.testing.criteria import cauchy_weights
from adjust.testing.gross_errors import Verdicts
from adjust.testing.single_tests import CONTROLLED, eigen2


class Verdict(NamedTuple):
    """Test of one observation: statistic with its degrees of freedom, estimated error in sigmas."""

    statistic: float
    freedom: int
    error: float


class Snooping:
    """The tests of a linear system's observations from ``first`` on, which are counted from there, as their rows are.

    Those before it are all kept, and may stand condensed; n_kept: their components. candidates: (M,) may be left out.
    out: what is, in order; columns: of each U (m, k), what its error shows elsewhere, and its share (k,). left:
    redundancy; omega: v'Pv of all that is in use. rounds: of a robust solution, at most.
    """

    rounds = 100

    def __init__(self, system: LinearSystem, candidates: BoolArray, first: int = 0, n_kept: int = 0) -> None:
        s, at = system, int(system.ptr[first])
        self.system, self.candidates, self.group_names = system, candidates, system.group_names
        self.ptr, self.row_of = s.ptr[first:] - at, s.row_of[at:] - first
        self.used, self.group, self.sizes = s.used[first:], s.group[first:], np.diff(self.ptr)
        self.joint = [(j.rows - at, j.W / np.linalg.norm(j.W, axis=0)) for j in s.joint]
        self.joint_of = {o - first: x for o, x in s.joint_of.items()}
        rows = s.used[s.row_of]
        # at the solution of the system itself, which is not where it was linearised if others are used
        e = s.e - s.A @ s.normal.solve(np.asarray(s.A[rows].T @ s.e[rows]))
        self.A, self.g = self._turned(s.A[at:], e[at:])
        self.alike = [np.flatnonzero(self.sizes == k) for k in np.unique(self.sizes)]
        self.R = self._own_blocks(first)
        self.out: list[int] = []
        self.columns: dict[int, tuple[FloatArray, FloatArray]] = {}
        self.omega = float(e[rows] @ e[rows])
        self.left = n_kept + int(self.used[self.row_of].sum()) - len(s.columns) + s.datum.shape[0]

    def _turned(self, A: sparse.csr_matrix, e: FloatArray) -> tuple[sparse.csr_matrix, FloatArray]:
        """Rows of joint readings by their own directions: W' over its lengths."""
        if not self.joint:
            return A, e
        m = A.shape[0]
        kept = np.ones(m)
        kept[np.concatenate([rows for rows, _ in self.joint])] = 0.0
        turn = sparse.diags(kept).tocoo()
        parts = [(turn.row, turn.col, turn.data)]
        for rows, C in self.joint:
            k = len(rows)
            parts.append((np.repeat(rows, k), np.tile(rows, k), C.T.ravel()))
        r, c, v = (np.concatenate(x) for x in zip(*parts, strict=True))
        turned = sparse.csr_matrix((v, (r, c)), shape=(m, m))
        return (turned @ A).tocsr(), turned @ e

    def rows(self, observations: IntArray) -> IntArray:
        """Rows (n, k) of observations (n,) of the same size."""
        return np.asarray(self.ptr[observations][:, None] + np.arange(int(self.sizes[observations[0]])))

    def _own_blocks(self, first: int) -> list[FloatArray]:
        """Own blocks of R: from the covariances of the tree, but for image points and joint readings."""
        known = np.zeros(len(self.used), dtype=np.bool_)
        blocks = [np.tile(np.eye(int(self.sizes[members[0]])), (len(members), 1, 1)) for members in self.alike]
        if first == self.system.n_image:
            known[[o for o in range(len(known)) if o not in self.joint_of]] = True
            influence, before = _influences(self.system.precision)
            more = np.flatnonzero(self.used != before)  # in use here alone
            index = np.concatenate([np.arange(self.ptr[o], self.ptr[o + 1]) for o in more] or [more])
            U = -np.asarray(self.A @ self.system.normal.solve(self.A[index].T.toarray()))
            inverse = np.linalg.inv(np.eye(len(index)) + U[index])
            for members, R in zip(self.alike, blocks, strict=True):
                own = U[self.rows(members)]
                R -= np.array([influence[o] for o in members]) - own @ inverse @ own.transpose(0, 2, 1)
        for members, R in zip(self.alike, blocks, strict=True):
            if not known[members].all():
                R[~known[members]] = self._solved_blocks(members[~known[members]])
        return blocks

    def _solved_blocks(self, members: IntArray) -> FloatArray:
        """The same from the normal matrix, of observations of the same size."""
        k, normal = int(self.sizes[members[0]]), self.system.normal
        blocks = np.tile(np.eye(k), (len(members), 1, 1))
        for first in range(0, len(members), 512):
            part = members[first : first + 512]
            A = self.A[self.rows(part).ravel()]
            x = normal.solve(A.T.toarray()).T.reshape(len(part), k, -1)
            blocks[first : first + 512] -= np.einsum("nij,nkj->nik", A.toarray().reshape(len(part), k, -1), x)
        return blocks

    # -- tests -------------------------------------------------------------------------------------------------------

    def tests(self) -> Verdicts:
        """Of all observations (M,), with what is kept as the last of the groups."""
        M, n_groups = len(self.sizes), len(self.group_names) + 1
        T, freedom, whole, own = np.zeros(M), np.zeros(M, dtype=np.int64), np.zeros(M, dtype=np.bool_), np.zeros(M)
        for members, R in zip(self.alike, self.R, strict=True):
            g = self.g[self.rows(members)]
            values, vectors = eigen2(R) if R.shape[1] == 2 else np.linalg.eigh(R)
            seen = values > CONTROLLED
            along = np.einsum("nij,ni->nj", vectors, g)
            T[members] = np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0).sum(axis=1)
            freedom[members], whole[members] = seen.sum(axis=1), seen.all(axis=1)
            own[members] = np.einsum("nii->n", R)
        used = self.used.copy()
        used[self.out] = False
        for o, (statistic, _) in self._outside().items():
            T[o], freedom[o] = statistic, self.sizes[o]
        freedom[~self.used] = 0
        rows = used[self.row_of]
        omega, redundancy = np.zeros(n_groups), np.zeros(n_groups)
        np.add.at(omega, self.group[self.row_of[rows]], self.g[rows] ** 2)
        np.add.at(redundancy, self.group[used], own[used])
        omega[-1], redundancy[-1] = max(0.0, self.omega - omega.sum()), max(0.0, self.left - redundancy.sum())
        return Verdicts(T, freedom, used, used & whole & self.candidates, self.group, omega, redundancy)

    def verdict(self, observation: int) -> Verdict:
        """Of an observation that is out: with all others out. Of one in use: now."""
        if observation in self.columns:
            statistic, error = self._outside()[observation]
            return Verdict(statistic, int(self.sizes[observation]), error)
        R, g = self._own(observation), self.g[self.ptr[observation] : self.ptr[observation + 1]]
        bias = np.linalg.pinv(R, rcond=CONTROLLED, hermitian=True) @ g
        freedom = int(np.linalg.matrix_rank(R, tol=CONTROLLED, hermitian=True))
        return Verdict(float(g @ bias), freedom, float(np.linalg.norm(bias)))

    def possible(self, observation: int) -> bool:
        """Whether an observation in use may be left out, and leaves nothing open."""
        mine = self.used[observation] and self.candidates[observation] and observation not in self.columns
        return bool(mine and np.linalg.eigvalsh(self._own(observation))[0] > CONTROLLED)

    def _own(self, observation: int) -> FloatArray:
        kind = int(np.searchsorted(np.array([self.sizes[m[0]] for m in self.alike]), self.sizes[observation]))
        return np.asarray(self.R[kind][int(np.searchsorted(self.alike[kind], observation))])

    # -- leaving out and taking back ---------------------------------------------------------------------------------

    def using(self, used: BoolArray) -> "Snooping":
        """The same with other observations (M,) in use."""
        new = copy(self)
        new.R, new.out, new.columns = list(self.R), list(self.out), dict(self.columns)
        new.take_back([o for o in self.out if used[o]])
        for o in np.flatnonzero(self.used & ~used).tolist():
            if o not in new.columns:
                new.leave_out(o)
        return new

    def leave_out(self, observation: int) -> None:
        """Give the observation a bias of its own. Raises IndeterminateError where only rounding still controls it."""
        rows = np.arange(int(self.ptr[observation]), int(self.ptr[observation + 1]))
        column = self.start_columns(rows)
        for U, _ in self.columns.values():
            column -= U @ U[rows].T
        own = column[rows]
        try:
            L = np.linalg.cholesky(0.5 * (own + own.T))
        except np.linalg.LinAlgError as error:
            raise IndeterminateError("what is left out already controls what is to go next") from error
        U = np.linalg.solve(L, column.T).T
        share = np.linalg.solve(L, self.g[rows])
        self._take(U, share, 1.0)
        self.columns[observation] = U, share
        self.out.append(observation)

    def take_back(self, observations: Sequence[int]) -> None:
        """As if these had never been left out."""
        if not observations:
            return
        kept = [o for o in self.out if o not in set(observations)]
        for o in reversed(self.out):
            self._take(*self.columns.pop(o), -1.0)
        self.out = []
        for o in kept:
            self.leave_out(o)

    def start_columns(self, columns: IntArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Columns (m, k) of R at the start, or some rows of them."""
        own = self._directions[:, columns][rows].toarray()
        return np.asarray(own - self.A[rows] @ self.system.normal.solve(self.A[columns].T.toarray()))

    @cached_property
    def _directions(self) -> sparse.csc_matrix:
        """C'C (m, m), by which R exceeds the cofactors."""
        m = self.A.shape[0]
        alone = np.ones(m)
        alone[[r for rows, _ in self.joint for r in rows]] = 0.0
        parts = [(np.arange(m), np.arange(m), alone)]
        parts += [(np.repeat(rows, len(rows)), np.tile(rows, len(rows)), (C.T @ C).ravel()) for rows, C in self.joint]
        r, c, v = (np.concatenate(x) for x in zip(*parts, strict=True))
        return sparse.csc_matrix((v, (r, c)), shape=(m, m))

    def _take(self, U: FloatArray, share: FloatArray, sign: float) -> None:
        self.g = self.g - sign * (U @ share)
        for number, members in enumerate(self.alike):
            own = U[self.rows(members)]
            self.R[number] = self.R[number] - sign * np.einsum("nia,nja->nij", own, own)
        self.omega -= sign * float(share @ share)
        self.left -= int(sign) * len(share)

    def _outside(self) -> dict[int, tuple[float, float]]:
        """T of every observation that is out, with the others out, and its estimated error in sigmas."""
        rows = [np.arange(int(self.ptr[o]), int(self.ptr[o + 1])) for o in self.out]
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

    def robust_squares(self, freedom: IntArray, factors: FloatArray) -> FloatArray:
        """Weighted squares (M,), over the factors (G,) of the groups, where Cauchy weights settle.

        What is not followed keeps its weight.
        """
        q, weights, factor = np.maximum(freedom, 1), np.ones(len(self.used)), factors[self.group]
        e, squares = self._linearised(), np.zeros(len(q))
        for _ in range(self.rounds):
            squares = np.bincount(self.row_of, weights=e**2, minlength=len(q)) / factor
            new = cauchy_weights(squares / q)
            for rows, _ in self.joint:  # one weight for what is whitened together
                mine = self.row_of[rows]
                new[mine] = new[mine].min()
            if np.abs(new - weights).max(initial=0.0) < 1e-2:
                break
            try:
                e = self._reweighted(new, factor)
            except np.linalg.LinAlgError:
                break  # what is so far off that its weight is nothing is all that determines something: it stands out
            weights = new
        return squares

    def _linearised(self) -> FloatArray:
        """Residuals (m,) that the robust solution begins with."""
        return self.system.e[len(self.system.e) - len(self.row_of) :]

    def _reweighted(self, weights: FloatArray, factor: FloatArray) -> FloatArray:
        """Residuals (m,) with weights (M,) over the factors (M,) of the variances."""
        s, kept = self.system, len(self.system.e) - len(self.row_of)
        of_rows = s.used[s.row_of].astype(float)
        of_rows[kept:] *= (weights / factor)[self.row_of]
        step = s.normal_of(of_rows).solve(np.asarray(s.A.T @ (of_rows * s.e)))
        return np.asarray(s.e[kept:] - s.A[kept:] @ step)


def _influences(precision: Precision) -> tuple[list[FloatArray], BoolArray]:
    """Whitened A Q A' (k, k) of everything but image points in the solution, and which of it that uses (M,)."""
    graph, readings = precision.graph, precision.graph.terrestrial
    found = [precision.rows(item).influence for item in graph.others]
    used = np.array([item.used for item in graph.others], dtype=np.bool_)
    if readings is None:
        return found, used
    found += list(influences_of_readings(readings, precision.tree)[:, None, None])
    return found, np.concatenate([used, readings.used])
