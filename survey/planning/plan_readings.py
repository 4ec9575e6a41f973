"""Single observations of ``plan.toml``, of every kind, as candidates are; values are predicted later."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from gtsam import Pose3

from adjust.design import Candidate
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.observations import (
    Alignment,
    CoordinateDifferences,
    Coordinates,
    Distance,
    LaserSpot,
    Level,
    OnSurface,
    Pair,
    PositionRef,
    Reading,
    position_text,
)
from adjust.model.survey import FloatArray, Survey
from survey.project.declared.instruments import setup_problem
from survey.project.declared.node import Node
from survey.project.declared.poses import read_pose
from survey.project.project import Accuracy, Project
from survey.project.tables.references import Names, read_frame, read_position, timed_frame
from survey.project.tables.terrestrial import ANGLES, READING_KINDS

_MOST = 100_000  # of whatever is counted in one place: more nobody measures, and memory ends
_Count = TypeVar("_Count", int, float)
_KEYS = (
    *("setup", "from", "to", "second", "kinds", "sigma_arcsec", "sigma_mm", "instrument_height_mm"),
    "target_height_mm",
)


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


def read_singles(node: Node, names: Names, prefix: str) -> tuple[Candidate, ...]:
    """Every single observation that ``node`` lists, each by itself; readings of one sight together.

    Sigmas of readings are nan where the instrument's hold. prefix: of the ids. Raises SurveyError.
    """
    out, readings = list[Candidate](), list[Reading]()
    for key in _SINGLES:
        for i, one in enumerate(tables_of(node, key), 1):
            if key == "readings":
                readings += _readings(one, names, f"{prefix}{i}")
            else:
                out += _SINGLES[key](one, names, f"{prefix}{i}")
        out += sights(readings) if key == "readings" else []
    return tuple(out)


def sights(readings: Iterable[Reading]) -> list[Candidate]:
    """Readings of a set-up with one target are one candidate."""
    found: dict[str, list[Reading]] = {}
    for r in readings:
        ends = [position_text(x) for x in (r.at, r.to, r.second) if x is not None]
        found.setdefault(" ".join(dict.fromkeys(ends)), []).append(r)
    return [Candidate(name, "sight", readings=tuple(group)) for name, group in found.items()]


def lengths_between(survey: Survey, start: StartValues) -> Callable[[Reading], float]:
    """Distances (m) between the ends of readings; 0 where one of them is no point of the world."""
    held = {p.point_id: p.x_in_world.value for p in survey.points if p.x_in_world.treatment == "held"}
    places: dict[str, object] = {**held, **start.points}

    def length(r: Reading) -> float:
        a, b = (places.get(x.point_id or "") if x.frame is None else None for x in (r.at, r.to))
        return 0.0 if a is None or b is None else float(np.linalg.norm(np.asarray(b) - np.asarray(a)))

    return length


def with_usual_sigmas(
    singles: Sequence[Candidate], survey: Survey, start: StartValues, project: Project
) -> list[Candidate]:
    """Sigmas of instruments for readings that the plan gives none; raises SurveyError where none is known."""
    distance = lengths_between(survey, start)
    return [replace(c, readings=_with_sigmas(c.readings, survey, project, distance)) for c in singles]


def _with_sigmas(
    readings: Sequence[Reading], survey: Survey, project: Project, distance: Callable[[Reading], float]
) -> tuple[Reading, ...]:
    """distance: m between the ends of a reading, for what depends on it."""
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


def _distance(node: Node, names: Names, _: str) -> list[Candidate]:
    node.allow("name", "from", "to", "sigma_mm")
    a, b = (_position(node, key, names) for key in ("from", "to"))
    name = node.text("name", f"{node.text('from')}-{node.text('to')}")
    distance = Distance(name, a, b, 1.0, node.si("sigma_mm", positive=True))
    return [Candidate(name, "distance", distances=(distance,))]


def _coordinates(node: Node, names: Names, _: str) -> list[Candidate]:
    node.allow("of", "sigma_mm")
    sigma = node.si("sigma_mm", positive=True)
    refs = ((text, read_position(text, names, node.fail("of", i))) for i, text in enumerate(node.names("of")))
    return [Candidate(f"coordinates of {text}", "coordinates", coordinates=(coordinates_at(ref, sigma),))
            for text, ref in refs]  # fmt: skip


def coordinates_at(ref: PositionRef, sigma: float) -> Coordinates:
    """Coordinates of a position to be measured, sigma m each."""
    return Coordinates((ref,), np.zeros((1, 3)), sigma**2 * np.eye(3))


def _pair(node: Node, names: Names, _: str) -> list[Candidate]:
    node.allow("name", "a", "b", "sigma_rotation_arcsec", "sigma_translation_mm")
    a, b = (read_frame(node.text(key), names, node.fail(key)) for key in ("a", "b"))
    turn = node.si("sigma_rotation_arcsec", positive=True)
    shift = node.si("sigma_translation_mm", None, True)
    sigmas = [turn] * 3 + ([] if shift is None else [shift] * 3)
    name = node.text("name", f"{node.text('a')}-{node.text('b')}")
    return [Candidate(name, "pair", pairs=(Pair(name, a, b, Pose3(), np.diag(np.square(sigmas))),))]


def _level(node: Node, names: Names, number: str) -> list[Candidate]:
    node.allow("frame", "axis", "sigma_arcsec")
    frame = timed_frame(node.text("frame"), names, node.fail("frame"))
    name, sigma = node.text("name", f"{number[0]}level{number[1:]}"), node.si("sigma_arcsec", positive=True)
    return [Candidate(name, "level", levels=(Level(name, frame, _axis(node, "axis"), 0.0, sigma),))]


def _alignment(node: Node, names: Names, number: str) -> list[Candidate]:
    node.allow("a", "axis_a", "b", "axis_b", "sigma_arcsec")
    sigma, name = node.si("sigma_arcsec", positive=True), f"{number[0]}alignment{number[1:]}"
    a, b = (timed_frame(node.text(key), names, node.fail(key)) for key in ("a", "b"))
    found = Alignment(name, a, _axis(node, "axis_a"), b, _axis(node, "axis_b"), np.zeros(2), sigma**2 * np.eye(2))
    return [Candidate(name, "alignment", alignments=(found,))]


def _spot(node: Node, names: Names, number: str) -> list[Candidate]:
    node.allow("beam", "target", "epoch", "sigma_mm")
    beam = node.reference("beam", (b.beam_id for b in names.survey.beams), "beam")
    target = node.reference("target", (t.target_id for t in names.survey.targets), "target")
    sigma, name = node.si("sigma_mm", positive=True), f"{number[0]}spot{number[1:]}"
    spot = LaserSpot(name, beam, node.text("epoch"), target, np.zeros(2), sigma**2 * np.eye(2))
    return [Candidate(name, "laser", laser_spots=(spot,))]


def _on_surface(node: Node, names: Names, _: str) -> list[Candidate]:
    node.allow("surface", "of", "sigma_mm")
    surface = node.reference("surface", (s.surface_id for s in names.survey.surfaces), "surface")
    sigma = node.si("sigma_mm", positive=True)
    return [Candidate(f"{position_text(p)} on {surface}", "surface", on_surfaces=(OnSurface(surface, p, sigma),))
            for p in _positions(node, "of", names)]  # fmt: skip


def _differences(node: Node, names: Names, _: str) -> list[Candidate]:
    node.allow("from", "to", "sigma_mm")
    at, sigma = _position(node, "from", names), node.si("sigma_mm", positive=True)
    found = (CoordinateDifferences((at,), (to,), np.zeros((1, 3)), sigma**2 * np.eye(3))
             for to in _positions(node, "to", names))  # fmt: skip
    return [Candidate(f"baseline {position_text(at)} {position_text(d.to[0])}", "coordinate difference",
                      coordinate_differences=(d,)) for d in found]  # fmt: skip


_SINGLES: Mapping[str, Callable[[Node, Names, str], Sequence[Any]]] = {
    "distances": _distance, "coordinates": _coordinates, "pairs": _pair, "readings": _readings, "levels": _level,
    "alignments": _alignment, "laser_spots": _spot, "surfaces": _on_surface, "coordinate_differences": _differences,
}  # fmt: skip
"""How single observations are read, by the key of their tables."""
SINGLES = tuple(_SINGLES)
