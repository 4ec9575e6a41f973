"""What the files of other network programs have in common: their lines, numbers and what a reader hands back."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import field, replace
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.observations import PositionRef
from adjust.model.subsets import with_positions
from adjust.model.survey import Survey
from survey.folder.text import FORBIDDEN_IN_IDS, decode, formula_problem, id_problem, read_bytes
from survey.project.targets import TargetKind
from survey.solution.quantities import SigmaKind

GON = np.pi / 200.0
CC = 1e-4 * GON
DEGREE = np.pi / 180.0
ARCSEC = DEGREE / 3600.0
MM = 1e-3
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_LARGEST = 1e15
LATIN_1 = "iso-8859-1"


@frozen(eq=False)
class ForeignNetwork:
    """A file of another program as a survey.

    sigma0: its a priori standard deviation of unit weight, in its own unit; weights do not depend on it.
    sigmas: which ones the program gives, or None where its file does not say. alpha: level of its tests, or None.
    reject: whether gross errors may be left out; False keeps what the file's owner decided to use, as its program does.
    notes: what was left out or changed, for people. target_kinds: of targets that are more than a list of points.
    """

    survey: Survey
    title: str = ""
    sigma0: float = 1.0
    sigmas: SigmaKind | None = None
    alpha: float | None = None
    reject: bool = False
    notes: tuple[str, ...] = ()
    target_kinds: Mapping[str, TargetKind] = field(default_factory=dict)


@frozen
class Where:
    """A place in a file, for messages."""

    path: Path
    line: int

    def error(self, problem: str) -> SurveyError:
        """An error that says where; ``problem`` says what was found and what to do."""
        return SurveyError(f"{self.path}, line {self.line}: {problem}")


@frozen
class Line:
    """One line of a text file without its comment."""

    where: Where
    text: str

    @property
    def words(self) -> list[str]:
        """The words between blanks."""
        return self.text.split()

    def numbers(self, words: list[str], what: str) -> list[float]:
        """All of ``words`` as numbers."""
        return [number(word, what, self.where) for word in words]


def text_of(path: Path) -> str:
    """The text of a file in UTF-8, or else in Latin-1; raises SurveyError where it is not there, or UTF-16."""
    data = read_bytes(path)[0]
    return decode(path, data if is_utf8(data) else data.decode(LATIN_1).encode())


def is_utf8(data: bytes) -> bool:
    """Whether bytes are text in UTF-8 (or UTF-16, of which the readers say so themselves)."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return True
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def lines_of(path: Path, comment: str = "") -> Iterator[Line]:
    """Lines that are not empty; what follows one of the characters in ``comment`` is cut off."""
    cut = re.compile(f"[{re.escape(comment)}].*") if comment else None
    for count, raw in enumerate(text_of(path).splitlines(), 1):
        text = (cut.sub("", raw) if cut else raw).strip()
        if text:
            yield Line(Where(path, count), text)


def number(text: str, what: str, where: Where) -> float:
    """A finite number; raises SurveyError that names ``what``."""
    if _NUMBER.fullmatch(text.strip()) is None:
        raise where.error(f"{what}: found {text.strip()[:40]!r} where a number is expected; correct it")
    value = float(text)
    if not abs(value) < _LARGEST:
        raise where.error(f"{what}: {text.strip()[:40]} is too large to be meant; correct it")
    return value


def positive(text: str, what: str, where: Where) -> float:
    """A number above zero."""
    value = number(text, what, where)
    if not value > 0.0:
        raise where.error(f"{what}: found {text.strip()}, which is not above zero; correct it")
    return value


def sexagesimal(sign: str, parts: tuple[str, str, str], what: str, where: Where) -> float:
    """Degrees, minutes and seconds as rad; 60 is read as what rounding made of 59.99."""
    degrees, minutes, seconds = (number(part, what, where) for part in parts)
    if minutes > 60.0 or seconds > 60.0 or min(degrees, minutes, seconds) < 0.0:
        raise where.error(f"{what}: minutes and seconds are at most 60 and not negative; correct the angle")
    return (-1.0 if sign == "-" else 1.0) * (degrees + minutes / 60.0 + seconds / 3600.0) * DEGREE


def check_cov(cov: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]", what: str, where: Where) -> None:
    """Raise where a covariance matrix is not positive definite."""
    sigma = np.sqrt(np.clip(np.diagonal(cov), 0.0, None))
    if not (sigma > 0.0).all():
        raise where.error(f"{what}: a variance is not above zero; correct the matrix")
    if np.linalg.eigvalsh(cov / np.outer(sigma, sigma))[0] < 1e-12:
        raise where.error(f"{what}: the matrix is not positive definite; correct it")


def safe_ids(names: list[str], taken: set[str] | None = None) -> dict[str, str]:
    """For every name that cannot be an id one that can: what is forbidden becomes "_"; all stay different."""
    used = {name for name in names if id_problem(name) is None} | (taken or set())
    out = {}
    for name in names:
        if id_problem(name) is None and name not in (taken or set()):
            continue
        plain = "".join("_" if c in FORBIDDEN_IN_IDS or not c.isprintable() else c for c in name)
        plain = plain.strip().lstrip(".") or "_"
        plain = f"_{plain[1:]}" if formula_problem(plain) else plain
        new, count = plain, 2
        while new in used:
            new, count = f"{plain}_{count}", count + 1
        used.add(new)
        out[name] = new
    return out


def with_safe_ids(survey: Survey) -> tuple[Survey, tuple[str, ...]]:
    """The survey with names that a project can hold, and what was renamed, for people."""
    points = safe_ids([p.point_id for p in survey.points], {"world"})
    setups = safe_ids([s.setup_id for s in survey.setups])
    readings = safe_ids([r.reading_id for r in survey.readings])
    if not (points or setups or readings):
        return survey, ()

    def ref(position: PositionRef) -> PositionRef:
        return PositionRef(points[position.point_id]) if position.point_id in points else position

    changed: dict[str, Any] = {
        "points": tuple(replace(p, point_id=points.get(p.point_id, p.point_id)) for p in survey.points),
        "setups": tuple(replace(s, setup_id=setups.get(s.setup_id, s.setup_id)) for s in survey.setups),
        "readings": tuple(
            replace(with_positions(r, ref), reading_id=readings.get(r.reading_id, r.reading_id),
                    setup_id=setups.get(r.setup_id, r.setup_id)) for r in survey.readings
        ),
        "reading_covariances": tuple(
            replace(c, reading_ids=tuple(readings.get(i, i) for i in c.reading_ids)) for c in survey.reading_covariances
        ),
        **{kind: tuple(with_positions(x, ref) for x in getattr(survey, kind))
           for kind in ("coordinate_differences", "coordinates", "distances")},
        "datum": replace(survey.datum, points=tuple(points.get(p, p) for p in survey.datum.points)),
    }  # fmt: skip
    shown = [f"{old} -> {new}" for old, new in points.items()]
    said = "renamed, because ids have none of / \\ : @ , ; and no = + - in front"
    note = f"{said}: {listed(shown, 6)}" if shown else ""
    return replace(survey, **changed), (note,) if note else ()
