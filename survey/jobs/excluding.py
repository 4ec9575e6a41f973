"""The jobs ``exclude`` and ``include``: what people leave out, as rows added to ``observations/exclusions.csv``.

>>> print(exclude_job(Path("lab"), ["X/hX05", "r7c2"], "motion blur").text())
>>> print(include_job(Path("lab"), ["X/hX05"], "was another one").text())

Nothing is adjusted: every command obeys the file from then on.
"""

import getpass
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import atomic_write, suggestion, time_text
from survey.project import Project
from survey.project.exclusions import EXCLUSIONS_FILE, Exclusion, Name, Row, appended, in_force, read_exclusions
from survey.project.finding import by_member, find
from survey.project.observed import Observed
from survey.project.project import OBSERVATIONS_FOLDER, LeftOut
from survey.project.reading import leaving_out, read_all

FILE = f"{OBSERVATIONS_FOLDER}/{EXCLUSIONS_FILE}"


@frozen
class ExcludeOutcome:
    """What was left out or taken back, by name, with what each name means; ``path``: the file that has it."""

    folder: Path
    excluded: bool
    done: tuple[LeftOut, ...]
    meanings: tuple[str, ...]
    path: Path
    n_in_force: int

    def summary(self) -> dict[str, object]:
        """As plain values."""
        names = [o.exclusion.as_dict() | o.counts() for o in self.done]
        return {"folder": str(self.folder), "excluded" if self.excluded else "included": names,
                "n_in_force": self.n_in_force, "written": str(self.path)}  # fmt: skip

    def text(self) -> str:
        """For people."""
        verb = "left out" if self.excluded else "taken back"
        lines = [f"{verb}: {o.exclusion.name} ({meaning})" for o, meaning in zip(self.done, self.meanings, strict=True)]
        return "\n".join([*lines, f"{self.path}: {self.n_in_force} exclusions in force"])


def exclude_job(folder: Path, names: Sequence[str], reason: str, author: str = "") -> ExcludeOutcome:
    """Leave observations out from now on, all of ``names`` or none.

    names: ``image:X/h05``, ``epoch:h05``, ``camera:X``, ``target:board``, ``point:board/r7c2``, ``distances:B1-B2`` and
    so on, bare where one thing only has that name. author: who decides; the surveyor of the project where not given.
    Raises SurveyError for what is unknown, may mean several things or is left out already.
    """
    folder = Path(folder)
    if not reason.strip():
        raise SurveyError(f"{folder}: say why, as --reason \"motion blur\"; the report lists it")  # fmt: skip
    return _changed(folder, True, lambda project: new_rows(project, names, reason, author))


def include_job(folder: Path, names: Sequence[str], reason: str = "", author: str = "") -> ExcludeOutcome:
    """Take back what was excluded, all of ``names`` or none; they may also name what is not there any more.

    Raises SurveyError for what is not excluded by that name.
    """
    return _changed(Path(folder), False, lambda project: included_rows(project, names, reason, author))


def _changed(folder: Path, excluded: bool, decided: Callable[[Project], Sequence[Row]]) -> ExcludeOutcome:
    with changing(folder, inputs=True) as place:
        project = read_all(folder)
        rows = decided(project)
        atomic_write(place / FILE, appended(folder / FILE, rows))
        replace_parts(folder)
    observed = Observed(project.survey, project.spots)
    hits = [observed.hits(row.exclusion.name, row.exclusion.at) for row in rows]
    done = tuple(h.left_out(row.exclusion) for row, h in zip(rows, hits, strict=True))
    now = in_force(read_exclusions(folder / OBSERVATIONS_FOLDER)[0])
    return ExcludeOutcome(folder, excluded, done, tuple(h.text() for h in hits), folder / FILE, len(now))


def author_name(said: Iterable[tuple[str, str]] = ()) -> str:
    """Who decides: $LABSURVEY_AUTHOR, the surveyor of [identification], or the user of the computer."""
    surveyor = next((value for key, value in said if key == "surveyor"), "")
    try:
        return os.environ.get("LABSURVEY_AUTHOR", "") or surveyor or getpass.getuser()
    except (OSError, KeyError):  # a user without a name, as in a container
        return ""


def _said(project: Project, name: Name, reason: str, author: str, at: tuple[float, float] | None = None) -> Exclusion:
    who = author or author_name(project.options.identification)
    return Exclusion(name, reason.strip(), who, time_text(), at=at)


def new_rows(project: Project, names: Sequence[str], reason: str, author: str = "") -> list[Row]:
    """Rows that exclude ``names`` from a project as it is without exclusions. Raises as :func:`exclude_job`."""
    place = project.folder / OBSERVATIONS_FOLDER
    if not names:
        raise SurveyError(f"{project.folder}: no name of an observation is given; name what is to be left out")
    observed = Observed(project.survey, project.spots)
    there = in_force(read_exclusions(place)[0])
    now = leaving_out(project, there.values())
    left = Observed(now.survey, now.spots)
    rows: dict[Name, Row] = {}
    for text in dict.fromkeys(names):
        try:
            name = find(observed, text)
        except SurveyError as error:
            member = by_member(observed, text)
            advice = f"; its coordinates belong to {member}: name the set by its id" if member else ""
            raise SurveyError(f"{place}: {error}{advice}") from error
        if name in there:
            where = f"{place / EXCLUSIONS_FILE}:{there[name].line}"
            raise SurveyError(f"{where}: {name} is left out already; name only what is not")
        if not left.is_used(name):
            by = f"'{project.folder.name}/{FILE}'" if there else "a table, by used = false"
            raise SurveyError(f"{place}: {name} is left out already, by {by}; name only what is not")
        rows[name] = Row(True, _said(project, name, reason, author, observed.place_of(name)))
    return list(rows.values())


def included_rows(project: Project, names: Sequence[str], reason: str = "", author: str = "") -> list[Row]:
    """Rows that take ``names`` back, of a project as it is without exclusions. Raises as :func:`include_job`."""
    return [Row(False, _said(project, found, reason, author)) for found in _in_force(project, names)]


def _in_force(project: Project, names: Sequence[str]) -> list[Name]:
    path = project.folder / FILE
    there = in_force(read_exclusions(path.parent)[0])
    observed, found = Observed(project.survey, project.spots), []
    if not names:
        raise SurveyError(f"{path}: no name of an exclusion is given; name what is to be taken back")
    for text in dict.fromkeys(names):
        same = [n for n in there if text in (str(n), n.id, f"{n.what}:{n.id}") or _ends_in(n.id, text)]
        exact = [n for n in same if text in (str(n), f"{n.what}:{n.id}")] or [n for n in same if text == n.id] or same
        if len(exact) > 1:
            raise SurveyError(f"{path}: {text!r} stands for {' and '.join(map(str, exact[:6]))}; name one of them so")
        found.append(exact[0] if exact else _as_found(path, observed, there, text))
    return list(dict.fromkeys(found))


def _ends_in(name: str, text: str) -> bool:
    """Whether a text is the last part of an id."""
    return name.endswith((f"/{text}", f":{text}"))


def _as_found(path: Path, observed: Observed, there: dict[Name, Exclusion], text: str) -> Name:
    """What a text means among the observations, where that is excluded by its own name."""
    try:
        name = find(observed, text)
    except SurveyError:
        name = None
    if name in there and name is not None:
        return name
    near = suggestion(text, [str(n) for n in there])
    if name is None:
        raise SurveyError(f"{path}: nothing of the name {text!r} is excluded; {near}")
    wider = [n for n in there if observed.covers(n, name)]
    if wider:
        raise SurveyError(f"{path}:{there[wider[0]].line}: {name} is left out by {wider[0]}; take that back")
    hint = "its table says used = false; write true there" if not observed.is_used(name) else near
    raise SurveyError(f"{path}: {name} is not excluded; {hint}")
