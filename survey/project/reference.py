"""Every key of ``survey.toml`` and every column, of what checks them: the page, a schema for editors."""

from collections.abc import Iterator
from itertools import groupby
from typing import Any

from adjust.lenses.models import MODELS
from survey.project.declared.declarations import DECLARATIONS, declared
from survey.project.declared.keys import NOTHING, REQUIRED, Declared, Key
from survey.project.exclusions import EXCLUSIONS
from survey.project.tables.column_texts import COLUMN_TEXTS, column_text
from survey.project.tables.layouts import LAYOUTS
from survey.project.tables.reading import Layout

_HEAD = """\
# Reference: every key and every column

All of `survey.toml` and of the tables in `observations/`, as the program checks them: this page is what
`labsurvey schema --markdown` prints. Keys and columns that are not here are refused, with the nearest known name.
What they are for: [observations](observations.md), [planning](planning.md) for `plan.toml`, [capture](capture.md) for
capture plans.

**In an editor**: `labsurvey schema > survey.schema.json` writes a JSON schema. With `#:schema ./survey.schema.json` as
the first line of `survey.toml`, editors that know it (Taplo, Even Better TOML) complete keys, show what they mean, and
underline what is wrong.

`ID` is a name of your own: letters, digits, `_`, `-` and `.`. Units are the endings of names.
"""
_KINDS = {"text": "text", "choice": "text", "flag": "true or false", "whole": "whole number", "number": "number",
          "names": "list of texts"}  # fmt: skip
_LINKS = {"pose": "[pose](#a-pose)", "poses": "[poses](#poses-by-epoch)"}


def reference_page() -> str:
    """The page in Markdown."""
    parts = [_HEAD, "## survey.toml\n"]
    parts += [_table(d) for d in DECLARATIONS]
    parts.append("## Parameters of the lens models\n")
    parts.append(_rows(("model", "parameters"), [(f"`{m.name}`", _listed(m.names)) for m in MODELS.values()]))
    parts.append("## Tables in `observations/`\n\nCSV with a head line, or Parquet with the same columns. Rows may be "
                 "in any order; columns that may be missing may also be blank.\n")  # fmt: skip
    parts += [_layout(layout) for layout in (*LAYOUTS.values(), EXCLUSIONS)]
    return "\n".join(parts)


def _table(d: Declared) -> str:
    where = f"[{d.path}]" if d.path and not d.path.isupper() else {
        "": "Before the first table", "POSE": "A pose", "EPOCHS": "Poses by epoch", "SIGMA": "`sigma` of named values",
        "CLOCK": "The clock of a table or a station",
    }[d.path]  # fmt: skip
    title = f"`{where}`" if where.startswith("[") else where
    kind = "" if d.of is None else f' with {d.of[0]} = "{d.of[1]}"'
    rows = [_row(key) for key in d.keys]
    if d.free_keys is not None:
        rows.append(_row(d.free_keys))
    return f"### {title}{kind}\n\n{d.what}\n\n" + _rows(("key", "value", "default", "meaning"), rows)


def _row(key: Key) -> tuple[str, ...]:
    name = key.name if key.name.isupper() else f"`{key.name}`"
    return name, _kind(key), _default(key), _meaning(key)


def _kind(key: Key) -> str:
    unit = f" {key.unit}" if key.unit else ""
    match key.kind:
        case "choice":
            return " or ".join(f'`"{word}"`' for word in key.choices)
        case "numbers":
            return f"list of {key.size[0]}{unit}"
        case "matrix":
            rows = key.size if len(key.size) == 2 else (key.size[0], key.size[0])
            return f"{rows[0]} rows of {rows[1]}" if rows[0] else "square matrix"
        case "sigma":
            return f"number{unit}, or one for each of {key.size[0]}"
        case "number":
            return f"number{unit}" + (" > 0" if key.positive else "")
        case "whole":
            return "whole number" + (f" ≥ {key.least}" if key.least is not None else "")
        case "flag" if key.choices:
            return f"true, false or a list of {', '.join(f'`{word}`' for word in key.choices)}"
        case "table":
            return _LINKS.get(key.table, "table")
    return _KINDS[key.kind]


def _default(key: Key) -> str:
    if key.default is REQUIRED:
        return "**required**"
    if key.default is NOTHING:
        return ""
    if isinstance(key.default, bool):
        return f"`{str(key.default).lower()}`"
    if isinstance(key.default, list):
        return "`[" + ", ".join(f'"{x}"' if isinstance(x, str) else f"{x:g}" for x in key.default) + "]`"
    return f'`"{key.default}"`' if isinstance(key.default, str) else f"`{key.default:g}`"


def _meaning(key: Key) -> str:
    refers = f"; an ID of `[{key.refers}]`" if key.refers and key.kind == "text" else ""
    refers = f"; IDs of `[{key.refers}]`" if key.refers and key.kind == "names" else refers
    return key.what.replace("|", "\\|") + refers


def _layout(layout: Layout) -> str:
    rows: list[tuple[str, ...]] = []
    needed = set(layout.required)
    said = [(c, column_text(layout.name, c), c in needed) for c in (*layout.required, *_optional(layout))]
    for (text, required), columns in groupby(said, key=lambda row: row[1:]):
        names = [c for c, *_ in columns]
        shown = _listed(names) if len(names) < 4 else f"`{names[0]}` … `{names[-1]}`"
        rows.append((shown, "**required**" if required else "", text))
    return f"### `{layout.name}.csv`\n\n{COLUMN_TEXTS[layout.name][0]}\n\n" + _rows(("column", "", "meaning"), rows)


def _optional(layout: Layout) -> Iterator[str]:
    yield from (c for c in layout.columns if c not in layout.required)


def _listed(names: tuple[str, ...] | list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _rows(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


_BY_ID = {"cameras", "stations", "tables", "targets", "points", "instruments", "setups", "beams", "surfaces", "align",
          "tolerances", "closures"}  # fmt: skip
_NO_ID = '[/\\\\:@,;"|<>*?]'
_NUMBER = {"type": "number"}


def survey_schema() -> dict[str, object]:
    """JSON schema (draft 2020-12) of a whole ``survey.toml``."""
    definitions = {d.name: _object(d) for d in DECLARATIONS}
    for name in ("target", "surface"):
        kinds = [d.name for d in DECLARATIONS if d.name.startswith(f"{name}_") and d.of is not None]
        definitions[name] = {"oneOf": [_ref(kind) for kind in kinds]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "survey.toml of labsurvey",
        **definitions.pop("root"),
        "$defs": definitions,
    }


def _ref(name: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{name}"}


def _object(table: Declared) -> dict[str, Any]:
    out: dict[str, Any] = {"type": "object", "description": table.what, "additionalProperties": False}
    if table.free_keys is not None:
        out["additionalProperties"] = _value(table.free_keys, table)
    if table.keys:
        out["properties"] = {key.name: _value(key, table) for key in table.keys}
    needed = [key.name for key in table.keys if key.default is REQUIRED]
    return out | ({"required": needed} if needed else {})


def _value(key: Key, table: Declared) -> dict[str, Any]:
    out = _typed(key, table)
    if "$ref" in out:  # beside a reference nothing else is shown by every editor
        return out
    unit = f" [{key.unit}]" if key.unit else ""
    out["description"] = f"{key.what}{unit}"
    if key.default is not NOTHING and key.default is not REQUIRED:
        out["default"] = key.default
    return out


def _typed(key: Key, table: Declared) -> dict[str, Any]:
    match key.kind:
        case "text":
            return {"type": "string"}
        case "choice":
            fixed = table.of is not None and table.of[0] == key.name
            return {"const": table.of[1]} if fixed and table.of is not None else {"enum": list(key.choices)}
        case "flag":
            flag = {"type": "boolean"}
            return {"anyOf": [flag, _names({"enum": list(key.choices)})]} if key.choices else flag
        case "whole":
            return {"type": "integer"} | ({} if key.least is None else {"minimum": key.least})
        case "number":
            return _NUMBER | ({"exclusiveMinimum": 0} if key.positive else {})
        case "numbers":
            return _list(_NUMBER, 1 if table.name == "point" else key.size[0], key.size[0])
        case "matrix":
            return _matrix(key.size)
        case "sigma":
            one = {"anyOf": [_NUMBER | {"exclusiveMinimum": 0}, {"const": "inf"}]}
            return {"anyOf": [one, _list(one, 1, key.size[0])]}
        case "names":
            item: dict[str, object] = {"enum": list(key.choices)} if key.choices else {"type": "string"}
            if (table.name, key.name) == ("lens", "free"):
                item = {"enum": list(_lens_parameters())}
            return _names(item)
        case "table":
            return _below(key, table)


def _names(item: dict[str, object]) -> dict[str, object]:
    return {"type": "array", "items": item, "uniqueItems": True}


def _list(item: dict[str, Any], least: int, most: int) -> dict[str, Any]:
    return {"type": "array", "items": item, "minItems": least, "maxItems": most}


def _matrix(size: tuple[int, ...]) -> dict[str, Any]:
    if len(size) == 2:
        return _list(_list(_NUMBER, size[1], size[1]), size[0], size[0])
    if not size[0]:
        return {"type": "array", "items": {"type": "array", "items": _NUMBER}}
    row = {"type": "array", "items": {"anyOf": [_NUMBER, {"const": "inf"}]}, "minItems": size[0], "maxItems": size[0]}
    return _list(row, size[0], size[0])


def _below(key: Key, table: Declared) -> dict[str, object]:
    """The table under a key: one, or one for each id."""
    if table.name == "lens" and key.name in ("values", "prior", "tie"):
        entry = _NUMBER if key.name == "values" else _ref(key.table)
        return {"type": "object", "properties": dict.fromkeys(_lens_parameters(), entry), "additionalProperties": False}
    if table.name == "root" and key.name in _BY_ID:
        return {
            "type": "object", "additionalProperties": _ref(key.table), "propertyNames": {"not": {"pattern": _NO_ID}},
        }  # fmt: skip
    return _ref(key.table)


def _lens_parameters() -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for key in declared("lens").keys[0].choices for name in MODELS[key].names))
