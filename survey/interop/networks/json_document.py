"""A network as one JSON document: points, readings, baselines, coordinates, and the adjusted points with covariance."""

from adjust.model.observations import PositionRef, Reading
from adjust.model.survey import Point
from survey.folder.plain import plain
from survey.folder.text import json_text
from survey.interop.networks.values import NetworkValues, between_points, point_of
from survey.project.tables.layouts import HEIGHTS
from survey.project.tables.terrestrial import ANGLES

FORMAT = "labsurvey-network-1"


def network_json(network: NetworkValues) -> str:
    """The document; SI and radians with units in the keys, None where nothing is known."""
    survey = network.survey
    document = {
        "format": FORMAT,
        "title": network.title,
        "units": "metres and radians; directions are counted as under bearings",
        "bearings": {"zero": survey.bearings.zero, "clockwise": survey.bearings.clockwise},
        "datum": {"kind": survey.datum.kind, "points": list(survey.datum.points)},
        "points": {p.point_id: _point(network, p) for p in survey.points},
        "readings": [_reading(r) for r in survey.readings if between_points(r)],
        "reading_covariances": [
            {"ids": list(c.reading_ids), "covariance": plain(c.cov)} for c in survey.reading_covariances
        ],
        "distances": [
            {"id": d.distance_id, "from": point_of(d.a), "to": point_of(d.b), "value_m": d.value, "sigma_m": d.sigma,
             "used": d.used}
            for d in survey.distances if between_points(d)
        ],
        "coordinate_differences": [
            {"from": _ids(o.at), "to": _ids(o.to), "values_m": plain(o.values), "covariance_m2": plain(o.cov),
             "used": o.used}
            for o in survey.coordinate_differences if between_points(o)
        ],
        "coordinates": [
            {"points": _ids(o.positions), "values_m": plain(o.values), "covariance_m2": plain(o.cov), "used": o.used}
            for o in survey.coordinates if between_points(o)
        ],
        "adjusted": _adjusted(network),
    }  # fmt: skip
    return json_text(document)


def _ids(positions: tuple[PositionRef, ...]) -> list[str | None]:
    return [point_of(p) for p in positions]


def _point(network: NetworkValues, point: Point) -> dict[str, object]:
    x = network.x.get(point.point_id)
    parameter = point.x_in_world
    out: dict[str, object] = {"treatment": parameter.treatment, "held": list(parameter.held)}
    if x is not None:
        out["x_m"] = plain(x)
    if parameter.prior_cov is not None:
        out["prior_covariance_m2"] = plain(parameter.prior_cov)
    return out


def _reading(r: Reading) -> dict[str, object]:
    unit = "rad" if r.kind in ANGLES else "m"
    out: dict[str, object] = {"id": r.reading_id, "kind": r.kind, "from": r.at.point_id, "to": r.to.point_id}
    out |= {"second": r.second.point_id} if r.second else {}
    out |= {"setup": r.setup_id} if r.setup_id else {}
    out |= {f"value_{unit}": r.value, f"sigma_{unit}": r.sigma, "group": r.group, "used": r.used}
    return out | {f"{name}_m": height for name in HEIGHTS if (height := getattr(r, name))}


def _adjusted(network: NetworkValues) -> dict[str, object] | None:
    if not network.adjusted:
        return None
    return {
        "sigma_factor": network.factor,
        "points": {
            name: {"x_m": network.x[name].tolist(), "covariance_m2": plain(cov)} for name, cov in network.covs.items()
        },
    }
