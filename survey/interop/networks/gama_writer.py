"""Networks as GNU Gama's input (.gkf); what Gama has no words for is left out."""

from collections.abc import Sequence
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.observations import Reading
from adjust.model.survey import FloatArray, Point, Survey
from survey.interop.networks.draft import AXES
from survey.interop.networks.foreign import CC, GON, MM
from survey.interop.networks.gama_readings import KINDS
from survey.interop.networks.values import NetworkValues, readings_of, triples_of
from survey.project.tables.terrestrial import ANGLES

_TAGS = {kind: tag for tag, kind in KINDS.items()}
_NO_LIMIT_MM = 1000000000  # of tol-abs, its default would leave readings out that this project uses
# how Gama calls axes along which bearings count as ours do, with angles that it reads clockwise
_AXES_XY = {("x", False): "ne", ("x", True): "nw", ("y", True): "en", ("y", False): "wn"}


def gama_text(network: NetworkValues) -> str:
    """The .gkf file of a network. Raises SurveyError for correlated direction sets, which Gama keeps apart."""
    survey, actual = network.survey, "apriori" if network.sigmas == "a_priori" else "aposteriori"
    body = [*_points(network), *_clusters(survey), *_triples(network)]
    return "\n".join(
        [
            '<?xml version="1.0" ?>',
            '<gama-local xmlns="http://www.gnu.org/software/gama/gama-local">',
            f'<network axes-xy="{_AXES_XY[survey.bearings.zero, survey.bearings.clockwise]}" angles="left-handed">',
            f"<description>{escape(network.title)}</description>",
            f'<parameters sigma-apr="1" conf-pr="{1.0 - network.alpha:.12g}" tol-abs="{_NO_LIMIT_MM}" '
            f'sigma-act="{actual}" />',
            "<points-observations>",
            *body,
            "</points-observations>",
            "</network>",
            "</gama-local>",
            "",
        ]
    )


def _used_axes(survey: Survey) -> str:
    """The axes that some observation determines; Gama takes a plane network as one without heights."""
    kinds = {r.kind for r in survey.readings}
    flat = kinds & {"direction", "angle", "azimuth", "horizontal_distance"}
    space = kinds & {"zenith", "slope_distance"} or survey.coordinate_differences or survey.distances
    observed = {a for c in survey.coordinates for i, a in enumerate(AXES) if np.isfinite(np.diag(c.cov)[i::3]).any()}
    wanted = set(observed) | (set("xy") if flat else set()) | (set("xyz") if space else set())
    wanted |= {"z"} if "height_difference" in kinds else set()
    return "".join(a for a in AXES if a in wanted)


def _points(network: NetworkValues) -> list[str]:
    axes = _used_axes(network.survey)
    datum = network.survey.datum
    chosen = set(datum.points) if datum.points else {p.point_id for p in network.survey.points}
    lines = []
    for point in network.survey.points:
        x = network.x.get(point.point_id)
        given = {a: repr(float(x[i])) for i, a in enumerate(AXES) if x is not None and a in axes and np.isfinite(x[i])}
        free = _free_axes(point, axes)
        adjusted = free.upper() if datum.kind == "inner" and point.point_id in chosen else free
        attributes = {"id": point.point_id, **given}
        held = "".join(a for a in axes if a not in free)
        attributes |= {k: v for k, v in (("fix", held), ("adj", adjusted)) if v}
        lines.append(_element("point", attributes))
    return lines


def _free_axes(point: Point, axes: str) -> str:
    if point.x_in_world.treatment == "held":
        return ""
    return "".join(a for a in axes if a not in point.x_in_world.held)


def _element(tag: str, attributes: dict[str, Any]) -> str:
    return f"<{tag} " + " ".join(f"{k}={quoteattr(str(v))}" for k, v in attributes.items()) + " />"


def _clusters(survey: Survey) -> list[str]:
    """One <obs> per setup; what is correlated stands in one."""
    readings = {r.reading_id: r for r in readings_of(survey)}
    home = {i: _home(r) for i, r in readings.items()}
    for joint in survey.reading_covariances:
        ids = [i for i in joint.reading_ids if i in readings]
        for other in ids[1:]:
            old, new = home[other], home[ids[0]]
            home = {i: new if h == old else h for i, h in home.items()}
    clusters: dict[str, list[Reading]] = {}
    for i, reading in readings.items():
        clusters.setdefault(home[i], []).append(reading)
    lines = []
    for members in clusters.values():
        lines += _cluster(survey, members)
    return lines


def _home(reading: Reading) -> str:
    if reading.kind == "direction":
        return f"setup {reading.setup_id}"
    return f"{_TAGS[reading.kind]} at {reading.at.point_id}"


def _cluster(survey: Survey, members: Sequence[Reading]) -> list[str]:
    setups = {r.setup_id for r in members if r.kind == "direction"}
    if len(setups) > 1:
        names = ", ".join(sorted(setups))
        raise SurveyError(f"directions of the setups {names} are correlated, which Gama cannot have; remove that")
    station = next((r.at.point_id for r in members if r.kind == "direction"), None)
    lines = [f"<obs from={quoteattr(station)}>" if station is not None else "<obs>"]
    lines += [_element(_TAGS[r.kind], _reading(r)) for r in members]
    place = {r.reading_id: k for k, r in enumerate(members)}
    units = np.array([CC if r.kind in ANGLES else MM for r in members])
    cov = np.diag(np.array([r.sigma for r in members]) ** 2)
    for joint in survey.reading_covariances:
        here = joint.of(place)
        idx = [place[name] for name in here.reading_ids]
        cov[np.ix_(idx, idx)] = here.cov
    if np.count_nonzero(cov) > len(cov):
        lines += _matrix(cov / np.outer(units, units))
    return [*lines, "</obs>"]


def _reading(reading: Reading) -> dict[str, object]:
    angular = reading.kind in ANGLES
    value = reading.value % (2.0 * np.pi) if reading.kind in ("direction", "azimuth") else reading.value
    sigma = reading.sigma / (CC if angular else MM)
    # the point of a direction set stands with the set
    attributes: dict[str, object] = {} if reading.kind == "direction" else {"from": reading.at.point_id}
    if reading.second is not None:
        attributes |= {"bs": reading.to.point_id, "fs": reading.second.point_id}
    else:
        attributes["to"] = reading.to.point_id
    attributes |= {"val": repr(float(value / GON if angular else value)), "stdev": repr(float(sigma))}
    heights = {
        "from_dh": reading.instrument_height,
        "bs_dh" if reading.second is not None else "to_dh": reading.target_height,
        "fs_dh": reading.second_height,
    }
    return attributes | {k: repr(v) for k, v in heights.items() if v} | {"extern": reading.reading_id}


def _matrix(cov: FloatArray) -> list[str]:
    rows = [" ".join(repr(float(x)) for x in row[i:]) for i, row in enumerate(cov)]
    return [f'<cov-mat dim="{len(cov)}" band="{len(cov) - 1}">', *rows, "</cov-mat>"]


def _triples(network: NetworkValues) -> list[str]:
    """Baselines; observed coordinates and the priors of points."""
    baselines, coordinates = triples_of(network.survey, priors=True)
    lines = []
    for t in baselines:
        lines.append("<vectors>")
        for at, to, row in zip(t.at, t.to, t.values, strict=True):
            differences = {f"d{a}": repr(float(v)) for a, v in zip(AXES, row, strict=True)}
            lines.append(_element("vec", {"from": at, "to": to, **differences}))
        lines += [*_matrix(t.cov / MM**2), "</vectors>"]
    for t in coordinates:
        seen = np.flatnonzero(np.isfinite(np.diagonal(t.cov)))
        if not len(seen):
            continue
        lines.append("<coordinates>")
        for k, name in enumerate(t.to):
            axes = {AXES[j % 3]: repr(float(t.values[k, j % 3])) for j in seen.tolist() if j // 3 == k}
            lines += [_element("point", {"id": name, **axes})] if axes else []
        lines += [*_matrix(t.cov[np.ix_(seen, seen)] / MM**2), "</coordinates>"]
    return lines
