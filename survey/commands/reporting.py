"""The command ``report``: the precision report of a project, in a language, as a page and on paper, with a check."""

import argparse
from pathlib import Path

from survey.commands.common import DONE, TEST_FAILED, begin_adjusting, is_set, print_json, require_project, say, tested
from survey.commands.parser import Commands, project_folder


def declare_report(commands: Commands) -> None:
    """Add ``report`` to the commands."""
    parser = commands.add(
        "report",
        _report,
        help="write the precision report of a project, also in German, as PDF, or as a check",
        usage="labsurvey report lab --pdf   (labsurvey report FOLDER [--language en|de] [--pdf] [--check] [--out DIR])",
        description="Adjusts the observations of FOLDER and writes FOLDER/results, report.html in the language asked "
        "for.\nWith --check the exit code is 3 when the global test or a tolerance of survey.toml is not met.",
        epilog="Next: open FOLDER/results/report.html",
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="folder with a survey.toml")
    parser.add_argument("--language", choices=("en", "de"), default="en", help="of the report; default: en")
    parser.add_argument("--pdf", action="store_true", help="write report.pdf too; needs Chromium, Chrome or WeasyPrint")
    parser.add_argument("--check", action="store_true", help="exit code 3 also where a tolerance is not met")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write results below DIR, not below FOLDER")


def _report(arguments: argparse.Namespace) -> int:
    begin_adjusting()
    require_project(arguments.folder, arguments.out)
    from survey.jobs.adjusting.job import adjust_job
    from survey.report.language import ReportOptions
    from survey.solution.earlier.runs import command_line

    language = arguments.language if arguments.language != "en" else None
    flags = {"language": language, "pdf": arguments.pdf, "check": arguments.check, "out": arguments.out}
    outcome = adjust_job(
        arguments.folder, out=arguments.out, progress=not is_set(arguments, "quiet"),
        report=ReportOptions(arguments.language, arguments.pdf), said=command_line("report", arguments.folder, **flags),
    )  # fmt: skip
    unmet = [v for v in outcome.statistics.verdicts if not v.met] if outcome.statistics is not None else []
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(outcome.text())
        for v in unmet:
            times = f"{v.found / v.allowed:.2f} times what is allowed"
            print(f"  tolerance {v.tolerance} not met: {' '.join(v.result)} {v.quantity}, {times}")
        say(arguments, *(f"written: {path}" for path in outcome.paths.values()))
    code = tested(outcome.solution["summary"])
    return TEST_FAILED if code == DONE and arguments.check and unmet else code
