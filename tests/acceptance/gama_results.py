"""What GNU Gama prints: the XML of an adjustment (gama-local-adjustment), with its own start values."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adjust.model.survey import FloatArray

GON = np.pi / 200
CC = GON * 1e-4
_SPACE = "{http://www.gnu.org/software/gama/gama-local-adjustment}"
_ANGULAR = ("angle", "direction", "zenith-angle", "azimuth")


@dataclass(frozen=True, eq=False)
class GamaRow:
    """One observation; SI. f in per cent of the deviation, qrr in Gama's unit of weight."""

    kind: str
    ends: tuple[str, ...]
    observed: float
    adjusted: float
    sigma: float
    qrr: float
    f: float
    standardized: float | None


@dataclass(frozen=True, eq=False)
class GamaResult:
    """start, adjusted: m, by point and axis. names: (point, axis) or (point, "orientation") of the covariance's rows.

    cov: in m and rad, as printed (times the sigma0 in use, squared); its band only, nan beyond. rows: observations.
    """

    start: dict[tuple[str, str], float]
    adjusted: dict[tuple[str, str], float]
    names: list[tuple[str, str]]
    cov: FloatArray
    redundancy: int
    defect: int
    omega: float
    apriori: float
    aposteriori: float
    used: str
    rows: list[GamaRow]


def _of(parent, path: str):
    return parent.find("/".join(_SPACE + tag for tag in path.split("/")))


def _number(parent, path: str) -> float:
    return float(_of(parent, path).text)


def _tag(element) -> str:
    return element.tag.removeprefix(_SPACE)


def gama_result(path: Path) -> GamaResult:
    """Parse NAME.xml (a file of our own data, no stranger's)."""
    root = ET.parse(path).getroot()
    summary = _of(root, "network-processing-summary")
    coordinates = _of(root, "coordinates")
    adjusted = _points(_of(coordinates, "adjusted"))
    stations = [(o.find(_SPACE + "id").text, "orientation") for o in _of(coordinates, "orientation-shifts")]
    names = [*adjusted, *stations]
    return GamaResult(
        _points(_of(coordinates, "approximate")) | _points(_of(coordinates, "fixed")),
        adjusted,
        names,
        _cov(_of(coordinates, "cov-mat"), names),
        int(_number(summary, "project-equations/degrees-of-freedom")),
        int(_number(summary, "project-equations/defect")),
        _number(summary, "project-equations/sum-of-squares"),
        _number(summary, "standard-deviation/apriori"),
        _number(summary, "standard-deviation/aposteriori"),
        _of(summary, "standard-deviation/used").text.strip(),
        [_row(o) for o in (_of(root, "observations") if _of(root, "observations") is not None else [])],
    )


def _points(section) -> dict[tuple[str, str], float]:
    out = {}
    for point in section:
        name = point.find(_SPACE + "id").text
        for child in point:
            if _tag(child).lower() in "xyz" and _tag(child) != "id":
                out[name, _tag(child).lower()] = float(child.text)
    return out


def _cov(section, names) -> FloatArray:
    n, band = int(_number(section, "dim")), int(_number(section, "band"))
    flat = np.array([float(e.text) for e in section.findall(_SPACE + "flt")])
    unit = np.array([CC if axis == "orientation" else 1e-3 for _, axis in names])
    out, first = np.full((n, n), np.nan), 0
    for i in range(n):
        k = min(band + 1, n - i)
        out[i, i : i + k] = out[i : i + k, i] = flat[first : first + k]
        first += k
    assert first == len(flat), "the covariance's band is not what dim and band say"
    return out * np.outer(unit, unit)


def _row(o) -> GamaRow:
    kind = _tag(o)
    unit, small = (GON, CC) if kind in _ANGULAR else (1.0, 1e-3)
    texts = {_tag(child): child.text for child in o}
    ends = tuple(texts[k] for k in ("from", "to", "left", "right", "id") if k in texts)
    standardized = float(texts["std-residual"]) if "std-residual" in texts else None
    return GamaRow(
        kind, ends, float(texts["obs"]) * unit, float(texts["adj"]) * unit, float(texts["stdev"]) * small,
        float(texts["qrr"]), float(texts["f"]), standardized,
    )  # fmt: skip
