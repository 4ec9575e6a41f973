"""The command ``adjust``: one project folder, or several as a batch."""

import argparse
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adjust.errors import SurveyError
from survey.commands.common import DONE, FAILED, TEST_FAILED, is_set, message, print_json, require_project, say, tested

if TYPE_CHECKING:
    from survey.jobs import AdjustOutcome


def declare_adjust(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``adjust`` to the commands."""
    parser = commands.add_parser(
        "adjust",
        help="adjust a project folder, or several one after the other (the main job)",
        usage="labsurvey adjust lab   (labsurvey adjust FOLDER [FOLDER ...] [--out DIR] [--redetect])",
        description="Detects targets where that has not been done, adjusts all observations, writes FOLDER/results.",
        epilog="Next: open FOLDER/results/report.html",
        **shaped,
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="folder with a survey.toml")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write results below DIR, not below FOLDER")
    parser.add_argument("--redetect", action="store_true", help="detect targets again, even where it was done before")
    parser.set_defaults(run=_adjust, parser=parser)


def _adjust(arguments: argparse.Namespace) -> int:
    folders: list[Path] = arguments.folders
    if len(folders) > 1:
        if arguments.out is not None:
            arguments.parser.error("--out needs a single FOLDER: the results of several would be mixed up")
        if len({folder.resolve() for folder in folders}) < len(folders):
            arguments.parser.error("a FOLDER is named twice")
        return _adjust_several(folders, arguments)
    code, outcome = _adjust_one(folders[0], arguments)
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(outcome.text())
        say(arguments, *(f"written: {path}" for path in outcome.paths.values()))
    if is_set(arguments, "verbose"):
        say(arguments, *(f"{step}: {seconds:.2f} s" for step, seconds in outcome.run.seconds.items()))
    return code


def _adjust_one(folder: Path, arguments: argparse.Namespace, progress: bool = True) -> "tuple[int, AdjustOutcome]":
    require_project(folder)
    from survey.jobs import adjust_job

    outcome = adjust_job(
        folder,
        out=arguments.out,
        progress=progress and not is_set(arguments, "quiet"),
        redetect=arguments.redetect,
    )
    return tested(outcome.adjustment.global_test), outcome


def _adjust_several(folders: Sequence[Path], arguments: argparse.Namespace) -> int:
    """A batch goes on past projects that fail; its exit code is that of the worst: 1 before 3 before 0."""
    from tqdm import tqdm

    rows: list[dict[str, Any]] = []
    for folder in tqdm(folders, desc="adjusting", unit="folder", disable=is_set(arguments, "quiet")):
        rows.append(_adjust_in_batch(folder, arguments))
        say(arguments, *([f"labsurvey: error: {rows[-1]['error']}"] if "error" in rows[-1] else []))
    if is_set(arguments, "json"):
        print_json({"folders": rows})
    else:
        print(_batch_table(rows))
    codes = {row["exit_code"] for row in rows}
    return next(code for code in (FAILED, TEST_FAILED, DONE) if code in codes)


def _adjust_in_batch(folder: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    row: dict[str, Any] = {"folder": str(folder)}
    try:
        code, outcome = _adjust_one(folder, arguments, progress=False)
    except (SurveyError, OSError) as error:
        return {**row, "exit_code": FAILED, "error": message(error)}
    except Exception as error:  # a bug in one project must not cost the night's other results
        traceback.print_exc()
        return {**row, "exit_code": FAILED, "error": f"{folder}: internal error, {type(error).__name__}: {error}"}
    return {**row, "exit_code": code, "summary": outcome.summary()}


def _batch_table(rows: Sequence[Mapping[str, Any]]) -> str:
    width = max(len("folder"), *(len(row["folder"]) for row in rows))
    lines = [f"{'folder':<{width}}  {'state':<18}  sigma0  redundancy"]
    states = {DONE: "done", FAILED: "error", TEST_FAILED: "global test failed"}
    for row in rows:
        numbers = ""
        if "summary" in row:
            found = row["summary"]["summary"]
            sigma0 = "-" if found["sigma0"] is None else f"{found['sigma0']:.3f}"
            numbers = f"{sigma0:>6}  {found['redundancy']:10d}"
        lines.append(f"{row['folder']:<{width}}  {states[row['exit_code']]:<18}  {numbers}".rstrip())
    return "\n".join(lines)
