"""Points and fixed stations of an adjusted epoch with what is known of them, and how they move with the whole."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np
from gtsam import Pose3, Rot3
from scipy import sparse

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.precision.precision import Precision, precision_of, rotations_only
from adjust.spatial.motions import moved_value, values_motions
from adjust.statistics.condensed import condensed_system
from adjust.statistics.system import LinearSystem

MOTIONS = ("tx", "ty", "tz", "rx", "ry", "rz", "scale")
_POINT = np.array([3, 4, 5])
_POSE = np.arange(6)
_MIXED = 1e-12


@frozen(eq=False)
class Epoch(ABC):
    """names with values (Pose3 or (3,) m), n components in all: three a point, six a pose.

    directions: (7, k) motions of the whole that the epoch leaves open.
    """

    names: tuple[ParameterName, ...]
    values: tuple[Pose3 | FloatArray, ...]
    directions: FloatArray

    @cached_property
    def index(self) -> dict[ParameterName, int]:
        """Number of each name."""
        return {n: i for i, n in enumerate(self.names)}

    @property
    def sizes(self) -> IntArray:
        """Components of each."""
        return np.array([6 if isinstance(v, Pose3) else 3 for v in self.values], dtype=np.int64)

    @property
    def extent(self) -> float:
        """Size of the whole, m; 1 where it has none."""
        x = np.array([origin(v) for v in self.values])
        x = x[np.isfinite(x).all(axis=1)]
        size = float(np.ptp(x, axis=0).max()) if len(x) else 0.0
        return size if size > 0.0 else 1.0

    def value(self, name: ParameterName) -> Pose3 | FloatArray:
        """Of a name."""
        return self.values[self.index[name]]

    def components(self, name: ParameterName) -> IntArray:
        """Which of rx ry rz x y z it has."""
        return _POSE if isinstance(self.value(name), Pose3) else _POINT

    def axes(self, name: ParameterName) -> FloatArray:
        """Axes (3, 3) of its displacement in the world."""
        value = self.value(name)
        return value.rotation().matrix() if isinstance(value, Pose3) else np.eye(3)

    @property
    def owner(self) -> IntArray:
        """Number (n,) of the name of every component."""
        return np.repeat(np.arange(len(self.names)), self.sizes)

    def part(self, names: Sequence[ParameterName]) -> Self:
        """Only these, in this order."""
        if tuple(names) == self.names:
            return self
        starts = np.concatenate([[0], np.cumsum(self.sizes)])
        rows = np.concatenate([np.arange(starts[self.index[n]], starts[self.index[n] + 1]) for n in names])
        return replace(self, names=tuple(names), values=tuple(self.value(n) for n in names))._of_rows(rows)

    @abstractmethod
    def _of_rows(self, rows: IntArray) -> Self:
        """What is known of these components (n,) of all, where names and values are theirs already."""

    @abstractmethod
    def mapped(self, values: tuple[Pose3 | FloatArray, ...], L: FloatArray, scale: float) -> Self:
        """With these values, to which L (3, 3) took the points; poses turned along, and their positions scaled."""


@frozen(eq=False)
class EpochState(Epoch):
    """By the joint covariance cov (n, n) of all components."""

    cov: FloatArray

    def _of_rows(self, rows: IntArray) -> Self:
        return replace(self, cov=self.cov[np.ix_(rows, rows)])

    def mapped(self, values: tuple[Pose3 | FloatArray, ...], L: FloatArray, scale: float) -> Self:
        """See :class:`Epoch`."""
        blocks, ends = _blocks(self.values, L, scale), np.cumsum(self.sizes)[:-1]

        def rows(cov: FloatArray) -> FloatArray:
            return np.concatenate([block @ part for block, part in zip(blocks, np.split(cov, ends), strict=True)])

        return replace(self, values=values, cov=rows(rows(self.cov).T))


@frozen(eq=False)
class EpochNormals(Epoch):
    """By the normal equations N (u, u) of all unknowns of the epoch, which its datum has no part in.

    column: (n,) of every component among the unknowns, -1 where it is held. L, scale: what the values were mapped by.
    """

    system: LinearSystem
    N: sparse.csr_matrix
    column: IntArray
    L: FloatArray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0

    def _of_rows(self, rows: IntArray) -> Self:
        return replace(self, column=self.column[rows])

    def mapped(self, values: tuple[Pose3 | FloatArray, ...], L: FloatArray, scale: float) -> Self:
        """See :class:`Epoch`."""
        return replace(self, values=values, L=L @ self.L, scale=scale * self.scale)

    @cached_property
    def kinds(self) -> list[tuple[IntArray, IntArray, IntArray, FloatArray]]:
        """Points, and poses: which names (p,), their components (p, k), columns (p, k), how they were mapped (k, k)."""
        first, out = np.cumsum(self.sizes) - self.sizes, []
        for k, block in ((3, self.L), (6, _of_pose(self.scale))):
            which = np.flatnonzero(self.sizes == k)
            if not len(which):
                continue
            at = first[which, None] + np.arange(k)
            out.append((which, at, self.column[at], block))
        return out

    def normals(self) -> sparse.csr_matrix:
        """N with the names' unknowns counted in the frame of the values.

        Raises SurveyError where an epoch that holds but some directions of something was turned.
        """
        u = self.N.shape[0]
        parts = [(np.arange(u), np.arange(u), np.ones(u))]
        for which, _, columns, block in self.kinds:
            free = columns >= 0
            mixed = (~free @ (np.abs(block) > _MIXED) & free).any(axis=1)
            if mixed.any():
                name = " ".join(self.names[int(which[mixed][0])])
                raise SurveyError(
                    f"{name} is held in some directions alone, and the epochs are turned against each other; hold all "
                    "of it or nothing"
                )
            inside = free[:, :, None] & free[:, None, :]
            down, across = (np.broadcast_to(c, inside.shape)[inside] for c in (columns[:, :, None], columns[:, None]))
            change = np.linalg.inv(block) - np.eye(len(block))
            parts.append((down, across, np.broadcast_to(change, inside.shape)[inside]))
        rows, columns, values = (np.concatenate(x) for x in zip(*parts, strict=True))
        back = sparse.csr_matrix((values, (rows, columns)), (u, u))
        return (back.T @ self.N @ back).tocsr()

    def times(self, right: FloatArray) -> FloatArray:
        """The joint covariance (n, n) in the epoch's own datum, times columns (n, k)."""
        out, by_unknown = np.zeros(right.shape), np.zeros((self.N.shape[0], right.shape[1]))
        for _, at, columns, block in self.kinds:
            by_unknown[columns[columns >= 0]] = (block.T @ right[at])[columns >= 0]
        found = self.system.times_covariance(by_unknown)
        for _, at, columns, block in self.kinds:
            out[at] = block @ np.where((columns >= 0)[:, :, None], found[columns], 0.0)
        return out

    def own(self) -> list[FloatArray]:
        """Covariances (3, 3) or (6, 6) of all names in the epoch's own datum."""
        precision, out = self.system.precision, [np.zeros((k, k)) for k in self.sizes.tolist()]
        by_name = precision.unknowns.by_name
        for which, _, _, block in self.kinds:
            free = [i for i in which.tolist() if self.names[i] in by_name]
            if not free:
                continue
            Q = precision.covs(np.array([by_name[self.names[i]].key for i in free], dtype=np.int64), len(block))
            for i, cov in zip(free, block @ Q @ block.T, strict=True):
                out[i] = cov
        return out


def _of_pose(scale: float) -> FloatArray:
    """How the tangent of a pose changes when all is turned and scaled: on the right, it turns along."""
    return np.diag([1.0] * 3 + [scale] * 3)


def _blocks(values: Sequence[Pose3 | FloatArray], L: FloatArray, scale: float) -> list[FloatArray]:
    pose = _of_pose(scale)
    return [pose if isinstance(v, Pose3) else L for v in values]


SomeEpoch = TypeVar("SomeEpoch", bound=Epoch)


def origin(value: Pose3 | FloatArray) -> FloatArray:
    """Position (3,) m."""
    return np.asarray(value.translation() if isinstance(value, Pose3) else value)


def epoch_state(adjustment: Adjustment) -> EpochState:
    """Points and fixed stations of an adjustment, a priori, in its datum; in rotation networks positions are nan."""
    names, values, directions = known(adjustment)
    return EpochState(names, values, directions, adjustment.joint(names))


def epoch_normals(adjustment: Adjustment) -> EpochNormals:
    """The same by its normal equations. Raises SurveyError for a solution that was moved to another datum."""
    names, values, directions = known(adjustment)
    system = condensed_system(precision_of(adjustment)).system
    A, columns, parts = system.A[system.used[system.row_of]], system.columns, []
    for name, value in zip(names, values, strict=True):
        of_name = np.full(6 if isinstance(value, Pose3) else 3, -1)
        if name in columns.at:
            of_name[columns.free[name]] = columns.at[name]
        parts.append(of_name)
    column = np.concatenate([np.zeros(0, dtype=np.int64), *parts])
    return EpochNormals(names, values, directions, system, (A.T @ A).tocsr(), column)


def known(adjustment: Adjustment) -> tuple[tuple[ParameterName, ...], tuple[Pose3 | FloatArray, ...], FloatArray]:
    """Points and fixed stations: names, values, and the motions (7, k) that are open."""
    names = [n for n in adjustment.estimates if n[0] == "point" or (n[0] == "world_from_station" and len(n) == 2)]
    values = tuple(
        e.value if isinstance(e.value, Pose3) else np.asarray(e.value) for e in (adjustment.estimates[n] for n in names)
    )
    if rotations_only(adjustment):
        values = tuple(Pose3(v.rotation(), np.full(3, np.nan)) for v in values if isinstance(v, Pose3))
    return tuple(names), values, open_directions(adjustment)


def datum_carriers(adjustment: Adjustment) -> tuple[ParameterName, ...]:
    """The points and stations over which the inner constraints of an adjustment hold; none where its datum is given."""
    precision = adjustment.precision
    if isinstance(precision, Precision):
        datum, by_key = precision.solved.datum, precision.graph.unknowns.by_key
        return () if datum is None else tuple(by_key[k].name for k in datum.keys)
    return ()


def open_directions(adjustment: Adjustment) -> FloatArray:
    """Motions (7, k) that an adjustment leaves open."""
    precision = adjustment.precision
    if isinstance(precision, Precision):
        datum = precision.solved.datum
        return np.zeros((7, 0)) if datum is None else np.asarray(datum.directions)
    return np.zeros((7, 0))


def differences(before: Sequence[Pose3 | FloatArray], after: Sequence[Pose3 | FloatArray]) -> FloatArray:
    """After minus before (n,), of poses in the tangent of the first; nan where only rotations are known."""
    return np.concatenate([differences_of(a, b) for a, b in zip(before, after, strict=True)])


def differences_of(a: Pose3 | FloatArray, b: Pose3 | FloatArray) -> FloatArray:
    """Of one point (3,) or pose (6,): b minus a."""
    if not (isinstance(a, Pose3) and isinstance(b, Pose3)):
        return origin(b) - origin(a)
    if np.isfinite(a.translation()).all() and np.isfinite(b.translation()).all():
        return np.asarray(Pose3.Logmap(a.inverse() * b))
    turn = Rot3.Logmap(a.rotation().inverse() * b.rotation())
    return np.concatenate([turn, np.full(3, np.nan)])


def moved(state: SomeEpoch, motion: FloatArray) -> SomeEpoch:
    """The whole moved by ``motion`` (7,), with what is known of it."""
    scale = float(np.exp(motion[6]))
    L = scale * Rot3.Expmap(motion[3:6]).matrix()
    return state.mapped(tuple(moved_value(v, motion) for v in state.values), L, scale)


def aligned(before: Epoch, after: SomeEpoch, directions: FloatArray, reference: Sequence[int]) -> SomeEpoch:
    """The second epoch moved along ``directions`` (7, k) until the reference lies on the first as well as it can."""
    if not directions.shape[1]:
        return after
    values, L, scale = laid_onto(before.values, after.values, directions, np.isin(before.owner, list(reference)))
    return after.mapped(values, L, scale)


Values = tuple[Pose3 | FloatArray, ...]


def laid_onto(
    target: Sequence[Pose3 | FloatArray], values: Values, directions: FloatArray, kept: BoolArray
) -> tuple[Values, FloatArray, float]:
    """Values moved as a whole until the kept components (n,) lie on the target; L and scale took them there."""
    along = values_motions(target) @ directions
    L, scale = np.eye(3), 1.0
    for _ in range(20):
        d = differences(target, values)
        rows = kept & np.isfinite(d)
        step = np.linalg.lstsq(along[rows], -d[rows], rcond=1e-10)[0]
        motion = directions @ step
        values, scale = tuple(moved_value(v, motion) for v in values), scale * float(np.exp(motion[6]))
        L = float(np.exp(motion[6])) * Rot3.Expmap(motion[3:6]).matrix() @ L
        if np.abs(along[rows] @ step).max(initial=0.0) < 1e-12:
            break
    return values, L, scale
