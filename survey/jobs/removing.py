"""The job ``remove``: observations are excluded, and the project is adjusted again, all or nothing.

>>> outcome = remove_job(Path("lab"), ["p3", "distances:tape 1", "image:X/h05"])
>>> print(outcome.text())

Nothing is deleted: the observations are listed in ``observations/exclusions.csv``, and predicted and tested from then
on as long as the rest determines what they hang on.
"""

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import Survey
from adjust.statistics.outliers.supported import supported
from survey.folder.replacing import complete, copy_folder, place_for, replace_parts
from survey.folder.text import atomic_write
from survey.jobs.adjusting.outcome import AdjustOutcome, made
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.adjusting.warm_start import COLD, warm_adjustment
from survey.jobs.excluding import FILE, new_rows
from survey.project import Project, read
from survey.project.exclusions import Name, appended
from survey.project.merging import point_files, read_copy
from survey.project.project import DEFINITION_FILE, OBSERVATIONS_FOLDER
from survey.project.reading import read_all
from survey.report.results import RESULTS
from survey.solution.earlier.changes import Snapshot
from survey.solution.earlier.previous import Move, change_dict, change_lines, moves, read_previous
from survey.solution.earlier.runs import Clock, command_line


@dataclass(frozen=True, eq=False)
class RemoveOutcome:
    """An adjustment without some observations. removed: their names.

    before: None where there was no valid adjustment to compare with; ``why`` says why.
    """

    outcome: AdjustOutcome
    removed: tuple[str, ...]
    moved: tuple[Move, ...]
    before: Snapshot | None
    why: str
    start: str
    seconds: float

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return {
            **self.outcome.summary(),
            "removed": list(self.removed),
            **change_dict(self.before, self.outcome.solution["summary"], self.moved),
            "not_compared_because": self.why or None,
            "start": self.start,
            "seconds": self.seconds,
        }

    def text(self) -> str:
        """For people."""
        lines = [f"removed: {', '.join(self.removed)}"]
        lines.append(f"to take them back: labsurvey include FOLDER {' '.join(self.removed)}, and adjust again")
        if self.before is None:
            lines.append(f"nothing to compare with: {self.why}")
        else:
            lines += change_lines(self.before, self.outcome.solution["summary"], self.moved)
        return "\n".join([*lines, "", self.outcome.text()])


def remove_job(
    folder: Path, names: Sequence[str], out: Path | None = None, progress: bool = True, reason: str = "",
    author: str = "",
) -> RemoveOutcome:  # fmt: skip
    """Adjust a project, or a copy of it at ``out``, without some observations, which are excluded from then on.

    names: as of :func:`survey.jobs.excluding.exclude_job`. Raises SurveyError for an unknown name, and where the rest
    does not determine everything but what was named; the project is as before whatever goes wrong.
    """
    begin, folder = time.perf_counter(), Path(folder)
    with place_for(folder, out) as place:
        project = read(folder)
        before, why = _previous(project)
        rows = new_rows(read_all(folder), names, reason, author)
        _copy(folder, place)
        atomic_write(place / FILE, appended(folder / FILE, rows))
        reduced = read_copy(place, project, out or folder)
        adjustment, start = _adjusted(folder, project, reduced, [row.exclusion.name for row in rows], before, progress)
        said = command_line("remove", folder, *names, out=out, reason=reason)
        outcome = made(reduced, adjustment, place, Clock({"adjust": time.perf_counter() - begin}), command=said)
        if out is None:
            replace_parts(folder, [FILE, RESULTS])
        else:
            complete(folder, place)
    outcome = outcome.at(out or folder)
    moved = () if before is None else moves(before, adjustment, project.options.sigmas)
    removed = tuple(str(row.exclusion.name) for row in rows)
    return RemoveOutcome(outcome, removed, moved, before, why, start, time.perf_counter() - begin)


def _adjusted(
    folder: Path, project: Project, reduced: Project, names: Sequence[Name], before: Snapshot | None, progress: bool
) -> tuple[Adjustment, str]:
    try:
        _require_nothing_lost(project.survey, reduced.survey, names)
        if before is None:
            return adjust_project(reduced, progress), COLD
        return warm_adjustment(reduced, before, lambda p: adjust_project(p, progress), progress)
    except SurveyError as error:
        said = f"{folder}: cannot do without {', '.join(map(str, names))}, nothing was changed: {error}"
        if isinstance(error, IndeterminateError):
            raise IndeterminateError(said, error.parameters) from error
        raise type(error)(said) from error


def _require_nothing_lost(survey: Survey, reduced: Survey, names: Sequence[Name]) -> None:
    """What stands in survey.toml goes only where it was named itself: a station by its last pair is an oversight."""
    known = set(supported(survey)[1])
    lost = [name for name in supported(reduced)[1] if name not in known and _is_declared(reduced, name)]
    named = {name.parts[-1] for name in names if name.what in ("camera", "target", "point")}
    stations = {c.station_id for c in reduced.cameras if c.camera_id in named}
    lost = [name for name in lost if name[1] not in named | stations]
    if lost:
        texts = tuple(" ".join(name) for name in lost)
        raise IndeterminateError(f"nothing would observe {', '.join(texts[:8])} any more", texts)


def _is_declared(survey: Survey, name: ParameterName) -> bool:
    """Whether an unknown is one of the project itself, and not the pose or reading of a moment."""
    return len(name) == 2 and (name[0] != "point" or any(p.point_id == name[1] for p in survey.points))


def _previous(project: Project) -> tuple[Snapshot | None, str]:
    """The last solution, or why there is none to compare with."""
    try:
        return read_previous(project), ""
    except SurveyError as error:
        return None, str(error)


def _copy(folder: Path, place: Path) -> None:
    """All that is read of a project, except images, which no adjustment reads."""
    if (folder / OBSERVATIONS_FOLDER).is_dir():
        copy_folder(folder / OBSERVATIONS_FOLDER, place / OBSERVATIONS_FOLDER)
    for name in (DEFINITION_FILE, *point_files(folder)):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(folder / name, place / name)
