"""The working sheet of an alignment: how far a body is off, which way to turn it, and whether that is worth turning.

A body is aligned with another frame when ``onto_from_body`` is the rotation wanted. What is off is the small rotation
w, about the body's own axes, that the body has too much: ``onto_from_body = wanted * exp(w)``. Turning the body by -w
aligns it: a foot at (x, y) of the body, which stands too high by ``(w x p)_z = y w_x - x w_y``, goes down by that.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from gtsam import Rot3

from adjust.frames.tree import FrameTree
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray
from adjust.observations.factors import ChainPose
from adjust.precision.precision import precision_of
from adjust.testing.distributions import norm
from survey.project.project import AlignmentTask
from survey.solution.quantities import SigmaKind, scale_of

State = Literal["aligned", "turn", "measure", "held"]
ARCSEC = math.pi / 648000.0
STATES: Mapping[State, str] = {
    "aligned": "aligned", "turn": "to be turned", "measure": "not told well enough", "held": "held, not measured",
}  # fmt: skip


@frozen
class AxisState:
    """What is off about one axis of the body: angle and sigma (rad); ``uncertainty`` is that of the stated level."""

    axis: str
    angle: float
    sigma: float
    uncertainty: float
    state: State


@frozen
class FootMove:
    """How far a foot is to move along the body's z axis (m), against the one that stays, and in turns of its screw."""

    name: str
    move: float
    sigma: float
    turns: float | None
    stays: bool


@frozen(eq=False)
class Sheet:
    """One alignment: w (3,) rad with covariance (3, 3), what it means about each axis and at each foot.

    upwards: cosine between the body's z axis and the plumb line; above 0.7 its feet are raised, below -0.7 lowered.
    level: probability of the uncertainties. reach: m, from the body's origin to its farthest foot or point.
    """

    task: AlignmentTask
    off: FloatArray
    cov: FloatArray
    axes: tuple[AxisState, ...]
    feet: tuple[FootMove, ...]
    upwards: float
    level: float
    reach: float

    @property
    def state(self) -> State:
        """The worst about any axis: what is significantly off goes first."""
        states = {axis.state for axis in self.axes}
        return "turn" if "turn" in states else "measure" if "measure" in states else "aligned"


def working_sheets(
    adjustment: Adjustment, tasks: tuple[AlignmentTask, ...], alpha: float = 0.05, sigmas: SigmaKind | None = None
) -> tuple[Sheet, ...]:
    """A sheet for every task; where no ``sigmas`` are asked for a priori, times sigma0 only where that is above 1.

    Raises SurveyError where the survey observes nothing of a body.
    """
    factor = scale_of(adjustment, sigmas).factor
    return tuple(_sheet(adjustment, task, alpha, factor if sigmas else max(1.0, factor)) for task in tasks)


def _sheet(adjustment: Adjustment, task: AlignmentTask, alpha: float, factor: float) -> Sheet:
    onto_from_body, cov = relative_rotation(adjustment, task.body, task.onto)
    D = np.zeros((3, 3), order="F")
    off = np.asarray(Rot3.Logmap(task.onto_from_body.between(onto_from_body), D))
    if np.linalg.norm(off) > np.radians(20.0):
        raise SurveyError(
            f"align.{task.task_id}: the body is {np.degrees(np.linalg.norm(off)):.0f} deg off, which is no error of "
            "alignment; give the rotation that is wanted as align.rotation_euler_xyz_deg"
        )
    cov = factor**2 * D @ cov @ D.T
    k = float(norm.isf(alpha / 2))
    axes = tuple(_axis_state(axis, float(off[i]), float(cov[i, i]) ** 0.5, k, task) for i, axis in enumerate("xyz"))
    to_world, _ = relative_rotation(adjustment, task.body, FrameRef("world"))
    up = np.asarray(adjustment.survey.vertical.up_in_world, dtype=float)
    return Sheet(
        task, off, cov, axes, _foot_moves(task, off, cov), float(to_world.matrix()[:, 2] @ up), 1.0 - alpha,
        _reach(adjustment, task),
    )  # fmt: skip


def relative_rotation(adjustment: Adjustment, a: FrameRef, b: FrameRef) -> tuple[Rot3, FloatArray]:
    """The adjusted rotation ``b_from_a`` and its covariance (3, 3), in a."""
    precision = precision_of(adjustment)
    graph, values = precision.graph, precision.solved.values
    u = graph.unknowns
    before = len(u.by_name), len(u.slot_key)
    chain = FrameTree(graph.survey, u).relative(a, b)
    if len(u.by_name) != before[0]:
        new = " ".join(list(u.by_name)[-1])
        raise SurveyError(f"{new}: no observation touches it; measure its levels or laser spots, or hold it")
    if len(u.slot_key) != before[1]:  # a held frame that nothing else needed: its value is all there is
        held = np.eye(3)
        for link in chain:
            if u.slot_key[link.slot] is not None or link.slot in u.table_slots:
                raise SurveyError(f"{a.kind} {a.frame_id}: no observation touches it; measure its levels, or hold it")
            R = u.slot_pose[link.slot].rotation().matrix()
            held = held @ (R.T if link.inverse else R)
        return Rot3(held), np.zeros((3, 3))
    pose, jacobians = ChainPose(u, graph.state, chain)(values)
    if not jacobians:
        return pose.rotation(), np.zeros((3, 3))
    by_key: dict[int, FloatArray] = {}
    for key, J in jacobians:
        by_key[key] = by_key[key] + J[:3] if key in by_key else J[:3]
    A = np.hstack(list(by_key.values()))
    Q = precision.joint([u.by_key[key].name for key in by_key])
    return pose.rotation(), np.asarray(A @ Q @ A.T)


def _axis_state(axis: str, angle: float, sigma: float, k: float, task: AlignmentTask) -> AxisState:
    uncertainty = k * sigma
    state: State
    if sigma < 1e-8:  # a thousandth of an arcsecond: kept at its value, not measured
        state = "held"
    elif task.tolerance is not None and abs(angle) + uncertainty <= task.tolerance:
        state = "aligned"
    elif abs(angle) > uncertainty:
        state = "turn"
    else:
        state = "aligned" if task.tolerance is None else "measure"
    return AxisState(axis, angle, sigma, uncertainty, state)


def _foot_moves(task: AlignmentTask, off: FloatArray, cov: FloatArray) -> tuple[FootMove, ...]:
    """Against the foot that stands highest along the body's z axis, so that all others move up to it."""
    if not task.feet:
        return ()
    heights = [f.y * off[0] - f.x * off[1] for f in task.feet]
    stays = int(np.argmax(heights))
    moves = []
    for i, foot in enumerate(task.feet):
        pivot = task.feet[stays]
        row = np.array([pivot.y - foot.y, foot.x - pivot.x, 0.0])
        move = float(row @ off)
        turns = move / task.pitch if task.pitch else None
        moves.append(FootMove(foot.name, move, float(np.sqrt(row @ cov @ row)), turns, i == stays))
    return tuple(moves)


def _reach(adjustment: Adjustment, task: AlignmentTask) -> float:
    """Distance in the body's plane from its origin to the farthest foot, else to a target's farthest point."""
    xy = np.array([(f.x, f.y) for f in task.feet])
    for target in adjustment.survey.targets:
        if not len(xy) and task.body.kind == "target" and target.target_id == task.body.frame_id:
            xy = np.asarray(target.x_in_target)[:, :2]
    return float(np.linalg.norm(xy, axis=1).max()) if len(xy) else 0.0


def angle_text(angle: float) -> str:
    """A small angle as people read it: arcseconds, beyond a tenth of a degree degrees."""
    return f"{angle / ARCSEC:.1f}″" if abs(angle) < math.radians(0.1) else f"{math.degrees(angle):.4f}°"


def steps(sheet: Sheet) -> list[str]:
    """What the operator is to do, in order; nothing where the body is aligned."""
    out = []
    by_axis = {axis.axis: axis for axis in sheet.axes}
    name = f"{sheet.task.body.kind} {sheet.task.body.frame_id}"
    if any(by_axis[a].state == "turn" for a in "xy"):
        if sheet.feet:
            fixed = next(foot.name for foot in sheet.feet if foot.stays)
            out.append(f"Leave the foot {fixed} as it is.")
            out += [_foot_text(sheet, foot) for foot in sheet.feet if not foot.stays]
        else:
            out += [_axis_text(name, by_axis[a], sheet) for a in "xy" if by_axis[a].state == "turn"]
    if by_axis["z"].state == "turn":
        out.append(_axis_text(name, by_axis["z"], sheet))
    for axis in sheet.axes:
        if axis.state == "measure":
            tolerance = angle_text(sheet.task.tolerance or 0.0)
            out.append(
                f"Measure better about the {axis.axis} axis: {angle_text(axis.angle)} ± {angle_text(axis.uncertainty)} "
                f"can neither be told from zero nor from the tolerance of {tolerance}."
            )
    if any(axis.state == "turn" for axis in sheet.axes):
        out.append("Measure again and call labsurvey align once more.")
    return out


def _foot_text(sheet: Sheet, foot: FootMove) -> str:
    verb = "Raise" if sheet.upwards > 0.7 else "Lower" if sheet.upwards < -0.7 else "Move along +z"
    turns = "" if foot.turns is None else f", {foot.turns:.2f} turns of its screw"
    if abs(foot.move) < 2.0 * foot.sigma:
        return f"Leave the foot {foot.name}: {1e3 * foot.move:.3f} ± {1e3 * foot.sigma:.3f} mm is not significant."
    return f"{verb} the foot {foot.name} by {1e3 * foot.move:.3f} mm (± {1e3 * foot.sigma:.3f} mm){turns}."


def _axis_text(name: str, axis: AxisState, sheet: Sheet) -> str:
    """Turning back what is too much: seen against the axis, a positive angle too much means clockwise."""
    way = "clockwise" if axis.angle > 0 else "counter-clockwise"
    seen = {
        "x": "looking against its x axis (which points at you)",
        "y": "looking against its y axis (which points at you)",
        "z": "seen from its front (its z axis points at you)",
    }[axis.axis]
    reach = abs(axis.angle) * sheet.reach
    edge = f": {1e3 * reach:.2f} mm at {1e3 * sheet.reach:.0f} mm from its origin" if reach and axis.axis == "z" else ""
    size = f"{angle_text(abs(axis.angle))} (± {angle_text(axis.sigma)})"
    return f"Turn {name} {way} by {size}, {seen}{edge}."


def sheet_text(sheets: Sequence[Sheet]) -> str:
    """For the terminal."""
    lines = []
    for sheet in sheets:
        task = sheet.task
        head = f"{task.task_id}: {task.body.kind} {task.body.frame_id} onto {task.onto.kind} {task.onto.frame_id}"
        lines.append(f"{head}: {STATES[sheet.state]}")
        lines.append(f"  {'axis':<5}{'off':>12}{'sigma':>10}{f'{sheet.level:.0%} ±':>10}")
        for axis in sheet.axes:
            values = (angle_text(axis.angle), angle_text(axis.sigma), angle_text(axis.uncertainty))
            lines.append(f"  {axis.axis:<5}{values[0]:>12}{values[1]:>10}{values[2]:>10}  {STATES[axis.state]}")
        lines += [f"  {i}. {step}" for i, step in enumerate(steps(sheet), 1)]
    return "\n".join(lines)
