"""How a project is adjusted and what it demands: [adjustment], [closures], [identification], [tolerances], [align]."""

from collections.abc import Iterable
from typing import Literal

import numpy as np
from gtsam import Rot3

from adjust.model.observations import Closure, frame_text
from adjust.model.survey import Survey
from adjust.model.tables import unit_of
from survey.folder.units import from_si, to_si
from survey.project.declared.node import Node
from survey.project.declared.poses import quaternion_wxyz, read_rotation
from survey.project.declared.toml_text import Section, in_units
from survey.project.project import (
    DEMANDED,
    POSITION,
    ROTATION,
    SIGMA_KINDS,
    AdjustmentOptions,
    AlignmentTask,
    Foot,
    Tolerance,
)
from survey.project.tables.references import Names, timed_frame

_UNITS = ("mm", "arcsec", "deg", "px", "1")
_SAID = {POSITION: ("mm",), ROTATION: ("arcsec", "deg")}


def read_options(root: Node) -> AdjustmentOptions:
    """The tables [adjustment], [closures], [tolerances] and [identification]. Raises SurveyError."""
    node, said = root.table("adjustment"), root.table("identification")
    flags = {n: node.flag(n) for n in ("reject_blocks", "reject_points", "reject_pairs", "variance_components")}
    form, closures = _closures(root)
    return AdjustmentOptions(
        _probability(node, "alpha"), **flags, pairs=form, closures=closures,
        sigmas=node.choice("sigmas", SIGMA_KINDS) if node.has("sigmas") else None,
        tolerances=tuple(_tolerance(name, node) for name, node in root.tables("tolerances")),
        identification=tuple((key, said.text(key)) for key in said.values),
        alpha0=_probability(node, "alpha0") if node.has("alpha0") else None, power=_probability(node, "power"),
    )  # fmt: skip


def _probability(node: Node, key: str) -> float:
    value = node.number(key)
    if value >= 1:
        raise node.error(f"found {value:g}; it is a probability, between 0 and 1", key)
    return value


def _tolerance(name: str, node: Node) -> Tolerance:
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
            return node.si(full)
    return None


def tolerance_sections(tolerances: tuple[Tolerance, ...]) -> list[Section]:
    """The inverse of :func:`read_options`; components are written in the unit that their name has in results."""
    sections: list[Section] = []
    for x in tolerances:
        values: dict[str, object] = in_units(of=x.of, ids=x.ids)
        if x.quantity in _SAID:
            values |= in_units(**{f"expanded_{_SAID[x.quantity][0]}": x.expanded})
        else:
            said, unit = {"expanded": x.expanded, "nominal": x.nominal, "tolerance": x.within}, _unit_of(x)
            keys = {key if unit == "1" else f"{key}_{unit}": value for key, value in said.items()}
            values |= {"component": x.quantity} | in_units(**keys)
        sections.append((("tolerances", x.name), values))
    return sections


def _unit_of(x: Tolerance) -> str:
    if x.of == "table_geometry":
        return "mm" if unit_of(x.quantity) == "m" else "arcsec"
    return "px" if x.quantity in ("fx", "fy", "u0", "v0", "skew") else "1"


FORMS: tuple[Literal["poses", "closed"], ...] = ("poses", "closed")


def _closures(root: Node) -> tuple[Literal["poses", "closed"], tuple[Closure, ...]]:
    """The form and all mounts, in the order of the file. Raises SurveyError."""
    form = root.table("adjustment").choice("pairs", FORMS)
    closures = tuple(_closure(name, node) for name, node in root.tables("closures"))
    if closures and form != "closed":
        raise root.table("closures").error('a mount closes a loop only where loops are; write [adjustment] pairs = '
                                           '"closed"', closures[0].closure_id)  # fmt: skip
    return form, closures


def _closure(name: str, node: Node) -> Closure:
    along = node.number("sigma_mm")
    if along < 0.0:
        raise node.error(f"found {along:g}; a sigma is not negative", "sigma_mm")
    return Closure(name, node.names("pairs"), node.si("sigma_arcsec"), node.si("sigma_mm"))


def closure_sections(closures: tuple[Closure, ...]) -> list[Section]:
    """The inverse of :func:`read_options`."""
    return [(("closures", c.closure_id),
             in_units(pairs=c.pair_ids, sigma_arcsec=c.rotation_sigma, sigma_mm=c.translation_sigma))
            for c in closures]  # fmt: skip


def read_alignment_tasks(root: Node, survey: Survey) -> tuple[AlignmentTask, ...]:
    """The tables [align.*]."""
    names = Names.of(survey)
    tasks = []
    for task_id, node in root.tables("align"):
        frames = [timed_frame(node.text(key), names, node.fail(key)) for key in ("body", "onto")]
        if frames[0] == frames[1]:
            raise node.error("body and onto are the same; name the frame that the body is to be aligned with", "onto")
        feet_node = node.table("feet_mm")
        feet = tuple(Foot(name, *to_si(feet_node.numbers(name, (2,)), "mm").tolist()) for name in feet_node.values)
        if feet and (len(feet) < 3 or np.linalg.matrix_rank(np.diff([(f.x, f.y) for f in feet], axis=0), 1e-9) < 2):
            raise node.error(f"found {len(feet)} feet; three that are not in a row make a plane", "feet_mm")
        tasks.append(AlignmentTask(task_id, frames[0], frames[1], read_rotation(node) or Rot3(), feet,
                                   node.si("pitch_mm", None), node.si("tolerance_arcsec", None)))  # fmt: skip
    return tuple(tasks)


def task_sections(tasks: Iterable[AlignmentTask]) -> list[Section]:
    """The tables that ``read_alignment_tasks`` reads."""
    sections: list[Section] = []
    for task in tasks:
        turned = not task.onto_from_body.equals(Rot3(), 0.0)
        values = in_units(
            body=frame_text(task.body), onto=frame_text(task.onto),
            rotation_quaternion_wxyz=quaternion_wxyz(task.onto_from_body) if turned else None,
            feet_mm={f.name: from_si([f.x, f.y], "mm").tolist() for f in task.feet}, pitch_mm=task.pitch,
            tolerance_arcsec=task.tolerance,
        )  # fmt: skip
        sections.append((("align", task.task_id), values))
    return sections
