"""GNU Gama's input files (.gkf): local networks of one, two and three dimensions.

Coordinates stay as they are in the file, whatever ``axes-xy`` calls the axes; a frame that is left-handed in nature
(x north, y east) then has bearings that count the other way round. Angles are gon, or degrees where written
``d-m-s``; deviations are mm, and of angles cc (1e-4 gon) or, where the value is in degrees, arc seconds, default
deviations too; Gama's weights do not depend on ``sigma-apr``, but a height difference without deviation has sigma-apr
times the root of its length in km. Readings beyond ``tol-abs`` are not used, as in Gama, and named.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import Bearings, Survey
from survey.folder.text import suggestion
from survey.interop.networks.absolute_terms import within_tolerance
from survey.interop.networks.draft import AXES, DraftPoint, NetworkDraft, Vectors
from survey.interop.networks.foreign import CC, MM, ForeignNetwork, positive
from survey.interop.networks.gama_readings import DEVIATIONS, Clusters, covariance
from survey.interop.safe_xml import Element, read_xml
from survey.solution.quantities import SigmaKind

RIGHT_HANDED = ("en", "nw", "ws", "se")
AXES_XY = (*RIGHT_HANDED, "ne", "sw", "es", "wn")
_SIGMAS: dict[str, SigmaKind] = {"aposteriori": "a_posteriori", "apriori": "a_priori"}
_OBEYED = ("sigma-apr", "conf-pr", "tol-abs", "sigma-act")
_OF_THE_OUTPUT = ("algorithm", "language", "encoding", "angular", "angles", "cov-band")  # they change no number
_CURVATURE = ("latitude", "ellipsoid")


def read_gama(path: Path) -> ForeignNetwork:
    """A network from a .gkf file. Raises SurveyError with file and line for what cannot be read."""
    root = read_xml(path, "gama-local")
    networks = root.all("network")
    if len(networks) != 1 or len(root.children) != 1:
        raise root.error(f"expected one <network>, found {[e.tag for e in root.children][:5]}")
    network = networks[0]
    bearings, azimuth_zero = bearings_of(network)
    title, given, bodies = _parts(network)
    asked, draft = _parameters(given), NetworkDraft()
    for body in bodies:
        _add_body(draft, body, Clusters(draft, body, asked.sigma0, azimuth_zero))
    survey, beyond = within_tolerance(draft.survey(bearings), asked.tolerance, asked.sigma0 * CC)
    notes = (*draft.notes, *beyond, *_not_obeyed(network, given, survey))
    return ForeignNetwork(survey, title, asked.sigma0, asked.sigmas, asked.alpha, notes=notes)


def bearings_of(network: Element) -> tuple[Bearings, float]:
    """How the file's angles count in its own coordinates, and what is to be added to azimuths (rad)."""
    network.allow("axes-xy", "angles", "epoch")
    axes, angles = network.get("axes-xy", "ne"), network.get("angles", "left-handed")
    if axes not in AXES_XY:
        raise network.error(f"axes-xy is {axes!r}; {suggestion(axes, AXES_XY)}")
    if angles not in ("left-handed", "right-handed"):
        raise network.error(f"angles is {angles!r}; write left-handed (clockwise) or right-handed")
    zero: Literal["x", "y"] = "x" if axes[0] in "ns" else "y"
    clockwise = (angles == "left-handed") == (axes in RIGHT_HANDED)
    return Bearings(zero, clockwise), np.pi if "s" in axes else 0.0


def _parts(network: Element) -> tuple[str, Element, Sequence[Element]]:
    """The title, all <parameters> as one element, and what has points and observations."""
    title, given, bodies = "", Element("parameters", {}, network.where), []
    for child in network.children:
        if child.tag == "description":
            title = next((line.strip() for line in child.text.splitlines() if line.strip()), "")
        elif child.tag == "parameters":
            given = Element("parameters", given.attributes | child.attributes, child.where)
        elif child.tag == "points-observations":
            bodies.append(child)
        else:
            raise child.error("is not known here; description, parameters and points-observations are")
    return title, given, bodies


@frozen
class _Parameters:
    """What a file asks for. sigma0: in its own unit; alpha: level of tests; tolerance: of absolute terms (m)."""

    sigma0: float
    alpha: float
    sigmas: SigmaKind
    tolerance: float


def _parameters(given: Element) -> _Parameters:
    level = given.number("conf-pr", 0.95)
    if not 0.0 < level < 1.0:
        raise given.error(f"conf-pr is {level:g}; it is a probability between 0 and 1")
    actual = given.get("sigma-act", "aposteriori")
    if actual not in _SIGMAS:
        raise given.error(f"sigma-act is {actual!r}; {suggestion(actual, _SIGMAS)}")
    tolerance = positive(given.get("tol-abs", "1000"), "tol-abs", given.where) * MM
    sigma0 = positive(given.get("sigma-apr", "10"), "sigma-apr", given.where)
    return _Parameters(sigma0, round(1.0 - level, 12), _SIGMAS[actual], tolerance)


def _not_obeyed(network: Element, given: Element, survey: Survey) -> Iterator[str]:
    """What the file asks for and does not get, for people."""
    curved = [f"{name} = {given.attributes[name].strip()}" for name in _CURVATURE if given.has(name)]
    if curved:
        n = sum(r.kind in ("zenith", "direction") for r in survey.readings)
        yield (
            f"not applied: {', '.join(curved)}; the {n} zenith angles and directions are not reduced for the "
            "curvature of the Earth, level surfaces are planes"
        )
    unknown = [name for name in given.attributes if name not in (*_OBEYED, *_OF_THE_OUTPUT, *_CURVATURE)]
    if unknown:
        yield f"not read: {', '.join(unknown)} of <parameters>"
    if network.has("epoch"):
        yield f"not kept: the epoch {network.get('epoch')} of the network"


def _add_body(draft: NetworkDraft, body: Element, clusters: Clusters) -> None:
    """Put what stands in a <points-observations> into the draft."""
    body.allow(*set(DEVIATIONS.values()))
    for child in body.children:
        match child.tag:
            case "point":
                _add_point(draft, child)
            case "obs" | "height-differences":
                clusters.add(child)
            case "vectors":
                draft.differences.append(_vectors(child))
            case "coordinates":
                _add_coordinates(draft, child)
            case _:
                raise child.error("is not known; point, obs, height-differences, vectors and coordinates are")


def _point_of(draft: NetworkDraft, element: Element) -> DraftPoint:
    """The point that an element names, new where it is not there yet."""
    element.allow("id", "x", "y", "z", "fix", "adj", "extern")
    name = element.get("id")
    if not name:
        raise element.error("the id is empty; give the point a name")
    return draft.points.setdefault(name, DraftPoint(name, element.where))


def _add_point(draft: NetworkDraft, element: Element) -> None:
    point = _point_of(draft, element)
    point.start |= {axis: element.number(axis) for axis in AXES if element.has(axis)}
    _set_status(element, point)


def _set_status(element: Element, point: DraftPoint) -> None:
    """Fixed, free or constrained by axis; ``fix`` goes before ``adj``."""
    for key in ("adj", "fix"):
        axes = element.get(key, "")
        if set(axes.lower()) - set(AXES):
            raise element.error(f"{key} is {axes!r}; it names axes: xy, z, xyz, XYZ")
        for axis in axes:
            status = "fixed" if key == "fix" else ("constrained" if axis.isupper() else "free")
            point.status[axis.lower()] = status
    for axis, status in point.status.items():
        if status == "fixed" and axis not in point.start:
            raise element.error(f"{axis} of point {point.point_id!r} is fixed but not given; add {axis}=")


def _vectors(element: Element) -> Vectors:
    vectors = element.all("vec")
    for e in vectors:
        e.allow("from", "to", "dx", "dy", "dz", "from_dh", "to_dh", "extern")
    values = np.array([[e.number(f"d{a}") for a in AXES] for e in vectors]).reshape(-1, 3)
    # the file's heights are of instrument and antenna above the points
    values[:, 2] += [e.number("from_dh", 0.0) - e.number("to_dh", 0.0) for e in vectors]
    cov = covariance(_matrix(element, "vec"), 3 * len(vectors)) * MM**2
    at, to = [e.get("from") for e in vectors], [e.get("to") for e in vectors]
    return Vectors(element.where, at, to, values, cov)


def _add_coordinates(draft: NetworkDraft, element: Element) -> None:
    points = element.all("point")
    values, rows = np.zeros((len(points), 3)), []
    for k, e in enumerate(points):
        point = _point_of(draft, e)
        for i, axis in enumerate(AXES):
            if e.has(axis):
                values[k, i] = e.number(axis)
                rows.append(3 * k + i)
                point.start.setdefault(axis, values[k, i])
        _set_status(e, point)
    cov = np.diag(np.full(3 * len(points), np.inf))
    cov[np.ix_(rows, rows)] = covariance(_matrix(element, "point"), len(rows)) * MM**2
    draft.coordinates.append(Vectors(element.where, [], [e.get("id") for e in points], values, cov))


def _matrix(element: Element, what: str) -> Element:
    matrices = element.all("cov-mat")
    others = [e for e in element.children if e.tag not in ("cov-mat", what)]
    if others:
        raise others[0].error(f"is not known here; {what} and cov-mat are")
    if len(matrices) != 1 or len(element.children) < 2:
        raise element.error(f"expected some <{what}> and one <cov-mat>, found {len(matrices)} of these; correct it")
    return matrices[0]
