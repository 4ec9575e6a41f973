"""What a request says, checked, and what of a workbench answers it."""

import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from starlette.requests import Request

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen

if TYPE_CHECKING:
    from survey.solution.earlier.changes import Changes
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


async def json_of(request: Request) -> object:
    """The body of a request; raises BodyError."""
    body = await request.body()
    try:
        return json.loads(body or b"{}")
    except (ValueError, RecursionError) as error:
        raise BodyError(str(error)) from error


class Body:
    """An object by its keys; every method raises BodyError for what is not of the kind it gives."""

    def __init__(self, values: object) -> None:
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


def _plan(bench: "Workbench", body: Body, _: object) -> "Told":
    from survey.planning.job import PlanRequest

    wanted = tuple(body.text("wanted").split())
    return bench.plan(PlanRequest(wanted, int(body.number("add", 5.0)), navigation=body.flag("navigation", False),
                                  place=int(body.number("place", 0.0))))  # fmt: skip


@frozen
class Asked:
    """What a page asks of a project. calls: what of ``survey.Workbench`` it is; changes: whether files may change.

    run: with the workbench, then the body where there is one, then the request; of jobs what is told of each image.
    what: that runs, for pages; only a "view" waits for no solution.
    """

    calls: tuple[str, ...]
    run: Callable[..., Any]
    changes: bool = True
    what: str = "view"


JOBS: Mapping[str, Asked] = {
    "init": Asked(("start",), lambda bench, body, _: bench.start(body.text("images"), body.text("folder"))),
    "show": Asked(("show",), lambda bench, body, _: bench.show(body.text("folder")), changes=False),
    "detect": Asked(("detect",), lambda bench, body, found: bench.detect(
        everything=body.flag("all", False), told=found)),
    "plan": Asked(("plan",), _plan),
    "navigate": Asked(("navigate",), lambda bench, body, _: bench.navigate(body.text("station"),
                                                                      body.number("interval_s", 0.0) or None)),
    "add": Asked(("add",), lambda bench, body, _: bench.add(body.text("folder"))),
    "compare": Asked(("compare_with",), lambda bench, body, _: bench.compare_with(body.text("folder")), changes=False),
    "batch": Asked(("batch",), lambda bench, body, _: bench.batch(body.names("folders"))),
}  # fmt: skip
"""The jobs of a page by their names, with what it asks of them."""


def _definition(bench: "Workbench", body: Body, _: Request) -> "Changes | None":
    """One of: {group, factor}, {parameter, treatment}, {datum: kind, points, stations}."""
    base = body.base()
    if body.text("group"):
        return bench.set_sigma_scale(body.text("group"), body.number("factor"), base)
    if body.text("parameter"):
        return bench.set_treatment(body.text("parameter"), body.text("treatment"), base)
    return bench.set_datum(body.text("datum"), body.names("points"), body.names("stations"), base)


def _exclusions(bench: "Workbench", body: Body, _: Request) -> "Changes | None":
    excluded, included = body.changes()
    return bench.decide(exclude=excluded, include=included, reason=body.text("reason"), author=body.text("author"),
                        base=body.base())  # fmt: skip


DECISIONS: Mapping[str, Asked] = {
    "adjust": Asked(("adjust",), lambda bench, body, _: bench.adjust(
        "cold" if body.text("mode") == "cold" else "warm"), False),
    "reload": Asked(("reload",), lambda bench, _, __: bench.reload(), False),
    "exclusions": Asked(("exclude", "include", "decide"), _exclusions),
    "definition": Asked(("set_sigma_scale", "set_treatment", "set_datum"), _definition),
    "remedy": Asked(("apply_remedy",), lambda bench, body, _: bench.apply_remedy(
        int(body.number("number")), body.base())),
    "undo": Asked(("undo",), lambda bench, body, _: bench.undo(body.base())),
    "redo": Asked(("redo",), lambda bench, body, _: bench.redo(body.base())),
    "runs/{number}/restore": Asked(("restore",), lambda bench, body, request: bench.restore(
        run_of(request), body.base())),
}  # fmt: skip
"""By their addresses; what they answer is the state after them."""


def told_changes(changes: "Changes | None", most: int | None) -> dict[str, object] | None:
    """What an adjustment changed, its summaries in the language that is spoken."""
    from survey.workbench.views.project import in_words

    found = None if changes is None else changes.as_dict(most)
    return found and found | {k: in_words(found[k]) for k in ("before", "after")}


VIEWS: Mapping[str, Asked] = {
    name: Asked((name,), lambda bench, _, name=name: getattr(bench, name)(), False)
    for name in ("readings", "parameters", "scene", "findings", "loops", "network", "table_residuals", "runs")
} | {
    "changes": Asked(("changes",), lambda bench, _: {
        "version": bench.version, "changes": told_changes(bench.changes, 500)}, False),
    "camera/{camera}": Asked(("camera_view",), lambda bench, request: bench.camera_view(
        request.path_params["camera"], distance_of(request)), False),
    "camera/{camera}/difference": Asked(("lens_change",), lambda bench, request: bench.lens_change(
        request.path_params["camera"], whole_of(request, "run"), request.query_params.get("other", ""),
        distance_of(request)), False),
    "compare": Asked(("compare",), lambda bench, request: told_changes(bench.compare(
        whole_of(request, "a"), whole_of(request, "b")), whole_of(request, "most")), False, "compare"),
}  # fmt: skip
"""By their addresses."""
