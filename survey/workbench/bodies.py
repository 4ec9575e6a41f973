"""What a request says, checked."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from starlette.requests import Request

from adjust.model.errors import SurveyError

if TYPE_CHECKING:
    from survey.detection import ImageReport
    from survey.workbench.pages.beginning import Told
    from survey.workbench.session import Workbench


_LARGEST = 1e12  # what any number of a request may be


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


def whole_of(request: Request, key: str) -> int | None:
    """What a request says of a whole number from 0 on, in its path or behind it; None where it says none."""
    text = str(request.path_params.get(key, request.query_params.get(key, "")))
    return int(text) if text.isdecimal() and len(text) < 10 else None


def size_of(request: Request) -> int | None:
    """Pixels of the longer side that a picture is asked for with; None for all."""
    asked = whole_of(request, "size") or 1600
    return None if request.query_params.get("size") == "full" else asked if asked <= 4096 else 1600


def run_of(request: Request) -> int:
    """The number of a run in a request's path. Raises SurveyError."""
    number = whole_of(request, "number")
    if number is None:
        raise SurveyError("a run has a number; 'labsurvey runs FOLDER' lists them")
    return number


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

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        value = self._value(key, default, (int, float), "a number")
        if not abs(value) <= _LARGEST:  # nor nan
            raise BodyError(f"{key}: expected a number")
        return float(value)

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


def _plan(bench: "Workbench", body: Body, _: Any) -> "Told":
    from survey.planning.job import PlanRequest

    wanted = tuple(body.text("wanted").split())
    return bench.plan(PlanRequest(wanted, int(body.number("add", 5.0)), navigation=body.flag("navigation", False),
                                  place=int(body.number("place", 0.0))))  # fmt: skip


@dataclass(frozen=True)
class Job:
    """A job of a page. call: what of ``survey.Workbench`` it is; changes: whether files may change."""

    call: str
    run: "Callable[[Any, Body, Callable[[ImageReport], None]], Told]"
    changes: bool = True


JOBS: Mapping[str, Job] = {
    "init": Job("start", lambda bench, body, _: bench.start(body.text("images"), body.text("folder"))),
    "show": Job("show", lambda bench, body, _: bench.show(body.text("folder")), changes=False),
    "detect": Job("detect", lambda bench, body, found: bench.detect(everything=body.flag("all", False), told=found)),
    "plan": Job("plan", _plan),
    "navigate": Job("navigate", lambda bench, body, _: bench.navigate(body.text("station"),
                                                                      body.number("interval_s", 0.0) or None)),
    "add": Job("add", lambda bench, body, _: bench.add(body.text("folder"))),
    "compare": Job("compare_with", lambda bench, body, _: bench.compare_with(body.text("folder")), changes=False),
    "batch": Job("batch", lambda bench, body, _: bench.batch(body.names("folders"))),
}  # fmt: skip
"""The jobs of a page by their names, with what it asks of them."""
