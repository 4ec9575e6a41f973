"""What the files of other network programs have in common: their lines, numbers and what a reader hands back."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import Survey
from survey.folder.text import decode, read_bytes
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


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True)
class Where:
    """A place in a file, for messages."""

    path: Path
    line: int

    def error(self, problem: str) -> SurveyError:
        """An error that says where; ``problem`` says what was found and what to do."""
        return SurveyError(f"{self.path}, line {self.line}: {problem}")


@dataclass(frozen=True)
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
