"""Deformation of a chain of stations between two epochs: how neighbours turned and moved, and whether that is real.

A relay station network measured twice tells how a hull bends (Chao et al. 2011). With ``b_from_a`` of either epoch,
``D = (b_from_a, first)^-1 (b_from_a, second)`` is the motion of a as seen from b, in the frame of a in the first epoch;
it does not depend on where the datum is. Errors follow to first order in the tangent on the right of D,
``C_D = Ad(D^-1) C_first Ad(D^-1)' + C_second``. The tests are those of Pelzer (1971): ``d' C^-1 d`` is chi-square where
nothing moved.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import FloatArray
from adjust.precision.precision import rotations_only
from adjust.spatial.rigid import rotation_log
from adjust.spatial.rigid_motions import Motions, right_jacobian_inverse
from adjust.spatial.rotation_forms import euler_cov_from_tangent, euler_from_matrix
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2
from adjust.testing.quadratic_forms import squares_in_sigmas


@frozen
class DeformationTest:
    """Chi-square test of some components: ``statistic`` with ``freedom`` degrees, ``p`` of as much without motion.

    freedom is the rank of the covariance; where it is 0 (all held, or not measured) statistic and p are nan.
    """

    statistic: float
    freedom: int
    p: float


@frozen(eq=False)
class Deformation:
    """What happened between stations a and b; see the module for its sense and frame.

    rotation: (3,) rad, rotation vector. displacement: (3,) m along the axes of a in the first epoch, nan where only
    rotations were measured. cov: (6, 6) of both, a priori unless scaled, rotation first. euler_zyx: (3,) rad about x,
    y, z with ``R = Rz Ry Rx``; euler_cov: (3, 3) rad^2. rotation_test, displacement_test, test: of three, three and all
    components. significant: by ``test``, at one error probability for all pairs together.
    """

    a: str
    b: str
    rotation: FloatArray
    displacement: FloatArray
    cov: FloatArray
    euler_zyx: FloatArray
    euler_cov: FloatArray
    rotation_test: DeformationTest
    displacement_test: DeformationTest
    test: DeformationTest
    significant: bool

    @property
    def sigmas(self) -> FloatArray:
        """Sigmas (6,) of rotation (rad) and displacement (m)."""
        return np.asarray(np.sqrt(np.diag(self.cov)))


def relative_poses(adjustment: Adjustment, pairs: Sequence[tuple[str, str]]) -> tuple[Motions, FloatArray]:
    """``b_from_a`` (p,) of two fixed stations each and the a priori covariances (p, 6, 6) rad, m, in the tangents in a.

    Neither depends on the datum. Held stations have no error. In networks of rotations the translation and its rows of
    the covariance are nan. Raises SurveyError for stations that were not adjusted as fixed ones.
    """
    same = next((a for a, b in pairs if a == b), None)
    if same is not None:
        raise SurveyError(f"a relative pose of station {same!r} to itself was asked for; name two stations")
    ends = [(_station(adjustment, a), _station(adjustment, b)) for a, b in pairs]
    of_a, of_b = (Motions.of(np.array([_pose(e[i]).matrix() for e in ends]).reshape(-1, 4, 4)) for i in (0, 1))
    b_from_a = of_b.inverse() @ of_a
    joint = adjustment.precision.whole_pairs([(a.name, b.name) for a, b in ends], 6)
    J = np.concatenate([np.broadcast_to(np.eye(6), (len(pairs), 6, 6)), -b_from_a.inverse().adjoint()], axis=2)
    cov = J @ joint @ np.swapaxes(J, 1, 2)
    if rotations_only(adjustment):
        cov[:, 3:], cov[:, :, 3:] = np.nan, np.nan
        b_from_a = Motions(b_from_a.rotation, np.full((len(pairs), 3), np.nan))
    return b_from_a, cov


def station_deformations(
    first: Adjustment, second: Adjustment, alpha: float = 0.05, scale: tuple[bool, bool] = (False, False)
) -> tuple[Deformation, ...]:
    """Deformation of each common station with the next, in the order of the first survey, between two adjustments.

    Their observations are independent. alpha: error probability of all pairs together (Sidak 1967). scale: whether the
    covariance of the first, and of the second, is multiplied with its sigma0^2; the tests then take sigma0 as known,
    which needs some redundancy.
    A prior that both epochs share counts twice. Raises SurveyError where fewer than two stations are common.
    """
    chosen = _consecutive(first, second)
    factors = [_factor(x, s) for x, s in zip((first, second), scale, strict=True)]
    return _deformations(chosen, relative_poses(first, chosen), relative_poses(second, chosen), factors, alpha)


def _station(adjustment: Adjustment, station_id: str) -> Estimate:
    name: ParameterName = ("world_from_station", station_id)
    if name not in adjustment.estimates:
        known = ", ".join(_stations(adjustment)) or "none"
        raise SurveyError(f"station {station_id!r} was not adjusted as a fixed station; fixed stations: {known}")
    return adjustment.estimates[name]


def _pose(estimate: Estimate) -> Pose3:
    if not isinstance(estimate.value, Pose3):
        raise TypeError(f"{'/'.join(estimate.name)} is not a pose")
    return estimate.value


def _stations(adjustment: Adjustment) -> tuple[str, ...]:
    """Fixed stations with a pose, in the order of the survey."""
    ids = (s.station_id for s in adjustment.survey.stations)
    return tuple(s for s in ids if ("world_from_station", s) in adjustment.estimates)


def _consecutive(first: Adjustment, second: Adjustment) -> tuple[tuple[str, str], ...]:
    there = set(_stations(second))
    common = [s for s in _stations(first) if s in there]
    if len(common) < 2:
        named = f"only {common[0]!r}" if common else "no fixed station"
        raise SurveyError(
            f"the two epochs have {named} in common; a deformation needs two stations with the same ids in both"
        )
    return tuple(pairwise(common))


def _factor(adjustment: Adjustment, scaled: bool) -> float:
    """Of the covariance; without redundancy there is no sigma0, and it stays a priori."""
    known = adjustment.redundancy > 0 and np.isfinite(adjustment.sigma0)
    return float(adjustment.sigma0) ** 2 if scaled and known else 1.0


def _deformations(
    pairs: Sequence[tuple[str, str]], first: tuple[Motions, FloatArray], second: tuple[Motions, FloatArray],
    factors: Sequence[float], alpha: float,
) -> tuple[Deformation, ...]:  # fmt: skip
    """Of pairs with their relative poses and covariances (p, 6, 6) in two epochs."""
    D = first[0].inverse() @ second[0]
    R, t, rotation = D.rotation, D.shifts, rotation_log(D.rotation)
    tangent_cov = _tangent_cov(D, factors[0] * first[1], factors[1] * second[1])
    dim = tangent_cov.shape[1]
    by_tangent = np.zeros((len(pairs), dim, dim))
    by_tangent[:, :3, :3] = right_jacobian_inverse(rotation)
    by_tangent[:, 3:, 3:] = R[:, : dim - 3, : dim - 3]
    cov = np.full((len(pairs), 6, 6), np.nan)
    cov[:, :dim, :dim] = by_tangent @ tangent_cov @ np.swapaxes(by_tangent, 1, 2)
    d, euler = np.concatenate([rotation, t], axis=1), euler_from_matrix(R)
    turned, moved, both = (_tests(d[:, k], cov[:, k, k]) for k in (slice(0, 3), slice(3, dim), slice(0, dim)))
    euler_cov = euler_cov_from_tangent(euler, tangent_cov[:, :3, :3])
    level = sidak(alpha, max(1, sum(test.freedom > 0 for test in both)))
    real = [test.p < level for test in both]
    ends = ([pair[i] for pair in pairs] for i in (0, 1))
    return tuple(map(Deformation, *ends, rotation, t, cov, euler, euler_cov, turned, moved, both, real))


def _tangent_cov(D: Motions, before: FloatArray, after: FloatArray) -> FloatArray:
    """Covariances (p, 6, 6) of D in the tangent on the right, (p, 3, 3) where either epoch measured rotations only."""
    if not np.isfinite(D.shifts).all():
        return np.asarray(np.swapaxes(D.rotation, 1, 2) @ before[:, :3, :3] @ D.rotation + after[:, :3, :3])
    back = D.inverse().adjoint()
    return np.asarray(back @ before @ np.swapaxes(back, 1, 2) + after)


def _tests(d: FloatArray, cov: FloatArray) -> list[DeformationTest]:
    """Of (p, k) components with their covariances (p, k, k), in the directions that have any."""
    known = np.isfinite(cov).all(axis=(1, 2))
    statistic, freedom = np.full(len(d), np.nan), np.zeros(len(d), dtype=np.int64)
    statistic[known], freedom[known] = squares_in_sigmas(d[known], cov[known])
    p = chi2.sf(statistic, np.maximum(freedom, 1))
    rows = np.where(freedom > 0, [statistic, p], np.nan).T.tolist()
    return [DeformationTest(x, n, of_x) for (x, of_x), n in zip(rows, freedom.tolist(), strict=True)]
