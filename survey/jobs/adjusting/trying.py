"""A candidate of a diagnosis carried out on the project folder: all of it or nothing, so that it can be taken back."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from adjust.diagnosis.diagnosis import Diagnosis
from adjust.diagnosis.hypothesis import Hypothesis, LeaveOut, Place, ScaleKey, SetKey, edit_told
from adjust.model.errors import DiagnosedError, SurveyError
from survey.folder.locking import settled
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import NOT_OURS, atomic_write, read_bytes
from survey.jobs.adjusting.edits import changed_files, left_out
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.detecting.image_defects import blurred
from survey.jobs.excluding import FILE, new_rows
from survey.project import read
from survey.project.exclusions import appended
from survey.project.finding import find
from survey.project.observed import Observed
from survey.project.project import RESULTS, Project
from survey.project.reading import read_all
from survey.project.tables.layouts import LAYOUTS
from survey.report.unsolved import JSON
from survey.solution.earlier.runs import same_versions
from survey.solution.records import sections


def try_job(folder: Path, number: int) -> str:
    """Carry out candidate ``number`` (from 1) of the diagnosis. What was done, for people.

    It is that of the results where they are of these inputs, else the project is adjusted first.
    Files that are changed are kept as they were below ``kept/``; what is left out becomes rows of ``exclusions.csv``.
    Raises SurveyError, with nothing written, where there is no such candidate, where only a person can do it, and where
    the project could not be read afterwards.
    """
    return carried_out(folder, chosen_of(folder, _candidates(folder), number))


def chosen_of(folder: Path, candidates: Sequence[Hypothesis], number: int) -> Hypothesis:
    """Candidate ``number`` (from 1), which a program can carry out; raises SurveyError for others."""
    if not 1 <= number <= len(candidates):
        n = len(candidates)
        found = f"{n} candidate{'s' if n > 1 else ''}" if n else "no cause that it could change"
        raise SurveyError(f"{folder}: --try {number}: the diagnosis names {found}; see labsurvey adjust {folder.name}")
    chosen = candidates[number - 1]
    if not chosen.edits:
        raise SurveyError(f"{folder}: --try {number}: only you can do that: {chosen.change}")
    return chosen


def _candidates(folder: Path) -> list[Hypothesis]:
    """Those that the diagnosis tells, then what leaves blurred images out."""
    project = read(folder)
    return [*(_told_before(project) or _found(project)), *blurred(project.survey, project.detected)]


def _found(project: Project) -> list[Hypothesis]:
    try:
        diagnosis = adjust_project(project, False).diagnosis
    except DiagnosedError as error:
        diagnosis = error.diagnosis
    named = diagnosis.candidates[: len(diagnosis.told())] if isinstance(diagnosis, Diagnosis) else ()
    return [c.hypothesis for c in named]


def _told_before(project: Project) -> list[Hypothesis]:
    """What the results tell that were made of these inputs by these versions; nothing where there are no such ones."""
    for name in (JSON, "solution.json"):  # a solution of before stays beside a failure
        try:
            with settled(project.folder):
                found = sections(read_bytes(project.folder / RESULTS / name)[0], "diagnosis", "inputs")
            inputs = found["inputs"]
            if inputs["hashes"] == dict(project.inputs) and same_versions(inputs["versions"]):
                return [_hypothesis(told) for told in found.get("diagnosis", [])]
        except (SurveyError, *NOT_OURS):  # none, or not ours
            continue
    return []


def _hypothesis(told: Mapping[str, Any]) -> Hypothesis:
    """As results tell it, of which nothing is left to be tried. Raises ValueError for edits outside the project."""
    edits, place = tuple(map(edit_told, told["edits"])), Place(told["kind"], tuple(told["ids"]))
    if any(not isinstance(e, ScaleKey | SetKey | LeaveOut) and e.table not in LAYOUTS for e in edits):
        raise ValueError("a table that no project has")
    return Hypothesis(str(told["name"]), str(told["cause"]), str(told["change"]), place, lambda: None, edits)


def carried_out(folder: Path, chosen: Hypothesis) -> str:
    """All edits of a hypothesis made in the project, or none. What was done, for people. Raises SurveyError."""
    with changing(folder, inputs=True) as place:
        changed = changed_files(folder, chosen)
        after = _readable(folder, {file.name: file.after for file in changed})
        names = in_use(read(folder), left_out(chosen))
        texts = {name: text for file in changed for name, text in ((file.kept, file.before), (file.name, file.after))}
        if names:
            texts[FILE] = appended(folder / FILE, new_rows(after, names, reason_of(chosen)))
        for name, text in texts.items():
            atomic_write(place / name, text)
        replace_parts(folder)
    lines = [f"{file.name}: changed; as it was: {file.kept}" for file in changed]
    if names:
        rows = f"{len(names)} row{'s' if len(names) > 1 else ''}"
        lines.append(f"{FILE}: {rows} added; labsurvey include takes them back")
    return "\n".join([f"changed: {chosen.cause}", *(f"  {line}" for line in lines)])


def _readable(folder: Path, texts: Mapping[str, str]) -> Project:
    """The project as it would be; raises SurveyError where it could not be read any more."""
    try:
        return read_all(folder, texts)
    except SurveyError as error:
        raise SurveyError(f"{folder}: nothing was changed: with this change {error}") from error


def in_use(now: Project, names: Sequence[str]) -> tuple[str, ...]:
    """Those names of which something is not left out already, by people or in a table."""
    observed = Observed(now.survey, now.spots)
    return tuple(name for name in names if observed.is_used(find(observed, name)))


def reason_of(chosen: Hypothesis) -> str:
    """Why something is left out that a candidate leaves out, for ``exclusions.csv``."""
    return f"tried: {chosen.cause}"
