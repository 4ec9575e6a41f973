"""The eyes of a relay station from what each of them saw: cameras without a common view, trackers, marker blocks.

>>> found = adjust_eyes((sequence_of_a, sequence_of_b))   # poses before own targets, A X = Z B, or motions, A X = X B
>>> found.pair("a", "b")   # Pair a -> b with its covariance (6, 6), for adjust.relay

Two eyes give one pair; more give the whole station at once, with the joint covariance of all eyes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import field

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, Pair
from adjust.model.result import GlobalTest
from adjust.model.survey import FloatArray
from adjust.precision.precision import global_test
from adjust.relay.eyes.checks import OutlierEpoch, refuse_undetermined
from adjust.relay.eyes.screening import solve_screened
from adjust.relay.eyes.sequences import EyeSequence
from adjust.relay.eyes.setup import EyeSetup, eye_setup
from adjust.relay.eyes.solver import EyeSolution
from adjust.spatial.rigid_motions import Motions

_UNCERTAIN = 0.1
"""Sigma (rad) of the rotation of an eye from which it is undetermined."""


@frozen
class EyeOptions:
    """reject: epochs that contradict the others are left out and listed.

    free_scales: of motions, whether each eye but the first has a scale of its own, as visual trackers do.
    """

    reject: bool = True
    free_scales: bool = False


@frozen(eq=False)
class EyeAdjustment:
    """Eyes of one station; the first defines the station's frame.

    station_from_eye: (k,) with joint covariance ``cov`` (6k, 6k), zero for the first. world: by name, the poses of the
    worlds in that of the first. scales: by eye, factor on its lengths. outliers: epochs left out, worst first.
    by_observation: (6k, 6n) derivative of all eyes by all observations, eye after eye in the order given.
    """

    eyes: tuple[FrameRef, ...]
    station_from_eye: Motions
    cov: FloatArray
    room_from_world: Mapping[str, Pose3]
    scales: Mapping[str, float]
    scale_sigmas: Mapping[str, float]
    outliers: tuple[OutlierEpoch, ...]
    omega: float
    redundancy: int
    solution: EyeSolution = field(repr=False)
    setup: EyeSetup = field(repr=False)

    @property
    def sigma0(self) -> float:
        """A posteriori standard deviation of unit weight."""
        return float(np.sqrt(self.omega / self.redundancy)) if self.redundancy else float("nan")

    def global_test(self, alpha: float = 0.05) -> GlobalTest | None:
        """Two-sided chi-square test of v'Pv."""
        return global_test(self.omega, self.redundancy, alpha)

    def pair(self, a_id: str, b_id: str, group: str = "pair") -> Pair:
        """``b_from_a`` of two eyes with covariance (6, 6). Raises SurveyError for an unknown eye."""
        a, b = self.eye_idx(a_id), self.eye_idx(b_id)
        X = self.station_from_eye
        b_from_a = X[np.array([b])].inverse() @ X[np.array([a])]
        J = self.pair_jacobian(a_id, b_id)
        return Pair(
            f"{a_id}-{b_id}", self.eyes[a], self.eyes[b], as_pose(b_from_a), symmetric(J @ self.cov @ J.T), group
        )

    def pair_jacobian(self, a_id: str, b_id: str) -> FloatArray:
        """Derivative (6, 6k) of the pair's tangent by the tangents of all eyes."""
        a, b = self.eye_idx(a_id), self.eye_idx(b_id)
        X = self.station_from_eye
        J = np.zeros((6, 6 * len(self.eyes)))
        J[:, 6 * b : 6 * b + 6] = -(X[np.array([a])].inverse() @ X[np.array([b])]).adjoint()[0]
        J[:, 6 * a : 6 * a + 6] += np.eye(6)
        return J

    def by_observation(self) -> FloatArray:
        """Derivative (6k, 6n) of the tangents of all eyes by the observations, in the order of the sequences."""
        out = np.zeros((6 * len(self.eyes), self.solution.influence.shape[1]))
        for i in range(len(self.eyes)):
            rows = self.solution.rows(i)
            if len(rows):
                out[6 * i : 6 * i + 6] = self.solution.influence[rows]
        return out

    def eye_idx(self, eye_id: str) -> int:
        """Position of an eye. Raises SurveyError for an unknown one."""
        ids = [eye.frame_id for eye in self.eyes]
        if eye_id not in ids:
            raise SurveyError(f"eye {eye_id!r} is not on this station; it has {', '.join(ids)}")
        return ids.index(eye_id)


def adjust_eyes(sequences: Sequence[EyeSequence], options: EyeOptions = EyeOptions()) -> EyeAdjustment:
    """The eyes of a station from poses of each in its own world, which stays unmoved while the station moves.

    Or from their motions over the same intervals, for eyes whose worlds drift, as those of trackers. Epochs are joined
    by their ids. Worlds of the same name are the same. Raises SurveyError naming the undetermined direction where the
    turns do not suffice.
    """
    setup = refuse_undetermined(eye_setup(sequences, options.free_scales))
    return station_of(setup, *solve_screened(setup, options.reject))


def station_of(setup: EyeSetup, solution: EyeSolution, outliers: tuple[OutlierEpoch, ...] = ()) -> EyeAdjustment:
    """The eyes as they were solved for. Raises SurveyError where a rotation is uncertain."""
    k = len(setup.eyes)
    place = np.concatenate([solution.rows(i) for i in range(k)])
    target = np.concatenate([6 * i + np.arange(6) for i in range(k) if len(solution.rows(i))])
    cov = np.zeros((6 * k, 6 * k))
    cov[np.ix_(target, target)] = solution.cov[np.ix_(place, place)]
    _refuse_weak(setup, cov)
    first = solution.cov.shape[0] - len(solution.scales)
    spread = np.sqrt(np.diag(solution.cov)[first:])
    factors = np.exp(solution.scales)
    ids = [eye.frame_id for eye in setup.eyes]
    return EyeAdjustment(
        setup.eyes, solution.unknowns[:k], symmetric(cov),
        {w: as_pose(solution.unknowns[np.array([i])]) for w, i in setup.world_idx.items()},
        {ids[e]: float(factors[i]) for i, e in enumerate(setup.scaled_eyes)},
        {ids[e]: float(spread[i] * factors[i]) for i, e in enumerate(setup.scaled_eyes)},
        outliers, solution.omega, solution.redundancy, solution, setup,
    )  # fmt: skip


def _refuse_weak(setup: EyeSetup, cov: FloatArray) -> None:
    """The last word: a rotation that stays uncertain is no result."""
    for i, eye in enumerate(setup.eyes):
        s, V = np.linalg.eigh(cov[6 * i : 6 * i + 3, 6 * i : 6 * i + 3])
        if s[-1] > _UNCERTAIN**2:
            text = ", ".join(f"{x:+.3f}" for x in V[:, -1])
            raise SurveyError(
                f"eye {eye.frame_id}: its rotation about ({text}) of its own frame is uncertain by "
                f"{np.degrees(np.sqrt(s[-1])):.1f} deg: undetermined; turn the station about a "
                "second axis, by 30 deg or more"
            )


def as_pose(motions: Motions) -> Pose3:
    """The single motion as GTSAM's type."""
    return Pose3(Rot3(motions.rotation[0]), motions.shifts[0])


def symmetric(cov: FloatArray) -> FloatArray:
    """Without the rounding that makes it lopsided."""
    return np.asarray(0.5 * (cov + cov.T))
