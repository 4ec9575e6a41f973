"""A JSON schema of ``survey.toml`` for editors, made from the declarations that check it."""

from typing import Any

from adjust.lenses.models import MODELS
from survey.project.declared.declarations import DECLARATIONS, declared
from survey.project.declared.keys import NOTHING, REQUIRED, Declared, Key

_BY_ID = {"cameras", "stations", "tables", "targets", "points", "instruments", "setups", "beams", "surfaces", "align",
          "tolerances", "closures"}  # fmt: skip
_NO_ID = '[/\\\\:@,;"|<>*?]'
_NUMBER = {"type": "number"}


def survey_schema() -> dict[str, Any]:
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
            item: dict[str, Any] = {"enum": list(key.choices)} if key.choices else {"type": "string"}
            if (table.name, key.name) == ("lens", "free"):
                item = {"enum": list(_lens_parameters())}
            return _names(item)
        case "table":
            return _below(key, table)


def _names(item: dict[str, Any]) -> dict[str, Any]:
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


def _below(key: Key, table: Declared) -> dict[str, Any]:
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
