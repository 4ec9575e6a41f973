"""The working sheet of an alignment as text and as one HTML page with a drawing; it computes nothing."""

import math
from collections.abc import Sequence

from survey.jobs.working_sheet import ARCSEC, AxisState, FootMove, Sheet
from survey.report import drawing as d
from survey.report.document import document
from survey.report.markup import esc

ROUND_COLUMNS = ("date", "task", "state", "x_arcsec", "y_arcsec", "z_arcsec", "sigma_x", "sigma_y", "sigma_z")
_STATES = {
    "aligned": "aligned",
    "turn": "to be turned",
    "measure": "not told well enough",
    "held": "held, not measured",
}
_CSS = """
ol { font-size: 1.15em; } li { margin: .4em 0; } td, th { text-align: right; }
td:first-child, th:first-child { text-align: left; }
.state { padding: .1em .8em; border-radius: 1em; font-size: 14px; font-weight: 600; white-space: nowrap; }
.aligned { background: var(--good-pill); color: var(--good); } .turn { background: var(--bad-pill); color: var(--bad); }
.measure { background: var(--warn-pill); color: var(--warn); }
.held { background: var(--plain-back); color: var(--plain); }
@media print { .state { border: 1px solid currentColor; } }
"""


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
        lines.append(f"{head}: {_STATES[sheet.state]}")
        lines.append(f"  {'axis':<5}{'off':>12}{'sigma':>10}{f'{sheet.level:.0%} ±':>10}")
        for axis in sheet.axes:
            values = (angle_text(axis.angle), angle_text(axis.sigma), angle_text(axis.uncertainty))
            lines.append(f"  {axis.axis:<5}{values[0]:>12}{values[1]:>10}{values[2]:>10}  {_STATES[axis.state]}")
        lines += [f"  {i}. {step}" for i, step in enumerate(steps(sheet), 1)]
    return "\n".join(lines)


def sheet_html(sheets: Sequence[Sheet], title: str, date: str, rounds: Sequence[Sequence[str]] = ()) -> str:
    """One page that needs nothing but itself; ``rounds`` are rows of ``ROUND_COLUMNS``, oldest first."""
    parts = [f'<style>{_CSS}</style><h1>{esc(title)}: alignment</h1><p class="meta">{esc(date)}</p>']
    parts += [_sheet_html(sheet, [row for row in rounds if row[1] == sheet.task.task_id]) for sheet in sheets]
    return document(f"{title}: alignment", "".join(parts))


def _sheet_html(sheet: Sheet, rounds: Sequence[Sequence[str]]) -> str:
    task = sheet.task
    rows = "".join(
        f'<tr><td>{axis.axis}</td><td>{angle_text(axis.angle)}</td><td>{angle_text(axis.sigma)}</td>'
        f'<td>± {angle_text(axis.uncertainty)}</td><td><span class="state {axis.state}">{_STATES[axis.state]}</span>'
        "</td></tr>" for axis in sheet.axes
    )  # fmt: skip
    todo = steps(sheet)
    listed = "<ol>" + "".join(f"<li>{esc(step)}</li>" for step in todo) + "</ol>" if todo else "<p>Nothing to do.</p>"
    tolerance = "" if task.tolerance is None else f" Tolerance {angle_text(task.tolerance)} about each axis."
    past = "".join(
        "<tr>" + "".join(f"<td>{esc(cell)}</td>" for cell in (row[0], row[2], *row[3:6])) + "</tr>" for row in rounds
    )
    history = (
        '<h3>Rounds</h3><div class="t"><table><tr><th>Date</th><th>State</th><th>x ″</th><th>y ″</th><th>z ″</th></tr>'
        f"{past}</table></div>"
        if len(rounds) > 1
        else ""
    )
    return (
        f'<h2>{esc(task.task_id)} <span class="state {sheet.state}">{_STATES[sheet.state]}</span></h2>'
        f"<p>{esc(task.body.kind)} <b>{esc(task.body.frame_id)}</b> is to be parallel to {esc(task.onto.kind)} "
        f"<b>{esc(task.onto.frame_id)}</b>.{tolerance}</p>{listed}{drawing(sheet)}"
        f'<div class="t"><table><tr><th>Axis</th><th>Off by</th><th>σ</th><th>{sheet.level:.0%}</th><th></th></tr>'
        f"{rows}</table></div>"
        f'<p class="note">Off by: how far {esc(task.body.frame_id)} is turned about its own axis, right-handed.</p>'
        f"{history}"
    )


def drawing(sheet: Sheet) -> str:
    """The body seen from its front with what each foot has to move, and the turn about z."""
    if not sheet.feet:
        return ""
    at = {foot.name: (foot.x, foot.y) for foot in sheet.task.feet}
    xs, ys = [x for x, _ in at.values()], [y for _, y in at.values()]
    size = max(max(xs) - min(xs), max(ys) - min(ys))
    scale, margin = 300.0 / size, 70.0

    def place(x: float, y: float) -> tuple[float, float]:
        return margin + (x - min(xs)) * scale, margin + (max(ys) - y) * scale

    width, height = 2 * margin + (max(xs) - min(xs)) * scale, 2 * margin + (max(ys) - min(ys)) * scale
    outline = " ".join(f"{u:.1f},{v:.1f}" for u, v in (place(*at[name]) for name in at))
    parts = [
        '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0L10 5L0 10z" fill="{d.RED}"/></marker></defs>'
        f'<polygon points="{outline}" fill="{d.EMPTY}" stroke="{d.GREY}"/>'
    ]
    for foot in sheet.feet:
        u, v = place(*at[foot.name])
        text_v = v + 26 if v > height / 2 else v - 16  # beside the body, not on it
        label = "stays" if foot.stays else f"{1e3 * foot.move:+.2f} mm"
        colour = d.GREY if foot.stays else d.RED
        parts.append(
            d.dot(u, v, 9, colour) + d.text(u, text_v, f"{foot.name}: {label}", "middle", 15, d.INK)
        )
    z = next(axis for axis in sheet.axes if axis.axis == "z")
    if z.state == "turn":
        u, v, r = width / 2, height / 2, 45.0
        ends = ((u - r, v), (u + r, v)) if z.angle > 0 else ((u + r, v), (u - r, v))
        sweep = 1 if z.angle > 0 else 0  # in the picture y points down: 1 is clockwise
        parts.append(
            f'<path d="M{ends[0][0]:.1f} {ends[0][1]:.1f}A{r} {r} 0 0 {sweep} {ends[1][0]:.1f} {ends[1][1]:.1f}" '
            f'fill="none" stroke="{d.RED}" stroke-width="3" marker-end="url(#tip)"/>'
            + d.text(u, v + 5, angle_text(abs(z.angle)), "middle", 15, d.INK)
        )
    return d.svg(width, height, parts, "feet and moves")
