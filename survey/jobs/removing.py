"""The job ``remove``: observations are excluded, and the project is adjusted again, all or nothing.

>>> outcome = remove_job(Path("lab"), ["p3", "distances:tape 1", "image:X/h05"])
>>> print(outcome.text())

Nothing is deleted: the observations are listed in ``observations/exclusions.csv``, and predicted and tested from then
on as long as the rest determines what they hang on.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from adjust.model.errors import IndeterminateError, SurveyError, listed
from adjust.model.result import ParameterName
from adjust.model.survey import Survey
from adjust.statistics.outliers.supported import supported
from survey.folder.text import atomic_write
from survey.folder.whole import copy_folder
from survey.jobs.changing import Change, ChangeOutcome, changed_project
from survey.jobs.excluding import FILE, new_rows
from survey.project.exclusions import Name, appended
from survey.project.project import OBSERVATIONS_FOLDER
from survey.project.reading import leaving_out, read_all, with_exclusions
from survey.solution.earlier.runs import command_line


def remove_job(
    folder: Path, names: Sequence[str], out: Path | None = None, progress: bool = True, reason: str = "",
    author: str = "",
) -> ChangeOutcome:  # fmt: skip
    """Adjust a project, or a copy of it at ``out``, without some observations, which are excluded from then on.

    names: as of :func:`survey.jobs.excluding.exclude_job`. Raises SurveyError for an unknown name, and where the rest
    does not determine everything but what was named; the project is as before whatever goes wrong.
    """
    folder = Path(folder)

    def reduced(place: Path) -> Change:
        everything, before = with_exclusions(read_all(folder), folder)
        rows = new_rows(everything, names, reason, author)
        if out is not None and (folder / OBSERVATIONS_FOLDER).is_dir():
            copy_folder(folder / OBSERVATIONS_FOLDER, place / OBSERVATIONS_FOLDER)
        atomic_write(place / FILE, appended(folder / FILE, rows))
        now, after = with_exclusions(replace(everything, folder=out or folder, files=folder), place)
        left, out_of_it = leaving_out(now, after.values()), [row.exclusion.name for row in rows]
        with _refusing(folder, out_of_it):
            _require_nothing_lost(leaving_out(everything, before.values()).survey, left.survey, out_of_it)
        removed = [str(name) for name in out_of_it]
        said = (f"removed: {', '.join(removed)}",
                f"to take them back: labsurvey include FOLDER {' '.join(removed)}, and adjust again")  # fmt: skip
        return Change(left, [FILE], command_line("remove", folder, *names, out=out, reason=reason),
                      {"removed": removed}, said, _refusing(folder, out_of_it))  # fmt: skip

    return changed_project(folder, out, reduced, progress=progress, compared=False)


@contextmanager
def _refusing(folder: Path, names: Sequence[Name]) -> Iterator[None]:
    """What is raised inside says that the project cannot do without these."""
    try:
        yield
    except SurveyError as error:
        said = f"{folder}: cannot do without {', '.join(map(str, names))}, nothing was changed: {error}"
        if isinstance(error, IndeterminateError):
            raise IndeterminateError(said, error.parameters) from error
        raise type(error)(said) from error


def _require_nothing_lost(survey: Survey, reduced: Survey, names: Sequence[Name]) -> None:
    """What stands in survey.toml goes only where it was named itself: a station by its last pair is an oversight."""
    known = set(supported(survey)[1])
    lost = [name for name in supported(reduced)[1] if name not in known and _is_declared(reduced, name)]
    named = {name.id.split("/")[-1] for name in names if name.what in ("camera", "target", "point")}
    stations = {c.station_id for c in reduced.cameras if c.camera_id in named}
    lost = [name for name in lost if name[1] not in named | stations]
    if lost:
        texts = tuple(" ".join(name) for name in lost)
        raise IndeterminateError(f"nothing would observe {listed(texts, 8)} any more", texts)


def _is_declared(survey: Survey, name: ParameterName) -> bool:
    """Whether an unknown is one of the project itself, and not the pose or reading of a moment."""
    return len(name) == 2 and (name[0] != "point" or any(p.point_id == name[1] for p in survey.points))
