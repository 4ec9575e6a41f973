"""The readings in GNU Gama's input files: clusters of observations, with their deviations or covariances."""

import re

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.observations import ReadingKind
from adjust.model.survey import FloatArray
from survey.folder.text import suggestion
from survey.interop.networks.draft import NetworkDraft
from survey.interop.networks.foreign import ARCSEC, CC, GON, MM, check_cov, number, positive, sexagesimal
from survey.interop.safe_xml import Element

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
_DISTANCE = "distance-stdev"
DEVIATIONS = {
    "direction": "direction-stdev",
    "distance": _DISTANCE,
    "s-distance": _DISTANCE,
    "angle": "angle-stdev",
    "z-angle": "zenith-angle-stdev",
    "azimuth": "azimuth-stdev",
}
"""Of a kind the attribute of <points-observations> that holds where a reading has no deviation of its own."""
_ANGULAR = ("direction", "angle", "z-angle", "azimuth")


@frozen
class Clusters:
    """What the clusters in one <points-observations> are read with, and the draft that they go to.

    sigma0: of unit weight, its own unit; azimuth_zero: what is to be added to azimuths (rad).
    """

    draft: NetworkDraft
    body: Element
    sigma0: float
    azimuth_zero: float

    def add(self, cluster: Element) -> None:
        """Put the readings of a cluster and their correlations into the draft. Raises SurveyError."""
        cluster.allow("from", "orientation", "from_dh", "extern")
        matrices = cluster.all("cov-mat")
        setup = self.draft.setup(_start_of_directions(cluster)) if cluster.all("direction") else ""
        names, units = [], []
        for child in cluster.children:
            if child.tag in KINDS:
                name, unit = self._add_reading(cluster, child, setup, bool(matrices))
                names.append(name)
                units.append(unit)
            elif child.tag != "cov-mat":
                raise child.error(f"is not known here; {suggestion(child.tag, (*KINDS, 'cov-mat'))}")
        if matrices:
            matrix = covariance(matrices[-1], len(names)) * np.outer(units, units)
            check_cov(matrix, "cov-mat", matrices[-1].where)
            self.draft.correlate(names, matrix)

    def _add_reading(self, cluster: Element, e: Element, setup: str, has_cov: bool) -> tuple[str, float]:
        """Add one reading; its id and the unit of its covariances in SI."""
        angle = e.tag == "angle"
        ends = ("bs", "fs", "bs_dh", "fs_dh") if angle else ("to", "dist")
        e.allow(*_COMMON, *ends)
        at = e.get("from", cluster.attributes.get("from"))
        to, second = (e.get("bs"), e.get("fs")) if angle else (e.get("to"), None)
        if at == to or second in (at, to):
            raise e.error(f"the points {at!r}, {to!r} of an observation must differ")
        value, unit = _value_and_unit(e)
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

    def _sigma(self, e: Element, value: float, unit: float) -> float:
        """From the element, the default of its kind (both in the unit that the value demands), or the length."""
        if e.has("stdev"):
            return positive(e.get("stdev"), "stdev", e.where) * unit
        if e.tag == "dh":
            if not e.has("dist"):
                raise e.error("has neither stdev (mm) nor dist (km); add one")
            return self.sigma0 * float(np.sqrt(positive(e.get("dist"), "dist", e.where))) * MM
        key = DEVIATIONS[e.tag]
        if not self.body.has(key):
            raise e.error(f"has no stdev and <points-observations> no {key}; add one")
        return _usual_sigma(self.body, key, value, unit)


def _start_of_directions(cluster: Element) -> str:
    """The point at which all directions of a cluster start."""
    stations = {c.get("from", cluster.attributes.get("from")) for c in cluster.all("direction")}
    if len(stations) != 1:
        raise cluster.error(f"directions of one set start at one point, found {sorted(stations)[:4]}; split it")
    return stations.pop()


def _value_and_unit(e: Element) -> tuple[float, float]:
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


def _usual_sigma(body: Element, key: str, value: float, unit: float) -> float:
    """The deviation (SI) that a file gives for a kind; of distances a + b D^c (mm, D in km)."""
    words = body.get(key).split()
    if not words:
        raise body.error(f"{key} is empty; give the deviation, for distances up to three numbers")
    a, *rest = (number(word, key, body.where) for word in words)
    if key == _DISTANCE:
        b, power = (*rest, 1.0)[:2] if rest else (0.0, 1.0)
        sigma = (a + b * (value / 1000.0) ** power) * MM
    else:
        sigma = a * unit
    if not 0.0 < sigma < np.inf:
        raise body.error(f"{key} gives a deviation that is not above zero; correct it")
    return float(sigma)


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
