"""A project that has grown or shrunk, adjusted again beside what it was: all of it or nothing."""

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import field
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.replacing import place_for, replace_parts
from survey.folder.whole import complete
from survey.jobs.adjusting.outcome import AdjustOutcome, made
from survey.jobs.adjusting.warm_start import warm_adjustment
from survey.project import Project
from survey.report.results import RESULTS
from survey.solution.earlier.changes import Snapshot
from survey.solution.earlier.previous import Move, change_dict, change_lines, moves, previous_solution
from survey.solution.earlier.runs import Clock


@frozen(eq=False)
class Change:
    """What becomes of a project. entries: what is new of it in the place where it is made.

    command: as it can be given again. done: what was done, by its word, as plain values; said: the same for people.
    guard: what the adjustment is run in. told: how the adjustment began is said too.
    """

    project: Project
    entries: Sequence[str]
    command: str
    done: dict[str, Any]
    said: tuple[str, ...]
    guard: AbstractContextManager[None] = field(default_factory=nullcontext)
    told: bool = False


@frozen(eq=False)
class ChangeOutcome:
    """A changed project, adjusted. start: how the adjustment began, for people.

    before: None where there was no valid adjustment to compare with; ``why`` says why.
    """

    outcome: AdjustOutcome
    change: Change
    moved: tuple[Move, ...]
    before: Snapshot | None
    why: str
    start: str
    seconds: float

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return {
            **self.outcome.summary(),
            **self.change.done,
            **change_dict(self.before, self.outcome.solution["summary"], self.moved),
            "not_compared_because": self.why or None,
            "start": self.start,
            "seconds": self.seconds,
        }

    def text(self) -> str:
        """For people."""
        lines, after = list(self.change.said), self.outcome.solution["summary"]
        if self.before is None:
            lines.append(f"nothing to compare with: {self.why}")
        elif self.change.told:
            how = f", {self.start}, {self.seconds:.2f} s"
            lines += change_lines(self.before, after, self.moved, how, "old stations and points")
        else:
            lines += change_lines(self.before, after, self.moved)
        return "\n".join([*lines, "", self.outcome.text()])


def changed_project(
    folder: Path, out: Path | None, change: Callable[[Path], Change], *, progress: bool, compared: bool
) -> ChangeOutcome:
    """Change an adjusted project, or a copy of it at ``out``; the project is as before whatever goes wrong.

    change: makes what is new in a place; raises SurveyError. compared: whether there has to be a solution of before.
    """
    begin, clock = time.perf_counter(), Clock()
    with place_for(folder, out) as place:
        with clock.step("read"):
            before, why = _before(folder, compared)
            new = change(place)
        with clock.step("adjust"), new.guard:
            adjustment, start = warm_adjustment(new.project, before, progress)
        outcome = made(new.project, adjustment, place, clock, command=new.command)
        if out is None:
            replace_parts(folder, [*new.entries, RESULTS])
        else:
            complete(folder, place)
    moved = () if before is None else moves(before, adjustment, new.project.options.sigmas)
    return ChangeOutcome(outcome.at(out or folder), new, moved, before, why, start, time.perf_counter() - begin)


def _before(folder: Path, needed: bool) -> tuple[Snapshot | None, str]:
    """The last solution, or why there is none to compare with; raises SurveyError for that where one is needed."""
    try:
        return previous_solution(folder), ""
    except SurveyError as error:
        if needed:
            raise
        return None, str(error)
