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
    with changing(folder) as place:
        made = make_results(place, adjustment, run, solution_dict(adjustment, run, statistics), statistics, options)
        replace_parts(folder)
    return {name: folder / RESULTS / name for name in made}


def make_results(
    place: Path,
    adjustment: Adjustment,
    run: RunInfo,
    solution: dict[str, Any],
    statistics: Statistics | None = None,
    options: ReportOptions = ENGLISH_PAGE,
) -> dict[str, Path]:
    """Make everything in ``place/results``; the paths by file name. Raises as :func:`write_results`.

    place: in the folder whose results these replace.
    solution: of :func:`survey.solution.dictionary.solution_dict`, with the statistics.
    """
    results = place / RESULTS
    parquet = options.parquet or (place.parent / RESULTS / PARQUET).is_file()  # there: not to be old
    results.mkdir(parents=True, exist_ok=True)
    tables: dict[str, Callable[[], bytes]] = {
        "covariance.npz": lambda: covariance_npz(adjustment, run.sigmas),
        "residuals.csv": lambda: image_residuals_csv(adjustment),
        **({PARQUET: lambda: image_residuals_parquet(adjustment)} if parquet else {}),
        "residuals_other.csv": lambda: other_residuals_csv(adjustment),
    }
    with Beside() as writing:

        def begun(makers: Mapping[str, Callable[[], bytes]]) -> list[Callable[[], None]]:
            return [writing.of(partial(_write, results / name, make)) for name, make in makers.items()]

        done = begun(tables)
        page = report_html(adjustment, run, solution, statistics, options.language)
        pages: dict[str, Callable[[], bytes]] = {
            "report.html": page.encode,
            **({"report.pdf": lambda: report_pdf(page)} if options.pdf else {}),
            "solution.json": lambda: solution_json(solution).encode(),
        }
        for written in (*done, *begun(pages)):
            written()
    return {name: results / name for name in (*tables, *pages)}


def _write(path: Path, make: Callable[[], bytes]) -> None:
    atomic_write(path, make())
