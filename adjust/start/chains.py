"""Chains of poses and what observations say of their products, as arrays."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from adjust.frames.unknowns import Chain
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.observations.images.segments import ranges


class ChainObservation(NamedTuple):
    """The chain's product is one of ``poses`` (k, 4, 4), likeliest first.

    block_idx: the block of image points, -1 for others. rotation_only: the translation of the product is unknown.
    ends: whether the two ends of the chain are bound to what was seen (False: to points that are unknown themselves).
    """

    chain: Chain
    poses: FloatArray
    block_idx: int = -1
    rotation_only: bool = False
    ends: tuple[bool, bool] = (True, True)


@frozen(eq=False)
class Chains:
    """Chains padded to L links: slots (n, L), -1 behind the end, which of them (n, L) are inverted."""

    slots: IntArray
    inverted: BoolArray

    @staticmethod
    def of(chains: Sequence[Chain]) -> "Chains":
        """Side by side."""
        sizes = [len(chain) for chain in chains]
        slots = np.full((len(chains), max(sizes, default=0)), -1, dtype=np.int64)
        inverted = np.zeros(slots.shape, dtype=np.bool_)
        inside = np.arange(slots.shape[1]) < np.array(sizes, dtype=np.int64)[:, None]
        slots[inside] = [link.slot for chain in chains for link in chain]
        inverted[inside] = [link.inverse for chain in chains for link in chain]
        return Chains(slots, inverted)

    def part(self, rows: IntArray) -> "Chains":
        """Some (m,) of them."""
        return Chains(self.slots[rows], self.inverted[rows])

    def once(self, wanted: BoolArray) -> BoolArray:
        """Where (n, L) they pass a slot that is ``wanted`` (slots,), but none of those that they pass twice."""
        out = (self.slots >= 0) & wanted[self.slots]
        for j in range(out.shape[1]):
            out[:, j] &= (self.slots == self.slots[:, j : j + 1]).sum(axis=1) == 1
        return out

    def by_slot(self, where: BoolArray) -> tuple[IntArray, IntArray]:
        """Rows and columns of the links ``where`` (n, L), sorted by slot."""
        row, column = np.nonzero(where)
        order = np.argsort(self.slots[row, column], kind="stable")
        return row[order], column[order]


@frozen(eq=False)
class Observations:
    """n observations as arrays: the product of each chain is one of its poses (K, 4, 4), which begin by first (n + 1,).

    links: the chains. block_idx, rotation_only: (n,), see :class:`ChainObservation`.
    """

    links: Sequence[Chain]
    chains: Chains
    poses: FloatArray
    first: IntArray
    block_idx: IntArray
    rotation_only: BoolArray

    @staticmethod
    def of(items: Sequence[ChainObservation]) -> "Observations":
        """In their order."""
        links = [o.chain for o in items]
        return Observations(
            links, Chains.of(links), np.concatenate([np.zeros((0, 4, 4)), *(o.poses for o in items)]),
            np.cumsum([0] + [len(o.poses) for o in items]), np.array([o.block_idx for o in items], dtype=np.int64),
            np.array([o.rotation_only for o in items], dtype=np.bool_),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.links)

    def __iter__(self) -> Iterator[ChainObservation]:
        return iter(self._items)

    @cached_property
    def _items(self) -> list[ChainObservation]:
        parts = np.split(self.poses, self.first[1:-1]) if len(self) else []
        return list(map(ChainObservation, self.links, parts, self.block_idx.tolist(), self.rotation_only.tolist()))

    def part(self, rows: IntArray) -> "Observations":
        """Some (m,) of them, in this order."""
        if np.array_equal(rows, np.arange(len(self))):
            return self
        counts = np.diff(self.first)[rows]
        return Observations(
            [self.links[i] for i in rows.tolist()], self.chains.part(rows), self.poses[runs(self.first, rows)],
            np.concatenate([[0], np.cumsum(counts)]), self.block_idx[rows], self.rotation_only[rows],
        )  # fmt: skip

    def and_also(self, more: "Observations") -> "Observations":
        """With others behind them."""
        if not len(self) or not len(more):
            return self if len(self) else more
        return Observations.of([*self, *more])


def runs(first: IntArray, wanted: IntArray) -> IntArray:
    """The numbers from ``first[i]`` up to ``first[i + 1]`` of all wanted i, one after the other."""
    return ranges(first[wanted], first[wanted + 1] - first[wanted])
