"""A two-axis positioner seen by a metrology sensor: its axes, how well they fit, and whether they are perfect.

A sensor that stands still (the world) measures the pose of a target on the platform at many pairs of joint angles.
Each measured pose is a pair between the platform's station and the world; platform and target share one frame, so
the mount takes up how the target sits on the inner axis. Fourteen parameters: the base, the mount, and two for the
axes, the deviation from a right angle and the distance along the common perpendicular. (Two poses and one between the
axes would be eighteen parameters, four of which are only where along and about each axis one begins to count.)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from gtsam import GaussianFactorGraph, Pose3, Rot3

from adjust.adjustment import adjust
from adjust.graph.assembly import values_of
from adjust.graph.building import GraphBuilder
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, Pair, TableReading
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import TABLE_GEOMETRY, FloatArray, Station, Survey, Table, VectorParameter
from adjust.spatial.rigid import nearest_rotation
from adjust.testing.distributions import fisher

POSITIONER, PLATFORM = "positioner", "platform"
AXIS_PARAMETERS = ("non_orthogonality", "axis_offset")
_MOST_ROUNDS = 30
_SETTLED = 1e-4


@dataclass(frozen=True)
class PoseWeights:
    """Standard deviations of each component: of the sensor's poses, and of the joint readings.

    The default joints are good to 0.2 arcsec, which is to say exact.
    """

    position_m: float = 1e-3
    rotation_rad: float = 1e-3
    joint_rad: float = 1e-6


@dataclass(frozen=True)
class PoseFit:
    """Distances and angles between measured and adjusted poses over all pairs."""

    position_mean_m: float
    position_rms_m: float
    position_max_m: float
    rotation_mean_rad: float
    rotation_max_rad: float


@dataclass(frozen=True)
class AxisTest:
    """Whether a property of the axes differs from zero: ``statistic`` is F distributed if it does not.

    values, sigmas: of ``names``, rad and m. p_value: probability of a statistic as large without any effect.
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    statistic: float
    degrees: tuple[int, int]
    p_value: float
    significant: bool


def positioner_survey(
    joints: FloatArray, sensor_from_target: FloatArray, weights: PoseWeights = PoseWeights(), perfect_axes: bool = False
) -> Survey:
    """The survey of joint angles (n, 2) rad, outer axis first, and measured poses (n, 4, 4) m.

    perfect_axes: the axes are taken to meet at a right angle. Raises SurveyError where the two do not belong together.
    """
    n = len(joints)
    if joints.shape != (n, 2) or sensor_from_target.shape != (n, 4, 4):
        raise SurveyError(
            f"{joints.shape} joint angles and {sensor_from_target.shape} poses: give (n, 2) rad and (n, 4, 4) m"
        )
    tangent = np.repeat([weights.rotation_rad, weights.position_m], 3)
    cov, joint_cov = np.diag(tangent**2), weights.joint_rad**2 * np.eye(2)
    epochs = [f"p{i + 1:04d}" for i in range(n)]
    rotations = nearest_rotation(sensor_from_target[:, :3, :3])
    pairs = [
        Pair(e, FrameRef("station", PLATFORM, e), FrameRef("world"), Pose3(Rot3(R), m[:3, 3]), cov)
        for e, R, m in zip(epochs, rotations, sensor_from_target, strict=True)
    ]
    readings = [TableReading(POSITIONER, e, a, joint_cov, "joint") for e, a in zip(epochs, joints, strict=True)]
    free = () if perfect_axes else AXIS_PARAMETERS
    return Survey(
        stations=(Station(PLATFORM, "table", table_id=POSITIONER),),
        tables=(Table(POSITIONER, geometry=VectorParameter(TABLE_GEOMETRY, np.zeros(4), free)),),
        table_readings=tuple(readings),
        pairs=tuple(pairs),
    )


def pose_fit(result: Adjustment) -> PoseFit:
    """How far the measured poses are from the adjusted ones."""
    v = np.array([o.residual for o in _pairs(result)])
    rotation, position = np.linalg.norm(v[:, :3], axis=1), np.linalg.norm(v[:, 3:], axis=1)
    return PoseFit(float(position.mean()), float(np.sqrt(np.mean(position**2))), float(position.max()),
                   float(rotation.mean()), float(rotation.max()))  # fmt: skip


def weights_from_residuals(
    joints: FloatArray, sensor_from_target: FloatArray, start: PoseWeights = PoseWeights(), perfect_axes: bool = False
) -> tuple[Adjustment, PoseWeights]:
    """Adjust with the sigmas of position and rotation that the residuals themselves tell (variance components).

    Iterated until a sigma changes by less than one in ten thousand; the joints keep the sigma given, for a turn of the
    joints looks much like one of the target. Foerstner (1979): ``sigma^2 *= v'Pv / r`` of each group.
    """
    weights, begin = start, None
    for _ in range(_MOST_ROUNDS):
        result = adjust(positioner_survey(joints, sensor_from_target, weights, perfect_axes), begin)
        begin = values_of(result)
        rotation, position = (_factor(_pairs(result), part) for part in (slice(0, 3), slice(3, 6)))
        if abs(rotation - 1.0) < _SETTLED and abs(position - 1.0) < _SETTLED:
            return result, weights
        weights = replace(
            weights, rotation_rad=weights.rotation_rad * rotation, position_m=weights.position_m * position
        )
    raise SurveyError(
        f"the sigmas of rotation and position did not settle in {_MOST_ROUNDS} rounds (now {weights}); give more "
        "poses, or weights that fit"
    )


@dataclass(frozen=True, eq=False)
class BlockCovariance:
    """Covariance (k, k) of the axes' free parameters from solutions that leave out one block of poses each."""

    cov: FloatArray
    n_blocks: int


def blockwise_covariance(
    joints: FloatArray, sensor_from_target: FloatArray, weights: PoseWeights, n_blocks: int = 20
) -> BlockCovariance:
    """Covariance of the axes' parameters that holds although neighbouring poses err alike (delete-block jackknife).

    The poses come in the order in which they were measured; each of the n_blocks stretches is left out once, by one
    step of Gauss-Newton from the solution of all, and ``C = (g - 1) / g * sum d d'`` (Quenouille, Tukey). Residuals of
    a real machine are hardly ever white: what its model leaves out bends, sags and drifts, and the sigmas of least
    squares are then too small.
    """
    n = len(joints)
    if not 3 <= n_blocks <= n // 2:
        raise SurveyError(f"{n_blocks} blocks of {n} poses: give at least three blocks of two poses or more")
    whole = positioner_survey(joints, sensor_from_target, weights)
    graph = GraphBuilder(whole, {}).build(values_of(adjust(whole)))
    axes = graph.unknowns.by_name["table_geometry", POSITIONER].key
    linear = [(o.ids[0 if o.kind == "pair" else 1], o.factor.linearize(graph.start)) for o in graph.others]
    values = []
    for block in np.array_split([pair.pair_id for pair in whole.pairs], n_blocks):
        kept, left_out = GaussianFactorGraph(), set(block)
        for epoch, factor in linear:
            if epoch not in left_out:
                kept.push_back(factor)
        values.append(kept.optimize().at(axes))
    d = np.array(values) - np.mean(values, axis=0)
    return BlockCovariance((n_blocks - 1) / n_blocks * d.T @ d, n_blocks)


def axis_tests(result: Adjustment, alpha: float = 0.01, blocks: BlockCovariance | None = None) -> tuple[AxisTest, ...]:
    """Test the deviation from a right angle, the distance of the axes, and both together against zero.

    ``x' inv(C) x / k`` is F distributed with k and ``redundancy`` degrees of freedom where the sigmas come from the
    same, white, residuals; with the covariance of g ``blocks`` it is, times (g - k) / (g - 1), with k and g - k
    (Hotelling). Raises SurveyError where the axes were taken to be perfect.
    """
    estimate = result.estimates[("table_geometry", POSITIONER)]
    free = [i for i, name in enumerate(estimate.components) if name in AXIS_PARAMETERS and estimate.status[i] != "held"]
    if isinstance(estimate.value, Pose3) or not free:
        raise SurveyError("the axes were taken to be perfect; adjust with perfect_axes=False to test them")
    tests = []
    for idx in [[i] for i in free] + ([free] if len(free) > 1 else []):
        k, x, C = len(idx), estimate.value[idx], estimate.cov[np.ix_(idx, idx)]
        degrees, scale = (k, result.redundancy), 1.0
        if blocks is not None:
            rows = [AXIS_PARAMETERS.index(estimate.components[i]) for i in idx]
            C, g = blocks.cov[np.ix_(rows, rows)], blocks.n_blocks
            degrees, scale = (k, g - k), (g - k) / (g - 1)
        statistic = scale * float(x @ np.linalg.solve(C, x)) / k
        p = float(fisher.sf(statistic, *degrees))
        names = tuple(estimate.components[i] for i in idx)
        sigmas = tuple(float(s) for s in np.sqrt(np.diag(C)))
        tests.append(AxisTest(names, tuple(float(a) for a in x), sigmas, statistic, degrees, p, p < alpha))
    return tuple(tests)


def _pairs(result: Adjustment) -> list[ObservationResidual]:
    return [o for o in result.other_residuals if o.kind == "pair"]


def _factor(pairs: Sequence[ObservationResidual], part: slice) -> float:
    """Root of the variance component of some components of all pairs."""
    omega = sum(float(np.sum((o.residual[part] / o.sigma[part]) ** 2)) for o in pairs)
    return float(np.sqrt(omega / sum(float(o.redundancy[part].sum()) for o in pairs)))
