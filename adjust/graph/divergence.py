"""What to say of an adjustment that did not arrive: what moved away, and which observations fit worst, by group."""

from itertools import pairwise

import gtsam
import numpy as np
from gtsam import Pose3

from adjust.frames.unknowns import Unknown
from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.datum import normal_diagonal, stacking, visible_keys
from adjust.graph.rank import readable
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.observations import position_text
from adjust.model.stopped import GroupFit, Pull, Stopped, UnknownState
from adjust.model.survey import FloatArray

_GROUPS, _OWNERS, _MOVED = 4, 3, 4
_BY_FAR = 9.0
"""Mean square over that of the next, from which an owner stands out."""
_MISFIT = 16.0
"""Mean squares over their variance from which a group or one of its owners is named: four sigmas."""


@frozen
class Misfit:
    """One observation: its group, whom it belongs to (a setup, a camera, itself), its name, and v'Pv per component."""

    group: str
    owner: str
    text: str
    square: float


def stopped_at(
    graph: AdjustmentGraph, start: gtsam.Values, values: gtsam.Values, iterations: int, omega: float, last_step: float
) -> Stopped:
    """The state, the gradient by kinds of unknowns and the fit of every group, the worst first."""
    before, after = (_by_group(misfits(graph, at)) for at in (start, values))
    groups = [
        GroupFit(name, len(mine), _rms(before.get(name, [])), _rms(mine),
                 tuple((o, float(np.sqrt(s))) for o, s in _owners(mine)[:_OWNERS]))
        for name, mine in after.items()
    ]  # fmt: skip
    every = graph.unknowns.by_name.values()
    unknowns = tuple(UnknownState(u.name, u.components, u.units, _value(u, start), _value(u, values)) for u in every)
    return Stopped(iterations, omega, last_step, tuple(sorted(groups, key=lambda g: -g.where_stopped)),
                   _gradient(graph, values), unknowns)  # fmt: skip


def _value(u: Unknown, values: gtsam.Values) -> Pose3 | FloatArray:
    if u.kind == "pose":
        return values.atPose3(u.key)
    return np.asarray(values.atPoint3(u.key) if u.kind == "point" else values.atVector(u.key), dtype=float)


def _gradient(graph: AdjustmentGraph, values: gtsam.Values) -> tuple[Pull, ...]:
    """Over the root of the diagonal of the normal matrix; empty where the system cannot be set up there."""
    try:
        linear = graph.linearized(graph.prepare(values, True, 0.0, False))
        stack = stacking(graph, visible_keys(graph, linear))
        down, scale = linear.gradientAtZero(), np.sqrt(np.maximum(normal_diagonal(linear, stack), 1e-300))
    except (SurveyError, RuntimeError):  # the latter from GTSAM, of what is not finite
        return ()
    every_pull = ((graph.unknowns.by_key[key], np.abs(down.at(key)) / scale[at]) for key, at in stack.at.items())
    pulls, found = grouped((u.name[0], (u, pull)) for u, pull in every_pull), []
    for kind, mine in pulls.items():
        every = np.concatenate([pull for _, pull in mine])
        u, most = max(mine, key=lambda item: float(np.max(item[1])))
        found.append(Pull(kind, len(every), float(np.sqrt(np.mean(every**2))), (readable(u), float(np.max(most)))))
    return tuple(sorted(found, key=lambda p: -p.largest[1]))


def _rms(found: list[Misfit]) -> float:
    return float(np.sqrt(np.mean([m.square for m in found]))) if found else 0.0


def _by_group(found: list[Misfit]) -> dict[str, list[Misfit]]:
    return grouped((m.group, m) for m in found)


def describe_divergence(graph: AdjustmentGraph, start: gtsam.Values, values: gtsam.Values) -> list[str]:
    """Lines for people: chi-square, what moved farthest from the start, the worst observations there and here.

    The start is named first: a group that is wrong stands out there, before the adjustment has spread its error.
    """
    before, after = misfits(graph, start), misfits(graph, values)
    n = max(1, len(after))
    first = _stands_out(before)
    rms = [_rms(side) for side in (before, after)]
    lines = [] if first is None else [first]
    lines += [
        f"the observations miss by {rms[0]:.3g} of their sigmas (root mean square of {n}) at the start values, "
        f"by {rms[1]:.3g} where it stopped"
    ]
    moved = farthest(graph, start, values)
    if moved:
        lines.append(f"farthest from their start values: {', '.join(moved)}")
    lines += [f"at the start values: {line}" for line in worst_by_group(before)]
    lines += [f"where it stopped: {line}" for line in worst_by_group(after)]
    return lines


def _stands_out(found: list[Misfit]) -> str | None:
    """The one owner whose observations fit far worse at the start than those of any other; None where none does."""
    owners = [o for o in _owners(found) if np.isfinite(o[1])]
    if len(owners) < 2 or owners[0][1] < _MISFIT or owners[0][1] < _BY_FAR * owners[1][1]:
        return None
    (owner, square), (_, after) = owners[:2]
    return (
        f"look first at {owner}: at the start values its observations miss by {np.sqrt(square):.3g} sigmas, those of "
        f"any other by {np.sqrt(after):.3g} at most"
    )


def worst_by_group(found: list[Misfit]) -> list[str]:
    """A line for each group that does not fit, the worst first: its misfit, its worst owners and observation."""
    groups = _by_group(found)
    mean = {group: float(np.mean([m.square for m in mine])) for group, mine in groups.items()}
    lines = []
    for group in sorted((g for g in groups if mean[g] > _MISFIT), key=lambda g: -mean[g])[:_GROUPS]:
        worst = max(groups[group], key=lambda m: m.square)
        owners = _owners(groups[group])
        shown = ", ".join(f"{owner} ({np.sqrt(value):.3g})" for owner, value in owners[:_OWNERS])
        lines.append(
            f"group {group} misses by {np.sqrt(mean[group]):.3g} sigmas; worst: {shown}; "
            f"of single observations {worst.text} ({np.sqrt(worst.square):.3g})"
        )
    return lines


def _owners(found: list[Misfit]) -> list[tuple[str, float]]:
    """Owners with the mean of their squares, the largest first."""
    squares = grouped((m.owner, m.square) for m in found)
    mean = [(owner, float(np.mean(values))) for owner, values in squares.items()]
    return sorted(mean, key=lambda item: (-item[1], item[0]))


def misfits(graph: AdjustmentGraph, values: gtsam.Values) -> list[Misfit]:
    """Every observation in use at ``values``; image points by image. Empty where the values cannot be evaluated."""
    try:
        squares = graph.whitened_squares(values)
    except SurveyError:
        return []
    out, used = [], graph.used()
    for block, (i, j) in zip(graph.survey.image_blocks, pairwise(graph.survey.image_points.ptr), strict=True):
        mine = squares[i:j][used[i:j]]
        if len(mine):
            text = f"camera {block.camera_id} at epoch {block.epoch_id}, target {block.target_id or 'points'}"
            out.append(Misfit(block.group, f"camera {block.camera_id}", text, float(mine.mean()) / 2.0))
    for item in graph.others:
        if item.used:
            square = 2.0 * float(item.factor.error(values)) / max(1, len(item.components))
            name = item.ids[0] if item.kind != "prior" else " ".join(item.ids)
            out.append(Misfit(item.group, f"{item.kind} {name}", " ".join((item.kind, *item.ids)), square))
    return [m for m in out + _reading_misfits(graph, values) if np.isfinite(m.square)]


def _reading_misfits(graph: AdjustmentGraph, values: gtsam.Values) -> list[Misfit]:
    batch, out = graph.terrestrial, []
    if batch is None:
        return []
    e, used = batch.unweighted(values) ** 2, batch.used
    for i, r in enumerate(graph.survey.readings):
        if used[i]:
            owner = f"setup {r.setup_id}" if r.setup_id else f"{r.kind} from {position_text(r.at)}"
            text = f"{r.kind} {r.reading_id} {position_text(r.at)} {position_text(r.to)}"
            out.append(Misfit(r.group, owner, text, float(e[i])))
    return out


def farthest(graph: AdjustmentGraph, start: gtsam.Values, values: gtsam.Values) -> list[str]:
    """The points and poses that moved farthest, then those that turned farthest, with how far."""
    rows: list[tuple[float, float, Unknown]] = []
    for u in graph.unknowns.by_name.values():
        if u.kind == "point":
            rows.append((float(np.linalg.norm(values.atPoint3(u.key) - start.atPoint3(u.key))), 0.0, u))
        elif u.kind == "pose":
            a, b = start.atPose3(u.key), values.atPose3(u.key)
            turn = float(np.linalg.norm(a.rotation().localCoordinates(b.rotation())))
            rows.append((float(np.linalg.norm(b.translation() - a.translation())), turn, u))
    shifts = sorted(rows, key=lambda row: -row[0])[:_MOVED]
    turns = sorted((row for row in rows if row[1] > np.radians(1.0)), key=lambda row: -row[1])[:2]
    out = [f"{readable(u)} by {1e3 * shift:.4g} mm" for shift, _, u in shifts if shift > 0.0]
    return out + [f"{readable(u)} by {np.degrees(turn):.3g} deg" for _, turn, u in turns]
