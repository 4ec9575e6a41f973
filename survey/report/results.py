"""The results of a survey as files: ``solution.json``, ``covariance.npz``, residuals as CSV and ``report.html``."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.native.parallel import Beside
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import Piece
from survey.project import atomic_write
from survey.project.project import RESULTS
from survey.report.language import ENGLISH_PAGE, ReportOptions
from survey.report.page import BegunPage, begun_page, finished_page, report_pdf
from survey.report.terminal import summary_text
from survey.solution.covariances import covariance_npz
from survey.solution.dictionary import RunInfo, solution_dict, with_statistics
from survey.solution.records import solution_json, solution_pieces
from survey.solution.residual_tables import (
    image_residuals_csv,
    image_residuals_parquet,
    image_rows,
    other_residuals_csv,
)
from survey.solution.statistics import Statistics

__all__ = [
    "RESULTS",
    "ReportOptions",
    "RunInfo",
    "begun_results",
    "finished_results",
    "solution_dict",
    "solution_json",
    "summary_text",
    "write_results",
]


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
        begun = begun_results(place, adjustment, run, options, writing)
        names = list(finished_results(begun, adjustment, run, statistics, options)[1])
        replace_parts(folder)
    return {name: folder / RESULTS / name for name in names}


class ResultFiles:
    """Files of ``place/results`` that are made and written beside each other and beside what comes after.

    place: in the folder whose results these replace.
    """

    def __init__(self, place: Path, writing: Beside) -> None:
        self.folder, self._writing = place / RESULTS, writing
        self.folder.mkdir(parents=True, exist_ok=True)
        self._begun: dict[str, Callable[[], None]] = {}

    def begin(self, makers: Mapping[str, Callable[[], bytes | Iterable[Piece]]]) -> None:
        """Files by name, by what makes them."""
        for name, make in makers.items():
            self._begun[name] = self._writing.of(partial(_write, self.folder / name, make))

    @property
    def paths(self) -> dict[str, Path]:
        """All that were begun, written; what programs read last."""
        for written in self._begun.values():
            written()
        return {name: self.folder / name for name in sorted(self._begun, key="solution.json".__eq__)}


@frozen(eq=False)
class BegunResults:
    """What needs the adjustment alone, in the making. page: gives the report as far as it is one without statistics."""

    files: ResultFiles
    page: Callable[[], BegunPage]


def begun_results(
    place: Path, adjustment: Adjustment, run: RunInfo, options: ReportOptions, writing: Beside,
    more: Mapping[str, object] = MappingProxyType({}),
) -> BegunResults:  # fmt: skip
    """Begin with what needs no statistics: tables of residuals and covariances, the solution, most of the report.

    more: what else ``solution.json`` is to hold.
    """
    files = ResultFiles(place, writing)
    rows = writing.of(lambda: image_rows(adjustment))

    def begun() -> BegunPage:
        return begun_page(adjustment, run, {**solution_dict(adjustment, run), **more}, rows(), options.language)

    page = writing.of(begun)  # first: what follows shares out its work
    parquet = options.parquet or (place.parent / RESULTS / PARQUET).is_file()  # there: not to be old
    files.begin({
        "covariance.npz": lambda: covariance_npz(adjustment, run.sigmas),
        "residuals.csv": lambda: image_residuals_csv(adjustment, rows()),
        **({PARQUET: lambda: image_residuals_parquet(adjustment)} if parquet else {}),
        "residuals_other.csv": lambda: other_residuals_csv(adjustment),
    })  # fmt: skip
    return BegunResults(files, page)


def finished_results(
    begun: BegunResults, adjustment: Adjustment, run: RunInfo, statistics: Statistics | None, options: ReportOptions
) -> tuple[dict[str, object], dict[str, Path]]:
    """What ``solution.json`` holds, and the paths of all files by name. Raises as :func:`write_results`."""
    page = begun.page()
    solution = page.context.solution
    if statistics is not None:
        solution = with_statistics(solution, adjustment, run, statistics)
    begun.files.begin({"solution.json": lambda: solution_pieces(solution)})
    report = finished_page(page, solution, statistics)
    begun.files.begin({
        "report.html": report.encode, **({"report.pdf": lambda: report_pdf(report)} if options.pdf else {}),
    })  # fmt: skip
    return solution, begun.files.paths


def _write(path: Path, make: Callable[[], bytes | Iterable[Piece]]) -> None:
    atomic_write(path, make())
