"""XML without surprises: no document type, no entities, nothing fetched, every element with its line."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from adjust.errors import SurveyError
from survey.files.text import read_bytes, suggestion
from survey.interop.foreign import Where, number

_DEEPEST = 40


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

    def __init__(self, path: Path, parser: Any) -> None:
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

    def refuse(self, *_arguments: Any) -> int:
        where = Where(self.path, self.parser.CurrentLineNumber)
        raise where.error("a document type or an entity is declared, which network files do not need; remove it")


def read_xml(path: Path, root_tag: str) -> Element:
    """The tree of a file whose root is ``root_tag``. Raises SurveyError with the line for what is no such XML."""
    data = read_bytes(path)[0]
    parser = expat.ParserCreate()
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
