r"""CERN's LGC, version 1: local networks in one right-handed frame, z up.

``*CALA`` are fixed points, ``*POIN`` free ones; ``*ANGL s``, ``*ZENH s`` (cc) and ``*DMES s`` (mm) hold directions,
zenith angles and slope distances with one deviation per section. Directions count clockwise from Y and share one
orientation per station. ``/h`` and ``\h`` are heights of instrument and target, the former up to its next mention.
"""

from pathlib import Path

from adjust.model.errors import SurveyError
from adjust.model.observations import ReadingKind
from adjust.model.survey import Bearings
from survey.folder.text import suggestion
from survey.interop.networks.draft import AXES, NetworkDraft
from survey.interop.networks.foreign import CC, GON, MM, ForeignNetwork, Line, lines_of, number

_READINGS: dict[str, tuple[ReadingKind, float, float]] = {
    "*ANGL": ("direction", GON, CC),
    "*ZENH": ("zenith", GON, CC),
    "*DMES": ("slope_distance", 1.0, MM),
}
_POINTS = {"*CALA": "fixed", "*POIN": "free"}
_SAID = ("*OLOC", "*PUNC", "*MICR", "*FAUS", "*PREC")
_KNOWN = ("*TITR", "*END", *_SAID, *_POINTS, *_READINGS)


def read_lgc(path: Path) -> ForeignNetwork:
    """A network from a .lgc file. Raises SurveyError with file and line for what cannot be read."""
    reader, ended = _Reader(), False
    for line in lines_of(path):
        if line.text.startswith("%"):
            continue
        if ended:
            raise line.where.error("text after *END; remove it")
        ended = reader.line(line)
    if not ended:
        raise SurveyError(f"{path}: *END is missing; is the file whole?")
    if not reader.draft.readings:
        raise SurveyError(f"{path}: there are no observations; sections *ANGL, *ZENH and *DMES are read")
    survey = reader.draft.survey(Bearings("y", True))
    return ForeignNetwork(survey, reader.title, 1.0, "a_posteriori", notes=tuple(reader.draft.notes))


class _Reader:
    def __init__(self) -> None:
        self.draft, self.title, self.section = NetworkDraft(), "", ""
        self.sigma = 0.0
        self.height: dict[str, float] = {}

    def line(self, line: Line) -> bool:
        """Take one line; whether it is the last."""
        words = line.words
        if words[0].startswith("*"):
            self._head(line, words)
        elif self.section == "*TITR":
            self.title = self.title or line.text
        elif self.section in _POINTS:
            self._point(line, words)
        elif self.section in _READINGS:
            self._reading(line, words)
        else:
            raise line.where.error(f"found {line.text[:40]!r} outside a section of points or observations")
        return self.section == "*END"

    def _head(self, line: Line, words: list[str]) -> None:
        if words[0] not in _KNOWN:
            raise line.where.error(f"{words[0]!r} is not supported; {suggestion(words[0], _KNOWN)}")
        self.section = words[0]
        if self.section in _READINGS:
            if len(words) != 2:
                raise line.where.error(f"{self.section} is followed by one deviation; correct it")
            self.sigma = number(words[1], "deviation", line.where)

    def _point(self, line: Line, words: list[str]) -> None:
        name, *coordinates = words
        if len(coordinates) != 3:
            raise line.where.error(f"point {name!r}: expected x y z, found {len(coordinates)} words")
        start = dict(zip(AXES, line.numbers(coordinates, f"point {name!r}"), strict=True))
        status = dict.fromkeys(AXES, _POINTS[self.section])
        self.draft.add_point(name, line.where, start, status)

    def _reading(self, line: Line, words: list[str]) -> None:
        kind, unit, sigma_unit = _READINGS[self.section]
        if len(words) < 3:
            raise line.where.error("expected two points and a value")
        at, to, text, *rest = words
        self.draft.require_points((at, to), line.where)
        if at == to:
            raise line.where.error(f"station and target are both {at!r}; correct one")
        if not self.sigma > 0.0:
            raise line.where.error(f"the deviation after {self.section} is {self.sigma:g}; it must be above zero")
        target = 0.0
        for word in rest:
            if word[0] == "/":
                self.height[at] = number(word[1:], "height of instrument", line.where)
            elif word[0] == "\\":
                target = number(word[1:], "height of target", line.where)
            else:
                raise line.where.error(f"found {word!r} after the value; heights are written /0.0 and \\0.0")
        value = number(text, "value", line.where)
        if kind == "slope_distance" and not value > 0.0:
            raise line.where.error(f"a distance of {text} m; distances are above zero")
        setup_id = self.draft.own_setup(at) if kind == "direction" else ""
        heights = (self.height.get(at, 0.0), target, 0.0)
        self.draft.reading(kind, at, to, value * unit, self.sigma * sigma_unit, setup_id=setup_id, heights=heights)
