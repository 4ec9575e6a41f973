"""Observations that follow from the pose of one frame in another: alignments, levels, laser spots; each kind at once.

A direction u = R a of a body turns with its pose by ``du = -R [a]x dw`` (perturbation on the right).
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import gtsam
import numpy as np

from adjust.frames.state import State
from adjust.frames.unknowns import Chain, Unknowns, VectorMap
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.observations.factors import Residual
from adjust.observations.images.batch import Chains
from adjust.spatial.rigid import skew
from adjust.spatial.vertical import VerticalMap


@frozen(eq=False)
class Predicted:
    """Predicted minus observed (n, k) of n observations, and its derivatives by pose (n, k, 6) and vector (n, k, m)."""

    residual: FloatArray
    by_pose: FloatArray
    by_vector: FloatArray | None = None


Predict = Callable[[gtsam.Values, IntArray, FloatArray, FloatArray], Predicted]
"""From values, the numbers (n,) of observations and their poses R (n, 3, 3), t (n, 3)."""


class PoseBatch:
    """Observations of one kind; each follows from the pose of its chain, and from a vector where there are any.

    Inside ``State.serving`` factors take what is evaluated for all of them at once; else each evaluates itself.
    """

    def __init__(
        self, unknowns: Unknowns, state: State, chains: Sequence[Chain], predict: Predict,
        vectors: Sequence[VectorMap | VerticalMap] = (),
    ) -> None:  # fmt: skip
        self.state, self.chains, self.predict, self.vectors = state, Chains(chains), predict, vectors
        self.keys = [list(dict.fromkeys(k for link in chain for k in unknowns.link_keys(link.slot)))
                     for chain in chains]  # fmt: skip
        self._owner = np.repeat(np.arange(len(chains)), np.diff(self.chains.ptr))
        self._served: tuple[int, _Linked] | None = None

    def poses(self, values: gtsam.Values) -> tuple[FloatArray, FloatArray]:
        """Of all chains: R (n, 3, 3), t (n, 3)."""
        self.state.load(values, self.chains.slot.tolist(), lenses=False)
        self.chains.evaluate(self.state)
        return self.chains.R, self.chains.t

    def residual(self, i: int, components: slice | BoolArray = slice(None)) -> Residual:
        """Of one of them, or of some of its components."""
        links = slice(int(self.chains.ptr[i]), int(self.chains.ptr[i + 1]))

        def residual(values: gtsam.Values) -> tuple[FloatArray, Iterator[tuple[int, FloatArray]]]:
            if self.state.served:
                here, at, mine = self._of_all(values), i, links
            else:
                here, at, mine = self._alone(values, i), 0, slice(None)
            return here.found.residual[at][components], self._blocks(i, here, at, mine, components)

        return residual

    def _of_all(self, values: gtsam.Values) -> "_Linked":
        if self._served is None or self._served[0] != self.state.evaluation:
            self.chains.evaluate(self.state)
            found = self.predict(values, np.arange(len(self.keys)), self.chains.R, self.chains.t)
            self._served = self.state.evaluation, _Linked(found, self._owner, self.chains.C)
        return self._served[1]

    def _alone(self, values: gtsam.Values, i: int) -> "_Linked":
        self.state.load(values, self.chains.slots(i), lenses=False)
        R, t, C = self.chains.one(self.state, i)
        return _Linked(self.predict(values, np.array([i]), R, t), np.zeros(len(C), dtype=np.int64), C)

    def _blocks(
        self, i: int, here: "_Linked", at: int, links: slice, components: slice | BoolArray
    ) -> Iterator[tuple[int, FloatArray]]:
        """Derivatives by every unknown, of number ``at`` of what was evaluated."""
        for slot, J in zip(self.chains.slots(i), here.by_links[links], strict=True):
            yield from self.state.by_keys(slot, J[components])
        vector, by_vector = self.vectors[i] if self.vectors else None, here.found.by_vector
        if vector is not None and vector.key is not None and by_vector is not None:
            yield vector.key, by_vector[at][components] @ vector.matrix


@frozen(eq=False)
class _Linked:
    """What is predicted, of which observation every link of a chain is, and C (links, 6, 6): poses by links."""

    found: Predicted
    owner: IntArray
    C: FloatArray

    @cached_property
    def by_links(self) -> FloatArray:
        """(links, k, 6)."""
        return self.found.by_pose[self.owner] @ self.C


def aligned(axis: FloatArray, across: FloatArray, observed: FloatArray) -> Predict:
    """Axes (n, 3) of one frame seen from another along two axes (n, 2, 3) across those that they were compared with."""

    def predict(values: gtsam.Values, rows: IntArray, R: FloatArray, t: FloatArray) -> Predicted:
        seen, a = across[rows] @ R, axis[rows]
        by_turn = -seen @ skew(a)
        by_pose = np.concatenate([by_turn, np.zeros_like(by_turn)], axis=2)
        return Predicted((seen @ a[:, :, None])[:, :, 0] - observed[rows], by_pose)

    return predict


def inclined(axis: FloatArray, observed: FloatArray, vertical: VerticalMap) -> Predict:
    """Inclinations of axes (n, 3) of bodies above the horizontal at their origins; by the tilts of the plumb line."""

    def predict(values: gtsam.Values, rows: IntArray, R: FloatArray, t: FloatArray) -> Predicted:
        (up, curved, up_by_tilt), a = vertical.at(values).upwards(t), axis[rows]
        u = (R @ a[:, :, None])[:, :, 0]
        sine = (u * up).sum(axis=1)
        level = u - sine[:, None] * up
        cosine = np.linalg.norm(level, axis=1)
        by_pose = np.concatenate([-up[:, None] @ R @ skew(a), (curved * level)[:, None] @ R], axis=2)
        per = 1.0 / cosine[:, None, None]
        return Predicted((np.arctan2(sine, cosine) - observed[rows])[:, None], per * by_pose,
                         per * (u[:, None] @ up_by_tilt))  # fmt: skip

    return predict


def spotted(axes: FloatArray, observed: FloatArray, beams: Sequence[VectorMap]) -> Predict:
    """Where beams meet the planes z = 0 of targets (n, 2) m; by ``target_from_body`` and by the beam (n, 2, 4).

    axes: (n, 3, 3) as in :func:`beam_axes`.
    """

    def predict(values: gtsam.Values, rows: IntArray, R: FloatArray, t: FloatArray) -> Predicted:
        full = {beam: beam.full(values) for beam in dict.fromkeys(beams[i] for i in rows.tolist())}
        beam, own = np.array([full[beams[i]] for i in rows.tolist()]), axes[rows]
        offset = (own[:, :, :2] @ beam[:, :2, None])[:, :, 0]
        along = (own[:, :, :2] @ beam[:, 2:, None])[:, :, 0] + own[:, :, 2]
        q, d = (R @ np.stack([offset, along], axis=2) + [[1.0, 0.0]] * t[:, :, None]).transpose(2, 0, 1)
        s = -q[:, 2:] / d[:, 2:]
        # a point of the line moves by dq + s dd; back along the line onto z = 0
        onto = np.concatenate([np.tile(np.eye(2), (len(rows), 1, 1)), -(d[:, :2] / d[:, 2:])[:, :, None]], axis=2)
        moved = onto @ R
        across = moved @ own[:, :, :2]
        by_pose = np.concatenate([-moved @ skew(offset + s * along), moved], axis=2)
        return Predicted((q + s * d)[:, :2] - observed[rows], by_pose,
                         np.concatenate([across, s[:, :, None] * across], axis=2))  # fmt: skip

    return predict


def beam_axes(axis: str) -> FloatArray:
    """The axis that a beam runs along and the two next ones, as columns (3, 3): 1, 2, then the beam's own."""
    return np.roll(np.eye(3), -("xyz".index(axis) + 1), axis=0).T
