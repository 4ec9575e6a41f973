"""The language of a report: English words are the keys, catalogues beside this module say them in other languages.

The language holds for everything made inside :func:`speaking`, numbers included (a German report has decimal commas).
A language is one file, ``catalogues/<language>.toml``.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path

from markupsafe import Markup, escape

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen

_CATALOGUES = Path(__file__).with_name("catalogues")
LANGUAGES = ("en", *sorted(path.stem for path in _CATALOGUES.glob("*.toml")))
GROUPS_BY_KIND = frozenset((
    "image", "table", "pair", "closure", "distance", "coordinates", "coordinate_difference", "level", "alignment",
    "laser", "surface", "reading", "direction", "angle", "zenith", "azimuth", "slope_distance", "horizontal_distance",
    "height_difference",
))  # fmt: skip
TURNING = {ord(sign): f"\\u{ord(sign):04x}" for sign in "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e"
           "\u2066\u2067\u2068\u2069"}  # fmt: skip
"""Signs that let what follows them be shown in another order, with what stands for them on a page."""
_SIGNS = tuple(map(chr, TURNING))
_NUMBER = r"[-+\d.e]+"
_PLACE = re.compile(r"\{[nw]?\}")
_PARTS = {"{}": "(.+?)", "{w}": r"(\S+)", "{n}": f"({_NUMBER})"}
_CELL = re.compile(r"( {2,}|^ ?)(\S+(?: \S+)*)")
_ALONE = re.compile(r"(?<![^ (])[-+]?\d+\.\d+(?:e[-+]?\d+)?(?![^ ,;)])")
_WORDS = frozenset(("required", "planned"))
_current: ContextVar[str] = ContextVar("language", default="en")


@frozen
class ReportOptions:
    """How results are written.

    language: of report.html, "en" or "de". pdf: report.pdf too. parquet: residuals.parquet too, which is written again
    as long as it is there.
    """

    language: str = "en"
    pdf: bool = False
    parquet: bool = False


ENGLISH_PAGE = ReportOptions()


class MissingTranslationError(KeyError):
    """A text of the report that a language does not know: a bug, found by the tests."""


@frozen
class Catalogue:
    """A language: its decimal sign, ``texts`` by their English form, ``messages`` as patterns with what they become.

    sentences: messages as the catalogue has them, by their English form: ``{}`` for a part, ``{w}`` for a part of one
    word, ``{n}`` for a number; those with most words of their own first. cells: words of columns in a text.
    """

    decimal: str
    texts: Mapping[str, str]
    sentences: Mapping[str, str]
    messages: tuple[tuple[str, str], ...]
    cells: Mapping[str, str]


@cache
def catalogue(language: str) -> Catalogue:
    """The catalogue of a language; English needs no texts."""
    if language == "en":
        return Catalogue(".", {}, {}, (), {})
    found = tomllib.loads((_CATALOGUES / f"{language}.toml").read_text(encoding="utf-8"))
    sentences = dict(sorted(found["sentences"].items(), key=lambda item: -len(_PLACE.sub("", item[0]))))
    messages = ((m["pattern"], m["text"]) for m in found["messages"])
    said = ((pattern_of(sentence), _PLACE.sub("{}", text)) for sentence, text in sentences.items())
    return Catalogue(found["decimal"], found["texts"], sentences, (*said, *messages),
                     found["texts"] | found["cells"])  # fmt: skip


_AROUND = "(.+); (.+) "
"""What the pattern of a cause that was tried begins with."""


@cache
def _phrases(language: str) -> tuple[tuple[str, str, str], ...]:
    """Every message with the longest words of its own, which are looked for before its pattern is.

    First what stands around a cause and its change: either may be any other message.
    """
    known = catalogue(language)
    words = [max(_PLACE.split(sentence), key=len) for sentence in known.sentences]
    words += [""] * (len(known.messages) - len(words))
    every = ((w, *one) for w, one in zip(words, known.messages, strict=True))
    return tuple(sorted(every, key=lambda one: not one[1].startswith(_AROUND)))


@cache  # not re's own, which holds fewer
def _compiled(pattern: str) -> re.Pattern[str]:
    return re.compile(pattern, re.DOTALL)


def pattern_of(sentence: str) -> str:
    """The pattern of a sentence."""
    words = [re.escape(words) for words in _PLACE.split(sentence)]
    places = [_PARTS[place] for place in _PLACE.findall(sentence)]
    return "".join(x for pair in zip(words, [*places, ""], strict=True) for x in pair)


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


def esc(value: object) -> Markup:
    """Text that cannot be taken for markup, and shows its characters in the order in which they stand."""
    if isinstance(value, Markup):
        return value
    text = str(value)
    return escape(text if text.isascii() else unturned(text, TURNING))


def plain_text(value: object) -> str:
    """The same before it is escaped, as templates do on their own."""
    return value if isinstance(value, Markup) else unturned(str(value), TURNING)


def unturned(text: str, shown: Mapping[int, str]) -> str:
    """The text with what is shown for each sign of ``TURNING``; most have none, and are not walked through."""
    return text.translate(shown) if not text.isascii() and any(map(text.__contains__, _SIGNS)) else text


def t(text: str, **values: object) -> Markup:
    """A text of the program in the report's language, with ``{name}`` filled in; values that are no markup escaped.

    Raises MissingTranslationError where the language does not have it.
    """
    if _current.get() != "en":
        texts = catalogue(_current.get()).texts
        if text not in texts:
            raise MissingTranslationError(text)
        text = texts[text]
    return Markup(text).format(**values) if values else Markup(text)


def known(text: str) -> str:
    """A heading or word that may be data: translated where the language has it, else as it is."""
    return catalogue(_current.get()).texts.get(text, text)


def group_name(name: str) -> str:
    """A group of observations: one named after its kind is said in the language, one that people named as it is."""
    return known(name.replace("_", " ")) if name in GROUPS_BY_KIND else name


def message(text: str) -> str:
    """A message that the adjustment has made, translated where its pattern is known, else as it is.

    A part that a pattern has as ``(.+)`` or ``(.+?)`` is a message itself.
    """
    for words, pattern, said in _phrases(_current.get()):
        if words in text and (found := _compiled(pattern).fullmatch(text)):
            numeric = re.findall(r"(?<!\\)\(([^()]*)\)", pattern)
            values = zip(found.groups(), numeric, strict=True)
            return said.format(*(_part(x, kind) for x, kind in values))
    return text


def text_said(text: str) -> str:
    """A text of several lines, each a message; what stands in columns, two spaces apart, stays in them."""
    return text if _current.get() == "en" else "\n".join(map(_line, text.split("\n")))


def _line(text: str) -> str:
    """Words begin where they began, and numbers and headings to the right end where they ended, as far as they can."""
    mark, line = re.fullmatch(r"( *(?:! )?)(.*)", text).groups()  # type: ignore[union-attr]  # fits everything
    whole = message(line)
    if whole != line or not line:
        return str(mark + whole)
    out = ""
    for found in _CELL.finditer(text):
        first, said = not out.strip(), _cell(found[2])
        begin = found.start(2) if first else found.end() - len(said)
        out += " " * max(begin - len(out), 0 if first else 2) + said
    return out


def _cell(text: str) -> str:
    """A word, or several with numbers among them; what only looks like a number, as a name may, is none."""
    words = catalogue(_current.get()).cells
    found = words.get(text) or message(text)
    return found if found != text else _ALONE.sub(lambda m: localised(m[0]), " ".join(
        words.get(word, word) if word in _WORDS else word for word in text.split(" ")))  # fmt: skip


def _part(text: str, kind: str) -> str:
    """A part of a message by its pattern: numbers and messages are said in the language, the rest is data."""
    return localised(text) if kind in (r"[\d.]+", _NUMBER) else message(text) if kind in (".+", ".+?") else text


def localised(number: str) -> str:
    """A number with the decimal sign of the language."""
    return number.replace(".", catalogue(_current.get()).decimal)
