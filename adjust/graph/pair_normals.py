"""Normal equations of surveys of nothing but pairs and priors, in the compiled core.

A view of the one graph: the same system as GTSAM's factors give, eliminated in the same order. What is analysed once
serves every step, and near the solution one factor serves several of them. Long corridors are eliminated by their rows.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import gtsam
import numpy as np

from adjust.graph.assembly import AdjustmentGraph, Evaluation
from adjust.graph.bending import Bending, tree
from adjust.graph.elimination import EXACT, force_on, lost, numbers, pose_cliques
from adjust.model.errors import IndeterminateError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.native.elimination import PoseFactor, PoseTree, pair_gradient


@frozen(eq=False)
class PairLinear:
    """Whitened residuals (E, 6) of pairs and their derivatives (E, 6, 6) by b and by a; what is known of single poses.

    own (N, 6, 6), right (N, 6): that part of the normal equations, poses as :class:`PairNormals` counts them.
    """

    normals: "PairNormals"
    white: FloatArray
    by_b: FloatArray
    by_a: FloatArray
    own: FloatArray
    right: FloatArray

    def add(self, key: int, A: FloatArray, b: FloatArray, _: gtsam.noiseModel.Base) -> None:
        """An observation of one pose, whitened as GTSAM has it: A (k, 6) and right hand side (k,)."""
        n = self.normals.number[key]
        self.own[n] += A.T @ A
        self.right[n] += A.T @ b

    def damped(self, damping: float) -> "PairLinear":
        """With Marquardt's damping: every unknown held with ``damping`` times its own diagonal."""
        return replace(self, own=self.own + damping * np.maximum(self.diagonal(), 1e-12)[:, :, None] * np.eye(6))

    def diagonal(self) -> FloatArray:
        """Of the normal matrix (N, 6)."""
        diagonal = np.einsum("nii->ni", self.own).copy()
        for nodes, J in ((self.normals.b, self.by_b), (self.normals.a, self.by_a)):
            free = nodes >= 0
            at = (6 * nodes[free, None] + np.arange(6)).ravel()
            squares = np.einsum("eij,eij->ej", J[free], J[free]).ravel()
            diagonal += np.bincount(at, squares, diagonal.size).reshape(-1, 6)
        return np.asarray(diagonal)

    def square(self, x: FloatArray) -> float:
        """``x' N x`` of the normal matrix N and x (N, 6), by the rows whose squares it is."""
        white, last = np.zeros(self.white.shape), np.vstack([x, np.zeros(6)])  # of what is held
        for nodes, J in ((self.normals.b, self.by_b), (self.normals.a, self.by_a)):
            white += np.einsum("eij,ej->ei", J, last[nodes])
        return float((white**2).sum() + (np.einsum("nij,nj->ni", self.own, x) * x).sum())

    def gradient(self) -> FloatArray:
        """Right hand side (N, 6) of the normal equations."""
        g = self.right.copy()
        pair_gradient(self.normals.b, self.normals.a, self.white, self.by_b, self.by_a, g)
        return g


class PairNormals:
    """The system of a graph with ``only_pairs``, and its elimination by Cholesky. last: keys to be eliminated last.

    exact: whether all digits are wanted; else IndeterminateError is raised where Cholesky refuses.
    b, a: (E,) numbers of the ends of the pairs in use, -1 for what is held. The ends of the others share a clique as
    well, as if these were in use: what is out is tested at the price of what is in.
    """

    def __init__(self, graph: AdjustmentGraph, last: Iterable[int], exact: bool = True) -> None:
        if graph.pairs is None:
            raise ValueError("the survey has no pairs between fixed stations")
        self.graph, self.batch = graph, graph.pairs
        self.priors = [item.factor for item in graph.singles if item.used and item.factor.size()]
        known = [*self.batch.seen(), *(factor.keys()[0] for factor in self.priors)]
        b, a = (keys[~self.batch.both_held] for keys in (self.batch.b_key, self.batch.a_key))
        solved = np.isin(b, [*known, -1]) & np.isin(a, [*known, -1])
        b, a = b[solved], a[solved]
        self.keys, pattern = pose_cliques([factor.keys()[0] for factor in self.priors], a, b, list(last))
        active = self.batch.arrays.used[~self.batch.both_held][solved]
        self.b, self.a = (numbers(self.keys, ends[active]) for ends in (b, a))
        self.number = {key: i for i, key in enumerate(self.keys.tolist())}
        self.factor = PoseFactor(pattern)
        self.kept = False
        """Whether the factor of the step before serves the next one."""
        self.exact = exact
        self.by_rows: bool | None = None
        """Whether the normal matrix has too few digits; not known before the first factor."""

    def linearized(self, at: Evaluation) -> PairLinear:
        """The system at what was evaluated, once more where something else was in between."""
        if at.number != self.graph.state.evaluation:
            self.graph.prepare(at.values, True)
        n = len(self.keys)
        linear = PairLinear(self, *self.batch.rows_here(), np.zeros((n, 6, 6)), np.zeros((n, 6)))
        for factor in self.priors:
            found = factor.linearize(at.values)
            linear.add(factor.keys()[0], *found.jacobian(), gtsam.noiseModel.Unit.Create(6))
        return linear

    @cached_property
    def bending(self) -> Bending:
        """Along a tree of pairs."""
        held = (self.a < 0) | (self.b < 0)
        near = np.append(np.maximum(self.a, self.b)[held], [self.number[f.keys()[0]] for f in self.priors])
        found = tree(len(self.keys), self.a[~held], self.b[~held], np.unique(near.astype(np.int64)))
        return Bending(self.keys.tolist(), *found)

    def solution(self, linear: PairLinear) -> tuple[gtsam.VectorValues, float] | None:
        """The solution and by how much it lowers chi-square; None where there is a pose without a pivot."""
        if not self.kept and not self._eliminated(linear):
            return None
        return self._solved(linear)

    def tree(self, linear: PairLinear) -> tuple[PoseTree, gtsam.VectorValues] | None:
        """The Bayes tree and the solution; None as above."""
        if not self.kept and not self._eliminated(linear):
            return None
        return PoseTree(self.factor.pattern, self.keys, self.factor.data), self._solved(linear)[0]

    def _eliminated(self, linear: PairLinear) -> bool:
        system = self.b, self.a, linear.by_b, linear.by_a, linear.own
        refused = not self.by_rows and self.factor.eliminate(*system) >= 0
        if refused and not self.exact:
            raise IndeterminateError("the normal equations have too few digits for all poses")
        if self.by_rows is None or refused:
            self.by_rows = refused or (self.exact and self.lost(linear) > EXACT)
        return not self.by_rows or self.factor.eliminate_rows(*system) < 0

    def lost(self, linear: PairLinear) -> float:
        """Share of its variance that the weakest motion of all has lost in the factor."""
        x = (force := force_on(linear.diagonal())).copy()
        self.factor.solve(x)
        return lost(force, x, linear.square(x))

    def _solved(self, linear: PairLinear) -> tuple[gtsam.VectorValues, float]:
        g = linear.gradient()
        x = g.copy()
        self.factor.solve(x)
        delta = gtsam.VectorValues()
        for key, row in zip(self.number, x, strict=True):
            delta.insert(key, row)
        return delta, float(np.sum(g * x))
