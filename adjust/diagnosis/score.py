"""What a change that no unknown of the graph knows would explain, and its size: by the score at the solution.

With whitened rows ``e + A dx`` and the derivative B of e by the change, ``g = B' e`` and ``M = B' (I - A Q A') B``:
v'Pv falls by ``g' inv(M) g``, and the change is ``-inv(M) g`` (score test, Rao 1948; model errors, Baarda 1968).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.statistics.system import LinearSystem, linear_system
from adjust.statistics.weakness import times_covariance

_SEEN = 1e-4
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

    def of_rows(self, rows: IntArray, B: FloatArray) -> Score:
        """Of a change with derivatives B (r, k) of these rows, which are in use."""
        kept = self._used[rows] > 0.0
        rows, B = rows[kept], B[kept]
        AB = np.asarray(self.A[rows].T @ B)
        return score(B.T @ self.e[rows], B.T @ B, AB, times_covariance(self.system, AB))

    def steps(self, columns: IntArray, parts: Sequence[IntArray]) -> dict[int, Score]:
        """An unknown with another value from part t of its rows on: the scores of t, at most ``_CUTS`` of them.

        parts: rows, in the order of time.
        """
        cuts = list(range(2, len(parts) - 1))[:: max(1, (len(parts) - 3) // _CUTS)]
        g, BB, AB = self._by_part(columns, parts)
        QAB = times_covariance(self.system, np.concatenate(list(AB), axis=1)) if len(AB) else np.zeros((0, 0))
        QAB = QAB.reshape(len(QAB), len(parts), -1).transpose(1, 0, 2)
        return {t: score(g[t:].sum(0), BB[t:].sum(0), AB[t:].sum(0), QAB[t:].sum(0)) for t in cuts}

    def drift(self, columns: IntArray, parts: Sequence[IntArray]) -> Score:
        """An unknown that changes in proportion to time, by ``theta`` from the first part to the last."""
        t = drift_times(len(parts))[:, None]
        g, BB, AB = self._by_part(columns, parts)
        whole = (t[:, :, None] * AB).sum(0)
        return score((t * g).sum(0), (t[:, :, None] ** 2 * BB).sum(0), whole, times_covariance(self.system, whole))

    def _by_part(self, columns: IntArray, parts: Sequence[IntArray]) -> tuple[FloatArray, FloatArray, FloatArray]:
        J = self.A[:, columns]
        B = [J[rows].toarray() for rows in parts]
        g = np.array([b.T @ self.e[rows] for b, rows in zip(B, parts, strict=True)])
        AB = np.array([self.A[rows].T @ b for b, rows in zip(B, parts, strict=True)])
        return g, np.array([b.T @ b for b in B]), AB


def drift_times(n: int) -> FloatArray:
    """(n,) from -1/2 to 1/2."""
    return np.asarray(np.linspace(-0.5, 0.5, n))
