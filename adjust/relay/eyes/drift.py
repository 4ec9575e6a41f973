"""How trackers err: variance components of their drift from the eyes' own misclosures.

A tracker's pose is a sum of small errors, so the errors of poses are correlated over the whole time and those of
motions over intervals one after the other are not. What the intervals are, the data say: misclosures at growing
intervals grow with the root of time where the world drifts, and not at all where poses have white noise.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.relay.eyes.checks import refuse_undetermined
from adjust.relay.eyes.eyes import EyeAdjustment, station_of
from adjust.relay.eyes.sequences import EyeSequence
from adjust.relay.eyes.setup import eye_setup
from adjust.relay.eyes.solver import EyeProblem, EyeSolution, Weights, linearise, solve_eyes
from adjust.relay.eyes.trajectories import CommonMotions, Trajectory, common_motions
from adjust.testing.distributions import norm

_PARTS = (slice(0, 3), slice(3, 6))


@frozen(eq=False)
class DriftModel:
    """Random walk of each tracker: sigmas per root second, rotation (k,) rad and position (k,) m.

    autocorrelation: of misclosures one interval apart, mean over all components, with its sigma where there is none.
    redundancy: (k, 2) of the variance components.
    """

    interval_s: float
    rotation: FloatArray
    position: FloatArray
    autocorrelation: float
    autocorrelation_sigma: float
    redundancy: FloatArray

    def cov(self, eye: int, n: int, interval_s: float) -> FloatArray:
        """Covariances (n, 6, 6) of motions of an eye over an interval."""
        variance = np.repeat([self.rotation[eye] ** 2, self.position[eye] ** 2], 3) * interval_s
        return np.asarray(np.broadcast_to(np.diag(variance), (n, 6, 6)).copy())


def sequences(common: CommonMotions, model: DriftModel) -> tuple[EyeSequence, ...]:
    """Motions with the covariances of their drift."""
    length = float(common.times_s[0, 1] - common.times_s[0, 0])
    ids = common.interval_ids
    return tuple(
        EyeSequence(eye, ids, m, model.cov(i, len(m), length))
        for i, (eye, m) in enumerate(zip(common.eyes, common.motions, strict=True))
    )


_MOST_ROUNDS = 100
_LEAST_REDUNDANCY = 1.0
_ALPHA = 0.05
_PAUSES = (0.25, 0.5, 1.0, 2.0)
"""In lengths of the interval."""


def fit_drift(common: CommonMotions) -> tuple[DriftModel, EyeAdjustment]:
    """Variance components of rotation and position of every tracker, estimated until they reproduce themselves.

    Foerstner (1979): each component is v'Pv over the redundancy of its group. One that falls until its group has less
    than one redundancy is as good as zero beside the others and stays there. Needs three eyes, since two cannot tell
    whose errors they are. Raises SurveyError for fewer, NotConvergedError.
    """
    k = len(common.eyes)
    if k < 3:
        raise SurveyError(f"{k} trackers cannot tell whose errors are whose; give three or more, or sigmas")
    length = float(common.times_s[0, 1] - common.times_s[0, 0])
    model = DriftModel(length, np.full(k, 3e-3), np.full(k, 1e-2), 0.0, 0.0, np.zeros((k, 2)))
    setup, solution = refuse_undetermined(eye_setup(sequences(common, model), free_scales=True)), None
    for _ in range(_MOST_ROUNDS):
        solution = solve_eyes(setup.problem, solution)
        factor, redundancy = _components(solution, k)
        model = DriftModel(
            length, model.rotation * np.sqrt(factor[:, 0]), model.position * np.sqrt(factor[:, 1]),
            *_autocorrelation(solution, k), redundancy,
        )  # fmt: skip
        cov = np.concatenate([s.cov for s in sequences(common, model)])
        setup = replace(setup, problem=replace(setup.problem, cov=cov))
        if np.abs(factor - 1.0).max() < 0.02:
            return model, station_of(refuse_undetermined(setup), solve_eyes(setup.problem, solution))
    raise NotConvergedError(
        f"the errors of {k} trackers did not settle in {_MOST_ROUNDS} rounds over intervals of {length:g} s: "
        f"{len(common.times_s)} motions do not tell whose they are; record longer trajectories with more turns"
    )


def _components(solution: EyeSolution, k: int) -> tuple[FloatArray, FloatArray]:
    """Variance factors (k, 2) and redundancies (k, 2) of rotation and position of each eye."""
    problem = solution.problem
    n = len(problem.observed) // k
    factor, redundancy = np.ones((k, 2)), np.zeros((k, 2))
    variance = np.diagonal(problem.cov, axis1=1, axis2=2)
    own = _residual_variances(problem, solution) / variance
    square = solution.residuals**2 / variance
    for eye in range(k):
        rows = slice(eye * n, (eye + 1) * n)
        for j, part in enumerate(_PARTS):
            redundancy[eye, j] = own[rows, part].sum()
            if redundancy[eye, j] > _LEAST_REDUNDANCY:
                factor[eye, j] = square[rows, part].sum() / redundancy[eye, j]
    return factor, redundancy


def _residual_variances(problem: EyeProblem, solution: EyeSolution) -> FloatArray:
    """The diagonal (n, 6) of Q_vv of the observations' residuals."""
    c, none = problem.conditions, np.zeros((len(problem.observed), 6))
    at = linearise(problem, solution.unknowns, solution.scales, none)
    weights, own = Weights(problem, at), none
    for rows, R in weights.stars:
        B_k = at.by_k[rows].reshape(len(rows), -1, 6)
        own[c.k_idx[rows[:, 0]]] = ((R @ B_k @ problem.cov[c.k_idx[rows[:, 0]]]) ** 2).sum(axis=1)
        R_l = np.swapaxes(R.reshape(*R.shape[:2], -1, 6), 1, 2)
        own[c.l_idx[rows]] = ((R_l @ (at.by_l @ problem.cov[c.l_idx])[rows]) ** 2).sum(axis=2)
    by = weights.residuals(weights.solve(at.by))
    return np.asarray(own - ((by @ solution.cov) * by).sum(axis=2))


def _autocorrelation(solution: EyeSolution, k: int) -> tuple[float, float]:
    """Of misclosures one interval apart: mean over components and eyes, and its sigma without any."""
    w = solution.misclosure.reshape(-1, k - 1, 6)
    shared = (w[1:] * w[:-1]).sum(axis=0) / (w * w).sum(axis=0)
    # the eyes share the first one's errors: k - 1 series count as half as many, not fewer than one
    independent = 6.0 * max(1.0, 0.5 * (k - 1))
    return float(shared.mean()), float(1.0 / np.sqrt(len(w) * independent))


def choose_interval(
    trajectories: Sequence[Trajectory], offsets_s: Sequence[float], intervals_s: Sequence[float]
) -> tuple[DriftModel, EyeAdjustment, CommonMotions]:
    """The shortest interval whose misclosures are not positively correlated with their neighbours (one-sided test).

    Where they are negatively correlated poses have errors of their own, which two motions share that meet in one: then
    there are pauses between intervals, as long as is needed. Raises SurveyError where they are correlated at all
    intervals, or the time in common is too short for any.
    """
    limit = float(norm.isf(_ALPHA))
    seen: list[str] = []
    for interval in intervals_s:
        try:
            common = common_motions(trajectories, offsets_s, interval)
        except SurveyError:
            if not seen:
                raise
            break  # longer ones do not fit either
        model, adjusted = fit_drift(common)
        for pause in _PAUSES:
            if model.autocorrelation > -limit * model.autocorrelation_sigma:
                break
            common = common_motions(trajectories, offsets_s, interval, step_s=(1.0 + pause) * interval)
            model, adjusted = fit_drift(common)
        seen.append(f"{interval:g} s: {model.autocorrelation:+.2f}")
        if model.autocorrelation < limit * model.autocorrelation_sigma:
            return model, adjusted, common
    raise SurveyError(
        f"the misclosures of neighbouring intervals are correlated at all intervals ({', '.join(seen)}); "
        "give longer ones"
    )


def growth(
    trajectories: Sequence[Trajectory],
    offsets_s: Sequence[float],
    adjusted: EyeAdjustment,
    intervals_s: Sequence[float],
) -> FloatArray:
    """Root mean square misclosures (L, k - 1, 2) of rotation (rad) and position (m) against the first eye, by interval.

    Constant where poses have white noise, growing with the root of the interval where they drift.
    """
    out = []
    for interval in intervals_s:
        common = common_motions(trajectories, offsets_s, interval, step_s=min(interval, 0.3))
        rows = []
        for eye in range(1, len(common.eyes)):
            X = adjusted.station_from_eye[np.array([eye])]
            A = common.motions[0]
            B = common.motions[eye].rescaled(adjusted.scales.get(common.eyes[eye].frame_id, 1.0))
            miss = (X.inverse() @ A.inverse() @ X @ B).log()
            rows.append([np.sqrt(np.mean(miss[:, part] ** 2)) for part in _PARTS])
        out.append(rows)
    return np.array(out)
