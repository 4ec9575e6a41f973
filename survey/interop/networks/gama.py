"""GNU Gama's input files (.gkf): local networks of one, two and three dimensions.

Coordinates stay as they are in the file, whatever ``axes-xy`` calls the axes; a frame that is left-handed in nature
(x north, y east) then has bearings that count the other way round. Angles are gon, or degrees where written
``d-m-s``; deviations are mm, and of angles cc (1e-4 gon) or, where the value is in degrees, arc seconds, default
deviations too; Gama's weights do not depend on ``sigma-apr``, but a height difference without deviation has sigma-apr
times the root of its length in km. Readings beyond ``tol-abs`` are not used, as in Gama, and named.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from adjust.model.observations import ReadingKind
from adjust.model.survey import Bearings, FloatArray, Survey
from survey.folder.text import suggestion
from survey.interop.networks.absolute_terms import within_tolerance
from survey.interop.networks.draft import AXES, DraftPoint, NetworkDraft, Vectors
from survey.interop.networks.foreign import (
    ARCSEC,
    CC,
    GON,
    MM,
    ForeignNetwork,
    check_cov,
    number,
    positive,
    sexagesimal,
)
from survey.interop.safe_xml import Element, read_xml
from survey.solution.quantities import SigmaKind

_DMS = re.compile(r"\s*([+-]?)(\d+)-(\d+)-(\d+\.?\d*)\s*")
_COMMON = ("from", "to", "val", "stdev", "from_dh", "to_dh", "extern")
KINDS: dict[str, ReadingKind] = {
    "direction": "direction",
    "distance": "horizontal_distance",
    "angle": "angle",
    "s-distance": "slope_distance",
    "z-angle": "zenith",
    "azimuth": "azimuth",
    "dh": "height_difference",
}
_DEVIATIONS = {
    "direction": "direction-stdev",
    "distance": "distance-stdev",
    "s-distance": "distance-stdev",
    "angle": "angle-stdev",
    "z-angle": "zenith-angle-stdev",
    "azimuth": "azimuth-stdev",
}
_ANGULAR = ("direction", "angle", "z-angle", "azimuth")
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
    return _Reader(networks[0]).network()


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


class _Reader:
    """One pass over <network>."""

    def __init__(self, network: Element) -> None:
        self.root, self.draft = network, NetworkDraft()
        self.bearings, self.azimuth_zero = bearings_of(network)
        self.title = ""
        self.parameters = Element("parameters", {}, network.where)
        self.defaults = network

    def network(self) -> ForeignNetwork:
        bodies = []
        for child in self.root.children:
            if child.tag == "description":
                self.title = next((line.strip() for line in child.text.splitlines() if line.strip()), "")
            elif child.tag == "parameters":
                together = self.parameters.attributes | child.attributes
                self.parameters = Element("parameters", together, child.where)
            elif child.tag == "points-observations":
                bodies.append(child)
            else:
                raise child.error("is not known here; description, parameters and points-observations are")
        for body in bodies:
            self._body(body)
        parameters = self.parameters
        level = parameters.number("conf-pr", 0.95)
        if not 0.0 < level < 1.0:
            raise parameters.error(f"conf-pr is {level:g}; it is a probability between 0 and 1")
        actual = parameters.get("sigma-act", "aposteriori")
        if actual not in _SIGMAS:
            raise parameters.error(f"sigma-act is {actual!r}; {suggestion(actual, _SIGMAS)}")
        tolerance = positive(parameters.get("tol-abs", "1000"), "tol-abs", parameters.where) * MM
        survey, beyond = within_tolerance(self.draft.survey(self.bearings), tolerance, self._sigma0() * CC)
        notes = (*self.draft.notes, *beyond, *self._ignored(survey))
        alpha = round(1.0 - level, 12)
        return ForeignNetwork(survey, self.title, self._sigma0(), _SIGMAS[actual], alpha, notes=notes)

    def _ignored(self, survey: Survey) -> Iterator[str]:
        """What the file asks for and does not get, for people."""
        given = self.parameters.attributes
        curved = [f"{name} = {given[name].strip()}" for name in _CURVATURE if name in given]
        if curved:
            n = sum(r.kind in ("zenith", "direction") for r in survey.readings)
            yield (
                f"not applied: {', '.join(curved)}; the {n} zenith angles and directions are not reduced for the "
                "curvature of the Earth, level surfaces are planes"
            )
        unknown = [name for name in given if name not in (*_OBEYED, *_OF_THE_OUTPUT, *_CURVATURE)]
        if unknown:
            yield f"not read: {', '.join(unknown)} of <parameters>"
        if self.root.has("epoch"):
            yield f"not kept: the epoch {self.root.get('epoch')} of the network"

    def _sigma0(self) -> float:
        return positive(self.parameters.get("sigma-apr", "10"), "sigma-apr", self.parameters.where)

    def _body(self, body: Element) -> None:
        body.allow(*set(_DEVIATIONS.values()))
        self.defaults = body
        for child in body.children:
            match child.tag:
                case "point":
                    self._point(child)
                case "obs" | "height-differences":
                    self._cluster(child)
                case "vectors":
                    self._vectors(child)
                case "coordinates":
                    self._coordinates(child)
                case _:
                    raise child.error("is not known; point, obs, height-differences, vectors and coordinates are")

    def _point(self, element: Element) -> None:
        element.allow("id", "x", "y", "z", "fix", "adj", "extern")
        name = element.get("id")
        if not name:
            raise element.error("the id is empty; give the point a name")
        point = self.draft.points.setdefault(name, DraftPoint(name, element.where))
        for axis in AXES:
            if element.has(axis):
                point.start[axis] = element.number(axis)
        self._status(element, point)

    def _status(self, element: Element, point: DraftPoint) -> None:
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

    def _cluster(self, cluster: Element) -> None:
        cluster.allow("from", "orientation", "from_dh", "extern")
        cov, names, units, setup = None, [], [], ""
        if cluster.all("direction"):
            setup = self.draft.setup(self._directions_from(cluster))
        for child in cluster.children:
            if child.tag == "cov-mat":
                cov = child
            elif child.tag in KINDS:
                name, unit = self._observation(cluster, child, setup, bool(cluster.all("cov-mat")))
                names.append(name)
                units.append(unit)
            else:
                raise child.error(f"is not known here; {suggestion(child.tag, (*KINDS, 'cov-mat'))}")
        if cov is not None:
            scale = np.array(units)
            matrix = covariance(cov, len(names)) * np.outer(scale, scale)
            check_cov(matrix, "cov-mat", cov.where)
            self.draft.correlate(names, matrix)

    def _directions_from(self, cluster: Element) -> str:
        stations = {c.get("from", cluster.attributes.get("from")) for c in cluster.all("direction")}
        if len(stations) != 1:
            raise cluster.error(f"directions of one set start at one point, found {sorted(stations)[:4]}; split it")
        return stations.pop()

    def _observation(self, cluster: Element, e: Element, setup: str, has_cov: bool) -> tuple[str, float]:
        """Add one reading; its id and the unit of its covariances in SI."""
        angle = e.tag == "angle"
        ends = ("bs", "fs", "bs_dh", "fs_dh") if angle else ("to", "dist")
        e.allow(*_COMMON, *ends)
        at = e.get("from", cluster.attributes.get("from"))
        to, second = (e.get("bs"), e.get("fs")) if angle else (e.get("to"), None)
        if at == to or second in (at, to):
            raise e.error(f"the points {at!r}, {to!r} of an observation must differ")
        value, unit = self._value(e)
        if e.tag == "azimuth":
            value += self.azimuth_zero
        sigma = unit if has_cov and not e.has("stdev") else self._sigma(e, value, unit)
        first_height = e.number("from_dh", cluster.number("from_dh", 0.0))
        heights = (first_height, e.number("bs_dh" if angle else "to_dh", 0.0), e.number("fs_dh", 0.0))
        own_setup = setup if cluster.attributes.get("from") in (None, at) or e.tag == "direction" else ""
        extern = e.get("extern", "")
        name = self.draft.reading(
            KINDS[e.tag], at, to, value, sigma, setup_id=own_setup, second=second, heights=heights, name=extern
        )
        return name, unit

    def _value(self, e: Element) -> tuple[float, float]:
        """The value in SI, and the unit of its deviation in SI."""
        text = e.get("val")
        if e.tag not in _ANGULAR:
            value = number(text, "val", e.where)
            if value <= 0.0 and e.tag != "dh":
                raise e.error(f"a distance of {text} m; distances are above zero")
            return value, MM
        found = _DMS.fullmatch(text)
        if found is None:
            return number(text, "val", e.where) * GON, CC
        return sexagesimal(found[1], (found[2], found[3], found[4]), "val", e.where), ARCSEC

    def _sigma(self, e: Element, value: float, unit: float) -> float:
        """From the element, the default of its kind (both in the unit that the value demands), or the length."""
        if e.has("stdev"):
            return positive(e.get("stdev"), "stdev", e.where) * unit
        if e.tag == "dh":
            if not e.has("dist"):
                raise e.error("has neither stdev (mm) nor dist (km); add one")
            return self._sigma0() * float(np.sqrt(positive(e.get("dist"), "dist", e.where))) * MM
        key = _DEVIATIONS[e.tag]
        if not self.defaults.has(key):
            raise e.error(f"has no stdev and <points-observations> no {key}; add one")
        words = self.defaults.get(key).split()
        if not words:
            raise self.defaults.error(f"{key} is empty; give the deviation, for distances up to three numbers")
        a, *rest = (number(word, key, self.defaults.where) for word in words)
        if e.tag in _ANGULAR:
            sigma = a * unit
        else:
            b, power = (*rest, 0.0, 1.0)[:2] if len(rest) != 1 else (rest[0], 1.0)
            sigma = (a + b * (value / 1000.0) ** power) * MM
        if not 0.0 < sigma < np.inf:
            raise self.defaults.error(f"{key} gives a deviation that is not above zero; correct it")
        return float(sigma)

    def _vectors(self, element: Element) -> None:
        vectors = element.all("vec")
        for e in vectors:
            e.allow("from", "to", "dx", "dy", "dz", "from_dh", "to_dh", "extern")
        values = np.array([[e.number(f"d{a}") for a in AXES] for e in vectors]).reshape(-1, 3)
        # the file's heights are of instrument and antenna above the points
        values[:, 2] += [e.number("from_dh", 0.0) - e.number("to_dh", 0.0) for e in vectors]
        cov = covariance(self._matrix(element, "vec"), 3 * len(vectors)) * MM**2
        at, to = [e.get("from") for e in vectors], [e.get("to") for e in vectors]
        self.draft.differences.append(Vectors(element.where, at, to, values, cov))

    def _coordinates(self, element: Element) -> None:
        points = element.all("point")
        values, rows = np.zeros((len(points), 3)), []
        for k, e in enumerate(points):
            e.allow("id", "x", "y", "z", "fix", "adj", "extern")
            point = self.draft.points.setdefault(e.get("id"), DraftPoint(e.get("id"), e.where))
            for i, axis in enumerate(AXES):
                if e.has(axis):
                    values[k, i] = e.number(axis)
                    rows.append(3 * k + i)
                    point.start.setdefault(axis, values[k, i])
            self._status(e, point)
        cov = np.diag(np.full(3 * len(points), np.inf))
        cov[np.ix_(rows, rows)] = covariance(self._matrix(element, "point"), len(rows)) * MM**2
        self.draft.coordinates.append(Vectors(element.where, [], [e.get("id") for e in points], values, cov))

    def _matrix(self, element: Element, what: str) -> Element:
        matrices = element.all("cov-mat")
        others = [e for e in element.children if e.tag not in ("cov-mat", what)]
        if others:
            raise others[0].error(f"is not known here; {what} and cov-mat are")
        if len(matrices) != 1 or len(element.children) < 2:
            raise element.error(f"expected some <{what}> and one <cov-mat>, found {len(matrices)} of these; correct it")
        return matrices[0]


def covariance(element: Element, n: int) -> FloatArray:
    """A symmetric matrix (n, n) from the upper part of its band, by rows."""
    element.allow("dim", "band")
    dim, band = element.number("dim"), element.number("band")
    if dim != n or band not in range(n):
        raise element.error(f"dim is {dim:g} and band {band:g}; expected dim {n} and a band from 0 to {n - 1}")
    words = element.text.split()
    width = int(band) + 1
    lengths = [min(width, n - i) for i in range(n)]
    if len(words) != sum(lengths):
        raise element.error(f"found {len(words)} numbers, a band of {width - 1} needs {sum(lengths)}; correct it")
    numbers = np.array([number(word, "cov-mat", element.where) for word in words])
    out, first = np.zeros((n, n)), 0
    for i, length in enumerate(lengths):
        out[i, i : i + length] = out[i : i + length, i] = numbers[first : first + length]
        first += length
    return out
