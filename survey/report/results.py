"""The results of a survey as files: ``solution.json``, ``covariance.npz``, residuals as CSV and ``report.html``."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from adjust.model.result import Adjustment
from adjust.native.parallel import Beside
from survey.folder.replacing import changing, replace_parts
from survey.project import atomic_write
from survey.project.project import RESULTS
from survey.report.page import report_html, report_pdf
from survey.report.terminal import summary_text
from survey.solution.covariances import covariance_npz
from survey.solution.dictionary import RunInfo, solution_dict
from survey.solution.records import solution_json
from survey.solution.residual_tables import image_residuals_csv, image_residuals_parquet, other_residuals_csv
from survey.solution.statistics import Statistics

__all__ = [
    "RESULTS",
    "ReportOptions",
    "RunInfo",
    "begun_tables",
    "make_results",
    "solution_dict",
    "solution_json",
    "summary_text",
    "write_results",
]


@dataclass(frozen=True)
class ReportOptions:
    """How results are written.

    language: of report.html, "en" or "de". pdf: report.pdf too. parquet: residuals.parquet too, which is written again
    as long as it is there.
    """

    language: str = "en"
    pdf: bool = False
    parquet: bool = False


ENGLISH_PAGE = ReportOptions()
PARQUET = "residuals.parquet"


def write_results(
    folder: Path,
    adjustment: Adjustment,
    run: RunInfo,
    statistics: Statistics | None = None,
    options: ReportOptions = ENGLISH_PAGE,
) -> dict[str, Path]:
    """Write everything into ``folder/results``, all files or none; the paths by file name.

    Raises SurveyError for a language that there is not, where no PDF can be made, and while a command has the folder;
    nothing has been written then.
    """
    with changing(folder) as place, Beside() as writing:
        begun = begun_tables(place, adjustment, run, options, writing)
        make_results(begun, adjustment, run, solution_dict(adjustment, run, statistics), statistics, options)
        replace_parts(folder)
    return {name: folder / RESULTS / name for name in begun.paths}


class ResultFiles:
    """Files of ``place/results`` that are made and written beside each other and beside what comes after.

    place: in the folder whose results these replace.
    """

    def __init__(self, place: Path, writing: Beside) -> None:
        self.folder, self._writing = place / RESULTS, writing
        self.folder.mkdir(parents=True, exist_ok=True)
        self._begun: dict[str, Callable[[], None]] = {}

    def begin(self, makers: Mapping[str, Callable[[], bytes]]) -> None:
        """Files by name, by what makes them."""
        for name, make in makers.items():
            self._begun[name] = self._writing.of(partial(_write, self.folder / name, make))

    @property
    def paths(self) -> dict[str, Path]:
        """All that were begun, written; what programs read last."""
        for written in self._begun.values():
            written()
        return {name: self.folder / name for name in sorted(self._begun, key="solution.json".__eq__)}


def begun_tables(
    place: Path, adjustment: Adjustment, run: RunInfo, options: ReportOptions, writing: Beside
) -> ResultFiles:  # fmt: skip
    """What needs the adjustment alone: residuals and covariances."""
    files = ResultFiles(place, writing)
    parquet = options.parquet or (place.parent / RESULTS / PARQUET).is_file()  # there: not to be old
    files.begin({
        "covariance.npz": lambda: covariance_npz(adjustment, run.sigmas),
        "residuals.csv": lambda: image_residuals_csv(adjustment),
        **({PARQUET: lambda: image_residuals_parquet(adjustment)} if parquet else {}),
        "residuals_other.csv": lambda: other_residuals_csv(adjustment),
    })  # fmt: skip
    return files


def make_results(
    begun: ResultFiles,
    adjustment: Adjustment,
    run: RunInfo,
    solution: dict[str, Any],
    statistics: Statistics | None = None,
    options: ReportOptions = ENGLISH_PAGE,
) -> dict[str, Path]:
    """Make everything else; the paths of all by file name. Raises as :func:`write_results`.

    begun: of :func:`begun_tables`. solution: of :func:`survey.solution.dictionary.solution_dict`, with the statistics.
    """
    begun.begin({"solution.json": lambda: solution_json(solution).encode()})
    page = report_html(adjustment, run, solution, statistics, options.language)
    begun.begin({
        "report.html": page.encode, **({"report.pdf": lambda: report_pdf(page)} if options.pdf else {}),
    })  # fmt: skip
    return begun.paths


def _write(path: Path, make: Callable[[], bytes]) -> None:
    atomic_write(path, make())
