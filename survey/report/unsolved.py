"""An adjustment that failed, as files beside its message: what was found, where it stopped, what pulls there."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gtsam import Pose3
from markupsafe import Markup

from adjust.model.errors import DiagnosedError, IndeterminateError, NotConvergedError, SurveyError
from adjust.model.stopped import Stopped, UnknownState
from survey.folder.plain import plain
from survey.report.language import group_name, message, speaking, t
from survey.report.markup import count, document, element, general, joined, note, part, section, table
from survey.report.sections.diagnosis import causes
from survey.solution.dictionary import RunInfo
from survey.solution.quantities import key_of, pose_dict, unit_for_people
from survey.solution.records import solution_json

JSON, PAGE = "unsolved.json", "unsolved.html"
_MOST = 200


def unsolved_files(error: SurveyError, run: RunInfo, in_language: str = "en") -> dict[str, bytes]:
    """``unsolved.json`` and ``unsolved.html`` of an adjustment that raised ``error``, by name.

    None where there was nothing to adjust: the message says it all.
    """
    if not isinstance(error, DiagnosedError | IndeterminateError) and _stopped(error) is None:
        return {}
    found = unsolved_dict(error, run)
    with speaking(in_language):
        return {JSON: solution_json(found).encode(), PAGE: _page(found).encode()}


def unsolved_dict(error: SurveyError, run: RunInfo) -> dict[str, Any]:
    """The message, the causes that were tried, the state where it stopped; as plain values."""
    stopped = _stopped(error)
    told = error.diagnosis.told() if isinstance(error, DiagnosedError) else []
    found = {
        "format": 1,
        "summary": {"folder": run.folder, "title": run.title, "converged": False, "date": run.date,
                    **({} if stopped is None else {"iterations": stopped.iterations, "omega": stopped.omega,
                                                   "last_step_sigmas": stopped.last_step})},
        "message": str(error),
        "diagnosis": told,
        **({} if stopped is None else _state(stopped)),
        "inputs": {"hashes": dict(run.input_hashes), "options": dict(run.options), "versions": dict(run.versions)},
    }  # fmt: skip
    return dict(plain(found))


def _stopped(error: BaseException | None) -> Stopped | None:
    """Of the first error of its chain of causes that knows it."""
    while error is not None:
        if isinstance(error, NotConvergedError) and error.stopped is not None:
            return error.stopped
        error = error.__cause__
    return None


def _state(stopped: Stopped) -> dict[str, Any]:
    return {
        "groups": {
            g.group: {"n": g.n, "rms_at_start": g.at_start, "rms_where_it_stopped": g.where_stopped,
                      "worst": [{"name": name, "rms": rms} for name, rms in g.worst]}
            for g in stopped.groups
        },
        "gradient": [
            {"unknowns": p.kind, "n": p.n, "rms_sigmas": p.rms, "largest": p.largest[0],
             "largest_sigmas": p.largest[1]}
            for p in stopped.gradient
        ],
        "state": {"/".join(u.name): {"start": _values(u, u.start), "value": _values(u, u.value)}
                  for u in stopped.unknowns},
    }  # fmt: skip


def _values(unknown: UnknownState, value: Any) -> dict[str, Any]:
    if isinstance(value, Pose3):
        return pose_dict(value)
    numbers = np.asarray(value, dtype=float).tolist()
    if unknown.name[0] == "point":
        return {f"{axis}_mm": 1e3 * x for axis, x in zip("xyz", numbers, strict=True)}
    return {key_of(name, (shown := unit_for_people(name, unit))[0]): x * shown[1]
            for name, unit, x in zip(unknown.components, unknown.units, numbers, strict=True)}  # fmt: skip


def _page(found: Mapping[str, Any]) -> str:
    s = found["summary"]
    first, *rest = str(found["message"]).splitlines()
    head = part("header", t("Adjustment report"), s["title"] or s["folder"], " · ".join((s["folder"], s["date"])))
    verdict = part("verdict", "failed", t("Failed"), message(first))
    lines = joined([element("p", message(line.strip().removeprefix("- "))) for line in rest])
    body = head + verdict + lines + causes(found["diagnosis"], s["folder"])
    if "groups" in found:
        body += _groups(found["groups"]) + _gradient(found["gradient"]) + _moved(found["state"])
    return document(f"{s['title'] or s['folder']} – {t('Adjustment report')}", body)


def _groups(found: Mapping[str, Any]) -> Markup:
    rows = [
        (group_name(name), count(g["n"]), general(g["rms_at_start"], 3), general(g["rms_where_it_stopped"], 3),
         ", ".join(f"{w['name']} ({general(w['rms'], 3)})" for w in g["worst"]))
        for name, g in found.items()
    ]  # fmt: skip
    columns = ("<Group", "Observations", "Misfit at the start [σ]", "Misfit where it stopped [σ]", "<Worst")
    return section("groups", "Groups of observations", table(columns, rows))


def _gradient(found: list[dict[str, Any]]) -> Markup:
    rows = [(p["unknowns"].replace("_", " "), count(p["n"]), general(p["rms_sigmas"], 3), p["largest"],
             general(p["largest_sigmas"], 3)) for p in found]  # fmt: skip
    said = t("How many of its own sigmas each unknown would go by itself: zero in a minimum.")
    columns = ("<Unknowns", "Components", "Gradient [σ]", "<Largest", "[σ]")
    return section("gradient", "Gradient", table(columns, rows) if rows else "", said)


def _moved(found: Mapping[str, Any]) -> Markup:
    def shown(values: Mapping[str, Any]) -> str:
        numbers = values.get("translation_mm", list(values.values()))
        return ", ".join(general(x, 6) for x in np.ravel(numbers).tolist())

    rows = [(name, shown(x["start"]), shown(x["value"])) for name, x in list(found.items())[:_MOST]]
    more = note(t("{n} more in unsolved.json.", n=count(len(found) - _MOST))) if len(found) > _MOST else Markup()
    columns = ("<Unknown", "<Start", "<Where it stopped")
    said = t("Poses by their shifts, in mm; points in mm; rotations are in unsolved.json.")
    return section("state", "State", table(columns, rows) + more, said)
