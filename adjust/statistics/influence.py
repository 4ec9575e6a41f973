"""What an undetected bias does to the unknowns: ``dx = Q A' P bias``, each unknown in its own sigmas (Baarda 1968)."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import sparse

from adjust.graph.datum import in_world
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.statistics.condensed import CondensedSystem
from adjust.statistics.result import Influence
from adjust.statistics.system import LinearSystem

_CHUNK = 64


def shifts(condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]) -> FloatArray:
    """How all unknowns (n, k) move with a bias of each of k observations; biases (c,) in sigmas, observed too large.

    rows: image points first, then all others.
    """
    system, parts = condensed.system, list[tuple[IntArray, FloatArray]]()
    for row in rows:
        if row < condensed.n_points:
            columns, A = condensed.point_rows(row)
            parts.append((columns, A.T @ bias[row]))
        else:
            parts.append(system.bias_column(row - condensed.n_points + system.n_image, bias[row]))
    places, values = (np.concatenate(x) for x in zip(*parts, strict=True))
    ptr = np.cumsum([0, *(len(x) for x, _ in parts)])
    right = sparse.csc_matrix((values, places, ptr), (len(system.columns), len(rows)))
    return system.times_covariance(right.toarray() if system.structured is None or system.motions.shape[1] else right)


def influences(
    condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]
) -> tuple[Influence, ...]:
    """The unknown and the position that each bias moves most; in the order of ``rows``."""
    system = condensed.system
    c, sigmas = system.columns, np.where(system.sigmas > 0.0, system.sigmas, np.inf)
    places, coordinates = _positions(system)

    def of(first: int) -> list[Influence]:
        part, out = rows[first : first + _CHUNK], list[Influence]()
        dx = shifts(condensed, part, bias)
        ratio = np.abs(dx)
        ratio /= sigmas[:, None]
        length, furthest = _furthest(dx, coordinates)
        for i, (row, j) in enumerate(zip(part, _first_largest(ratio).tolist(), strict=True)):
            name = places[int(furthest[i])] if places else ()
            out.append(Influence(row, c.names[j], c.components[j], c.units[j], float(dx[j, i]), float(ratio[j, i]),
                                 name, float(length[i])))  # fmt: skip
        return out

    return tuple(x for part in side_by_side(of, range(0, len(rows), _CHUNK)) for x in part)


def _positions(system: LinearSystem) -> tuple[list[ParameterName], sparse.csr_matrix]:
    """Unknowns that are positions in the world, and (p, n) which unknowns are the coordinates of each: ones."""
    names, columns, ptr = list[ParameterName](), list[int](), [0]
    components = system.columns.components
    for name, at in system.columns.at.items():
        if name[0] == "point" or in_world(system.precision.graph.survey, name):
            mine = [c for c in at.tolist() if components[c] in ("x", "y", "z", "tx", "ty", "tz")]
            if mine:
                names.append(name)
                columns += mine
                ptr.append(len(columns))
    return names, sparse.csr_matrix((np.ones(len(columns)), columns, ptr), (len(names), len(components)))


def _furthest(dx: FloatArray, coordinates: sparse.csr_matrix) -> tuple[FloatArray, IntArray]:
    """How far the position moves that moves most, and which that is; of every column of dx (n, k)."""
    if not coordinates.shape[0]:
        return np.zeros(dx.shape[1]), np.zeros(dx.shape[1], dtype=np.int64)
    squares = np.asarray(coordinates @ np.square(dx))
    at = _first_largest(squares)
    return np.sqrt(squares[at, np.arange(len(at))]), at


def _first_largest(values: FloatArray) -> IntArray:
    """Of every column (k,) the row of its largest value; ``argmax`` takes ten times as long along the first axis."""
    at = np.flatnonzero(~(values < values.max(axis=0)))  # what is no number is the largest, as for argmax
    rows, columns = np.divmod(at, values.shape[1])
    return np.asarray(rows[np.unique(columns, return_index=True)[1]])
