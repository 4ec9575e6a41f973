"""XML without surprises: no entities, nothing fetched, every element with its line.

A document type that only names a grammar is passed over; one that declares anything itself is refused, because
entities and default attributes can blow a short file up without end.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from adjust.model.errors import SurveyError
from survey.folder.text import read_bytes, suggestion
from survey.interop.networks.foreign import LATIN_1, Where, is_utf8, number

_DEEPEST = 40
_LITERAL = rb"(?:\"[^\"]*\"|'[^']*')"
_GRAMMAR = rb"\s+(?:SYSTEM|PUBLIC\s+" + _LITERAL + rb")\s*" + _LITERAL
_DOCTYPE = re.compile(rb"<!DOCTYPE\s+[^\s<>\"'\[\]]+(?:" + _GRAMMAR + rb")?\s*>")
_BLANK = re.compile(rb"(?:\xef\xbb\xbf)?\s+|\xef\xbb\xbf")
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")


@dataclass(eq=False)
class Element:
    """One element; ``text`` is what stands in it outside its children."""

    tag: str
    attributes: dict[str, str]
    where: Where
    children: list["Element"] = field(default_factory=list)
    text: str = ""

    def has(self, name: str) -> bool:
        """Whether the attribute is there."""
        return name in self.attributes

    def get(self, name: str, default: str | None = None) -> str:
        """An attribute without the blanks around it; raises where it is missing and has no default."""
        value = self.attributes.get(name, default)
        if value is None:
            raise self.error(f"the attribute {name!r} is missing; add it")
        return " ".join(value.split())

    def number(self, name: str, default: float | None = None) -> float:
        """An attribute as a number."""
        if default is not None and not self.has(name):
            return default
        return number(self.get(name), name, self.where)

    def all(self, tag: str) -> list["Element"]:
        """The children of this name."""
        return [child for child in self.children if child.tag == tag]

    def one(self, tag: str) -> "Element":
        """The only child of this name; raises where there is none or another."""
        found = self.all(tag)
        if len(found) != 1:
            raise self.error(f"expected one <{tag}>, found {len(found)}; correct it")
        return found[0]

    def allow(self, *names: str) -> None:
        """Raise for an attribute that is not known."""
        for name in self.attributes:
            if name not in names and not name.startswith("xmlns"):
                raise self.error(f"unknown attribute {name!r}; {suggestion(name, names)}")

    def error(self, problem: str) -> SurveyError:
        """An error with the line of this element."""
        return self.where.error(f"<{self.tag}>: {problem}")


class _Builder:
    """Handlers of expat that make a tree of elements."""

    def __init__(self, path: Path, parser: expat.XMLParserType) -> None:
        self.path, self.parser = path, parser
        self.open: list[Element] = []
        self.root: Element | None = None

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, Where(self.path, self.parser.CurrentLineNumber))
        if len(self.open) >= _DEEPEST:
            raise element.error(f"elements are nested deeper than {_DEEPEST}; this is no network file")
        if self.open:
            self.open[-1].children.append(element)
        else:
            self.root = element
        self.open.append(element)

    def end(self, _tag: str) -> None:
        self.open.pop()

    def text(self, data: str) -> None:
        if self.open:
            self.open[-1].text += data

    def refuse(self, *_arguments: object) -> int:
        where = Where(self.path, self.parser.CurrentLineNumber)
        raise where.error("the document type declares entities or the like, which network files do not need; remove it")


def _without_doctype(data: bytes) -> bytes:
    """Blanks instead of a document type that declares nothing; lines stay where they are.

    Without it an entity that nobody declared is an error, as it should be, and no longer a gap in a value.
    """
    at, closing = 0, {b"<?": b"?>", b"<!--": b"-->"}
    while True:
        blank = _BLANK.match(data, at)
        at = at if blank is None else blank.end()
        begin = next((b for b in closing if data.startswith(b, at)), None)
        if begin is None:
            break
        end = data.find(closing[begin], at)
        if end < 0:
            break
        at = end + len(closing[begin])
    found = _DOCTYPE.match(data, at)
    if found is None:
        return data
    return data[:at] + re.sub(rb"[^\r\n]", b" ", found[0]) + data[found.end() :]


def _declared(data: bytes) -> bool:
    """Whether the file says itself that its text is in an encoding other than UTF-8."""
    head = data[:200].removeprefix(b"\xef\xbb\xbf")
    found = re.match(rb"<\?xml[^>]*?encoding\s*=\s*[\"']([\w.-]+)", head)
    return data[:2] in _UTF_16 or (found is not None and found[1].lower() not in (b"utf-8", b"utf8"))


def read_xml(path: Path, root_tag: str) -> Element:
    """The tree of a file whose root is ``root_tag``. Raises SurveyError with the line for what is no such XML."""
    data = _without_doctype(read_bytes(path)[0])
    parser = expat.ParserCreate() if is_utf8(data) or _declared(data) else expat.ParserCreate(LATIN_1)
    parser.buffer_text = True
    builder = _Builder(path, parser)
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.text
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = builder.refuse
    parser.ExternalEntityRefHandler = builder.refuse
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        line = getattr(error, "lineno", 1)
        raise Where(path, line).error(f"this is not well-formed XML ({error}); correct it") from None
    if builder.root is None or builder.root.tag != root_tag:
        found = builder.root.tag if builder.root else "nothing"
        raise SurveyError(f"{path}: the outermost element is {found!r}, not {root_tag!r}; give a file of that kind")
    return builder.root
