"""The normal equations of the conditions, ``N = B Q B'`` with a row of blocks per loop: solved, and inverted in parts.

Two ways to the same solution. With short loops N is sparse and factorised as it stands. With the loops of a spanning
tree each loop has one pair to itself, so that N is block diagonal but for the tree's few pairs, ``N = D + U S U'``,
and the Sherman-Morrison-Woodbury formula needs no more than a matrix of the tree's size: the way for dense networks.
"""

from collections.abc import Sequence
from typing import Protocol

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse as sp

from adjust.graph.cliques import Cliques
from adjust.graph.elimination import Elimination, positive_definite_lu
from adjust.model.survey import FloatArray, IntArray
from adjust.observations.pair_arrays import whitening
from adjust.precision.tree import TreeCovariance
from adjust.relay.loops import LoopBasis


class NormalEquations(Protocol):
    """N = B Q B' of one linearisation."""

    B: sp.bsr_array
    Q: FloatArray

    def solve(self, right: FloatArray) -> FloatArray:
        """N^-1 applied to columns (L dim, k) or one vector (L dim,)."""

    def adjusted_covariances(self) -> FloatArray:
        """Q - Q B' N^-1 B Q, the diagonal blocks (E, dim, dim) of all pairs."""


def condition_matrix(basis: LoopBasis, blocks: FloatArray) -> sp.bsr_array:
    """B (L dim, E dim) from the derivatives (K, dim, dim) of the misclosures."""
    dim = blocks.shape[-1]
    shape = (len(basis) * dim, basis.topology.n_pairs * dim)
    return sp.bsr_array((blocks, basis.pair_idx, basis.ptr), shape=shape)


def block_diagonal(blocks: FloatArray) -> sp.bsr_array:
    """Sparse matrix of diagonal blocks (n, dim, dim)."""
    n, dim, _ = blocks.shape
    return sp.bsr_array((np.ascontiguousarray(blocks), np.arange(n), np.arange(n + 1)), shape=(n * dim, n * dim))


class SparseNormals:
    """N factorised as it is; for short loops."""

    def __init__(self, basis: LoopBasis, blocks: FloatArray, Q: FloatArray) -> None:
        self.basis, self.blocks, self.Q = basis, blocks, Q
        self.B = condition_matrix(basis, blocks)
        self.N = (self.B @ block_diagonal(Q) @ self.B.T).tocsc()
        self.factor = positive_definite_lu(self.N)

    def solve(self, right: FloatArray) -> FloatArray:
        """N^-1 applied to ``right``."""
        return np.asarray(self.factor.solve(right))

    def adjusted_covariances(self) -> FloatArray:
        """One pass over the Bayes tree of the loops' multipliers; pair by pair where GTSAM refuses weak pivots.

        Loops that share a pair share a clique, so the tree's one pass gives all blocks of N^-1 that are asked for.
        """
        dim: int = self.Q.shape[-1]
        of_pair = self.basis.pair_idx
        graph, dims = _as_factors(self.N, dim), dict.fromkeys(range(len(self.basis)), dim)
        found = Elimination(gtsam.Ordering.ColamdGaussianFactorGraph(graph)).of(graph.eliminateMultifrontal)
        if found is None:
            return np.array([joint_covariance(self, [e]) for e in range(len(self.Q))])
        tree, out = TreeCovariance(Cliques.of(found, dims), dims), self.Q.copy()
        loop, order = np.repeat(np.arange(len(self.basis)), self.basis.lengths), np.argsort(of_pair, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(of_pair[order])) + 1) if len(order) else ():
            e = of_pair[rows[0]]
            G = self.Q[e] @ np.concatenate(list(np.swapaxes(self.blocks[rows], -1, -2)), axis=1)
            out[e] -= G @ tree.joint(loop[rows].tolist()) @ G.T
        return out


class TreeNormals:
    """N through its block diagonal part and the pairs of the spanning tree; for dense networks."""

    def __init__(self, basis: LoopBasis, blocks: FloatArray, Q: FloatArray) -> None:
        if basis.tree is None:
            raise ValueError("these normal equations need the loops of a spanning tree")
        dim = Q.shape[-1]
        self.B, self.Q, self.chords = condition_matrix(basis, blocks), Q, basis.tree.chord_idx
        self.tree_pairs = np.setdiff1d(np.unique(basis.pair_idx), self.chords)
        self.own = blocks[basis.ptr[:-1]]  # each loop begins with its own pair
        root = self.own @ np.linalg.cholesky(Q[self.chords])
        inverse_root = np.linalg.inv(root)
        self.D_inverse = block_diagonal(np.swapaxes(inverse_root, -1, -2) @ inverse_root)
        columns = (self.tree_pairs[:, None] * dim + np.arange(dim)).ravel()
        self.U = self.B.tocsc()[:, columns].tocsr()
        S_root_inverse = whitening(Q[self.tree_pairs])
        S_inverse = scipy.linalg.block_diag(*(np.swapaxes(S_root_inverse, -1, -2) @ S_root_inverse))
        self.capacitance = scipy.linalg.cho_factor(S_inverse + (self.U.T @ self.D_inverse @ self.U).toarray())

    def solve(self, right: FloatArray) -> FloatArray:
        """D^-1 - D^-1 U (S^-1 + U' D^-1 U)^-1 U' D^-1, applied to ``right``."""
        y = self.D_inverse @ right
        return np.asarray(y - self.D_inverse @ (self.U @ scipy.linalg.cho_solve(self.capacitance, self.U.T @ y)))

    def adjusted_covariances(self) -> FloatArray:
        """The tree's pairs have (S^-1 + U' D^-1 U)^-1; the others follow from them through their own loops."""
        dim, out = self.Q.shape[-1], self.Q.copy()
        n = len(self.tree_pairs)
        T = scipy.linalg.cho_solve(self.capacitance, np.eye(n * dim))
        at = np.arange(n)
        out[self.tree_pairs] = T.reshape(n, dim, n, dim)[at, :, at, :]
        F = self.U.tobsr(blocksize=(dim, dim))
        inverse_own = np.linalg.inv(self.own)
        for k, e in enumerate(self.chords):
            rows = slice(F.indptr[k], F.indptr[k + 1])
            index = (F.indices[rows, None] * dim + np.arange(dim)).ravel()
            G = inverse_own[k] @ np.concatenate(list(F.data[rows]), axis=1)
            out[e] = G @ T[np.ix_(index, index)] @ G.T
        return out


def joint_covariance(normals: NormalEquations, pair_idx: Sequence[int] | IntArray) -> FloatArray:
    """Q_ij - Q_i B_i' N^-1 B_j Q_j of some adjusted pairs, stacked; one solution per column, no inverse."""
    Q, dim, k = normals.Q, normals.Q.shape[-1], len(pair_idx)
    index = np.asarray(pair_idx, dtype=np.int64)
    columns = (index[:, None] * dim + np.arange(dim)).ravel()
    own = scipy.linalg.block_diag(*Q[index]) if k else np.zeros((0, 0))
    BQ = normals.B.tocsc()[:, columns].toarray() @ own
    return np.asarray(own - BQ.T @ normals.solve(BQ))


def _as_factors(N: sp.csc_array, dim: int) -> gtsam.GaussianFactorGraph:
    """A normal matrix (n dim, n dim), a factor for each of its blocks on and above the diagonal."""
    graph, none, zero = gtsam.GaussianFactorGraph(), np.zeros(dim), np.zeros((dim, dim))
    blocks = N.tobsr(blocksize=(dim, dim))
    row = np.repeat(np.arange(len(blocks.indptr) - 1), np.diff(blocks.indptr))
    for i, j, block in zip(row.tolist(), blocks.indices.tolist(), blocks.data, strict=True):
        if i == j:
            graph.add(gtsam.HessianFactor(i, block, none, 0.0))
        elif i < j:
            graph.add(gtsam.HessianFactor(i, j, zero, block, none, zero, none, 0.0))
    return graph
