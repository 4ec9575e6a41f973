"""What a request says, checked."""

import json
from typing import Any

from starlette.requests import Request

from adjust.model.errors import SurveyError


def distance_of(request: Request) -> float:
    """What a request says of how far a point is, m; at infinity where it says nothing. Raises SurveyError."""
    text = request.query_params.get("distance_m", "inf")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not value > 0.0:
        raise SurveyError(f"distance_m: found {text!r}; expected metres, or inf")
    return value


class BodyError(Exception):
    """What is asked is not understood."""


async def json_of(request: Request) -> Any:
    """The body of a request; raises BodyError."""
    body = await request.body()
    try:
        return json.loads(body or b"{}")
    except (ValueError, RecursionError) as error:
        raise BodyError(str(error)) from error


class Body:
    """An object by its keys; every method raises BodyError for what is not of the kind it gives."""

    def __init__(self, values: Any) -> None:
        if not isinstance(values, dict):
            raise BodyError("expected an object")
        self._values = values

    def _value(self, key: str, default: Any, kinds: tuple[type, ...], expected: str) -> Any:
        value = self._values.get(key, default)
        if type(value) not in kinds:
            raise BodyError(f"{key}: expected {expected}")
        return value

    def text(self, key: str) -> str:
        """A text, empty where there is none."""
        return str(self._value(key, "", (str,), "a text"))

    def number(self, key: str) -> float:
        """A number."""
        return float(self._value(key, None, (int, float), "a number"))

    def names(self, key: str) -> list[str]:
        """Texts, none where there are none."""
        value: list[str] = self._value(key, [], (list,), "a list of names")
        if not all(isinstance(x, str) for x in value):
            raise BodyError(f"{key}: expected a list of names")
        return value

    def flag(self, key: str, default: bool = True) -> bool:
        """Yes or no."""
        return bool(self._value(key, default, (bool,), "true or false"))

    def base(self) -> int | None:
        """The version of the solution that a decision is about."""
        found: int | None = self._value("base", None, (int, type(None)), "the version of a solution")
        return found

    def changes(self) -> tuple[list[str], list[str]]:
        """Names to exclude and to include, of ``changes: [{name} or {what, id}, excluded]``."""
        found = self._values.get("changes", [])
        if not isinstance(found, list) or not found or not all(isinstance(c, dict) for c in found):
            raise BodyError("changes: expected a list of {what, id, excluded}")
        names: tuple[list[str], list[str]] = ([], [])
        for c in found:
            name = c.get("name", c.get("id") if c.get("what") == "reading" else f"{c.get('what')}:{c.get('id')}")
            if not isinstance(name, str) or type(c.get("excluded")) is not bool:
                raise BodyError("changes: expected {what, id, excluded}")
            names[0 if c["excluded"] else 1].append(name)
        return names
