"""What a network of measured pairs can tell, before anything is adjusted (Chao et al. 2011, theorem 1, generalised).

n eyes have n - 1 independent relative poses, C(n, 2) measurable pairs and C(n, 3) triangle conditions, of which
C(n - 1, 2) are independent. With E pairs measured among n stations in c parts there are n - c independent unknowns and
E - n + c independent loop conditions (the dimension of the cycle space), each of 3 equations (rotations) or 6 (poses).
"""


import numpy as np
import scipy.sparse as sp

from adjust.model.errors import listed
from adjust.model.frozen import frozen
from adjust.model.survey import IntArray
from adjust.pose_network.cycles import connected_parts, loop_labels
from adjust.pose_network.network import Topology

_NAMED = 12


@frozen
class Counts:
    """Numbers of a network, and what is weak in it by id.

    triangle_conditions: triples of stations that are all measured with each other. loop_equations: 3 or 6.
    parts: stations of each part, largest first. uncontrolled_pairs: close no loop (bridges), so no error in them can be
    found. inseparable_pairs: groups that share all their loops, so an error in one is seen but not told from the
    others'. isolated_stations: measured with none.
    """

    n_stations: int
    n_pairs: int
    n_parts: int
    independent_unknowns: int
    measurable_pairs: int
    triangle_conditions: int
    independent_conditions: int
    loop_equations: int
    parts: tuple[tuple[str, ...], ...]
    uncontrolled_pairs: tuple[str, ...]
    inseparable_pairs: tuple[tuple[str, ...], ...]
    isolated_stations: tuple[str, ...]

    @property
    def redundancy(self) -> int:
        """Equations of all independent conditions."""
        return self.loop_equations * self.independent_conditions

    @property
    def conditions_per_unknown(self) -> float:
        """Independent conditions per measured pair, (n - 2) / n where all are measured; the mean redundancy number."""
        return self.independent_conditions / self.n_pairs if self.n_pairs else 0.0

    def __str__(self) -> str:
        what = "rotations" if self.loop_equations == 3 else "poses"
        lines = [
            f"stations {self.n_stations}, parts {self.n_parts}, independent {what} {self.independent_unknowns}",
            f"pairs measured {self.n_pairs} of {self.measurable_pairs}, triangle conditions {self.triangle_conditions}",
            f"independent conditions {self.independent_conditions} ({self.redundancy} equations), "
            f"{self.conditions_per_unknown:.2f} per measured pair",
        ]
        if self.n_parts > 1:
            lines += [f"part {i + 1}: {listed(part, _NAMED)}" for i, part in enumerate(self.parts[:10])]
            lines += [f"and {self.n_parts - 10} more parts"] if self.n_parts > 10 else []
        if self.uncontrolled_pairs:
            lines.append(f"uncontrolled (close no loop): {listed(self.uncontrolled_pairs, _NAMED)}")
        lines += [f"errors seen but not told apart: {listed(group, _NAMED)}" for group in self.inseparable_pairs[:10]]
        left_out = len(self.inseparable_pairs) - 10
        lines += [f"and {left_out} more such groups"] if left_out > 0 else []
        return "\n".join(lines)


def count(topology: Topology, loop_equations: int = 3) -> Counts:
    """Count in linear time (triangles: E sqrt(E)). loop_equations: 3 for rotations, 6 for poses."""
    n, m = topology.n_stations, topology.n_pairs
    part = connected_parts(topology.n_stations, topology.a_idx, topology.b_idx)
    c = int(part.max()) + 1 if n else 0
    mark = loop_labels(n, topology.a_idx, topology.b_idx)
    degree = np.bincount(np.concatenate([topology.a_idx, topology.b_idx]), minlength=n)
    grouped = [tuple(topology.station_ids[i] for i in g) for g in _groups(part, 1)]
    return Counts(
        n_stations=n, n_pairs=m, n_parts=c, independent_unknowns=n - c, measurable_pairs=n * (n - 1) // 2,
        triangle_conditions=_triangles(topology), independent_conditions=m - n + c, loop_equations=loop_equations,
        parts=tuple(sorted(grouped, key=len, reverse=True)),
        uncontrolled_pairs=tuple(topology.pair_ids[e] for e in np.flatnonzero(mark == 0)),
        inseparable_pairs=_inseparable(topology, mark),
        isolated_stations=tuple(topology.station_ids[i] for i in np.flatnonzero(degree == 0)),
    )  # fmt: skip


def _groups(label: IntArray, least: int) -> list[IntArray]:
    """Positions of equal labels, where at least so many are equal."""
    order = np.argsort(label, kind="stable")
    first = np.flatnonzero(np.diff(label[order], prepend=-1) != 0)
    size = np.diff(first, append=len(order))
    return [order[i : i + n] for i, n in zip(first, size, strict=True) if n >= least]


def _inseparable(topology: Topology, mark: IntArray) -> tuple[tuple[str, ...], ...]:
    controlled = np.flatnonzero(mark)
    return tuple(tuple(topology.pair_ids[e] for e in controlled[g]) for g in _groups(mark[controlled], 2))


def _triangles(topology: Topology) -> int:
    """Triangles of the simple graph; pairs point from the lower to the higher degree, which bounds the products."""
    n = topology.n_stations
    a, b = topology.a_idx, topology.b_idx
    ends = np.stack(np.divmod(np.unique(np.minimum(a, b) * n + np.maximum(a, b)), max(n, 1)), axis=1)
    degree = np.bincount(ends.ravel(), minlength=n)
    rank = np.empty(n, dtype=np.int64)
    rank[np.argsort(degree, kind="stable")] = np.arange(n)
    low, high = np.sort(rank[ends], axis=1).T
    A = sp.csr_array((np.ones(len(ends), dtype=np.int64), (low, high)), shape=(n, n))
    return int((A @ A).multiply(A).sum())
