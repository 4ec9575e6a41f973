"""Between a survey of stations and pairs and a pose network, both ways."""

from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import Datum, FloatArray, PoseParameter, Station, Survey, Treatment
from adjust.observations.pairs import pair_arrays
from adjust.pose_network.network import PoseNetwork, pose_network


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
    measured = pair_arrays(survey.pairs)
    inner = survey.datum.kind == "inner"
    if not inner and not any_datum and all(p.treatment == "free" for p in given.values()):
        raise IndeterminateError(
            "the datum: no station is held or has a prior; hold a station or set the datum to inner constraints"
        )
    return pose_network(
        ids, [p.pair_id for p in survey.pairs],
        [index[p.a.frame_id] for p in survey.pairs], [index[p.b.frame_id] for p in survey.pairs],
        measured.rotations, measured.translations, np.nan_to_num(measured.cov, posinf=0.0),
        held={i: _matrix(p) for i, p in given.items() if p.treatment == "held"},
        prior={i: (_matrix(p), _prior(p, ids[i])) for i, p in given.items() if p.treatment == "prior"},
        start={i: _matrix(p) for i, p in given.items() if p.treatment == "free" and p.value is not None},
        inner=[index[s] for s in survey.datum.stations or ids if s in index] if inner else None,
        used=measured.used, survey=survey,
    )  # fmt: skip


def _matrix(parameter: PoseParameter) -> FloatArray:
    return np.eye(4) if parameter.value is None else np.asarray(parameter.value.matrix())


def _prior(parameter: PoseParameter, station_id: str) -> FloatArray:
    if parameter.prior_cov is None or parameter.value is None:
        raise SurveyError(f"station {station_id!r} has a prior without value or covariance; give both")
    return parameter.prior_cov


def survey_of(network: PoseNetwork) -> Survey:
    """The stations and pairs of a network as the survey that is solved: its datum, and the pairs in use of now.

    Where nothing but rotations was measured, all stations are held in one place.
    """
    survey = network.as_survey
    pairs, given = list(survey.pairs), np.array([p.used for p in survey.pairs], dtype=np.bool_)
    for e in np.flatnonzero(given != network.used).tolist():
        pairs[e] = replace(pairs[e], used=bool(network.used[e]))
    return replace(survey, pairs=tuple(pairs))


def as_survey(network: PoseNetwork) -> Survey:
    """All stations and pairs of a network, in the datum that it is solved in."""
    inner = network.anchor is not None
    whole = len(network.inner) == network.n_stations
    datum = Datum("inner", (), () if whole else tuple(network.station_ids[i] for i in network.inner.tolist()))
    known = network.survey or Survey(stations=_stations(network), pairs=_pairs(network))
    stations = known.stations
    if network.rotation_only:
        stations = tuple(replace(s, world_from_station=_turning_only(s.world_from_station)) for s in stations)
    return replace(known, stations=stations, datum=datum if inner else Datum())


def _turning_only(given: PoseParameter) -> PoseParameter:
    """With its position held, which nothing tells; at the origin, for all turn about it."""
    if given.treatment == "held":
        return given
    turn = Rot3() if given.value is None else given.value.rotation()
    return replace(given, value=Pose3(turn, np.zeros(3)), held=("tx", "ty", "tz"))


def _stations(network: PoseNetwork) -> tuple[Station, ...]:
    out = []
    for i, station in enumerate(network.station_ids):
        R, t = network.station_rotations[i], network.station_translations[i]
        value = Pose3(Rot3(R), t) if np.isfinite(t).all() else None
        prior = network.prior_cov.get(i)
        treatment: Treatment = "held" if network.is_held[i] else "free" if prior is None else "prior"
        out.append(Station(station, world_from_station=PoseParameter(value, treatment, prior)))
    return tuple(out)


def _pairs(network: PoseNetwork) -> tuple[Pair, ...]:
    frames = [FrameRef("station", s) for s in network.station_ids]
    rows = zip(network.pair_ids, network.a_idx.tolist(), network.b_idx.tolist(), network.arrays.poses,
               network.is_pose.tolist(), network.cov, network.used.tolist(), strict=True)  # fmt: skip
    return tuple(Pair(i, frames[a], frames[b], motion if pose else motion.rotation(), cov if pose else cov[:3, :3],
                      used=used) for i, a, b, motion, pose, cov, used in rows)  # fmt: skip
