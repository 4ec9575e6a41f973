"""The jobs around the adjustment: project folders, target detection, reports, the command ``labsurvey``.

In Python the five steps of the command line are five calls over values that never change:

    project = survey.read("lab")          what the folder holds
    problem = survey.problem(project)     what is observed and what is asked for
    solution = survey.solve(problem)      the adjustment; survey.adjust(project) is both steps
    solution.precision                    tests, reliability, budget; data frames such as solution.points
    solution.report("lab")                everything into lab/results

See docs/python.md. The names in ``__all__`` stay; everything is loaded when it is first used, so that importing this
package costs nothing.
"""

from typing import TYPE_CHECKING

from adjust.model.loading import lazily

if TYPE_CHECKING:
    from adjust.model.errors import SurveyError
    from survey.examples import write_example
    from survey.jobs.pairs import PairsOutcome, station_pairs
    from survey.jobs.starting import start_project
    from survey.notebook.batch import Batch, adjust_many
    from survey.notebook.covariance import Covariance
    from survey.notebook.plots import Plot
    from survey.notebook.solution import Solution
    from survey.notebook.steps import Problem, adjust, cross_validate, detect, exclude, include, problem, read, solve
    from survey.project import Project, write_project
    from survey.workbench.session import Workbench

_PLACES = {
    "Batch": "survey.notebook.batch",
    "Covariance": "survey.notebook.covariance",
    "PairsOutcome": "survey.jobs.pairs",
    "Plot": "survey.notebook.plots",
    "Problem": "survey.notebook.steps",
    "Project": "survey.project",
    "Solution": "survey.notebook.solution",
    "SurveyError": "adjust.model.errors",
    "Workbench": "survey.workbench.session",
    "adjust": "survey.notebook.steps",
    "adjust_many": "survey.notebook.batch",
    "cross_validate": "survey.notebook.steps",
    "detect": "survey.notebook.steps",
    "exclude": "survey.notebook.steps",
    "include": "survey.notebook.steps",
    "problem": "survey.notebook.steps",
    "read": "survey.notebook.steps",
    "solve": "survey.notebook.steps",
    "start_project": "survey.jobs.starting",
    "station_pairs": "survey.jobs.pairs",
    "write_example": "survey.examples",
    "write_project": "survey.project",
}

__all__ = [
    "Batch",
    "Covariance",
    "PairsOutcome",
    "Plot",
    "Problem",
    "Project",
    "Solution",
    "SurveyError",
    "Workbench",
    "adjust",
    "adjust_many",
    "cross_validate",
    "detect",
    "exclude",
    "include",
    "problem",
    "read",
    "solve",
    "start_project",
    "station_pairs",
    "write_example",
    "write_project",
]

__getattr__ = lazily(globals(), _PLACES)


def __dir__() -> list[str]:
    """Public names first."""
    return sorted(__all__)
