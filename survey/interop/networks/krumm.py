"""Krumm's text files of textbook networks (.dat), and the adjusted coordinates beside them (.adj).

x is east and y north, bearings count clockwise from y; angles are gon, or degrees in sections marked ``dms``. A
deviation that is left out is that of the row before. Section names are English or German.
"""

import re
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import ReadingKind
from adjust.model.survey import Bearings, FloatArray
from survey.folder.text import suggestion
from survey.interop.networks.draft import AXES, DraftPoint, NetworkDraft, Vectors
from survey.interop.networks.foreign import ARCSEC, GON, ForeignNetwork, Line, lines_of, number, positive, sexagesimal

_DMS = re.compile("([+-]?)(\\d+)[°d](\\d+)['′](\\d+\\.?\\d*)[\"″]?")
_SKIPPED = ("project", "source", "quelle", "graphics", "grafik", "approximateorientation", "approximatescale")
_ANGULAR: dict[str, ReadingKind] = {
    "direction": "direction",
    "richtung": "direction",
    "gridbearing": "azimuth",
    "azimuth": "azimuth",
    "zenithangle": "zenith",
    "zenitwinkel": "zenith",
    "verticalangle": "zenith",
    "vertikalwinkel": "zenith",
    "angle": "angle",
    "winkel": "angle",
}
_LENGTHS: dict[str, ReadingKind] = {
    "distance": "horizontal_distance",
    "strecke": "horizontal_distance",
    "spatialdistance": "slope_distance",
    "raumstrecke": "slope_distance",
}
_BASELINES = ("3dbaseline", "3dbasislinie")
_HEIGHTS = "levelledheightdifference"
_AXES_OF: dict[ReadingKind, str] = {"height_difference": "z", "zenith": "xyz", "slope_distance": "xyz"}


@frozen
class _Section:
    """A section: its name in lower case without plural, whether in degrees, its lines."""

    name: str
    dms: bool
    head: Line
    lines: tuple[Line, ...]


def read_krumm(path: Path) -> ForeignNetwork:
    """A network from a .dat file. Raises SurveyError with file and line for what cannot be read."""
    sections = _sections(path)
    reader = _Reader()
    named = {s.name: s for s in sections}
    if "coordinate" not in named:
        raise SurveyError(f"{path}: there is no section [Coordinates]; is this a file in Krumm's format?")
    reader.coordinates(named["coordinate"])
    for section in sections:
        reader.observations(section)
    if not reader.axes:
        raise SurveyError(f"{path}: there are no observations; add a section like [Distances]")
    reader.close_azimuths()
    reader.datum(named.get("datum"))
    sigma0 = _sigma0(named["sigma0"]) if "sigma0" in named else 1.0
    title = " ".join(line.text for line in named["project"].lines) if "project" in named else path.stem
    survey = reader.draft.survey(Bearings("y", True))
    return ForeignNetwork(survey, title, sigma0, "a_posteriori", notes=tuple(reader.draft.notes))


def _sections(path: Path) -> list[_Section]:
    out: list[tuple[str, bool, Line, list[Line]]] = []
    for line in lines_of(path, "%"):
        text = re.sub(r"(^|\s)#.*", "", line.text).strip()
        if text.startswith("["):
            if not text.endswith("]"):
                raise line.where.error(f"found {text[:40]!r}; a section is written [Name]")
            name, *options = (part.strip().lower() for part in text[1:-1].split(","))
            unknown = set(options) - {"dms", "s", "gon"}
            if unknown:
                raise line.where.error(f"the units {sorted(unknown)} are not known; dms,s and gon are")
            out.append((_singular(name), "dms" in options, line, []))
        elif text:
            if not out:
                raise line.where.error("text before the first [Section]; remove it or mark it with %")
            out[-1][3].append(Line(line.where, text))
    sections = [_Section(name, dms, head, tuple(lines)) for name, dms, head, lines in out]
    known = (*_SKIPPED, "coordinate", "datum", "sigma0", *_ANGULAR, *_LENGTHS, *_BASELINES, _HEIGHTS)
    for section in sections:
        if section.name not in known:
            problem = f"section {section.head.text} is not supported; {suggestion(section.name, known)}"
            raise section.head.where.error(problem)
    return sections


def _singular(name: str) -> str:
    for known in (*_ANGULAR, *_LENGTHS, *_BASELINES, _HEIGHTS, "coordinate"):
        if name in (known + "s", known + "n", known + "en"):
            return known
    return {"koordinaten": "coordinate", "horizontaldistances": "distance"}.get(name, name)


def _sigma0(section: _Section) -> float:
    if len(section.lines) != 1:
        raise section.head.where.error("[Sigma0] has one line, a number and its unit; correct it")
    line = section.lines[0]
    units = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "gon": GON, "mgon": 1e-3 * GON, "": 1.0}
    value, unit = (*line.words, "")[:2]
    if unit not in units:
        raise line.where.error(f"the unit {unit!r} is not known; {suggestion(unit, units)}")
    return positive(value, "sigma0", line.where) * units[unit]


class _Reader:
    """Collects the sections of one file."""

    def __init__(self) -> None:
        self.draft = NetworkDraft()
        self.axes: set[str] = set()
        # bearings without deviation: constants that orient a station; angles that wait for them
        self.constants: dict[tuple[str, str], float] = {}
        self.waiting: list[tuple[Line, list[str], float, float]] = []

    def coordinates(self, section: _Section) -> None:
        for line in section.lines:
            name, *words = line.words
            if not 2 <= len(words) <= 3:
                raise line.where.error(f"point {name!r}: expected 2 or 3 coordinates, found {len(words)}")
            values = line.numbers(words, f"point {name!r}")
            self.draft.add_point(name, line.where, dict(zip(AXES, values, strict=False)))

    def observations(self, section: _Section) -> None:
        sigma: list[str] = []
        for line in section.lines:
            if section.name in _ANGULAR:
                sigma = self._angular(section, line, sigma)
            elif section.name in _LENGTHS:
                sigma = self._length(_LENGTHS[section.name], line, sigma)
            elif section.name == _HEIGHTS:
                sigma = self._height(line, sigma)
            elif section.name in _BASELINES:
                sigma = self._baseline(line, sigma)

    def _ends(self, line: Line, n: int, at_least: int) -> tuple[list[str], list[str]]:
        words = line.words
        if len(words) < n + at_least:
            raise line.where.error(f"found {len(words)} words, expected {n} points and at least {at_least} numbers")
        if len(set(words[:n])) < n:
            raise line.where.error(f"the points {', '.join(words[:n])} must differ")
        return words[:n], words[n:]

    def _angular(self, section: _Section, line: Line, before: list[str]) -> list[str]:
        kind = _ANGULAR[section.name]
        ends, (text, *rest) = self._ends(line, 3 if kind == "angle" else 2, 1)
        if len(rest) not in (0, 1, 3) or (len(rest) == 3 and kind != "zenith"):
            raise line.where.error(f"found {len(rest)} words after the value; expected a deviation or none")
        value = _angle(text, section.dms, line)
        if section.name in ("verticalangle", "vertikalwinkel"):
            value = np.pi / 2 - value
        given = rest[:1] or before
        if not given:
            if kind != "azimuth":
                raise line.where.error("has no deviation, nor has a row before; add it")
            self.constants[ends[0], ends[1]] = value
            return []
        unit = ARCSEC if section.dms else GON
        sigma = positive(given[0].rstrip('"'), "deviation", line.where) * unit
        if kind == "angle" and not set(ends) <= set(self.draft.points):
            self.waiting.append((line, ends, value, sigma))
            return given
        self._add(line, kind, ends, value, sigma, rest[1:])
        return given

    def _add(
        self, line: Line, kind: ReadingKind, ends: list[str], value: float, sigma: float, heights: list[str]
    ) -> None:
        self.draft.require_points(ends, line.where)
        at, to, second = (*ends, None)[:3]
        high = [number(word, "height", line.where) for word in heights] or [0.0, 0.0]
        self.draft.reading(
            kind, str(at), str(to), value, sigma, second=second, heights=(high[0], high[1], 0.0),
            setup_id=self.draft.own_setup(str(at)) if kind == "direction" else "",
        )  # fmt: skip
        self.axes |= set(_AXES_OF.get(kind, "xy"))

    def _length(self, kind: ReadingKind, line: Line, before: list[str]) -> list[str]:
        ends, (text, *rest) = self._ends(line, 2, 1)
        if len(rest) == 2 or len(rest) > 3:
            problem = "two ways to combine a constant and a proportional deviation are in use"
            raise line.where.error(f"found {len(rest)} words after the distance; {problem}: write their sum")
        given = rest[:1] or before
        if not given:
            raise line.where.error("has no deviation (m), nor has a row before; add it")
        sigma = positive(given[0], "deviation", line.where)
        self._add(line, kind, ends, positive(text, "distance", line.where), sigma, rest[1:])
        return given

    def _height(self, line: Line, before: list[str]) -> list[str]:
        ends, (text, length, *rest) = self._ends(line, 2, 2)
        given = rest[:1] or before
        if len(rest) > 1 or not given:
            raise line.where.error("expected height difference, length of the line (m) and deviation for 1 km (m)")
        per_km = positive(given[0], "deviation", line.where)
        sigma = per_km * np.sqrt(positive(length, "length", line.where) / 1000.0)
        self._add(line, "height_difference", ends, number(text, "height difference", line.where), float(sigma), [])
        return given

    def _baseline(self, line: Line, before: list[str]) -> list[str]:
        (at, to), words = self._ends(line, 2, 3)
        given = words[3:] or before
        if len(given) not in (3, 6):
            raise line.where.error(f"found {len(given)} numbers after dx dy dz; expected 3 deviations or 6 covariances")
        numbers = np.array(line.numbers(given, "covariance"))
        cov = np.diag(numbers**2) if len(given) == 3 else np.zeros((3, 3))
        if len(given) == 6:
            cov[np.triu_indices(3)] = numbers
            cov = cov + np.triu(cov, 1).T
        values = np.array([line.numbers(words[:3], "baseline")])
        self.draft.differences.append(Vectors(line.where, [at], [to], values, cov))
        self.axes |= set(AXES)
        return given

    def close_azimuths(self) -> None:
        """Angles against a mark without coordinates become bearings: the constant bearing of the mark and the angle."""
        for line, (at, left, right), value, sigma in self.waiting:
            known = [p for p in (left, right) if p not in self.draft.points]
            if at not in self.draft.points or len(known) != 1 or (at, known[0]) not in self.constants:
                raise line.where.error(
                    f"points without coordinates: {', '.join(known) or at}; add them, or the bearing of the mark"
                )
            bearing = self.constants[at, known[0]]
            if known[0] == left:
                self._add(line, "azimuth", [at, right], bearing + value, sigma, [])
            else:
                self._add(line, "azimuth", [at, left], bearing - value, sigma, [])
            self.draft.notes.append(
                f"the angle at {at} between {left} and {right} stands as a bearing: {known[0]} is a mark without "
                "coordinates whose bearing is given as a constant"
            )

    def datum(self, section: _Section | None) -> None:
        for point in self.draft.points.values():
            point.status = {axis: "free" for axis in sorted(self.axes) if axis in point.start}
        if section is None or not section.lines:
            return
        first, *rest = section.lines
        word, *tokens = first.text.replace(",", " ").split()
        if word == "dyn":
            self._dynamic(section, rest)
            return
        if word not in ("fix", "free"):
            raise first.where.error(f"found {word!r}; a datum is fix, free or dyn")
        status = "fixed" if word == "fix" else "constrained"
        for line, names in [(first, tokens), *((r, r.text.replace(",", " ").split()) for r in rest)]:
            for name in names:
                for point, axis in self._named(name, line):
                    point.status[axis] = status

    def _named(self, token: str, line: Line) -> list[tuple[DraftPoint, str]]:
        """The coordinates that a word of the datum names: a point, or an axis and a point."""
        points = self.draft.points
        if token in points:
            found = [(points[token], axis) for axis in points[token].status]
        else:
            found = [(points[token[1:]], token[0])] if token[1:] in points and token[0] in AXES else []
        if not found or any(axis not in point.status for point, axis in found):
            raise line.where.error(f"{token!r} names no coordinate; {suggestion(token, points)}")
        return found

    def _dynamic(self, section: _Section, lines: list[Line]) -> None:
        """Coordinates with a covariance matrix (m^2), or with one deviation (m) each."""
        named = [(self._named(line.words[0], line), line.numbers(line.words[1:], "datum")) for line in lines]
        if not named or any(len(coordinates) != 1 for coordinates, _ in named):
            raise section.head.where.error("a dynamic datum names one coordinate and its deviation per line")
        n, widths = len(named), {len(numbers) for _, numbers in named}
        if widths not in ({1}, {n}):
            raise section.head.where.error(f"expected one deviation or {n} covariances per line; correct the datum")
        rows = np.array([numbers for _, numbers in named])
        small: FloatArray = np.diag(rows[:, 0] ** 2) if widths == {1} else rows
        ids = list(dict.fromkeys(c[0][0].point_id for c, _ in named))
        idx = [3 * ids.index(c[0][0].point_id) + AXES.index(c[0][1]) for c, _ in named]
        cov = np.diag(np.full(3 * len(ids), np.inf))
        cov[np.ix_(idx, idx)] = small
        values = np.array([[self.draft.points[i].start.get(a, 0.0) for a in AXES] for i in ids])
        self.draft.coordinates.append(Vectors(section.head.where, [], ids, values, cov))


def _angle(text: str, dms: bool, line: Line) -> float:
    if not dms:
        return number(text, "angle", line.where) * GON
    found = _DMS.fullmatch(text)
    if found is None:
        raise line.where.error(f"found {text[:30]!r} where an angle like 38°48'50.7\" is expected; correct it")
    return sexagesimal(found[1], (found[2], found[3], found[4]), "angle", line.where)
