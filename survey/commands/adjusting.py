"""The commands ``adjust``, for one project folder or many as a batch, and ``report``, its precision report alone."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from survey.commands.common import (
    DONE,
    TEST_FAILED,
    begin_adjusting,
    is_set,
    load_late,
    not_negative,
    positive,
    require_project,
    say,
    show,
    tell,
    tested,
    use_memory_again,
)
from survey.commands.parser import command, flag, group, project_folder

if TYPE_CHECKING:
    from survey.batch.record import Record
    from survey.project.tables.files import Begun


@command(
    "adjust",
    flag("folders", nargs="+", type=project_folder, metavar="FOLDER", help="folder with a survey.toml"),
    flag("--out", type=Path, metavar="DIR", help="write results below DIR, not below FOLDER"),
    flag("--redetect", action="store_true", help="detect targets again, even where it was done before"),
    flag("--parquet", action="store_true", help="write results/residuals.parquet too, numbers in full"),
    flag("--method", choices=("joint", "published"), default="joint",
         help="published: also the published step-by-step methods (head on a table, measured pairs), beside the joint "
         "adjustment; default: joint"),
    flag("--try", type=positive, metavar="N", dest="candidate",
         help="carry out cause N of the diagnosis on the project, then adjust; changed files are kept in FOLDER/kept"),
    group(
        "batch",
        flag("--jobs", type=positive, metavar="N", help="folders at a time; default: one per core"),
        flag("--report", type=Path, metavar="DIR",
             help="write an overview of all folders: overview.html, .json, .csv"),
        flag("--resume", action="store_true", help="go on with the batch whose journal is in DIR"),
        flag("--fresh", action="store_true", help="adjust also folders whose inputs have not changed"),
        flag("--retries", type=not_negative, metavar="N", default=1,
             help="tries more where a process was lost or a file not reached; default: 1"),
        flag("--scheduler", metavar="ADDRESS", help="work on the Dask cluster at ADDRESS"),
        flag("--language", choices=("en", "de"), default="en", help="of the overview; default: en"),
    ),
    help="adjust a project folder, or many side by side (the main job)",
    usage="labsurvey adjust lab   (labsurvey adjust FOLDER [FOLDER ...] [--report DIR] [--out DIR] [--redetect])",
    description="Detects targets where that has not been done, adjusts all observations, writes FOLDER/results.\n"
    "Several folders are a batch: side by side on all cores, past failures, without those that are unchanged.",
    epilog="Next: open FOLDER/results/report.html, of a batch DIR/overview.html",
)
def adjust(arguments: argparse.Namespace) -> int:
    """The command ``adjust``."""
    folders: list[Path] = arguments.folders
    only_batch = arguments.report is not None or arguments.scheduler is not None
    if len(folders) > 1 or only_batch:
        if arguments.out is not None:
            arguments.parser.error("--out needs a single FOLDER: the results of several would be mixed up")
        if arguments.method != "joint":
            arguments.parser.error("--method published needs a single FOLDER: it is beside one adjustment")
        if arguments.parquet:
            arguments.parser.error("--parquet needs a single FOLDER")
        if arguments.candidate is not None:
            arguments.parser.error("--try needs a single FOLDER: it changes one project")
        if len({folder.resolve() for folder in folders}) < len(folders):
            arguments.parser.error("a FOLDER is named twice")
        if arguments.resume and arguments.report is None:
            arguments.parser.error("--resume needs the --report DIR of the batch that is to go on")
        return _adjust_batch(arguments)
    if arguments.resume:
        arguments.parser.error("--resume is for a batch: several FOLDERs and --report DIR")
    return _adjust_one(folders[0], arguments)


def _adjust_one(folder: Path, arguments: argparse.Namespace) -> int:
    require_project(folder, arguments.out)
    if arguments.candidate is not None:
        begin_adjusting()
        from survey.jobs.adjusting.trying import try_job

        say(arguments, try_job(folder, arguments.candidate))
    with _beginning(folder) as ahead:
        from survey.jobs.adjusting.job import adjust_job
        from survey.report.language import ReportOptions

        outcome = adjust_job(
            folder, out=arguments.out, progress=not is_set(arguments, "quiet"), redetect=arguments.redetect,
            method=arguments.method, report=ReportOptions(parquet=arguments.parquet), ahead=ahead,
        )  # fmt: skip
    show(arguments, outcome, outcome.paths.values())
    if is_set(arguments, "verbose"):
        say(arguments, *(f"{step}: {seconds:.2f} s" for step, seconds in outcome.run.seconds.items()))
    return tested(outcome.solution["summary"])


@contextmanager
def _beginning(folder: Path) -> Iterator[dict[Path, "Begun"]]:
    """Large tables are read while libraries are loaded, and these before the rest of this program."""
    use_memory_again()
    from survey.folder.ahead import reading_ahead

    with reading_ahead(folder) as ahead:
        load_late()
        from survey.project.tables.files import begin_tables

        yield begin_tables(ahead)


def _adjust_batch(arguments: argparse.Namespace) -> int:
    """A batch goes on past projects that fail; its exit code is that of the worst: 1 before 3 before 0."""
    from tqdm import tqdm

    from survey.batch.run import BatchOptions, exit_code, run_batch
    from survey.batch.tables import row_of, summary_table, trend_lines
    from survey.batch.trends import trends_of

    options = BatchOptions(
        arguments.jobs, arguments.scheduler, arguments.report, arguments.resume, arguments.fresh, arguments.redetect,
        arguments.retries, progress=not is_set(arguments, "quiet"),
    )  # fmt: skip

    def told(record: "Record") -> None:
        if record.error:
            with tqdm.external_write_mode():  # not through the bar
                say(arguments, f"labsurvey: error: {record.error}")
                say(arguments, *([record.traceback.rstrip()] if record.traceback else []))

    records = run_batch(arguments.folders, options, told)
    trends = trends_of(records)
    paths = {}
    if arguments.report is not None:
        from survey.batch.page import write_overview

        paths = write_overview(arguments.report, records, trends, arguments.language)
    overview = {"folders": [row_of(r) for r in records], "written": {n: str(p) for n, p in paths.items()}}
    charts = ["", *trend_lines(trends, records)] if trends.charts else [""]
    tell(arguments, overview, "\n".join([summary_table(records), *charts]), paths.values())
    return exit_code(records)


@command(
    "report",
    flag("folder", type=project_folder, metavar="FOLDER", help="folder with a survey.toml"),
    flag("--language", choices=("en", "de"), default="en", help="of the report; default: en"),
    flag("--pdf", action="store_true", help="write report.pdf too; needs Chromium, Chrome or WeasyPrint"),
    flag("--check", action="store_true", help="exit code 3 also where a tolerance is not met"),
    flag("--out", type=Path, metavar="DIR", help="write results below DIR, not below FOLDER"),
    help="write the precision report of a project, also in German, as PDF, or as a check",
    usage="labsurvey report lab --pdf   (labsurvey report FOLDER [--language en|de] [--pdf] [--check] [--out DIR])",
    description="Adjusts the observations of FOLDER and writes FOLDER/results, report.html in the language asked "
    "for.\nWith --check the exit code is 3 when the global test or a tolerance of survey.toml is not met.",
    epilog="Next: open FOLDER/results/report.html",
)
def report(arguments: argparse.Namespace) -> int:
    """The command ``report``."""
    require_project(arguments.folder, arguments.out)
    language = arguments.language if arguments.language != "en" else None
    flags = {"language": language, "pdf": arguments.pdf, "check": arguments.check, "out": arguments.out}
    with _beginning(arguments.folder) as ahead:
        from survey.jobs.adjusting.job import adjust_job
        from survey.report.language import ReportOptions
        from survey.solution.earlier.runs import command_line

        outcome = adjust_job(
            arguments.folder, out=arguments.out, progress=not is_set(arguments, "quiet"), ahead=ahead,
            report=ReportOptions(arguments.language, arguments.pdf),
            said=command_line("report", arguments.folder, **flags),
        )  # fmt: skip
    unmet = [v for v in outcome.statistics.verdicts if not v.met] if outcome.statistics is not None else []
    lines = (f"\n  tolerance {v.tolerance} not met: {' '.join(v.result)} {v.quantity}, {v.found / v.allowed:.2f} times "
             "what is allowed" for v in unmet)  # fmt: skip
    show(arguments, outcome, outcome.paths.values(), "".join(lines))
    code = tested(outcome.solution["summary"])
    return TEST_FAILED if code == DONE and arguments.check and unmet else code
