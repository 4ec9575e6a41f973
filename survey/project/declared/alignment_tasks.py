"""What is to be aligned: the tables [align.*] of ``survey.toml``, read and written."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from gtsam import Rot3

from adjust.model.survey import Survey
from survey.folder.units import from_si, to_si
from survey.project.declared.declarations import keys_of
from survey.project.declared.node import Node
from survey.project.declared.poses import quaternion_wxyz, rotation_from_euler, rotation_from_quaternion
from survey.project.declared.toml_text import Section
from survey.project.project import AlignmentTask, Foot
from survey.project.tables.references import NameProblemError, Names, check_epochs, frame_text, read_frame

_ROTATIONS = ("rotation_quaternion_wxyz", "rotation_euler_xyz_deg")


def read_alignment_tasks(root: Node, survey: Survey) -> tuple[AlignmentTask, ...]:
    """The tables [align.*]."""
    names = Names.of(survey)
    tasks = []
    for task_id, node in root.tables("align"):
        node.allow(*keys_of("align"))
        frames = []
        for key in ("body", "onto"):
            try:
                frame = read_frame(node.text(key), names)
                check_epochs(frame, None, names)
            except NameProblemError as problem:
                raise node.error(str(problem), key) from problem
            frames.append(frame)
        if frames[0] == frames[1]:
            raise node.error("body and onto are the same; name the frame that the body is to be aligned with", "onto")
        feet_node = node.table("feet_mm")
        feet = tuple(Foot(name, *to_si(feet_node.numbers(name, (2,)), "mm").tolist()) for name in feet_node.values)
        if feet and (len(feet) < 3 or np.linalg.matrix_rank(np.diff([(f.x, f.y) for f in feet], axis=0), 1e-9) < 2):
            raise node.error(f"found {len(feet)} feet; three that are not in a row make a plane", "feet_mm")
        pitch = to_si(node.number("pitch_mm", positive=True), "mm") if node.has("pitch_mm") else None
        tolerance = None
        if node.has("tolerance_arcsec"):
            tolerance = float(to_si(node.number("tolerance_arcsec", positive=True), "arcsec"))
        tasks.append(
            AlignmentTask(task_id, frames[0], frames[1], _wanted(node), feet, None if pitch is None else float(pitch),
                          tolerance)
        )  # fmt: skip
    return tuple(tasks)


def _wanted(node: Node) -> Rot3:
    if all(node.has(key) for key in _ROTATIONS):
        raise node.error("the rotation is given twice; keep the quaternion or the Euler angles", _ROTATIONS[1])
    if node.has(_ROTATIONS[1]):
        return rotation_from_euler(to_si(node.numbers(_ROTATIONS[1], (3,)), "deg"))
    if not node.has(_ROTATIONS[0]):
        return Rot3()
    rotation = rotation_from_quaternion(node.numbers(_ROTATIONS[0], (4,)))
    if rotation is None:
        raise node.error("the quaternion has not the length 1; correct it (w first)", _ROTATIONS[0])
    return rotation


def task_sections(tasks: Iterable[AlignmentTask]) -> list[Section]:
    """The tables that ``read_alignment_tasks`` reads."""
    sections: list[Section] = []
    for task in tasks:
        values: dict[str, Any] = {"body": frame_text(task.body), "onto": frame_text(task.onto)}
        if not task.onto_from_body.equals(Rot3(), 0.0):
            values["rotation_quaternion_wxyz"] = quaternion_wxyz(task.onto_from_body)
        if task.feet:
            values["feet_mm"] = {f.name: from_si([f.x, f.y], "mm").tolist() for f in task.feet}
        if task.pitch is not None:
            values["pitch_mm"] = float(from_si(task.pitch, "mm"))
        if task.tolerance is not None:
            values["tolerance_arcsec"] = float(from_si(task.tolerance, "arcsec"))
        sections.append((("align", task.task_id), values))
    return sections
