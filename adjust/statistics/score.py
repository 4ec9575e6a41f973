"""What a change that no unknown of the graph knows would explain, and its size: by the score at the solution.

With whitened rows ``e + A dx`` and the derivative B of e by the change, ``g = B' e`` and ``M = B' (I - A Q A') B``:
v'Pv falls by ``g' inv(M) g``, and the change is ``-inv(M) g`` (score test, Rao 1948; model errors, Baarda 1968).
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy import sparse

from adjust.frames.lens_states import lenders
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.statistics.normal import DENSE
from adjust.statistics.system import LinearSystem, linear_system
from adjust.testing.criteria import contradicting
from adjust.testing.quadratic_forms import pseudo_half
from adjust.testing.significance import Significance, significance

_SEEN = 1e-7
"""Share of a change's column that no unknown takes over, below which it does not show."""
_CUTS = 40
_SMALL = 1_000_000  # numbers of a matrix that is written out


@frozen(eq=False)
class Score:
    """theta: (k,) the change. cov: (k, k), a priori. drop: of v'Pv. seen: how many of the k directions show."""

    theta: FloatArray
    cov: FloatArray
    drop: float
    seen: int


def scores(g: FloatArray, BB: FloatArray, taken: FloatArray) -> list[Score]:
    """Of ``g = B'e`` (s, k), ``B'B`` (s, k, k) and what the unknowns take over of that, ``B'A Q A'B`` (s, k, k)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(BB, axis1=1, axis2=2), 1e-300))
    half, seen = pseudo_half(scale[:, :, None] * (BB - taken) * scale[:, None], _SEEN)
    half = scale[:, :, None] * half
    cov, along = half @ np.swapaxes(half, 1, 2), np.einsum("sqk,sq->sk", half, g)
    rows = zip(-np.einsum("skl,sl->sk", cov, g), cov, (along**2).sum(axis=1).tolist(), seen.tolist(), strict=True)
    return [Score(*row) for row in rows]


Part = tuple[IntArray, FloatArray]
"""Rows (r,) of a linear system, and the derivatives (r, k) of their whitened residuals by a change."""


@frozen(eq=False)
class LinearScores:
    """An adjustment as a linear system, for scores."""

    result: Adjustment

    @cached_property
    def system(self) -> LinearSystem:
        """All observations, those in use with their weight, the others without."""
        return linear_system(self.result)

    @cached_property
    def A(self) -> sparse.csr_matrix:
        """(m, n), zero rows for what is not in use."""
        return sparse.diags(self._used) @ self.system.A

    @cached_property
    def e(self) -> FloatArray:
        """(m,) at the minimum, zero for what is not in use: what is left to go of an adjustment is gone from here."""
        e = self._used * self.system.e
        return np.asarray(e - self.A @ self.system.times_covariance(np.asarray(self.A.T @ e)))

    @cached_property
    def _used(self) -> FloatArray:
        return self.system.used[self.system.row_of].astype(float)

    @property
    def scale(self) -> float:
        """Variance factor."""
        return max(1.0, self.result.omega / max(self.result.redundancy, 1))

    def ratio(self, drop: float) -> float:
        """How many times smaller the misfit beyond noise becomes by a drop of v'Pv."""
        return ratio(*self.contradicting, drop)

    @property
    def contradicting(self) -> tuple[float, float]:
        """Square sum and redundancy of all, or where these are noise, of the groups that are not; redundancy >= 1."""
        whole = self.result.omega, max(self.result.redundancy, 1)
        return contradicting(whole, ((g.omega, max(g.redundancy, 1.0)) for g in self.result.groups))

    def columns(self, name: ParameterName, components: Sequence[str] = ()) -> IntArray:
        """Of an unknown, or of some of its components; none where it is held."""
        at = self.system.columns.at.get(name, np.zeros(0, dtype=np.int64))
        return at if not components else at[[self.system.columns.components[i] in components for i in at]]

    @cached_property
    def _by_column(self) -> sparse.csc_matrix:
        return self.A.tocsc()

    @cached_property
    def _dense(self) -> FloatArray | None:
        """(m, n) of a small survey, whose products cost less so."""
        return np.asarray(self.A.toarray()) if np.prod(self.A.shape) <= _SMALL else None

    def rows_of(self, columns: IntArray) -> IntArray:
        """Rows (r,) that these unknowns have a part in."""
        ptr, rows = self._by_column.indptr, self._by_column.indices
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(rows[ptr[c] : ptr[c + 1]] for c in columns)]))

    def mean_squares(self, columns: Sequence[IntArray]) -> FloatArray:
        """(u,) of the residuals of the rows that each of these unknowns has a part in."""
        ends = np.cumsum([0, *map(len, columns)])
        of = np.concatenate([np.zeros(0, dtype=np.int64), *columns])
        seen = abs(self.A) @ sparse.csc_matrix((np.ones(len(of)), of, ends), (self.A.shape[1], len(columns)))
        seen.data[:] = 1.0
        squares, n = np.asarray(seen.T @ self.e**2), np.asarray(seen.sum(axis=0)).ravel()
        return np.asarray(squares / np.maximum(n, 1.0))

    def parts(self, columns: IntArray, rows: Sequence[IntArray]) -> list[Part]:
        """Rows with their derivatives by unknowns."""
        if not rows:
            return []
        every, J = np.concatenate(rows), np.zeros((sum(map(len, rows)), len(columns)))
        order = np.argsort(every, kind="stable")
        for k, c in enumerate(columns.tolist()):
            mine = slice(self._by_column.indptr[c], self._by_column.indptr[c + 1])
            found = self._by_column.indices[mine]
            at = np.minimum(np.searchsorted(every, found, sorter=order), len(every) - 1)
            here = every[order[at]] == found
            J[order[at[here]], k] = self._by_column.data[mine][here]
        return list(zip(rows, np.split(J, np.cumsum([len(r) for r in rows])[:-1]), strict=True))

    def image_parts(self, shifts: Mapping[int, FloatArray]) -> list[Part]:
        """By image block a shift (n, 2, k) px of its points, in the order of the blocks."""
        ptr, W = self.result.image_residuals.block_ptr, self.system.precision.graph.square_roots()
        out = []
        for i, D in sorted(shifts.items()):
            w = W[ptr[i] : ptr[i + 1], :, None]
            B = np.stack([w[:, 0] * D[:, 0] + w[:, 1] * D[:, 1], w[:, 2] * D[:, 1]], axis=1)
            rows = np.arange(2 * ptr[i], 2 * ptr[i + 1])
            out.append((rows, self._used[rows, None] * B.reshape(-1, B.shape[2])))
        return out

    def of_parts(self, parts: Sequence[Part]) -> Score:
        """Of a change of all of them."""
        return self._summed(parts, np.ones(len(parts)))

    def drift(self, parts: Sequence[Part]) -> Score:
        """A change in proportion to time, by ``theta`` from the first part to the last."""
        return self._summed(parts, drift_times(len(parts)))

    def apart(self, parts: Sequence[Part]) -> tuple[FloatArray, FloatArray]:
        """Of p changes by one number each: B'e (p,) and M (p, p), what the unknowns leave of B'B.

        They may have rows in common.
        """
        g, _, taken = self._normals(parts, np.arange(len(parts)))
        rows, B = (np.concatenate(x) for x in zip(*((r, J[:, 0]) for r, J in parts), strict=True))
        columns = sparse.csc_matrix((B, rows, np.cumsum([0, *(len(r) for r, _ in parts)])), (len(self.e), len(parts)))
        return g[:, 0], (columns.T @ columns).toarray() - taken[0][:, 0, :, 0]

    def steps(self, courses: Sequence[Sequence[Part]]) -> list[dict[int, Score]]:
        """Of each course a change from part t on: the scores of t, at most ``_CUTS`` of them.

        courses: their parts in the order of time, all with derivatives by as many numbers.
        """
        cuts = [list(range(2, n - 1))[:: max(1, (n - 3) // _CUTS)] for n in map(len, courses)]
        every = [(parts[at[0] :], np.diff([*at, len(parts)])) for parts, at in zip(courses, cuts, strict=True) if at]
        if not every:
            return [{} for _ in courses]
        ptr, lengths = np.cumsum([0, *map(len, cuts)]), np.concatenate([n for _, n in every])
        group = np.repeat(np.arange(len(lengths)), lengths)
        g, BB, taken = self._normals([p for parts, _ in every for p in parts], group, ptr)
        over = np.empty_like(BB)
        for (i, j), mine in zip(pairwise(ptr.tolist()), taken, strict=True):
            g[i:j], BB[i:j] = (np.cumsum(x[i:j][::-1], axis=0)[::-1] for x in (g, BB))
            later = np.cumsum(np.cumsum(mine[::-1, :, ::-1], axis=0), axis=2)[::-1, :, ::-1]
            over[i:j] = np.einsum("ikil->ikl", later)
        found = iter(scores(g, BB, over))
        return [{t: next(found) for t in at} for at in cuts]

    def _summed(self, parts: Sequence[Part], weights: FloatArray) -> Score:
        """Of changes of all of them in these proportions."""
        if not parts:
            return Score(np.zeros(0), np.zeros((0, 0)), 0.0, 0)
        weighted = [(rows, w * self._used[rows, None] * B) for w, (rows, B) in zip(weights, parts, strict=True)]
        g, BB, taken = self._normals(weighted, np.zeros(len(parts), dtype=np.int64))
        return scores(g, BB, taken[0][:, :, 0])[0]

    def _normals(
        self, parts: Sequence[Part], group: IntArray, ptr: IntArray | None = None
    ) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
        """Of groups of parts, each a change of its own: B'e (S, k), B'B (S, k, k); of sets B'A Q A'B (s, k, s, k).

        group: (p,) of every part, 0, 1, ... in this order. ptr: groups at which sets begin, and S; one set without. No
        two parts of a group have a row in common.
        """
        rows, B = (np.concatenate(x) for x in zip(*parts, strict=True))
        of_row, k, n = np.repeat(group, [len(r) for r, _ in parts]), B.shape[1], int(group[-1]) + 1
        by_group = np.split(np.arange(len(rows)), np.searchsorted(of_row, np.arange(1, n)))
        g = np.array([B[mine].T @ self.e[rows[mine]] for mine in by_group])
        BB = np.array([B[mine].T @ B[mine] for mine in by_group])
        ends = k * (np.array([0, n]) if ptr is None else ptr)
        if self._dense is not None:
            dense = self._dense
            BA = np.concatenate([B[mine].T @ dense[rows[mine]] for mine in by_group])
            sets = (BA[i:j] for i, j in pairwise(ends.tolist()))
            taken = [some @ self.system.covariance @ some.T for some in sets]
        else:
            at = (k * of_row[:, None] + np.arange(k)).ravel(), np.repeat(rows, k)
            taken = self._taken(sparse.csr_matrix((B.ravel(), at), (n * k, len(self.e))) @ self.A, ends)
        return g, BB, [x.reshape(len(x) // k, k, len(x) // k, k) for x in taken]

    def _taken(self, BA: sparse.csr_matrix, ptr: IntArray) -> list[FloatArray]:
        """``B'A Q A'B`` (c, c) of sets of sparse rows B'A (c, n)."""
        if len(self.system.columns) > DENSE:
            return self.system.among_each(BA, ptr)
        out = []
        for some in (BA[i:j] for i, j in pairwise(ptr.tolist())):
            near = np.unique(some.indices)
            few = some[:, near].toarray()
            out.append(np.asarray(few @ self.system.covariance[np.ix_(near, near)] @ few.T))
        return out


def ratio(omega: float, n: float, drop: float) -> float:
    """How many times smaller a square sum beyond its expectation n becomes by a drop; noise itself is some of it."""
    noise, excess = float(np.sqrt(2.0 * n)), max(omega - n, drop)
    return (excess + noise) / (excess - drop + noise)


def drift_times(n: int) -> FloatArray:
    """(n,) from -1/2 to 1/2."""
    return np.asarray(np.linspace(-0.5, 0.5, n))


@frozen(eq=False)
class SharedLens:
    """What ``camera`` shares with ``lender``: names (k,) with units, by how much its own would differ, cov a priori.

    test: whether they differ, as ``significant``.
    """

    camera: str
    lender: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    difference: FloatArray
    cov: FloatArray
    test: Significance

    def said(self) -> str:
        """The parameters that differ by more than three sigmas, or all, in words."""
        sigmas = np.sqrt(np.maximum(np.diag(self.cov), 0.0))
        clear = np.abs(self.difference) > 3.0 * sigmas
        return ", ".join(
            f"{name} {d:+.3g} +- {s:.2g}{'' if unit == '1' else ' ' + unit}" for name, unit, d, s, shown in
            zip(self.names, self.units, self.difference, sigmas, clear | ~clear.any(), strict=True) if shown
        )  # fmt: skip


def shared_lenses(result: Adjustment, estimated_sigma0: bool) -> tuple[SharedLens, ...]:
    """Of every camera that shares parameters; F with sigma0 of the adjustment in which they are free, or chi-square.

    The statistic is ``(drop / k) / ((v'Pv - drop) / (r - k))`` where v'Pv falls by ``drop`` (Koch 1999, 4.2.1).
    """
    shared = lenders(result.survey)
    if not shared or result.precision is None:
        return ()
    linear, out = LinearScores(result), []
    for camera, (lender, parameters) in shared.items():
        found = result.estimates["lens", camera]
        names = tuple(x for x in found.components if x in parameters)
        score = own_score(linear, camera, lender, names)
        k, left = score.seen, result.redundancy - score.seen
        if not k or (estimated_sigma0 and left <= 0):
            continue
        variance = (result.omega - score.drop) / left if estimated_sigma0 else 1.0
        redundancy = left if estimated_sigma0 else None
        test = significance(result, "lens_shared", names, score.drop / variance, k, redundancy)
        units = tuple(found.units[found.components.index(x)] for x in names)
        out.append(SharedLens(camera, lender, names, units, score.theta, score.cov, test))
    return tuple(out)


def own_score(linear: LinearScores, camera: str, lender: str, parameters: tuple[str, ...]) -> Score:
    """Of a change of these parameters in the images of one camera alone."""
    ptr = 2 * linear.result.image_residuals.block_ptr
    rows = [np.arange(ptr[i], ptr[i + 1]) for i, b in enumerate(linear.result.survey.image_blocks)
            if b.camera_id == camera]  # fmt: skip
    columns = linear.columns(("lens", lender), parameters)
    return linear.of_parts(linear.parts(columns, rows) if len(columns) else [])
