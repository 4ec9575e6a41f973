"""Tables as TOML text, in the order given."""

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

Section = tuple[tuple[str, ...], Mapping[str, Any]]


def toml_text(sections: Iterable[Section]) -> str:
    """A document of ``sections``: path of the header (empty for the top) and its keys; tables below them are inline."""
    parts = []
    for path, values in sections:
        lines = [f"[{'.'.join(_key(part) for part in path)}]"] if path else []
        lines += [f"{_key(key)} = {_value(value)}" for key, value in values.items()]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _string(key)


def _string(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # JSON leaves DEL as it is, TOML does not


def _value(value: Any) -> str:
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value)  # inf and nan are TOML, too
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items())
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(item) for item in value)}]"
    raise TypeError(f"no TOML for {type(value)}")
