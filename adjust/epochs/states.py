"""Points and fixed stations of an adjusted epoch with their joint covariance, and how they move with the whole."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.precision.precision import Precision, rotations_only
from adjust.spatial.motions import point_motions
from adjust.spatial.rigid import skew

MOTIONS = ("tx", "ty", "tz", "rx", "ry", "rz", "scale")
_MOST = 20_000  # components: 3 GB a matrix, of which a few are held at once
_POINT = np.array([3, 4, 5])
_POSE = np.arange(6)


@dataclass(frozen=True, eq=False)
class EpochState:
    """names with values (Pose3 or (3,) m) and joint covariance cov (n, n), three components a point, six a pose.

    directions: (7, k) motions of the whole that the epoch leaves open.
    """

    names: tuple[ParameterName, ...]
    values: tuple[Pose3 | FloatArray, ...]
    cov: FloatArray
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

    def part(self, names: Sequence[ParameterName]) -> "EpochState":
        """Only these, in this order."""
        if tuple(names) == self.names:
            return self
        starts = np.concatenate([[0], np.cumsum(self.sizes)])
        rows = np.concatenate([np.arange(starts[self.index[n]], starts[self.index[n] + 1]) for n in names])
        values = tuple(self.value(n) for n in names)
        return EpochState(tuple(names), values, self.cov[np.ix_(rows, rows)], self.directions)


def origin(value: Pose3 | FloatArray) -> FloatArray:
    """Position (3,) m."""
    return np.asarray(value.translation() if isinstance(value, Pose3) else value)


def epoch_state(adjustment: Adjustment) -> EpochState:
    """Points and fixed stations of an adjustment, a priori, in its datum; in rotation networks positions are nan.

    Raises SurveyError where they are too many for one matrix.
    """
    names = [n for n in adjustment.estimates if n[0] == "point" or (n[0] == "world_from_station" and len(n) == 2)]
    values = tuple(
        e.value if isinstance(e.value, Pose3) else np.asarray(e.value) for e in (adjustment.estimates[n] for n in names)
    )
    if rotations_only(adjustment):
        values = tuple(Pose3(v.rotation(), np.full(3, np.nan)) for v in values if isinstance(v, Pose3))
    if sum(6 if isinstance(v, Pose3) else 3 for v in values) > _MOST:
        raise SurveyError(
            f"{len(names)} points and stations are too many: what moved is told from one covariance matrix of at most "
            f"{_MOST} components; compare parts of the survey, each with the stations that hold it"
        )
    return EpochState(tuple(names), values, adjustment.joint(names), open_directions(adjustment))


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


def gauge_rows(state: EpochState) -> FloatArray:
    """How all components (n, 7) move with the whole."""
    return np.concatenate([value_motions(v) for v in state.values])


def value_motions(value: Pose3 | FloatArray) -> FloatArray:
    """How the components (3 or 6, 7) of a point or pose move with the whole."""
    if not isinstance(value, Pose3):
        return point_motions(value)
    R, t = value.rotation().matrix(), np.asarray(value.translation())
    out = np.zeros((6, 7))
    out[:3, 3:6] = R.T
    if np.isfinite(t).all():
        out[3:, :3], out[3:, 3:6], out[3:, 6] = R.T, -R.T @ skew(t), R.T @ t
    return out


def differences(before: EpochState, after: EpochState) -> FloatArray:
    """After minus before (n,), of poses in the tangent of the first; nan where only rotations are known."""
    return np.concatenate([differences_of(a, b) for a, b in zip(before.values, after.values, strict=True)])


def differences_of(a: Pose3 | FloatArray, b: Pose3 | FloatArray) -> FloatArray:
    """Of one point (3,) or pose (6,): b minus a."""
    if not (isinstance(a, Pose3) and isinstance(b, Pose3)):
        return origin(b) - origin(a)
    if np.isfinite(a.translation()).all() and np.isfinite(b.translation()).all():
        return np.asarray(Pose3.Logmap(a.inverse() * b))
    turn = Rot3.Logmap(a.rotation().inverse() * b.rotation())
    return np.concatenate([turn, np.full(3, np.nan)])


def moved_value(value: Pose3 | FloatArray, motion: FloatArray) -> Pose3 | FloatArray:
    """A point or pose moved by ``motion`` (7,) about the origin: translation, rotation vector, ln(scale)."""
    R, s = Rot3.Expmap(motion[3:6]).matrix(), float(np.exp(motion[6]))
    x = s * R @ origin(value) + motion[:3]
    return Pose3(Rot3(R @ value.rotation().matrix()), x) if isinstance(value, Pose3) else x


def moved(state: EpochState, motion: FloatArray) -> EpochState:
    """The whole moved by ``motion`` (7,), with its covariance."""
    R, s = Rot3.Expmap(motion[3:6]).matrix(), float(np.exp(motion[6]))
    # the tangent of a pose, on the right, turns along
    blocks = [np.diag([1.0] * 3 + [s] * 3) if isinstance(v, Pose3) else s * R for v in state.values]
    ends = np.cumsum(state.sizes)[:-1]

    def rows(cov: FloatArray) -> FloatArray:
        return np.concatenate([block @ part for block, part in zip(blocks, np.split(cov, ends), strict=True)])

    return replace(state, values=tuple(moved_value(v, motion) for v in state.values), cov=rows(rows(state.cov).T))


def aligned(before: EpochState, after: EpochState, directions: FloatArray, reference: Sequence[int]) -> EpochState:
    """The second epoch moved along ``directions`` (7, k) until the reference lies on the first as well as it can."""
    if not directions.shape[1]:
        return after
    owner = np.repeat(np.arange(len(before.names)), before.sizes)
    kept = np.isin(owner, list(reference))
    for _ in range(20):
        d = differences(before, after)
        rows = kept & np.isfinite(d)
        G = gauge_rows(before)[rows] @ directions
        step = np.linalg.lstsq(G, -d[rows], rcond=1e-10)[0]
        after = moved(after, directions @ step)
        if np.abs(G @ step).max(initial=0.0) < 1e-12:
            break
    return after
