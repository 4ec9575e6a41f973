"""What a change that no unknown of the graph knows would explain, and its size: by the score at the solution.

With whitened rows ``e + A dx`` and the derivative B of e by the change, ``g = B' e`` and ``M = B' (I - A Q A') B``:
v'Pv falls by ``g' inv(M) g``, and the change is ``-inv(M) g`` (score test, Rao 1948; model errors, Baarda 1968).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.statistics.system import LinearSystem, linear_system
from adjust.statistics.weakness import times_covariance

_SEEN = 1e-7
"""Share of a change's column that no unknown takes over, below which it does not show."""
_CUTS = 40


@dataclass(frozen=True, eq=False)
class Score:
    """theta: (k,) the change. cov: (k, k), a priori. drop: of v'Pv. seen: how many of the k directions show."""

    theta: FloatArray
    cov: FloatArray
    drop: float
    seen: int


def score(g: FloatArray, BB: FloatArray, AB: FloatArray, QAB: FloatArray) -> Score:
    """Of ``g = B'e`` (k,), ``B'B`` (k, k), ``A'B`` (n, k) and ``Q A'B`` (n, k)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(BB), 1e-300))
    values, V = np.linalg.eigh(scale[:, None] * (BB - AB.T @ QAB) * scale)
    kept = values > _SEEN
    L = scale[:, None] * V[:, kept]
    along = L.T @ g
    cov = (L / values[kept]) @ L.T
    return Score(-cov @ g, cov, float((along**2 / values[kept]).sum()), int(kept.sum()))


Part = tuple[IntArray, FloatArray]
"""Rows (r,) of a linear system, and the derivatives (r, k) of their whitened residuals by a change."""


@dataclass(frozen=True, eq=False)
class Linear:
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
        """(m,), zero for what is not in use."""
        return np.asarray(self._used * self.system.e)

    @cached_property
    def _used(self) -> FloatArray:
        return self.system.used[self.system.row_of].astype(float)

    @property
    def scale(self) -> float:
        """Variance factor."""
        return max(1.0, self.result.omega / max(self.result.redundancy, 1))

    def columns(self, name: ParameterName, components: Sequence[str] = ()) -> IntArray:
        """Of an unknown, or of some of its components; none where it is held."""
        at = self.system.columns.at.get(name, np.zeros(0, dtype=np.int64))
        return at if not components else at[[self.system.columns.components[i] in components for i in at]]

    def parts(self, columns: IntArray, rows: Sequence[IntArray]) -> list[Part]:
        """Rows with their derivatives by unknowns."""
        J = self.A[:, columns]
        return [(r, J[r].toarray()) for r in rows]

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
        if not parts:
            return Score(np.zeros(0), np.zeros((0, 0)), 0.0, 0)
        rows, B = (np.concatenate(x) for x in zip(*parts, strict=True))
        B = self._used[rows, None] * B
        AB = np.asarray(self.A[rows].T @ B)
        return score(B.T @ self.e[rows], B.T @ B, AB, times_covariance(self.system, AB))

    def steps(self, parts: Sequence[Part]) -> dict[int, Score]:
        """A change from part t on: the scores of t, at most ``_CUTS`` of them. parts: in the order of time."""
        cuts = list(range(2, len(parts) - 1))[:: max(1, (len(parts) - 3) // _CUTS)]
        g, BB, AB = self._by_part(parts)
        QAB = times_covariance(self.system, np.concatenate(list(AB), axis=1)) if len(AB) else np.zeros((0, 0))
        QAB = QAB.reshape(len(QAB), len(parts), -1).transpose(1, 0, 2)
        return {t: score(g[t:].sum(0), BB[t:].sum(0), AB[t:].sum(0), QAB[t:].sum(0)) for t in cuts}

    def drift(self, parts: Sequence[Part]) -> Score:
        """A change in proportion to time, by ``theta`` from the first part to the last."""
        t = drift_times(len(parts))[:, None]
        g, BB, AB = self._by_part(parts)
        whole = (t[:, :, None] * AB).sum(0)
        return score((t * g).sum(0), (t[:, :, None] ** 2 * BB).sum(0), whole, times_covariance(self.system, whole))

    def _by_part(self, parts: Sequence[Part]) -> tuple[FloatArray, FloatArray, FloatArray]:
        g = np.array([B.T @ self.e[rows] for rows, B in parts])
        AB = np.array([self.A[rows].T @ B for rows, B in parts])
        return g, np.array([B.T @ B for _, B in parts]), AB


def drift_times(n: int) -> FloatArray:
    """(n,) from -1/2 to 1/2."""
    return np.asarray(np.linspace(-0.5, 0.5, n))
