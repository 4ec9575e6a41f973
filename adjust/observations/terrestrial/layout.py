"""Readings as arrays, and where their derivatives go in the blocks that are served to GTSAM.

Readings between the same positions with the same setup make one chunk, those with a joint covariance another. A chunk
is one factor: its residuals and, key after key, its row-major Jacobian blocks lie in flat arrays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from adjust.frames.unknowns import Unknowns, VectorMap
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import PositionRef, Reading
from adjust.model.survey import BoolArray, FloatArray, IntArray, Setup, Survey
from adjust.observations.factors import ChainPose, Position
from adjust.observations.terrestrial import equations as k
from adjust.observations.terrestrial.parameters import TerrestrialParameters, check_reading

KINDS = {
    "direction": k.DIRECTION, "angle": k.ANGLE, "zenith": k.ZENITH, "azimuth": k.AZIMUTH, "slope_distance": k.SLOPE,
    "horizontal_distance": k.HORIZONTAL, "height_difference": k.HEIGHT,
}  # fmt: skip
_DISTANCES = (k.SLOPE, k.HORIZONTAL)


@frozen(eq=False)
class ReadingArrays(k.Readings):
    """N readings in the order of ``Survey.readings``."""

    observed: FloatArray
    sigma: FloatArray
    target_centring: FloatArray
    used: BoolArray


@frozen(eq=False)
class Chunk:
    """Rows of one factor. whitener: (m, m), upside of ``inv(cov) = W'W``, where the rows have a joint covariance."""

    rows: IntArray
    keys: tuple[int, ...]
    dims: tuple[int, ...]
    start: int
    whitener: FloatArray | None = None

    @property
    def width(self) -> int:
        """Number of columns."""
        return sum(self.dims)


@frozen(eq=False)
class ChainRow:
    """A reading whose ``column`` to ``column + 3`` follow a chain: block (3, dim) per key, at ``goal[key]``."""

    row: int
    column: int
    chain: int
    goal: Mapping[int, int]


@frozen(eq=False)
class Layout:
    """Everything about readings that does not change with the values.

    positions: P, in the order of the arrays' indices; bodies: those whose axes are used. entry_ptr (C + 1,): ranges of
    the entries (goal, row, column, factor) of each chunk. chain_rows: per chunk; chains number P positions, then
    bodies. size: of the flat array of all Jacobian blocks.
    """

    arrays: ReadingArrays
    positions: tuple[Position, ...]
    bodies: tuple[ChainPose, ...]
    chunks: tuple[Chunk, ...]
    goal: IntArray
    row: IntArray
    column: IntArray
    factor: FloatArray
    entry_ptr: IntArray
    chain_rows: Mapping[int, list[ChainRow]]
    size: int


def reading_arrays(
    survey: Survey, parameters: TerrestrialParameters, index: Mapping[PositionRef, int],
    bodies: Mapping[PositionRef, int], flat: Mapping[PositionRef, int],
) -> ReadingArrays:  # fmt: skip
    """The readings as arrays. Raises SurveyError for those that cannot be."""
    readings: Sequence[Reading] = survey.readings
    orientation = {s: i for i, s in enumerate(parameters.orientations)}
    centring = {s: i for i, s in enumerate(parameters.centrings)}
    instrument = {s: i + 1 for i, s in enumerate(parameters.instruments)}
    setups = {s: (orientation.get(s, -1), centring.get(s, -1), instrument.get(x.instrument_id or "", 0), x)
              for s, x in parameters.setups.items()}  # fmt: skip
    rows, heights = np.zeros((len(readings), 8), dtype=np.int64), np.zeros((len(readings), 3))
    numbers, used = np.zeros((len(readings), 3)), np.zeros(len(readings), dtype=np.bool_)
    for n, r in enumerate(readings):
        own: tuple[int, int, int, Setup | None] = setups[r.setup_id] if r.setup_id else (-1, -1, 0, None)
        setup = own[3]
        check_reading(r, setup, flat)
        body = bodies[r.at] if setup is not None and not setup.levelled else -1
        right = index[r.second] if r.second is not None else -1
        rows[n] = KINDS[r.kind], index[r.at], index[r.to], right, *own[:3], body
        heights[n] = r.instrument_height, r.target_height, r.second_height
        numbers[n] = r.value, r.sigma, r.target_centring_sigma
        used[n] = r.used
    kind, at, to, second, turn, offset, instruments, body_of = rows.T.copy()
    observed, sigma, plumbing = numbers.T.copy()
    return ReadingArrays(
        kind, at, to, second, turn, offset, instruments, body_of, heights, observed, sigma, plumbing, used
    )


_Sight = tuple[int, int, tuple[int, ...], bool]
"""First column, number of the position or chain, its keys, and whether it is an unknown point."""


@dataclass(eq=False)
class LayoutBuilder:
    """Groups readings into chunks and finds the place of each derivative; one use."""

    survey: Survey
    unknowns: Unknowns
    parameters: TerrestrialParameters
    arrays: ReadingArrays
    positions: Sequence[Position]
    bodies: Sequence[ChainPose]
    blocks: list[tuple[int, int, int]] = field(default_factory=list)
    singles: list[tuple[int, int, int, float]] = field(default_factory=list)
    chain_rows: dict[int, list[ChainRow]] = field(default_factory=dict)
    size: int = 0

    def __post_init__(self) -> None:
        p = self.parameters
        self.orientation_maps = list(p.orientations.values())
        self.centring_maps = list(p.centrings.values())
        self.instrument_maps = [None, *p.instruments.values()]
        self.dims = {key: u.dim for key, u in self.unknowns.by_key.items()}
        a = self.arrays
        self.rows = list(zip(*(x.tolist() for x in (a.kind, a.at, a.to, a.second, a.orientation, a.centring,
                                                    a.instrument, a.body)), strict=True))  # fmt: skip
        self.raised = np.count_nonzero(a.heights[:, 1:], axis=1).tolist()
        self.sights: dict[tuple[int, ...], list[_Sight]] = {}
        self.cells: dict[int, list[tuple[int, int, float]]] = {}

    def build(self) -> Layout:
        """The layout."""
        chunks: list[Chunk] = []
        counts = [(0, 0)]
        for rows, whitener in self._groups():
            chunks.append(self._chunk(len(chunks), rows, whitener))
            counts.append((len(self.blocks), len(self.singles)))
        b = np.array(self.blocks, dtype=np.int64).reshape(-1, 3)
        step = np.arange(3)
        goal = np.concatenate([(b[:, :1] + step).ravel(), np.array([s[0] for s in self.singles], dtype=np.int64)])
        row = np.concatenate([np.repeat(b[:, 1], 3), np.array([s[1] for s in self.singles], dtype=np.int64)])
        column = np.concatenate([(b[:, 2:] + step).ravel(), np.array([s[2] for s in self.singles], dtype=np.int64)])
        factor = np.concatenate([np.ones(3 * len(b)), np.array([s[3] for s in self.singles])])
        per_block, per_single = (np.diff([c[i] for c in counts]) for i in range(2))
        chunk = np.concatenate([np.repeat(np.arange(len(chunks)), 3 * per_block),
                                np.repeat(np.arange(len(chunks)), per_single)])  # fmt: skip
        order = np.argsort(chunk, kind="stable")
        ptr = np.concatenate([[0], np.cumsum(3 * per_block + per_single)]).astype(np.int64)
        return Layout(
            self.arrays, tuple(self.positions), tuple(self.bodies), tuple(chunks), goal[order], row[order],
            column[order], factor[order], ptr, self.chain_rows, self.size,
        )  # fmt: skip

    def _groups(self) -> list[tuple[list[int], FloatArray | None]]:
        a = self.arrays
        out: list[tuple[list[int], FloatArray | None]] = []
        taken = np.zeros(len(a.kind), dtype=np.bool_)
        if self.survey.reading_covariances:
            number = {r.reading_id: n for n, r in enumerate(self.survey.readings)}
            for block in self.survey.reading_covariances:
                out.append(self._joint(block.reading_ids, np.asarray(block.cov, dtype=float), number, taken))
        groups: dict[tuple[int, ...], list[int]] = {}
        columns = np.stack([a.at, a.to, a.second, a.orientation, a.centring, a.instrument, a.body], axis=1)
        for n, key in enumerate(map(tuple, columns.tolist())):
            if not taken[n]:
                groups.setdefault(key, []).append(n)
        return out + [(rows, None) for rows in groups.values()]

    def _joint(
        self, ids: tuple[str, ...], cov: FloatArray, number: Mapping[str, int], taken: BoolArray
    ) -> tuple[list[int], FloatArray]:
        name = f"covariance of readings {', '.join(ids[:3])}{' ...' if len(ids) > 3 else ''}"
        lost = [i for i in ids if i not in number]
        if lost:
            raise SurveyError(f"{name}: there is no reading {lost[0]!r}")
        rows = [number[i] for i in ids]
        if len(set(rows)) < len(rows) or taken[rows].any():
            raise SurveyError(f"{name}: a reading has only one covariance, and stands in it once")
        taken[rows] = True
        if cov.shape != (len(rows), len(rows)) or not np.allclose(cov, cov.T, rtol=1e-9, atol=0.0):
            raise SurveyError(f"{name}: shape {cov.shape} for {len(rows)} readings; give a symmetric square matrix")
        if self.arrays.used[rows].any() != self.arrays.used[rows].all():
            raise SurveyError(f"{name}: use all of its readings, or none")
        scale = np.sqrt(np.maximum(np.diag(cov), 0.0))
        try:
            L = np.linalg.cholesky(cov / scale[:, None] / scale)
        except np.linalg.LinAlgError:
            raise SurveyError(f"{name}: the matrix is not positive definite") from None
        self.arrays.sigma[rows] = scale
        return rows, scipy.linalg.solve_triangular(L, np.diag(1.0 / scale), lower=True)

    def _chunk(self, number: int, rows: list[int], whitener: FloatArray | None) -> Chunk:
        parts = [(r, self._sights(r), self._vectors(r)) for r in rows]
        keys: dict[int, int] = {}
        for _, sights, vectors in parts:
            for key in (*(key for sight in sights for key in sight[2]), *(key for _, key, _ in vectors)):
                keys.setdefault(key, self.dims[key])
        if not keys and whitener is not None:
            names = ", ".join(repr(self.survey.readings[r].reading_id) for r in rows[:3])
            raise SurveyError(f"correlated readings {names} join held positions only; give them sigmas of their own")
        start, at = self.size, {}
        for key, dim in keys.items():
            at[key] = self.size
            self.size += dim * len(rows)
        for i, (r, sights, vectors) in enumerate(parts):
            goal = {key: at[key] + i * dim for key, dim in keys.items()}
            for column, chain, own, is_point in sights:
                if is_point:
                    self.blocks.append((goal[own[0]], r, column))
                elif own:
                    mine = {key: goal[key] for key in own}
                    self.chain_rows.setdefault(number, []).append(ChainRow(r, column, chain, mine))
            self.singles += [(goal[key] + k, r, column + j, f) for column, key, m in vectors
                             for j, k, f in self._cells(key, m)]  # fmt: skip
        return Chunk(np.array(rows, dtype=np.int64), tuple(keys), tuple(keys.values()), start, whitener)

    def _sights(self, r: int) -> list[_Sight]:
        """The positions of a reading, and the body whose axes it is counted in."""
        _, at, to, second, *_, body = self.rows[r]
        found = self.sights.get((at, to, second, body))
        if found is None:
            ends = ((k.AT, at), (k.TO, to), (k.SECOND, second))
            found = [(column, i, tuple(self.positions[i].keys), self.positions[i].point_key is not None)
                     for column, i in ends if i >= 0]  # fmt: skip
            if body >= 0:
                found.append((k.BODY, len(self.positions) + body, tuple(self.bodies[body].keys), False))
            self.sights[at, to, second, body] = found
        return found

    def _vectors(self, r: int) -> list[tuple[int, int, VectorMap]]:
        """Vectors that take part in a reading: first columns and keys; those without unknowns are left out."""
        kind, *_, orientation, centring, instrument, body = self.rows[r]
        found: list[tuple[int, VectorMap | None]] = []
        if kind == k.DIRECTION:
            found.append((k.ORIENTATION, self.orientation_maps[orientation]))
        if centring >= 0:
            found.append((k.CENTRING, self.centring_maps[centring]))
        if kind in (*_DISTANCES, k.ZENITH):
            found.append((k.INSTRUMENT, self.instrument_maps[instrument]))
        if body < 0 or self.raised[r]:
            found.append((k.TILT, self.parameters.vertical.tilt))
        return [(column, m.key, m) for column, m in found if m is not None and m.key is not None]

    def _cells(self, key: int, vector: VectorMap) -> list[tuple[int, int, float]]:
        """Rows, columns and values of what a vector's matrix is made of."""
        if key not in self.cells:
            row, column = np.nonzero(vector.matrix)
            self.cells[key] = list(zip(row.tolist(), column.tolist(), vector.matrix[row, column].tolist(), strict=True))
        return self.cells[key]
