"""Names that mean harm, in every place of a survey where a file can put one; a look at the pages made of them."""

import dataclasses
import json
from collections import Counter
from html.parser import HTMLParser
from typing import Any

PAYLOADS = (
    "<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "'><svg onload=alert(1)>", "</script><b>",
    "</title></style></textarea>", "\u202egpj.x", "{n} {} %s {0!r}", "<!--", "&lt;i&gt;&#60;b>", "\\u003cb\\x3e",
    "javascript:alert(1)", "]]><![CDATA[", "</svg><a href=javascript:alert(1)>",
)  # fmt: skip
BIDI = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u200e\u200f\u061c"
_FIELDS = ("group", "title", "name", "folder", "remarks")


def _is_name(field: str) -> bool:
    return field.endswith(("_id", "_ids", "ids")) or field in _FIELDS


def names_in(value: Any) -> list[str]:
    """All names in a tree of dataclasses, in their order."""
    found: dict[str, None] = {}

    def look(value: Any, here: bool) -> None:
        if isinstance(value, str) and here and value:
            found[value] = None
        elif dataclasses.is_dataclass(value):
            for field in dataclasses.fields(value):
                look(getattr(value, field.name), _is_name(field.name))
        elif isinstance(value, tuple | list):
            for one in value:
                look(one, here)
        elif isinstance(value, dict):
            for one in value.values():
                look(one, here)

    look(value, False)
    return list(found)


def evil_names(names: list[str]) -> dict[str, str]:
    """An evil name for each; all of them different."""
    return {name: f"{name}{PAYLOADS[k % len(PAYLOADS)]}" for k, name in enumerate(names)}


def renamed(value: Any, names: dict[str, str]) -> Any:
    """The same tree with other names, also where they are keys or parts of keys."""
    if isinstance(value, str):
        return names.get(value, value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        changed = {}
        for field in dataclasses.fields(value):
            old = getattr(value, field.name)
            if field.init and not (isinstance(old, str) and not _is_name(field.name)):
                changed[field.name] = renamed(old, names)
        return dataclasses.replace(value, **changed)
    if isinstance(value, tuple | list) and type(value) in (tuple, list):
        return type(value)(renamed(one, names) for one in value)
    if isinstance(value, dict):
        return {renamed(key, names): renamed(one, names) for key, one in value.items()}
    return value


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: Counter[tuple[str, tuple[str, ...]]] = Counter()
        self.comments: list[str] = []
        self.data: list[str] = []
        self.links: list[str] = []
        self._is_data = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag, tuple(sorted(name for name, _ in attrs))] += 1
        self.links += [value or "" for name, value in attrs if name in ("href", "src", "xlink:href", "action")]
        self._is_data = tag == "script" and ("type", "application/json") in attrs

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)

    def handle_comment(self, data: str) -> None:
        self.comments.append(data)

    def handle_data(self, data: str) -> None:
        if self._is_data:
            self.data.append(data)
            self._is_data = False


def faults_of(page: str) -> list[str]:
    """What in a page made of evil names is more than text."""
    found, out = _looked_at(page), []
    for (tag, attributes), n in found.tags.items():
        if tag in ("img", "iframe", "object", "embed", "base", "form") or any(a.startswith("on") for a in attributes):
            out.append(f"{n} times <{tag} {' '.join(attributes)}>")
    out += [f"a comment {text[:40]!r}" for text in found.comments]
    out += [f"a link to {link}" for link in found.links if link.lower().startswith(("javascript:", "data:", "//"))]
    out += [f"U+{ord(sign):04X}" for sign in BIDI if sign in page]
    for text in found.data:
        json.loads(text)
    return out


def tags_of(page: str) -> set[tuple[str, tuple[str, ...]]]:
    """All tags of a page with the names of their attributes."""
    return set(_looked_at(page).tags)


def _looked_at(page: str) -> _Page:
    parser = _Page()
    parser.feed(page)
    parser.close()
    return parser
