"""A solved survey as a notebook user wants it: data frames, covariances and plots by name, and its report."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from survey.jobs.adjusting.published_methods import published_dict
from survey.notebook import frames
from survey.notebook.covariance import Covariance
from survey.notebook.names import components, heading, html_table, rows_in_joint, verdict
from survey.notebook.plots import Plot
from survey.notebook.plots import plot as plot_by_name
from survey.project import Project
from survey.report.language import ReportOptions
from survey.report.results import RunInfo, summary_text, write_results
from survey.solution.dictionary import solution_dict
from survey.solution.quantities import Scale, scale_of
from survey.solution.statistics import Statistics, statistics_of
from survey.solution.verdict import MISFIT, UNTESTED, fit_of


@frozen(eq=False)
class Solution:
    """An adjusted project. Data frames are made new each time they are asked for; nothing in here changes.

    Sigmas are those of the report (a posteriori: times sigma0, where there is redundancy).
    """

    project: Project
    adjustment: Adjustment
    run: RunInfo

    @property
    def sigma0(self) -> float:
        """A posteriori standard deviation of unit weight; 1 where residuals are as the sigmas say."""
        return self.adjustment.sigma0

    @property
    def redundancy(self) -> int:
        """Observations more than needed."""
        return self.adjustment.redundancy

    @property
    def passed(self) -> bool | None:
        """Whether no residuals are larger than the sigmas say, of the whole or a part; None: nothing is redundant."""
        fit = fit_of(self.adjustment, self.precision.consistency)
        return None if fit == UNTESTED else fit != MISFIT

    @property
    def warnings(self) -> tuple[str, ...]:
        """What its owner should know first."""
        return self.adjustment.warnings

    @cached_property
    def scale(self) -> Scale:
        """What covariances are multiplied with."""
        return scale_of(self.adjustment, self.run.sigmas)

    @cached_property
    def precision(self) -> Statistics:
        """The fourth step: tests, reliability, weak directions, relative precision, budget, tolerances."""
        return statistics_of(self.adjustment, self.project.options, self.scale)

    @cached_property
    def as_dict(self) -> Mapping[str, Any]:
        """All that ``solution.json`` holds."""
        return solution_dict(self.adjustment, self.run, self.precision)

    @cached_property
    def published(self) -> Mapping[str, Any]:
        """The published step-by-step methods beside this adjustment, as in ``solution.json``.

        Raises SurveyError naming what the project lacks for them.
        """
        return published_dict(self.adjustment, self.scale)

    points = property(frames.points)
    stations = property(frames.stations)
    poses = property(frames.poses)
    cameras = property(frames.cameras)
    lenses = property(frames.lenses)
    tables = property(frames.tables)
    unknowns = property(frames.unknowns)
    image_residuals = property(frames.image_residuals)
    readings = property(frames.readings)
    groups = property(frames.groups)
    reliability = property(frames.reliability)
    relative_precision = property(frames.relative_precision)
    budget = property(frames.budget)

    def covariance(
        self, *names: str | tuple[str, ...], sigmas: Literal["a_priori", "a_posteriori"] | None = None
    ) -> Covariance:
        """Joint covariance of what the names mean: ids ("head", "X"), paths ("lens/X/fx") or tuples of them.

        sigmas: as in the report where None. Raises SurveyError for a name that there is not or that is held.
        """
        estimates = self.adjustment.estimates
        wanted = components(estimates, names)
        if not wanted:
            raise SurveyError("the covariance of what? name things, such as covariance('B3') or covariance('lens/X')")
        scale = self.scale if sigmas is None else scale_of(self.adjustment, sigmas)
        parameters, rows = rows_in_joint(estimates, wanted)
        joint = np.asarray(self.adjustment.precision.joint(parameters))
        units = tuple(dict(zip(estimates[n].components, estimates[n].units, strict=True))[c] for n, c in wanted)
        matrix = scale.factor**2 * joint[np.ix_(rows, rows)]
        return Covariance(wanted, units, matrix, scale.sigmas == "a_posteriori")

    def plot(self, name: str, **chosen: str) -> Plot:
        """A picture by name. Raises SurveyError for one that there is not.

        ``residuals``, ``mean_residuals``, ``histogram`` of a ``camera=``, ``map``, ``perspective``, ``correlations``,
        ``quantiles`` of a ``group=`` of observations.
        """
        return plot_by_name(name, self.adjustment, self.scale, **chosen)

    def report(self, folder: str | Path, *, language: str = "en", pdf: bool = False) -> dict[str, Path]:
        """The last step: write everything into ``folder/results``; the paths by file name. Raises SurveyError."""
        return write_results(
            Path(folder), self.adjustment, self.run, self.precision, ReportOptions(language, pdf)
        )

    def __repr__(self) -> str:
        """The summary that the command line prints."""
        return summary_text(self.adjustment, self.run, dict(self.as_dict))

    def _repr_html_(self) -> str:
        a, test = self.adjustment, self.adjustment.global_test
        said = "nothing redundant" if test is None else f"global test {test.said}"
        colour = "#7b858f" if test is None else "#2f7d4f" if test.status != "failed" else "#b3261e"
        rows = [("sigma0", f"{a.sigma0:.4f}"), ("observations", f"{a.n_observations}"), ("unknowns", f"{a.n_unknowns}"),
                ("redundancy", f"{a.redundancy}"), ("iterations", f"{a.iterations}")]  # fmt: skip
        rows += [(f"group {g.group}", f"{g.n_observations} observations, × {np.sqrt(max(g.factor, 0.0)):.3f}")
                 for g in a.groups]  # fmt: skip
        warned = html_table(("warnings",), [(w,) for w in self.warnings[:10]]) if self.warnings else ""
        title = heading(f"Solution {self.run.title or self.run.folder}")
        return title + verdict(colour, said) + html_table(("", ""), rows) + warned
