"""How positions and poses changed from one epoch to another, with covariance, in a datum of some of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.epochs.states import EpochState, differences, gauge_rows
from adjust.model.errors import SurveyError
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.precision.s_transformation import transformed
from adjust.testing.quadratic_forms import pseudo_precision, pseudo_square, pseudo_square_beside


@dataclass(frozen=True, eq=False)
class Change:
    """Differences d (n,), their covariance Q (n, n), the motions G (n, k) that do not count, and whose rows are whose.

    owner: (n,) number of the name. component: (n,) of rx ry rz x y z, 0 to 5. weight: (n,) in the datum. held: (n, k)
    what the datum holds, held' d = 0. nowhere: names of which an epoch knows the rotation alone.
    """

    names: tuple[ParameterName, ...]
    d: FloatArray
    Q: FloatArray
    G: FloatArray
    owner: IntArray
    component: IntArray
    weight: FloatArray
    held: FloatArray
    nowhere: frozenset[ParameterName]

    def rows(self, stable: Sequence[int]) -> IntArray:
        """Components of these names."""
        return np.flatnonzero(np.isin(self.owner, stable))

    def transformed(self, stable: Sequence[int]) -> "Change":
        """In the datum of these names: S = I - G (G'EG)^-1 G'E."""
        if not self.G.shape[1]:
            return self
        E = np.zeros(len(self.d))
        E[self.rows(stable)] = self.weight[self.rows(stable)]
        if np.linalg.matrix_rank(np.sqrt(E)[:, None] * self.G) < self.G.shape[1]:
            raise SurveyError(
                f"{len(stable)} stable points cannot carry the {self.G.shape[1]} motions that the epochs leave open; "
                "name more, or hold something in both"
            )
        d, Q = transformed(self.d, self.Q, self.G, E)
        return replace(self, d=d, Q=Q, held=E[:, None] * self.G)

    def shares(self, stable: Sequence[int]) -> dict[int, float]:
        """What each name adds to d' Q^+ d of the others alone: (P d)_j' P_jj^-1 (P d)_j (Niemeier 2008, 13.3)."""
        here = self.transformed(stable)
        rows = here.rows(stable)
        d = here.d[rows]
        _, _, P = pseudo_square(d, here.Q[np.ix_(rows, rows)])
        gradient, owner, out = P @ d, here.owner[rows], {}
        for i in stable:
            mine = np.flatnonzero(owner == i)
            if len(mine):
                out[i] = float(gradient[mine] @ np.linalg.pinv(P[np.ix_(mine, mine)], hermitian=True) @ gradient[mine])
        return out

    def square(self, stable: Sequence[int]) -> tuple[float, int]:
        """D' Q^+ d of these names in their own datum, and its rank."""
        here = self.transformed(stable)
        rows = here.rows(stable)
        statistic, rank = pseudo_square_beside(here.d[rows], here.Q[np.ix_(rows, rows)], here.held[rows])
        # what the datum takes away is no information, whatever rounding leaves of it
        return statistic, min(rank, max(0, len(rows) - self.G.shape[1]))


def open_motions(before: EpochState, after: EpochState) -> FloatArray:
    """Motions (7, k) that either epoch leaves open, orthonormal in units of the extent."""
    both = np.hstack([before.directions, after.directions])
    if not both.shape[1]:
        return both
    scale = np.array([1.0] * 3 + [before.extent] * 4)
    U, s, _ = np.linalg.svd(scale[:, None] * both / np.linalg.norm(scale[:, None] * both, axis=0), full_matrices=False)
    return np.asarray(U[:, s > 1e-6 * s.max()] / scale[:, None])


def change_of(
    names: tuple[ParameterName, ...], before: EpochState, after: EpochState, directions: FloatArray,
    cross: FloatArray | None,
) -> Change:  # fmt: skip
    """From the first to the second state of the same names. directions, cross: see :func:`compare`."""
    d, Q = differences(before, after), before.cov + after.cov
    if cross is not None:
        Q = Q - cross - cross.T
    G = gauge_rows(before) @ directions
    known = np.isfinite(d) & (np.diag(before.cov) + np.diag(after.cov) > 0.0)
    owner = np.repeat(np.arange(len(names)), before.sizes)
    component = np.concatenate([before.components(n) for n in names])
    nowhere = frozenset(names[int(i)] for i in owner[~np.isfinite(d)])
    Q_known = Q if known.all() else Q[np.ix_(known, known)]
    change = Change(names, d[known], Q_known, G[known], owner[known], component[known],
                     np.ones(int(known.sum())), np.zeros((int(known.sum()), 0)), nowhere)  # fmt: skip
    return replace(change, weight=_weights(change))


def _weights(change: Change) -> FloatArray:
    """One weight for all positions, one for all rotations: the mean precision of a component if all others are known.

    With points alone, or a datum that both epochs have, they do not matter; metres and radians need them.
    """
    position, G = change.component >= 3, change.G
    if position.all() or not position.any() or not G.shape[1]:
        return np.ones(len(position))
    precision = pseudo_precision(transformed(change.d, change.Q, G, np.ones(len(G)))[1], G)
    return np.asarray(np.where(position, precision[position].mean(), precision[~position].mean()))
