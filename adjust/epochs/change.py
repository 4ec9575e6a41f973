"""What lies between two epochs, in any datum: by their covariance matrices (large ones: ``adjust.epochs.joined``)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from adjust.epochs.states import Epoch, EpochState, differences
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.precision.s_transformation import transformed
from adjust.spatial.motions import values_motions
from adjust.testing.quadratic_forms import pseudo_precision, pseudo_square, pseudo_square_beside

Displaced = Callable[[IntArray], tuple[FloatArray, FloatArray]]
"""Of components (p, k), those of a name in a row: displacements (p, k) and the covariances (p, k, k) of each name."""
Between = tuple[
    tuple[tuple[ParameterName, ...], FloatArray, FloatArray, IntArray, IntArray, frozenset[ParameterName]], BoolArray
]
"""The fields of a :class:`Change`, and which of all components they are of."""


@frozen(eq=False)
class Change(ABC):
    """Differences d (n,) of known components, the motions G (n, k) that do not count, and whose rows are whose.

    owner: (n,) number of the name. component: (n,) of rx ry rz x y z, 0 to 5. nowhere: names of which an epoch knows
    the rotation alone.
    """

    names: tuple[ParameterName, ...]
    d: FloatArray
    G: FloatArray
    owner: IntArray
    component: IntArray
    nowhere: frozenset[ParameterName]

    def rows(self, stable: Sequence[int]) -> IntArray:
        """Components of these names."""
        return np.flatnonzero(np.isin(self.owner, stable))

    @cached_property
    def weight(self) -> FloatArray:
        """Weights (n,) in a datum: one of positions, one of rotations, the mean precision if all others are known.

        With points alone, or a datum that both epochs have, they do not matter; metres and radians need them.
        """
        position = self.component >= 3
        if position.all() or not position.any() or not self.G.shape[1]:
            return np.ones(len(position))
        return np.asarray(np.where(position, self._precision(position), self._precision(~position)))

    def datum(self, stable: Sequence[int]) -> FloatArray:
        """E (n,), the weights of these names; raises SurveyError where they cannot carry the motions."""
        E, rows = np.zeros(len(self.d)), self.rows(stable)
        E[rows] = self.weight[rows]
        if np.linalg.matrix_rank(np.sqrt(E[rows])[:, None] * self.G[rows]) < self.G.shape[1]:
            raise SurveyError(
                f"{len(stable)} stable points cannot carry the {self.G.shape[1]} motions that the epochs leave open; "
                "name more, or hold something in both"
            )
        return E

    @abstractmethod
    def _precision(self, rows: BoolArray) -> float:
        """Mean of the diagonal of Q^+ over these components, in the datum of all."""

    @abstractmethod
    def square(self, stable: Sequence[int]) -> tuple[float, int]:
        """``d' Q^+ d`` of these names in their datum, and the rank of Q."""

    @abstractmethod
    def shares(self, stable: Sequence[int]) -> dict[int, float]:
        """What each name adds to d' Q^+ d of the others alone: (P d)_j' P_jj^-1 (P d)_j, PG = 0 (Niemeier 2008, 13)."""

    @abstractmethod
    def displaced(self, stable: Sequence[int]) -> Displaced:
        """The displacements in the datum of these names."""


def between(before: Epoch, after: Epoch, directions: FloatArray, determined: BoolArray) -> Between:
    """Of two epochs of the same names, one of which has ``determined`` (n,) a component; which are known (n,)."""
    d = differences(before.values, after.values)
    known = np.isfinite(d) & determined
    component = np.concatenate([before.components(n) for n in before.names])
    nowhere = frozenset(before.names[int(i)] for i in before.owner[~np.isfinite(d)])
    G = values_motions(before.values) @ directions
    return (before.names, d[known], G[known], before.owner[known], component[known], nowhere), known


@frozen(eq=False)
class MatrixChange(Change):
    """By the covariance Q (n, n) of the differences."""

    Q: FloatArray

    @classmethod
    def of(
        cls, before: EpochState, after: EpochState, directions: FloatArray, cross: FloatArray | None
    ) -> "MatrixChange":
        """Of two states of the same names; cross: covariance (n, n) of the first with the second, 0 where None."""
        Q = before.cov + after.cov
        if cross is not None:
            Q = Q - cross - cross.T
        fields, known = between(before, after, directions, np.diag(before.cov) + np.diag(after.cov) > 0.0)
        return cls(*fields, Q if known.all() else Q[np.ix_(known, known)])

    def _precision(self, rows: BoolArray) -> float:
        precision = pseudo_precision(transformed(self.d, self.Q, self.G, np.ones(len(self.G)))[1], self.G)
        return float(precision[rows].mean())

    def _in_datum(self, stable: Sequence[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """S d, S Q S' with S = I - G (G'EG)^-1 G'E, and what the datum holds, E G, held' S d = 0."""
        if not self.G.shape[1]:
            return self.d, self.Q, self.G
        E = self.datum(stable)
        return *transformed(self.d, self.Q, self.G, E), E[:, None] * self.G

    def square(self, stable: Sequence[int]) -> tuple[float, int]:
        """See :class:`Change`."""
        d, Q, held = self._in_datum(stable)
        rows = self.rows(stable)
        return pseudo_square_beside(d[rows], Q[np.ix_(rows, rows)], held[rows])

    def shares(self, stable: Sequence[int]) -> dict[int, float]:
        """See :class:`Change`."""
        d, Q, held = self._in_datum(stable)
        rows = self.rows(stable)
        P, G, H = pseudo_square(d[rows], Q[np.ix_(rows, rows)])[2], self.G[rows], held[rows]
        S = np.eye(len(rows)) - G @ np.linalg.solve(H.T @ G, H.T)
        P = S.T @ P @ S  # of all inverses the one that the motions have no part in
        gradient, owner, out = P @ d[rows], self.owner[rows], {}
        for i in stable:
            mine = np.flatnonzero(owner == i)
            if len(mine):
                out[i] = float(gradient[mine] @ np.linalg.pinv(P[np.ix_(mine, mine)], hermitian=True) @ gradient[mine])
        return out

    def displaced(self, stable: Sequence[int]) -> Displaced:
        """See :class:`Change`."""
        d, Q, _ = self._in_datum(stable)
        return lambda rows: (d[rows], Q[rows[:, :, None], rows[:, None]])
