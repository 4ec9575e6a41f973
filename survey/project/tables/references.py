"""Frames and positions by name, as tables of observations write them.

A frame is ``world`` or ``kind:id``, with ``@epoch`` where it moves: ``station:head@e01``. A position is a world point
(``B1``), a point of a target (``target:board/r0c0``) or a frame, whose origin is meant.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import field

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameKind, FrameRef, PositionRef, frame_text
from adjust.model.survey import Survey
from survey.folder.text import id_problem, suggestion
from survey.project.tables.reading import Table

_KINDS: tuple[FrameKind, ...] = ("station", "camera", "target", "table", "mount")


Fail = Callable[[str], SurveyError]
"""What makes an error of a problem: it knows where."""


@frozen(eq=False)
class Names:
    """The frames and points of a survey by name.

    bodies: for every frame, the moving body that carries it ("" for the world). target_points: position of each id.
    """

    survey: Survey
    bodies: Mapping[tuple[str, str], str] = field(default_factory=dict)

    @classmethod
    def of(cls, survey: Survey) -> "Names":
        """The names of a survey."""
        bodies: dict[tuple[str, str], str] = {}
        for station in survey.stations:
            bodies["station", station.station_id] = "" if station.motion == "fixed" else f"station:{station.station_id}"
        for camera in survey.cameras:
            bodies["camera", camera.camera_id] = bodies["station", camera.station_id]
        for target in survey.targets:
            carrier = bodies["station", target.station_id] if target.station_id else ""
            moves = target.motion == "epoch"
            bodies["target", target.target_id] = f"target:{target.target_id}" if moves else carrier
        for table in survey.tables:
            bodies["table", table.table_id] = ""
            bodies["mount", table.table_id] = f"mount:{table.table_id}"
        return cls(survey, bodies)

    @functools.cached_property
    def points(self) -> dict[str, int]:
        """Position of each world point in ``Survey.points``."""
        return {point.point_id: i for i, point in enumerate(self.survey.points)}

    @functools.cached_property
    def target_points(self) -> dict[str, dict[str, int]]:
        """Position of each point id in its target, by target id."""
        return {t.target_id: {name: i for i, name in enumerate(t.point_ids)} for t in self.survey.targets}

    @functools.cached_property
    def positions(self) -> dict[str, PositionRef]:
        """Those that were read before, by their text: a network names each of its points many times."""
        return {}

    @functools.cached_property
    def frames(self) -> dict[str, FrameRef]:
        """The same of frames: a network of pairs names each of its stations many times."""
        return {}

    def ids(self, kind: str) -> list[str]:
        """All ids of a kind of frame."""
        return [frame_id for frame_kind, frame_id in self.bodies if frame_kind == kind]


def read_frame(text: str, names: Names, fail: Fail) -> FrameRef:
    """A frame; a name without kind is a station. Raises what ``fail`` makes of a problem."""
    found = names.frames.get(text)
    if found is None:
        found = names.frames[text] = _read_frame(text, names, fail)
    return found


def _read_frame(text: str, names: Names, fail: Fail) -> FrameRef:
    body, _, epoch = text.partition("@")
    if "@" in text:
        _check_id(epoch, "epoch", fail)
    kind_text, colon, frame_id = body.partition(":")
    if body == "world":
        if epoch:
            raise fail(f"{text!r}: the world has no epochs; remove '@{epoch}'")
        return FrameRef("world")
    if not colon:
        kind_text, frame_id = "station", body
    kind = next((kind for kind in _KINDS if kind == kind_text), None)
    if kind is None:
        raise fail(f"{text!r}: unknown kind of frame {kind_text!r}; {suggestion(kind_text, _KINDS)}")
    _check_id(frame_id, kind, fail)
    if (kind, frame_id) not in names.bodies:
        raise fail(f"{text!r}: unknown {kind} {frame_id!r}; {suggestion(frame_id, names.ids(kind))}")
    if epoch and not names.bodies[kind, frame_id]:
        raise fail(f"{text!r}: this {kind} does not move; remove '@{epoch}'")
    return FrameRef(kind, frame_id, epoch or None)


def read_position(text: str, names: Names, fail: Fail) -> PositionRef:
    """A position: world point, point of a target, or the origin of a frame. Raises what ``fail`` makes of a problem."""
    found = names.positions.get(text)
    if found is None:
        found = names.positions[text] = _read_position(text, names, fail)
    return found


def _read_position(text: str, names: Names, fail: Fail) -> PositionRef:
    if ":" not in text and "@" not in text and text != "world":
        if text not in names.points:
            raise fail(f"unknown point {text!r}; {_where_points_come_from(text, names)}")
        return PositionRef(text)
    name, slash, point_id = text.partition("/")
    if "@" in point_id:  # target:board/r0c0@e01 is as clear as target:board@e01/r0c0
        point_id, _, epoch = point_id.partition("@")
        name = f"{name}@{epoch}"
    frame = read_frame(name, names, fail)
    if not slash:
        return PositionRef(None, frame)
    if frame.kind != "target":
        raise fail(f"{text!r}: only a target has points; write target:id/point")
    known = names.target_points[frame.frame_id]
    if point_id not in known:
        raise fail(f"{text!r}: unknown point {point_id!r}; {suggestion(point_id, known)}")
    return PositionRef(point_id, frame)


def _where_points_come_from(text: str, names: Names) -> str:
    stations = names.ids("station")
    if text in stations:
        return f"for the origin of the station write 'station:{text}'"
    return f"{suggestion(text, names.points)}; list it as [points.{text}], or set tie_points = true"


def _check_id(name: str, what: str, fail: Fail) -> None:
    problem = id_problem(name)
    if problem:
        raise fail(f"{what}: {problem}")


def check_epochs(a: FrameRef | None, b: FrameRef | None, names: Names, fail: Fail) -> None:
    """Raise where a moving frame has no epoch, unless both frames stand on the same body."""
    bodies = [names.bodies.get((ref.kind, ref.frame_id), "") if ref else "" for ref in (a, b)]
    if bodies[0] == bodies[1] and (a and a.epoch_id) == (b and b.epoch_id):
        return
    for ref, body in zip((a, b), bodies, strict=True):
        if ref and body and ref.epoch_id is None:
            name = frame_text(ref)
            raise fail(f"{name!r} moves and the epoch is not given; write '{name}@epoch_id'")


def timed_frame(text: str, names: Names, fail: Fail) -> FrameRef:
    """A frame, with its epoch where it moves."""
    frame = read_frame(text, names, fail)
    check_epochs(frame, None, names, fail)
    return frame


def timed_position(text: str, names: Names, fail: Fail) -> PositionRef:
    """A position, with its epoch where it moves."""
    position = read_position(text, names, fail)
    check_epochs(position.frame, None, names, fail)
    return position


def read_ends(
    table: Table, row: int, texts: tuple[str, str], names: Names, what: str
) -> tuple[PositionRef, PositionRef]:
    """The positions that a row names in from_id and to_id; SurveyError where they are none, or the same."""
    fail = table.fail(row, "from_id, to_id")
    a, b = (read_position(text, names, fail) for text in texts)
    check_epochs(a.frame, b.frame, names, fail)
    if a == b:
        raise fail(f"both are {texts[0]!r}; a {what} joins two different positions")
    return a, b
