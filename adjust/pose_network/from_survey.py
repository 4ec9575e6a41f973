"""From a survey of stations and pairs to a pose network."""

from dataclasses import fields

import numpy as np

from adjust.model.errors import IndeterminateError, SurveyError, listed
from adjust.model.survey import FloatArray, PoseParameter, Survey
from adjust.observations.pair_arrays import pair_arrays
from adjust.pose_network.network import PoseNetwork, Topology, check_determined, network_of

_BESIDE = ("distances", "coordinates", "coordinate_differences", "levels", "alignments")
"""What may be observed between stations beside their pairs: it brings no unknown of its own."""
_FREELY = {"stations", "pairs", "closures", "instruments", "setups", "beams", "surfaces", *_BESIDE}


def network_of_pairs(survey: Survey) -> PoseNetwork | None:
    """The network of a survey whose unknowns are poses of fixed stations, all tied together by its pairs; else None.

    This is the one place that says which surveys are started and stepped as networks: what is observed between the
    stations besides only adds to it. Raises IndeterminateError where nothing but pairs is observed, and these leave a
    station floating or give no datum.
    """
    if not survey.pairs or not _stations_and_pairs(survey):
        return None
    beside = any(getattr(survey, kind) for kind in _BESIDE)
    if beside and survey.datum.kind == "inner":  # where a free network lies is not to be seen in its pairs alone
        return None
    reached = {r.frame_id for r in survey.pair_frames}
    lost = [s.station_id for s in survey.stations
            if s.station_id not in reached and s.world_from_station.treatment == "free"]  # fmt: skip
    if lost:
        if beside:
            return None
        raise IndeterminateError(
            f"no measured pair ties {listed(lost, 8)} to the datum; measure a pair to the rest, hold the "
            "station, or leave it out", tuple(lost),
        )  # fmt: skip
    if not beside:
        return network_from_survey(survey)
    try:
        network = network_from_survey(survey)
        check_determined(network)
    except IndeterminateError:
        return None
    return None if network.rotation_only else network


def _stations_and_pairs(survey: Survey) -> bool:
    """Whether there is nothing but fixed stations, pairs between them and what else may be observed between them."""
    there_is = {f.name for f in fields(survey) if isinstance(v := getattr(survey, f.name), tuple) and v}
    if there_is - _FREELY or survey.vertical.tilt.free:
        return False
    return survey.pairs_join_fixed_stations


def network_from_survey(survey: Survey, any_datum: bool = False) -> PoseNetwork:
    """The network of a survey's pairs; stations without a pair are left out.

    any_datum: a survey that gives none is solved as a free network. Raises SurveyError for pairs that join other frames
    than fixed stations, IndeterminateError where the survey gives no datum.
    """
    stations = survey.stations_by_id
    if not survey.pairs_join_fixed_stations:
        for pair, ref in ((p, r) for p in survey.pairs for r in (p.a, p.b)):
            if ref.kind != "station" or ref.frame_id not in stations or stations[ref.frame_id].motion != "fixed":
                raise SurveyError(
                    f"pair {pair.pair_id!r} ends at {ref.kind} {ref.frame_id!r}, which is no fixed station of the "
                    "survey; a pose network joins fixed stations"
                )
    ids = list(dict.fromkeys(r.frame_id for r in survey.pair_frames))
    index = {s: i for i, s in enumerate(ids)}
    given = {index[s]: stations[s].world_from_station for s in ids}
    measured = pair_arrays(survey.pairs)
    inner = survey.datum.kind == "inner"
    if not inner and not any_datum and all(p.treatment == "free" for p in given.values()):
        raise IndeterminateError(
            "the datum: no station is held or has a prior; hold a station or set the datum to inner constraints"
        )
    a = np.array([index[p.a.frame_id] for p in survey.pairs], dtype=np.int64)
    b = np.array([index[p.b.frame_id] for p in survey.pairs], dtype=np.int64)
    return network_of(
        Topology(tuple(ids), tuple(p.pair_id for p in survey.pairs), a, b), measured,
        held={i: _matrix(p) for i, p in given.items() if p.treatment == "held"},
        prior={i: (_matrix(p), _prior(p, ids[i])) for i, p in given.items() if p.treatment == "prior"},
        start={i: _matrix(p) for i, p in given.items() if p.treatment == "free" and p.value is not None},
        inner=[index[s] for s in survey.datum.stations or ids if s in index] if inner else None,
        survey=survey,
    )  # fmt: skip


def _matrix(parameter: PoseParameter) -> FloatArray:
    return np.eye(4) if parameter.value is None else np.asarray(parameter.value.matrix())


def _prior(parameter: PoseParameter, station_id: str) -> FloatArray:
    if parameter.prior_cov is None or parameter.value is None:
        raise SurveyError(f"station {station_id!r} has a prior without value or covariance; give both")
    return parameter.prior_cov
