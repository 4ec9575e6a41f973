"""The five steps over frozen values: read -> problem -> solve -> precision -> report. Each step returns a new value."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import Survey
from survey.folder.text import suggestion
from survey.jobs.adjusting.outcome import run_info
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.cross_validation import CrossValidation
from survey.jobs.cross_validation import cross_validate as cross_validate_project
from survey.jobs.detecting.job import detect_job
from survey.jobs.detecting.outcome import DetectOutcome
from survey.jobs.excluding import ExcludeOutcome, exclude_job, include_job
from survey.notebook.names import heading, html_table
from survey.notebook.solution import Solution
from survey.project import AdjustmentOptions, Project
from survey.project import read as read_project
from survey.project.project import lines_text, observed


def read(folder: str | Path) -> Project:
    """Read a project folder; nothing is computed and nothing written. Raises SurveyError."""
    return read_project(Path(folder))


def detect(
    folder: str | Path, *, progress: bool = False, jobs: int | None = None, everything: bool = False
) -> DetectOutcome:  # fmt: skip
    """Find targets and spots in the images of a folder that are new or have changed, and write their tables there.

    everything: in the other images too. Raises SurveyError.
    """
    return detect_job(Path(folder), jobs=jobs, progress=progress, everything=everything)


def exclude(folder: str | Path, *names: str, reason: str, author: str = "") -> ExcludeOutcome:
    """Leave observations of a folder out from now on, such as ``"X/hX05"`` or ``"distances:B1-B2"``.

    All of ``names`` or none; nothing is adjusted. Raises SurveyError.
    """
    return exclude_job(Path(folder), names, reason, author)


def include(folder: str | Path, *names: str, reason: str = "", author: str = "") -> ExcludeOutcome:
    """Take back what was excluded from a folder, all of ``names`` or none. Raises SurveyError."""
    return include_job(Path(folder), names, reason, author)


@frozen(eq=False)
class Problem:
    """What is to be adjusted: a project and how. It shows what is observed and what is asked for."""

    project: Project

    @property
    def survey(self) -> Survey:
        """Cameras, stations, points and all observations, as :func:`adjust.solve` takes them."""
        return self.project.survey

    @property
    def options(self) -> AdjustmentOptions:
        """How it will be adjusted."""
        return self.project.options

    def with_options(self, **changed: Any) -> "Problem":
        """The same problem with other options, such as ``reject_points=False``; raises SurveyError for unknown ones."""
        known = [f.name for f in fields(AdjustmentOptions)]
        for name in changed:
            if name not in known:
                raise SurveyError(f"there is no option {name!r}; {suggestion(name, known)}")
        return Problem(replace(self.project, options=replace(self.options, **changed)))

    @property
    def observed(self) -> dict[str, int]:
        """How many observations of each kind there are."""
        return observed(self.survey, sum(len(b.uv) for b in self.project.spots))

    def solve(self, *, progress: bool = False) -> Solution:
        """The next step; see :func:`solve`."""
        return solve(self, progress=progress)

    def __repr__(self) -> str:
        """Counts for people."""
        head = f"Problem {self.project.title or self.project.folder.name}"
        return "\n".join((head, *lines_text(self.project.contents)))

    def _repr_html_(self) -> str:
        return heading("Problem", self.project.title or self.project.folder.name) + html_table(
            ("", ""), [(name, (said, "text-align:left")) for name, said in self.project.contents]
        )


def problem(project: Project | str | Path) -> Problem:
    """What is to be adjusted, of a project or its folder. Raises SurveyError where targets are not detected yet."""
    project = project if isinstance(project, Project) else read(project)
    made = Problem(project)
    if not made.observed:
        what = f"survey.detect({str(project.folder)!r})" if project.images else "tables in observations/"
        raise SurveyError(f"{project.folder}: nothing is observed yet; first {what}")
    return made


def solve(problem: Problem, *, progress: bool = False) -> Solution:
    """Adjust: start values, least squares, gross errors left out as the options say. Raises SurveyError."""
    adjustment = adjust_project(problem.project, progress)
    return Solution(problem.project, adjustment, run_info(problem.project, {}))


def adjust(project: Project | Problem | str | Path, *, progress: bool = False) -> Solution:
    """Problem and solution in one step, of a project or its folder; nothing is written. Raises SurveyError."""
    return solve(project if isinstance(project, Problem) else problem(project), progress=progress)


def cross_validate(
    project: Project | str | Path, distance: float = float("inf"), *, progress: bool = False
) -> CrossValidation:  # fmt: skip
    """The epochs in two halves, each adjusted by itself, and the lenses compared for points at ``distance`` (m).

    Nothing is written. Raises SurveyError where there are no two halves.
    """
    return cross_validate_project(project if isinstance(project, Project) else read(project), distance, progress)
