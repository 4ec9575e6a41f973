"""The command ``labsurvey``: arguments in, exit code out. The jobs are in ``survey.jobs``.

Exit codes: 0 done, 1 something its owner can mend, 2 wrong usage, 3 solved but the global test failed (residuals larger
than the sigmas say), 130 interrupted.
Results go to stdout, progress and messages to stderr. Heavy imports happen inside the commands.
"""

import argparse
import json
import os
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adjust.errors import SurveyError
from survey.examples import EXAMPLES, write_example

if TYPE_CHECKING:
    from survey.jobs import AdjustOutcome

DONE, FAILED, USAGE, TEST_FAILED, INTERRUPTED = 0, 1, 2, 3, 130

_OPENING = "labsurvey adjust lab"
_DESCRIPTION = """\
Adjusts a whole laboratory at once: cameras, turntable, beacons, relay stations and tape readings.

  labsurvey example full-lab lab      write a ready project into the folder lab
  labsurvey adjust lab                detect targets in its images, adjust everything, write lab/results
"""
_EPILOG = """\
Next: labsurvey example full-lab lab
Help for one command: labsurvey adjust --help
Exit codes: 0 done, 1 error in the project, 2 wrong usage, 3 solved but residuals are larger than the sigmas say.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; the exit code."""
    try:
        try:
            arguments = build_parser().parse_args(argv)
            return int(arguments.run(arguments))
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # whoever read our output has left; a second complaint at exit would be noise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (SurveyError, OSError) as error:
        if isinstance(error, OSError) and error.filename is None:
            raise  # not about a file of the user
        print(f"labsurvey: error: {_message(error)}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("\nlabsurvey: interrupted", file=sys.stderr)
        return INTERRUPTED


def _message(error: SurveyError | OSError) -> str:
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}; check the name, the permissions and the free space"
    return str(error)


def build_parser() -> argparse.ArgumentParser:
    """All commands and flags."""
    shared = argparse.ArgumentParser(add_help=False)
    # SUPPRESS: a flag before the command is not reset by the command's own default
    shared.add_argument(
        "--json", action="store_true", default=argparse.SUPPRESS, help="print the summary as one JSON object"
    )
    shared.add_argument("-v", "--verbose", action="store_true", default=argparse.SUPPRESS, help="say more on stderr")
    shared.add_argument(
        "--quiet", action="store_true", default=argparse.SUPPRESS, help="no progress bars and no messages on stderr"
    )
    shaped: Any = {"formatter_class": argparse.RawDescriptionHelpFormatter, "parents": [shared]}
    parser = argparse.ArgumentParser(
        "labsurvey", usage=f"{_OPENING}   (labsurvey COMMAND ...)", description=_DESCRIPTION, epilog=_EPILOG, **shaped
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and stop")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_adjust(commands, shaped)
    _add_detect(commands, shaped)
    _add_plan(commands, shaped)
    _add_add(commands, shaped)
    _add_remove(commands, shaped)
    _add_convert(commands, shaped)
    _add_trackers(commands, shaped)
    _add_navigate(commands, shaped)
    _add_compare(commands, shaped)
    _add_example(commands, shaped)
    return parser


class _Version(argparse.Action):
    """Prints the version, which is looked up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"labsurvey {version('labsurvey')}")
        except PackageNotFoundError:
            print("labsurvey, run from its source folder without being installed")
        parser.exit()


def _add_adjust(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "adjust",
        help="adjust a project folder, or several one after the other (the main job)",
        usage=f"{_OPENING}   (labsurvey adjust FOLDER [FOLDER ...] [--out DIR] [--redetect])",
        description="Detects targets where that has not been done, adjusts all observations, writes FOLDER/results.",
        epilog="Next: open FOLDER/results/report.html",
        **shaped,
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="folder with a survey.toml")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write results below DIR, not below FOLDER")
    parser.add_argument("--redetect", action="store_true", help="detect targets again, even where it was done before")
    parser.set_defaults(run=_adjust, parser=parser)


def _add_detect(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "detect",
        help="find the targets and beacons in the images of a project folder",
        usage="labsurvey detect lab   (labsurvey detect FOLDER [--jobs N] [--pictures])",
        description="Writes FOLDER/observations/image_points.csv, and spots.csv where beacons are asked for.",
        epilog="Next: labsurvey adjust FOLDER",
        **shaped,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder with a survey.toml and images/")
    parser.add_argument("--jobs", type=_positive, metavar="N", help="images at a time; default: one per processor")
    parser.add_argument("--pictures", action="store_true", help="also write every image with what was found in it")
    parser.set_defaults(run=_detect, parser=parser)


def _add_plan(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "plan",
        help="say what a network of pairs will tell, before it is measured",
        usage="labsurvey plan lab   (labsurvey plan FOLDER)",
        description="Counts conditions and redundancy from survey.toml and observations/pairs.csv, which needs no "
        "values yet, only pair_id,a_id,b_id; names the pairs that close no loop.",
        epilog="Next: labsurvey adjust FOLDER",
        **shaped,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder with a survey.toml")
    parser.set_defaults(run=_plan, parser=parser)


def _add_add(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "add",
        help="add stations or observations to an adjusted project",
        usage="labsurvey add lab lab/more   (labsurvey add FOLDER NEW [--out DIR])",
        description="NEW holds observations/*.csv and, for new stations, cameras, targets, points or tables, a "
        "survey.toml with them.\nFOLDER is adjusted with them from its last solution; on any error it stays as it was.",
        epilog="Next: open FOLDER/results/report.html",
        **shaped,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="adjusted project folder")
    parser.add_argument("new", type=Path, metavar="NEW", help="folder with what is new")
    parser.add_argument("--out", type=Path, metavar="DIR", help="leave FOLDER alone, write the grown project to DIR")
    parser.set_defaults(run=_add, parser=parser)


def _add_remove(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "remove",
        help="adjust a project again without some observations",
        usage="labsurvey remove lab p3   (labsurvey remove FOLDER ID [ID ...] [--out DIR])",
        description="Writes used = false beside pairs, distances and coordinates, adjusts again and says what moved.\n"
        "Refuses what the rest cannot do without; on any error FOLDER stays as it was.",
        epilog="Next: open FOLDER/results/report.html",
        **shaped,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="project folder, adjusted or not")
    parser.add_argument("ids", nargs="+", metavar="ID", help="pair, distance, point or set; pairs:ID where it is twice")
    parser.add_argument("--out", type=Path, metavar="DIR", help="leave FOLDER alone, write the new project to DIR")
    parser.set_defaults(run=_remove, parser=parser)


def _add_convert(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "convert",
        help="pose networks between g2o files and project folders",
        usage="labsurvey convert garage.g2o garage   (labsurvey convert FROM TO [--format g2o|project])",
        description="A g2o file becomes a project whose first station (or what FIX names) is held; the pairs of a\n"
        "project become a g2o file, with adjusted poses where there are results. TO must be new.",
        epilog="Next: labsurvey adjust TO",
        **shaped,
    )
    parser.add_argument("source", type=Path, metavar="FROM", help="g2o file, or project folder")
    parser.add_argument("target", type=Path, metavar="TO", help="new project folder, or new file ending with .g2o")
    parser.add_argument("--format", choices=("g2o", "project"), help="of TO; default: by its ending")
    parser.add_argument(
        "--information", choices=("tangent", "quaternion"), default="tangent",
        help="rotation part of g2o's information: of the rotation vector, or of the quaternion as g2o itself means it",
    )  # fmt: skip
    parser.set_defaults(run=_convert, parser=parser)


def _add_trackers(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "trackers",
        help="clocks, drift and relative poses of trackers on one station, from their trajectories",
        usage="labsurvey trackers a.csv b.csv c.csv   (labsurvey trackers FILE FILE FILE ... [--out DIR])",
        description="Files have lines t,x,y,z,qx,qy,qz,qw (s, m, world_from_eye); a file's name is its tracker's.",
        epilog="Next: labsurvey trackers FILE FILE FILE --out DIR",
        **shaped,
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="trajectories, three or more")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write the pairs to DIR/pairs.csv")
    parser.set_defaults(run=_trackers, parser=parser)


def _add_navigate(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "navigate",
        help="find the pose of the head at every epoch from beacons, named or not",
        usage="labsurvey navigate lab   (labsurvey navigate FOLDER [--epochs E ...] [--station S] [--interval S])",
        description="Calibrates from the epochs that show targets, then gives the others a pose with covariance from\n"
        "their beacons; writes FOLDER/results/trajectory.csv and .json.",
        epilog="Next: open FOLDER/results/trajectory.csv",
        **shaped,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder with a survey.toml")
    parser.add_argument("--station", metavar="S", help="the head; default: the one that a table carries")
    parser.add_argument("--epochs", nargs="+", metavar="E", help="default: all that show beacons and no target")
    parser.add_argument("--interval", type=float, metavar="SECONDS", help="epochs follow each other: bridge by motion")
    parser.add_argument("--no-table", action="store_true", help="make no use of the table's angles")
    parser.add_argument("--unnamed", action="store_true", help="forget the names that spots have")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write results below DIR, not below FOLDER")
    parser.set_defaults(run=_navigate, parser=parser)


def _add_compare(commands: Any, shaped: dict[str, Any]) -> None:
    parser = commands.add_parser(
        "compare",
        help="say how stations have turned and moved between two epochs",
        usage="labsurvey compare spring autumn   (labsurvey compare A B)",
        description="Adjusts both project folders, writes nothing, and tests the motion of every station against the\n"
        "next one of the same id in both.",
        epilog="Next: labsurvey adjust B",
        **shaped,
    )
    parser.add_argument("first", type=Path, metavar="A", help="project folder of the first epoch")
    parser.add_argument("second", type=Path, metavar="B", help="project folder of the second epoch")
    parser.set_defaults(run=_compare, parser=parser)


def _add_example(commands: Any, shaped: dict[str, Any]) -> None:
    listed = "\n".join(f"  {name:<12}{what}" for name, what in EXAMPLES.items())
    parser = commands.add_parser(
        "example",
        help="write a ready project folder to try things on",
        usage="labsurvey example full-lab lab   (labsurvey example NAME DIR [--seed N] [--jobs N])",
        description=f"Writes a project with rendered images and simulated readings.\n\n{listed}",
        epilog="Next: labsurvey adjust DIR",
        **shaped,
    )
    parser.add_argument("name", choices=tuple(EXAMPLES), metavar="NAME", help=", ".join(EXAMPLES))
    parser.add_argument("folder", type=Path, metavar="DIR", help="new folder")
    parser.add_argument("--seed", type=_not_negative, default=1, metavar="N", help="other numbers give other noise")
    parser.add_argument("--jobs", type=_positive, metavar="N", help="images at a time; default: one per processor")
    parser.set_defaults(run=_example, parser=parser)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"found {value}; expected 1 or more")
    return value


def _not_negative(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"found {value}; expected 0 or more")
    return value


def _is(arguments: argparse.Namespace, flag: str) -> bool:
    return bool(getattr(arguments, flag, False))


def _say(arguments: argparse.Namespace, *lines: str) -> None:
    """Messages beside the results."""
    if not _is(arguments, "quiet"):
        for line in lines:
            print(line, file=sys.stderr)


def _print_json(value: Mapping[str, Any]) -> None:
    print(json.dumps(value, indent=1, allow_nan=False))


def _require_project(folder: Path) -> None:
    if (folder / ".before").is_dir():
        from survey.replacing import recover, unfinished

        if unfinished(folder):  # a mixture of old and new must not be taken for a project
            recover(folder)
            print(f"labsurvey: {folder}: an 'add' that was killed has been undone", file=sys.stderr)
    if not folder.is_dir():
        hint = "; 'labsurvey example full-lab lab' writes a ready one"
        raise SurveyError(f"{folder}: no such folder{hint}")
    if not (folder / "survey.toml").is_file():
        raise SurveyError(f"{folder}: there is no survey.toml in it; give the folder that holds one")


def _example(arguments: argparse.Namespace) -> int:
    progress = not _is(arguments, "quiet")
    n = write_example(arguments.name, arguments.folder, seed=arguments.seed, jobs=arguments.jobs, progress=progress)
    if _is(arguments, "json"):
        _print_json({"example": arguments.name, "folder": str(arguments.folder), "seed": arguments.seed, "images": n})
    else:
        print(
            f"{arguments.folder}: example {arguments.name}{f' with {n} images' if n else ''}\n"
            f"Next: labsurvey adjust {arguments.folder}"
        )
    return DONE


def _plan(arguments: argparse.Namespace) -> int:
    _require_project(arguments.folder)
    from survey.network import plan_job

    outcome = plan_job(arguments.folder)
    if _is(arguments, "json"):
        _print_json(outcome.summary())
    else:
        print(f"{outcome.text()}\nNext: labsurvey adjust {arguments.folder}")
    return DONE


def _add(arguments: argparse.Namespace) -> int:
    _require_project(arguments.folder)
    from survey.network import add_job

    outcome = add_job(arguments.folder, arguments.new, out=arguments.out, progress=not _is(arguments, "quiet"))
    if _is(arguments, "json"):
        _print_json(outcome.summary())
    else:
        print(outcome.text())
        _say(arguments, *(f"written: {path}" for path in outcome.outcome.paths.values()))
    test = outcome.outcome.adjustment.global_test
    return DONE if test is None or test.omega <= test.upper else TEST_FAILED


def _remove(arguments: argparse.Namespace) -> int:
    _require_project(arguments.folder)
    from survey.removing import remove_job

    progress = not _is(arguments, "quiet")
    outcome = remove_job(arguments.folder, arguments.ids, out=arguments.out, progress=progress)
    if _is(arguments, "json"):
        _print_json(outcome.summary())
    else:
        print(outcome.text())
        _say(arguments, *(f"written: {path}" for path in outcome.outcome.paths.values()))
    test = outcome.outcome.adjustment.global_test
    return DONE if test is None or test.omega <= test.upper else TEST_FAILED


def _convert(arguments: argparse.Namespace) -> int:
    if arguments.source.is_dir():
        _require_project(arguments.source)
    from survey.converting import convert_job

    outcome = convert_job(
        arguments.source, arguments.target, format=arguments.format, information=arguments.information
    )
    if _is(arguments, "json"):
        _print_json(outcome.summary())
    else:
        print(outcome.text() + (f"\nNext: labsurvey adjust {outcome.target}" if outcome.format == "project" else ""))
    return DONE


def _trackers(arguments: argparse.Namespace) -> int:
    files: dict[str, Path] = {path.stem: path for path in arguments.files}
    if len(files) < len(arguments.files):
        arguments.parser.error("two FILEs have the same name, but it names their trackers")
    from survey.relay import read_trajectories, relay_trackers, tracker_pairs, trackers_text, write_relay_pairs

    found = relay_trackers(read_trajectories(files))
    written = None
    if arguments.out is not None:
        written = write_relay_pairs(arguments.out, tracker_pairs(found).pairs)
    if _is(arguments, "json"):
        _print_json({"trackers": list(files), "report": trackers_text(found), "written": written and str(written)})
    else:
        print(trackers_text(found), end="")
        _say(arguments, *([f"written: {written}"] if written else []))
    return DONE


def _detect(arguments: argparse.Namespace) -> int:
    _require_project(arguments.folder)
    from survey.jobs import detect_job

    outcome = detect_job(
        arguments.folder,
        jobs=arguments.jobs,
        pictures=arguments.pictures,
        progress=not _is(arguments, "quiet"),
    )
    if _is(arguments, "verbose"):
        _say(arguments, *outcome.messages)
    if _is(arguments, "json"):
        _print_json(outcome.summary())
    else:
        print(f"{outcome.text()}\nNext: labsurvey adjust {arguments.folder}")
    return DONE


def _navigate(arguments: argparse.Namespace) -> int:
    _require_project(arguments.folder)
    from survey.navigation import NavigateRequest, navigate_job

    epochs = None if arguments.epochs is None else tuple(arguments.epochs)
    request = NavigateRequest(arguments.station, epochs, arguments.interval, not arguments.no_table, arguments.unnamed)
    outcome = navigate_job(arguments.folder, request, out=arguments.out, progress=not _is(arguments, "quiet"))
    if _is(arguments, "verbose"):
        _say(arguments, *(f"{step}: {seconds:.2f} s" for step, seconds in outcome.seconds.items()))
    if _is(arguments, "json"):
        _print_json(outcome.summary())
    else:
        print(outcome.text())
        _say(arguments, *(f"written: {path}" for path in outcome.paths.values()))
    return DONE


def _compare(arguments: argparse.Namespace) -> int:
    _require_project(arguments.first)
    _require_project(arguments.second)
    from survey.comparison import compare_job

    outcome = compare_job(arguments.first, arguments.second, progress=not _is(arguments, "quiet"))
    if _is(arguments, "json"):
        _print_json(outcome.summary())
    else:
        print(outcome.text())
    return DONE


def _adjust(arguments: argparse.Namespace) -> int:
    folders: list[Path] = arguments.folders
    if len(folders) > 1:
        if arguments.out is not None:
            arguments.parser.error("--out needs a single FOLDER: the results of several would be mixed up")
        if len({folder.resolve() for folder in folders}) < len(folders):
            arguments.parser.error("a FOLDER is named twice")
        return _adjust_several(folders, arguments)
    code, outcome = _adjust_one(folders[0], arguments)
    if _is(arguments, "json"):
        _print_json(outcome.summary())
    else:
        print(outcome.text())
        _say(arguments, *(f"written: {path}" for path in outcome.paths.values()))
    if _is(arguments, "verbose"):
        _say(arguments, *(f"{step}: {seconds:.2f} s" for step, seconds in outcome.run.seconds.items()))
    return code


def _adjust_one(folder: Path, arguments: argparse.Namespace, progress: bool = True) -> "tuple[int, AdjustOutcome]":
    _require_project(folder)
    from survey.jobs import adjust_job

    outcome = adjust_job(
        folder,
        out=arguments.out,
        progress=progress and not _is(arguments, "quiet"),
        redetect=arguments.redetect,
    )
    test = outcome.adjustment.global_test
    # too small residuals mean cautious sigmas: the report says so, but nobody is misled
    return (DONE if test is None or test.omega <= test.upper else TEST_FAILED), outcome


def _adjust_several(folders: Sequence[Path], arguments: argparse.Namespace) -> int:
    """A batch goes on past projects that fail; its exit code is that of the worst: 1 before 3 before 0."""
    from tqdm import tqdm

    rows: list[dict[str, Any]] = []
    for folder in tqdm(folders, desc="adjusting", unit="folder", disable=_is(arguments, "quiet")):
        rows.append(_adjust_in_batch(folder, arguments))
        _say(arguments, *([f"labsurvey: error: {rows[-1]['error']}"] if "error" in rows[-1] else []))
    if _is(arguments, "json"):
        _print_json({"folders": rows})
    else:
        print(_batch_table(rows))
    codes = {row["exit_code"] for row in rows}
    return next(code for code in (FAILED, TEST_FAILED, DONE) if code in codes)


def _adjust_in_batch(folder: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    row: dict[str, Any] = {"folder": str(folder)}
    try:
        code, outcome = _adjust_one(folder, arguments, progress=False)
    except (SurveyError, OSError) as error:
        return {**row, "exit_code": FAILED, "error": _message(error)}
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


if __name__ == "__main__":
    sys.exit(main())
