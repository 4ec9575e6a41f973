"""Covariances of all cliques of a Bayes tree in one pass from the roots to the leaves.

With a clique's conditional R x_f + S x_s: T = -R^-1 S, Q_fs = T Q_ss, Q_ff = R^-1 R^-T + T Q_ss T' (the sparse inverse
subset of Takahashi, Fagan and Chen 1973; Golub and Plemmons 1980 for geodetic networks). The unknowns of every factor
lie together in one clique, so all redundancy numbers follow from it.
"""

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
from scipy.linalg import lapack

from adjust.model import FloatArray


class TreeCovariance:
    """Marginal and joint covariances. ``dims`` gives the dimension of every key."""

    def __init__(self, tree: gtsam.GaussianBayesTree, dims: Mapping[int, int]) -> None:
        self.tree, self.dims = tree, dims
        self._home: dict[int, int] = {}
        self._cliques: list[tuple[dict[int, int], FloatArray]] = []
        stack: list[tuple[gtsam.GaussianBayesTreeClique, int]] = [(root, -1) for root in tree.roots()]
        while stack:
            clique, parent = stack.pop()
            self._add(clique, parent)
            me = len(self._cliques) - 1
            stack += [(clique[j], me) for j in range(clique.nrChildren())]

    def _add(self, clique: gtsam.GaussianBayesTreeClique, parent: int) -> None:
        conditional = clique.conditional()
        keys = list(conditional.keys())
        R = conditional.R()
        nf = R.shape[0]
        at, n = {}, 0
        for key in keys:
            at[key] = n
            n += self.dims[key]
        inverse, info = lapack.dtrtri(R)
        if info != 0:
            raise ZeroDivisionError("the Bayes tree is singular")
        model = conditional.get_model()
        C = np.empty((n, n))
        C[:nf, :nf] = inverse @ inverse.T if model is None else (inverse * model.sigmas() ** 2) @ inverse.T
        if n > nf:
            T = -(inverse @ conditional.S())
            parent_at, parent_C = self._cliques[parent]
            index = np.concatenate(
                [np.arange(parent_at[k], parent_at[k] + self.dims[k]) for k in keys if at[k] >= nf]
            )
            Qss = parent_C[np.ix_(index, index)]
            C[:nf, nf:] = T @ Qss
            C[nf:, :nf] = C[:nf, nf:].T
            C[nf:, nf:] = Qss
            C[:nf, :nf] += C[:nf, nf:] @ T.T
        for key in keys:
            if at[key] < nf:
                self._home[key] = len(self._cliques)
        self._cliques.append((at, C))

    def marginal(self, key: int) -> FloatArray:
        """Covariance (dim, dim) of one unknown."""
        at, C = self._cliques[self._home[key]]
        i = slice(at[key], at[key] + self.dims[key])
        return C[i, i]

    def joint(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of any unknowns, stacked in this order; fast where they share a clique."""
        for key in keys:
            at, C = self._cliques[self._home[key]]
            if all(k in at for k in keys):
                index = np.concatenate([np.arange(at[k], at[k] + self.dims[k]) for k in keys])
                return np.asarray(C[np.ix_(index, index)])
        joint = self.tree.jointMarginalCovariance(list(keys))
        return np.block([[joint.at(a, b) for b in keys] for a in keys])
