"""Deformation of a chain of stations between two epochs: how neighbours turned and moved, and whether that is real.

A relay station network measured twice tells how a hull bends (Chao et al. 2011). With ``b_from_a`` of either epoch,
``D = (b_from_a, first)^-1 (b_from_a, second)`` is the motion of a as seen from b, in the frame of a in the first epoch;
it does not depend on where the datum is. Errors follow to first order in the tangent on the right of D,
``C_D = Ad(D^-1) C_first Ad(D^-1)' + C_second``. The tests are those of Pelzer (1971): ``d' C^-1 d`` is chi-square where
nothing moved.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import FloatArray
from adjust.precision.precision import rotations_only
from adjust.spatial.rigid_motions import right_jacobian_inverse
from adjust.spatial.rotation_forms import euler_cov_from_tangent, euler_from_matrix
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2
from adjust.testing.quadratic_forms import pseudo_square


@dataclass(frozen=True)
class DeformationTest:
    """Chi-square test of some components: ``statistic`` with ``freedom`` degrees, ``p`` of as much without motion.

    freedom is the rank of the covariance; where it is 0 (all held, or not measured) statistic and p are nan.
    """

    statistic: float
    freedom: int
    p: float


@dataclass(frozen=True, eq=False)
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


def relative_pose(adjustment: Adjustment, a: str, b: str) -> tuple[Pose3, FloatArray]:
    """``b_from_a`` of two fixed stations and its a priori covariance (6, 6) rad, m, in the tangent on the right, in a.

    Neither depends on the datum. Held stations have no error. In networks of rotations the translation and its rows of
    the covariance are nan. Raises SurveyError for stations that were not adjusted as fixed ones.
    """
    if a == b:
        raise SurveyError(f"a relative pose of station {a!r} to itself was asked for; name two stations")
    of_a, of_b = _station(adjustment, a), _station(adjustment, b)
    b_from_a = _pose(of_b).inverse() * _pose(of_a)
    dim = 3 if rotations_only(adjustment) else 6
    J = np.hstack([np.eye(6), -b_from_a.inverse().AdjointMap()])[:dim]
    cov = np.full((6, 6), np.nan)
    cov[:dim, :dim] = J @ adjustment.joint([of_a.name, of_b.name]) @ J.T
    if dim == 3:
        b_from_a = Pose3(b_from_a.rotation(), np.full(3, np.nan))
    return b_from_a, cov


def station_deformations(
    first: Adjustment, second: Adjustment, pairs: Sequence[tuple[str, str]] | None = None, alpha: float = 0.05,
    scale: tuple[bool, bool] = (False, False),
) -> tuple[Deformation, ...]:  # fmt: skip
    """Deformation of every pair (a, b) of stations between two adjustments of independent observations.

    pairs: of stations of both; without it, each common station with the next in the order of the first survey.
    alpha: error probability of all pairs together (Sidak 1967). scale: whether the covariance of the first, and of the
    second, is multiplied with its sigma0^2; the tests then take sigma0 as known, which needs some redundancy.
    A prior that both epochs share counts twice. Raises SurveyError where fewer than two stations are common, or a named
    one is not in both.
    """
    chosen = _consecutive(first, second) if pairs is None else tuple(pairs)
    factors = [_factor(x, s) for x, s in zip((first, second), scale, strict=True)]
    for x in (first, second):
        ends = [[_station(x, s) for s in pair] for pair in chosen]
        x.precision.bring_together((a.name, b.name) for a, b in ends if all({*e.status} - {"held"} for e in (a, b)))
    found = [_deformation(first, second, a, b, factors) for a, b in chosen]
    tested = max(1, sum(d.test.freedom > 0 for d in found))
    level = sidak(alpha, tested)
    return tuple(replace(d, significant=bool(d.test.p < level)) for d in found)


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


def _deformation(first: Adjustment, second: Adjustment, a: str, b: str, factors: Sequence[float]) -> Deformation:
    """One pair, not yet judged."""
    (before, cov_before), (after, cov_after) = relative_pose(first, a, b), relative_pose(second, a, b)
    undo = before.rotation().matrix().T
    R, t = undo @ after.rotation().matrix(), undo @ (after.translation() - before.translation())
    rotation = np.asarray(Rot3.Logmap(Rot3(R)))
    tangent_cov = _tangent_cov(R, t, factors[0] * cov_before, factors[1] * cov_after)
    dim = len(tangent_cov)
    by_tangent = np.zeros((dim, dim))
    by_tangent[:3, :3] = right_jacobian_inverse(rotation)
    by_tangent[3:, 3:] = R[: dim - 3, : dim - 3]
    cov = np.full((6, 6), np.nan)
    cov[:dim, :dim] = by_tangent @ tangent_cov @ by_tangent.T
    d, euler = np.concatenate([rotation, t]), euler_from_matrix(R)
    turned, moved, both = (_test(d[k], cov[k, k]) for k in (slice(0, 3), slice(3, dim), slice(0, dim)))
    euler_cov = euler_cov_from_tangent(euler, tangent_cov[:3, :3])
    return Deformation(a, b, rotation, t, cov, euler, euler_cov, turned, moved, both, False)


def _tangent_cov(R: FloatArray, t: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Covariance (6, 6) of D in the tangent on the right, (3, 3) where either epoch measured rotations only."""
    if not np.isfinite(t).all():
        return np.asarray(R.T @ before[:3, :3] @ R + after[:3, :3])
    back = Pose3(Rot3(R), t).inverse().AdjointMap()
    return np.asarray(back @ before @ back.T + after)


def _test(d: FloatArray, cov: FloatArray) -> DeformationTest:
    """Of (k,) components with their covariance (k, k), in the directions that have any."""
    statistic, freedom, _ = pseudo_square(d, cov) if np.isfinite(cov).all() else (np.nan, 0, cov)
    if freedom == 0:
        return DeformationTest(float("nan"), 0, float("nan"))
    return DeformationTest(statistic, freedom, float(chi2.sf(statistic, freedom)))
