"""Between a survey of stations and pairs and a pose network, both ways."""

import numpy as np
from gtsam import Pose3, Rot3

from adjust.frames.unknowns import POSE_COMPONENTS, POSE_UNITS
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment, Estimate, GroupSummary, ImageResiduals, ObservationResidual, ParameterName
from adjust.model.survey import FloatArray, PoseParameter, Survey
from adjust.pose_network.network import PoseNetwork, pose_network
from adjust.pose_network.precision import UNCONTROLLED
from adjust.pose_network.solution import NetworkSolution
from adjust.precision.pose_networks import NamedPrecision
from adjust.precision.precision import adjusted_motion, global_test
from adjust.relay.motions import Motions, right_jacobian_inverse


def network_from_survey(survey: Survey, any_datum: bool = False) -> PoseNetwork:
    """The network of a survey's pairs; stations without a pair are left out.

    any_datum: a survey that gives none is solved as a free network. Raises SurveyError for pairs that join other frames
    than fixed stations, IndeterminateError where the survey gives no datum.
    """
    stations = {s.station_id: s for s in survey.stations}
    for pair in survey.pairs:
        for ref in (pair.a, pair.b):
            if ref.kind != "station" or ref.frame_id not in stations or stations[ref.frame_id].motion != "fixed":
                raise SurveyError(
                    f"pair {pair.pair_id!r} ends at {ref.kind} {ref.frame_id!r}, which is no fixed station of the "
                    "survey; a pose network joins fixed stations"
                )
    ids = list(dict.fromkeys(r.frame_id for p in survey.pairs for r in (p.a, p.b)))
    index = {s: i for i, s in enumerate(ids)}
    given = {index[s]: stations[s].world_from_station for s in ids}
    cov = np.zeros((len(survey.pairs), 6, 6))
    for e, pair in enumerate(survey.pairs):
        k = len(pair.cov)
        cov[e, :k, :k] = pair.cov
    measured = [p.b_from_a for p in survey.pairs]
    inner = survey.datum.kind == "inner"
    if not inner and not any_datum and all(p.treatment == "free" for p in given.values()):
        raise IndeterminateError(
            "the datum: no station is held or has a prior; hold a station or set the datum to inner constraints"
        )
    return pose_network(
        ids, [p.pair_id for p in survey.pairs],
        [index[p.a.frame_id] for p in survey.pairs], [index[p.b.frame_id] for p in survey.pairs],
        np.array([_rotation(m) for m in measured]),
        np.array([m.translation() if isinstance(m, Pose3) else np.full(3, np.nan) for m in measured]), cov,
        held={i: _matrix(p) for i, p in given.items() if p.treatment == "held"},
        prior={i: (_matrix(p), _prior(p, ids[i])) for i, p in given.items() if p.treatment == "prior"},
        start={i: _matrix(p) for i, p in given.items() if p.treatment == "free" and p.value is not None},
        inner=[index[s] for s in survey.datum.stations or ids if s in index] if inner else None,
        used=np.array([p.used for p in survey.pairs]),
    )  # fmt: skip


def _rotation(motion: Pose3 | Rot3) -> FloatArray:
    return np.asarray(motion.rotation().matrix() if isinstance(motion, Pose3) else motion.matrix())


def _matrix(parameter: PoseParameter) -> FloatArray:
    return np.eye(4) if parameter.value is None else np.asarray(parameter.value.matrix())


def _prior(parameter: PoseParameter, station_id: str) -> FloatArray:
    if parameter.prior_cov is None or parameter.value is None:
        raise SurveyError(f"station {station_id!r} has a prior without value or covariance; give both")
    return parameter.prior_cov


def network_adjustment(survey: Survey, solution: NetworkSolution, alpha: float = 0.05) -> Adjustment:
    """The solution as an adjustment of ``survey``, as reports and files take it."""
    network = solution.network
    pairs = _pair_residuals(survey, solution)
    groups: dict[str, list[float]] = {}
    used = network.used
    whitened = solution.precision.pairs.whitened
    for e, item in enumerate(pairs):
        if used[e]:
            row = groups.setdefault(item.group, [0.0, 0.0, 0.0])
            row[0], row[1] = row[0] + len(item.residual), row[1] + float(item.redundancy.sum())
            row[2] += float(whitened[e] @ whitened[e])
    summaries = [GroupSummary(g, int(n), r, omega) for g, (n, r, omega) in groups.items()]
    priors, prior_group = _prior_residuals(solution)
    summaries += prior_group
    empty = np.zeros((0, 2))
    images = ImageResiduals(np.zeros(1, dtype=np.int64), empty, empty, empty, np.zeros(0), np.zeros(0, dtype=np.bool_))
    n_unknowns = network.dim * (network.n_stations - len(network.held))
    defect = network.dim if network.anchor is not None else 0
    n_observations = sum(g.n_observations for g in summaries)
    test = global_test(solution.omega, solution.redundancy, alpha)
    return Adjustment(
        survey, _estimates(survey, solution), images, pairs + priors, tuple(summaries), n_observations, n_unknowns,
        defect, solution.redundancy, solution.omega, solution.sigma0, test, solution.iterations, solution.max_step,
        True, tuple(f"left out: {r}" for r in solution.rejected), NamedPrecision(solution),
    )  # fmt: skip


def _estimates(survey: Survey, solution: NetworkSolution) -> dict[ParameterName, Estimate]:
    network, out = solution.network, {}
    treatment = {s.station_id: s.world_from_station.treatment for s in survey.stations}
    covs, d = solution.precision.station_cov, network.dim
    for i, station in enumerate(network.station_ids):
        name: ParameterName = ("world_from_station", station)
        cov = np.zeros((6, 6))
        cov[:d, :d] = covs[i]
        status = tuple(treatment[station] if k < d else "held" for k in range(6))
        out[name] = Estimate(name, solution.pose(station), POSE_COMPONENTS, POSE_UNITS, cov, status)
    return out


def _pair_residuals(survey: Survey, solution: NetworkSolution) -> tuple[ObservationResidual, ...]:
    network, stats = solution.network, solution.precision.pairs
    out = []
    for e, pair in enumerate(survey.pairs):
        k = 6 if network.is_pose[e] else 3
        v, cov = stats.residual[e, :k], network.cov[e, :k, :k]
        spread = np.diag(stats.residual_cov[e, :k, :k])
        sigma = np.sqrt(np.diag(cov))
        seen = spread > UNCONTROLLED * sigma**2
        standardized = np.where(seen, v / np.sqrt(np.where(seen, spread, 1.0)), np.nan)
        motion = Motions(network.rotations[e : e + 1], network.translations[e : e + 1] if k == 6 else None)
        observed = motion.log()[0]
        out.append(
            ObservationResidual("pair", pair.group, (pair.pair_id, _text(pair.a), _text(pair.b)), POSE_COMPONENTS[:k],
                                POSE_UNITS[:k], observed, adjusted_motion(observed, v), v, sigma,
                                stats.redundancy[e, :k], standardized, float(stats.test[e]), bool(network.used[e]))
        )  # fmt: skip
    return tuple(out)


def _prior_residuals(solution: NetworkSolution) -> tuple[tuple[ObservationResidual, ...], list[GroupSummary]]:
    network, out = solution.network, []
    total = np.zeros(3)
    for i, cov in network.prior_cov.items():
        known = np.flatnonzero(np.isfinite(np.diag(cov)[: network.dim]))
        given = Motions(network.station_rotations[[i]], network.station_translations[[i]])
        here = Motions(solution.rotations[[i]], solution.translations[[i]])
        if network.rotation_only:
            given, here = Motions(given.rotation), Motions(here.rotation)
        v = (given.inverse() @ here).log()[0]
        J = right_jacobian_inverse(v[None])[0]
        e, C = v[known], cov[np.ix_(known, known)]
        Q = (J @ solution.precision.joint([i]) @ J.T)[np.ix_(known, known)]
        W = np.linalg.cholesky(np.linalg.inv(C)).T
        rest = np.eye(len(known)) - W @ Q @ W.T
        white, spread, sigma = W @ e, np.diag(C - Q), np.sqrt(np.diag(C))
        seen = spread > UNCONTROLLED * sigma**2
        standardized = np.where(seen, e / np.sqrt(np.where(seen, spread, 1.0)), np.nan)
        test = float(white @ np.linalg.pinv(rest, rcond=1e-9, hermitian=True) @ white)
        redundancy = np.diag(rest)
        total += np.array([len(known), redundancy.sum(), white @ white])
        names = tuple(np.array(POSE_COMPONENTS)[known]), tuple(np.array(POSE_UNITS)[known])
        out.append(
            ObservationResidual("prior", "prior", ("world_from_station", network.station_ids[i]), *names,
                                np.zeros(len(known)), e, e, sigma, redundancy, standardized, test, True)
        )  # fmt: skip
    summary = [GroupSummary("prior", int(total[0]), float(total[1]), float(total[2]))] if out else []
    return tuple(out), summary


def _text(ref: FrameRef) -> str:
    return f"{ref.kind}:{ref.frame_id}"

