"""Readings, levels, alignments, laser spots, surfaces and differences of ``plan.toml``; values are predicted later."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from gtsam import Pose3

from adjust.design import Candidate
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.observations import (
    Alignment,
    CoordinateDifferences,
    LaserSpot,
    Level,
    OnSurface,
    PositionRef,
    Reading,
    position_text,
)
from adjust.model.survey import FloatArray, Survey
from survey.project.declared.instruments import setup_problem
from survey.project.declared.node import Node
from survey.project.declared.poses import read_pose
from survey.project.project import Accuracy, Project
from survey.project.tables.references import Names, read_position, timed_frame
from survey.project.tables.terrestrial import ANGLES, READING_KINDS

_MOST = 100_000  # of whatever is counted in one place: more nobody measures, and memory ends
_Count = TypeVar("_Count", int, float)
_KEYS = (
    *("setup", "from", "to", "second", "kinds", "sigma_arcsec", "sigma_mm", "instrument_height_mm"),
    "target_height_mm",
)


@dataclass(frozen=True, eq=False)
class Terrestrial:
    """Planned observations by field of the survey; sigmas of readings are nan where the instrument's hold."""

    readings: tuple[Reading, ...] = ()
    levels: tuple[Level, ...] = ()
    alignments: tuple[Alignment, ...] = ()
    laser_spots: tuple[LaserSpot, ...] = ()
    on_surfaces: tuple[OnSurface, ...] = ()
    coordinate_differences: tuple[CoordinateDifferences, ...] = ()

    def added_to(self, survey: Survey) -> Survey:
        """The survey with these observations too."""
        lists: dict[str, Any] = {f.name: getattr(survey, f.name) + getattr(self, f.name) for f in fields(self)}
        return replace(survey, **lists)


def tables_of(node: Node, key: str) -> list[Node]:
    """The tables of a list ``[[key]]``."""
    values = node.values.get(key, [])
    if not isinstance(values, list) or not all(isinstance(v, dict) for v in values):
        raise node.error(f"expected a list of tables; write [[{'.'.join(map(str, (*node.path, key)))}]]", key)
    return [Node(node.file, node.lines, (*node.path, key, i), v) for i, v in enumerate(values)]


def planned_poses(node: Node) -> list[Pose3]:
    """The poses of a list ``[[poses]]``. Raises SurveyError for one without place or rotation."""
    found = [(pose, read_pose(pose).value) for pose in tables_of(node, "poses")]
    for pose, value in found:
        if value is None:
            raise pose.error("a planned pose needs its place and rotation; add them")
    return [value for _, value in found if value is not None]


def few(node: Node, n: _Count, key: str) -> _Count:
    """The number itself. Raises SurveyError where it is more than can be meant."""
    if n > _MOST:
        raise node.error(f"makes {n:.3g}; at most {_MOST} are planned in one place, take fewer", key)
    return n


def read_terrestrial(node: Node, names: Names, prefix: str) -> Terrestrial:
    """Everything of these kinds. prefix: of the ids. Raises SurveyError."""
    parts = {key: tables_of(node, key) for key in TERRESTRIAL_KEYS}
    return Terrestrial(
        tuple(r for i, n in enumerate(parts["readings"]) for r in _readings(n, names, f"{prefix}{i + 1}")),
        tuple(_level(n, names, f"{prefix}level{i + 1}") for i, n in enumerate(parts["levels"])),
        tuple(_alignment(n, names, f"{prefix}alignment{i + 1}") for i, n in enumerate(parts["alignments"])),
        tuple(_spot(n, names, f"{prefix}spot{i + 1}") for i, n in enumerate(parts["laser_spots"])),
        tuple(o for n in parts["surfaces"] for o in _on_surface(n, names)),
        tuple(d for n in parts["coordinate_differences"] for d in _differences(n, names)),
    )


TERRESTRIAL_KEYS = ("readings", "levels", "alignments", "laser_spots", "surfaces", "coordinate_differences")


def terrestrial_candidates(part: Terrestrial) -> list[Candidate]:
    """Readings of a set-up with one target are one candidate, everything else stands for itself."""
    sights: dict[str, list[Reading]] = {}
    for r in part.readings:
        ends = [position_text(x) for x in (r.at, r.to, r.second) if x is not None]
        sights.setdefault(" ".join(dict.fromkeys(ends)), []).append(r)
    out = [Candidate(name, "sight", readings=tuple(group)) for name, group in sights.items()]
    out += [Candidate(x.level_id, "level", levels=(x,)) for x in part.levels]
    out += [Candidate(x.alignment_id, "alignment", alignments=(x,)) for x in part.alignments]
    out += [Candidate(x.spot_id, "laser", laser_spots=(x,)) for x in part.laser_spots]
    out += [
        Candidate(f"{position_text(x.position)} on {x.surface_id}", "surface", on_surfaces=(x,))
        for x in part.on_surfaces
    ]
    return out + [
        Candidate(f"baseline {position_text(x.at[0])} {position_text(x.to[0])}", "coordinate difference",
                  coordinate_differences=(x,)) for x in part.coordinate_differences
    ]  # fmt: skip


def lengths_between(survey: Survey, start: StartValues) -> Callable[[Reading], float]:
    """Distances (m) between the ends of readings; 0 where one of them is no point of the world."""
    held = {p.point_id: p.x_in_world.value for p in survey.points if p.x_in_world.treatment == "held"}
    places: dict[str, object] = {**held, **start.points}

    def length(r: Reading) -> float:
        a, b = (places.get(x.point_id or "") if x.frame is None else None for x in (r.at, r.to))
        return 0.0 if a is None or b is None else float(np.linalg.norm(np.asarray(b) - np.asarray(a)))

    return length


def with_usual_sigmas(
    readings: tuple[Reading, ...], survey: Survey, project: Project, distance: Callable[[Reading], float]
) -> tuple[Reading, ...]:
    """Readings with the sigmas of their instruments where the plan gives none. Raises SurveyError where none is known.

    distance: m between the ends of a reading, for what depends on it.
    """
    instruments = {s.setup_id: s.instrument_id for s in survey.setups}
    out = []
    for r in readings:
        accuracy = project.sigmas.instruments.get(instruments.get(r.setup_id) or "", Accuracy())
        sigma: float | None = r.sigma if np.isfinite(r.sigma) else accuracy.sigma(r.kind, distance(r))
        if sigma is None:
            raise SurveyError(
                f"{project.folder}/plan.toml: reading {r.reading_id} ({r.kind}) has no sigma; give sigma_arcsec or "
                "sigma_mm, or the sigmas of the instrument in survey.toml"
            )
        scale = project.sigmas.scale.get(r.group, 1.0)
        out.append(replace(r, sigma=scale * sigma, target_centring_sigma=accuracy.target_centring))
    return tuple(out)


def _readings(node: Node, names: Names, prefix: str) -> list[Reading]:
    """One reading of every kind to every target."""
    node.allow(*_KEYS)
    setup = node.text("setup", "")
    if setup and (problem := setup_problem(setup, names.survey.setups)):
        raise node.error(problem, "setup")
    kinds = node.names("kinds")
    at, targets = _position(node, "from", names), _positions(node, "to", names)
    second = _position(node, "second", names) if node.has("second") else None
    sigma = {True: node.si("sigma_arcsec", np.nan, True), False: node.si("sigma_mm", np.nan, True)}
    heights = [node.si(f"{x}_height_mm", 0.0) for x in ("instrument", "target")]
    out: list[Reading] = []
    for i, kind in enumerate(kinds):
        if kind not in READING_KINDS:
            raise node.error(f"unknown kind {kind!r}; there are {', '.join(READING_KINDS)}", "kinds", i)
        if kind == "direction" and not setup:
            raise node.error("directions of one set-up share an orientation; name it with setup", "kinds", i)
        if (kind == "angle") != (second is not None):
            raise node.error("an angle, and nothing else, has a right-hand target; give it as second", "kinds", i)
        for to in targets:
            if to in (at, second):
                raise node.error("stands in the same reading twice; its positions must differ", "to")
            name = f"plan {prefix} {kind} {to.point_id or len(out) + 1}"
            out.append(Reading(name, kind, at, to, 1.0, sigma[kind in ANGLES], setup, second,
                               heights[0], heights[1], heights[1], group=kind))  # fmt: skip
    return out


def _position(node: Node, key: str, names: Names) -> PositionRef:
    return read_position(node.text(key), names, node.fail(key))


def _positions(node: Node, key: str, names: Names) -> list[PositionRef]:
    if isinstance(node.values.get(key), str):
        return [_position(node, key, names)]
    return [read_position(text, names, node.fail(key)) for text in node.names(key)]


def _axis(node: Node, key: str) -> FloatArray:
    text = node.text(key)
    name, sign = (text[1:], -1.0) if text.startswith("-") else (text, 1.0)
    if name not in ("x", "y", "z"):
        raise node.error(f"found {text!r}; write x, y, z, -x, -y or -z", key)
    return np.asarray(sign * np.eye(3)["xyz".index(name)])


def _level(node: Node, names: Names, name: str) -> Level:
    node.allow("frame", "axis", "sigma_arcsec")
    frame = timed_frame(node.text("frame"), names, node.fail("frame"))
    return Level(node.text("name", name), frame, _axis(node, "axis"), 0.0, node.si("sigma_arcsec", positive=True))


def _alignment(node: Node, names: Names, name: str) -> Alignment:
    node.allow("a", "axis_a", "b", "axis_b", "sigma_arcsec")
    sigma = node.si("sigma_arcsec", positive=True)
    a, b = (timed_frame(node.text(key), names, node.fail(key)) for key in ("a", "b"))
    return Alignment(name, a, _axis(node, "axis_a"), b, _axis(node, "axis_b"), np.zeros(2), sigma**2 * np.eye(2))


def _spot(node: Node, names: Names, name: str) -> LaserSpot:
    node.allow("beam", "target", "epoch", "sigma_mm")
    beam = node.reference("beam", (b.beam_id for b in names.survey.beams), "beam")
    target = node.reference("target", (t.target_id for t in names.survey.targets), "target")
    sigma = node.si("sigma_mm", positive=True)
    return LaserSpot(name, beam, node.text("epoch"), target, np.zeros(2), sigma**2 * np.eye(2))


def _on_surface(node: Node, names: Names) -> list[OnSurface]:
    node.allow("surface", "of", "sigma_mm")
    surface = node.reference("surface", (s.surface_id for s in names.survey.surfaces), "surface")
    sigma = node.si("sigma_mm", positive=True)
    return [OnSurface(surface, p, sigma) for p in _positions(node, "of", names)]


def _differences(node: Node, names: Names) -> list[CoordinateDifferences]:
    node.allow("from", "to", "sigma_mm")
    at = _position(node, "from", names)
    sigma = node.si("sigma_mm", positive=True)
    return [
        CoordinateDifferences((at,), (to,), np.zeros((1, 3)), sigma**2 * np.eye(3))
        for to in _positions(node, "to", names)
    ]
