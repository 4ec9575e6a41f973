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


@dataclass(frozen=True, eq=False)
class ReadingArrays(k.Readings):
    """N readings in the order of ``Survey.readings``."""

    observed: FloatArray
    sigma: FloatArray
    target_centring: FloatArray
    used: BoolArray


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
class ChainRow:
    """A reading whose ``column`` to ``column + 3`` follow a chain: block (3, dim) per key, at ``goal[key]``."""

    row: int
    column: int
    chain: int
    goal: Mapping[int, int]


@dataclass(frozen=True, eq=False)
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
        keys: dict[int, int] = {}
        for r in rows:
            for key in self._keys(r):
                keys.setdefault(key, self.dims[key])
        if not keys and whitener is not None:
            names = ", ".join(repr(self.survey.readings[r].reading_id) for r in rows[:3])
            raise SurveyError(f"correlated readings {names} join held positions only; give them sigmas of their own")
        start, at = self.size, {}
        for key, dim in keys.items():
            at[key] = self.size
            self.size += dim * len(rows)
        for i, r in enumerate(rows):
            self._place(number, r, {key: at[key] + i * dim for key, dim in keys.items()})
        return Chunk(np.array(rows, dtype=np.int64), tuple(keys), tuple(keys.values()), start, whitener)

    def _sights(self, r: int) -> list[tuple[int, Position]]:
        a = self.arrays
        found = [(k.AT, a.at[r]), (k.TO, a.to[r])] + ([(k.SECOND, a.second[r])] if a.second[r] >= 0 else [])
        return [(column, self.positions[i]) for column, i in found]

    def _vectors(self, r: int) -> list[tuple[int, VectorMap]]:
        """Vectors that take part in a reading and their first columns, those without unknowns left out."""
        a = self.arrays
        kind, found = a.kind[r], []
        if kind == k.DIRECTION:
            found.append((k.ORIENTATION, self.orientation_maps[a.orientation[r]]))
        if a.centring[r] >= 0:
            found.append((k.CENTRING, self.centring_maps[a.centring[r]]))
        instrument = self.instrument_maps[a.instrument[r]]
        if instrument is not None and kind in (*_DISTANCES, k.ZENITH):
            found.append((k.INSTRUMENT, instrument))
        tilt = self.parameters.vertical.tilt
        if tilt is not None and (a.body[r] < 0 or a.heights[r, 1:].any()):
            found.append((k.TILT, tilt))
        return [(column, m) for column, m in found if m.key is not None]

    def _keys(self, r: int) -> list[int]:
        keys = [key for _, position in self._sights(r) for key in position.keys]
        if self.arrays.body[r] >= 0:
            keys += self.bodies[self.arrays.body[r]].keys
        return keys + [m.key for _, m in self._vectors(r) if m.key is not None]

    def _place(self, chunk: int, r: int, goal: dict[int, int]) -> None:
        for column, position in self._sights(r):
            if position.point_key is not None:
                self.blocks.append((goal[position.point_key], r, column))
            elif position.keys:
                chain = int(self.arrays.at[r] if column == k.AT else
                            self.arrays.to[r] if column == k.TO else self.arrays.second[r])  # fmt: skip
                mine = {key: goal[key] for key in position.keys}
                self.chain_rows.setdefault(chunk, []).append(ChainRow(r, column, chain, mine))
        body = int(self.arrays.body[r])
        if body >= 0 and self.bodies[body].keys:
            mine = {key: goal[key] for key in self.bodies[body].keys}
            self.chain_rows.setdefault(chunk, []).append(ChainRow(r, k.BODY, len(self.positions) + body, mine))
        for column, vector in self._vectors(r):
            if vector.key is None:
                continue
            for i, j in np.argwhere(vector.matrix != 0.0).tolist():
                self.singles.append((goal[vector.key] + j, r, column + i, float(vector.matrix[i, j])))
