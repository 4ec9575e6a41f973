"""The language of a report: English words are the keys, other languages say them their own way.

The language holds for everything made inside :func:`speaking`, numbers included (a German report has decimal commas).
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from adjust.model.errors import SurveyError
from survey.report.german import GERMAN, GERMAN_MESSAGES

LANGUAGES = ("en", "de")
GROUPS_BY_KIND = frozenset((
    "image", "table", "pair", "closure", "distance", "coordinates", "coordinate_difference", "level", "alignment",
    "laser", "surface", "reading", "direction", "angle", "zenith", "azimuth", "slope_distance", "horizontal_distance",
    "height_difference",
))  # fmt: skip
_current: ContextVar[str] = ContextVar("language", default="en")


class MissingTranslationError(KeyError):
    """A text of the report that a language does not know: a bug, found by the tests."""


@contextmanager
def speaking(language: str) -> Iterator[None]:
    """Everything inside is said in this language. Raises SurveyError for one that there is not."""
    if language not in LANGUAGES:
        raise SurveyError(f"language {language!r}: reports are written in {' and '.join(LANGUAGES)}")
    token = _current.set(language)
    try:
        yield
    finally:
        _current.reset(token)


def language() -> str:
    """The language of the report being made."""
    return _current.get()


def t(text: str, **values: Any) -> str:
    """A text of the program in the report's language, with ``{name}`` filled in.

    Raises MissingTranslationError where the language does not have it.
    """
    if _current.get() == "de":
        if text not in GERMAN:
            raise MissingTranslationError(text)
        text = GERMAN[text]
    return text.format(**values) if values else text


def known(text: str) -> str:
    """A heading or word that may be data: translated where the language has it, else as it is."""
    return GERMAN.get(text, text) if _current.get() == "de" else text


def group_name(name: str) -> str:
    """A group of observations: one named after its kind is said in the language, one that people named as it is."""
    return known(name.replace("_", " ")) if name in GROUPS_BY_KIND else name


def message(text: str) -> str:
    """A message that the adjustment has made, translated where its pattern is known, else as it is."""
    if _current.get() == "de":
        for pattern, german in GERMAN_MESSAGES:
            found = re.fullmatch(pattern, text, re.DOTALL)
            if found:
                numeric = re.findall(r"(?<!\\)\(([^()]*)\)", pattern)
                values = zip(found.groups(), numeric, strict=True)
                return german.format(*(localised(x) if kind == r"[\d.]+" else x for x, kind in values))
    return text


def localised(number: str) -> str:
    """A number with the decimal sign of the language."""
    return number.replace(".", ",") if _current.get() == "de" else number
