"""The tables [tolerances.NAME] of ``survey.toml``: what the project demands of its results."""

from typing import Any

from survey.files.declarations import keys_of
from survey.files.node import Node
from survey.files.project import DEMANDED, POSITION, ROTATION, Tolerance
from survey.files.toml_text import Section
from survey.files.units import from_si, to_si

_UNITS = ("mm", "arcsec", "deg", "px", "1")
_SAID = {POSITION: ("mm",), ROTATION: ("arcsec", "deg")}


def read_tolerances(root: Node) -> tuple[Tolerance, ...]:
    """All demands, in the order of the file. Raises SurveyError."""
    return tuple(_read(name, node) for name, node in root.tables("tolerances"))


def _read(name: str, node: Node) -> Tolerance:
    node.allow(*keys_of("tolerance"))
    for key in ("expanded", "nominal", "tolerance"):
        given = [full for unit in _UNITS if node.has(full := key if unit == "1" else f"{key}_{unit}")]
        if len(given) > 1 and not (key == "expanded" and not node.has("component")):  # which has its own words for it
            raise node.error(f"{given[0]} is given too; keep one of the two", given[1])
    of = node.choice("of", DEMANDED)
    ids = node.names("ids", ())
    if node.has("component"):
        component = node.text("component")
        expanded, nominal, within = (_given(node, key, None) for key in ("expanded", "nominal", "tolerance"))
        if expanded is None and within is None:
            raise node.error("nothing is demanded; add tolerance_UNIT (with nominal_UNIT) or expanded_UNIT")
        if nominal is not None and within is None:
            raise node.error("a nominal value needs a tolerance; add tolerance_UNIT")
        return Tolerance(name, of, ids, component, expanded, nominal, within)
    quantity = POSITION if _given(node, "expanded", _SAID[POSITION]) is not None else ROTATION
    largest = _given(node, "expanded", _SAID[quantity])
    if largest is None:
        raise node.error("nothing is demanded; add expanded_mm (of position) or expanded_arcsec (of rotation)")
    if quantity == POSITION and _given(node, "expanded", _SAID[ROTATION]) is not None:
        raise node.error("expanded_mm and an angle are both given; make two tolerances of them")
    for key in ("nominal", "tolerance"):
        if _given(node, key, None) is not None:
            raise node.error(f"{key} is about one component; name it with 'component'")
    return Tolerance(name, of, ids, quantity, largest)


def _given(node: Node, key: str, units: tuple[str, ...] | None) -> float | None:
    """The value under ``key_unit``, or under ``key`` for one without unit, in SI."""
    for unit in units or _UNITS:
        full = key if unit == "1" else f"{key}_{unit}"
        if node.has(full):
            value = node.number(full, positive=key != "nominal")
            return value if unit in ("px", "1") else float(to_si(value, unit))
    return None


def tolerance_sections(tolerances: tuple[Tolerance, ...]) -> list[Section]:
    """The inverse of :func:`read_tolerances`; components are written in the unit that their name has in results."""
    sections: list[Section] = []
    for x in tolerances:
        values: dict[str, Any] = {"of": x.of} | ({"ids": x.ids} if x.ids else {})
        if x.quantity in _SAID:
            unit = _SAID[x.quantity][0]
            values[f"expanded_{unit}"] = None if x.expanded is None else float(from_si(x.expanded, unit))
        else:
            values["component"] = x.quantity
            unit = _unit_of(x)
            for key, value in (("expanded", x.expanded), ("nominal", x.nominal), ("tolerance", x.within)):
                if value is not None:
                    shown = value if unit in ("px", "1") else float(from_si(value, unit))
                    values[key if unit == "1" else f"{key}_{unit}"] = shown
        sections.append((("tolerances", x.name), values))
    return sections


def _unit_of(x: Tolerance) -> str:
    if x.of == "table_geometry":
        return "mm" if x.quantity == "axis_offset" else "arcsec"
    return "px" if x.quantity in ("fx", "fy", "u0", "v0", "skew") else "1"
