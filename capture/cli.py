"""The command ``labcapture``: arguments in, exit code out, as ``survey.cli`` does it.

Exit codes: 0 done, 1 something its owner can mend, 2 wrong usage, 130 interrupted. Results go to stdout, progress and
messages to stderr. Heavy imports happen inside the commands.
"""

import argparse
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from adjust.model.errors import SurveyError
from survey.commands.common import DONE, is_set, print_json, run_as_program, run_command, say, tell
from survey.commands.completion import declare_completion
from survey.commands.parser import Parser, command, flag, port, program_parser, project_folder

if TYPE_CHECKING:
    from capture.devices.camera import CameraInfo

_OPENING = "labcapture run plan.toml"
_DESCRIPTION = """\
Takes the images of a survey with real cameras and a real turntable, ready for 'labsurvey adjust'.

  labcapture cameras                   what cameras there are
  labcapture run plan.toml --dry-run   the poses, the limits, the time it will take
  labcapture run plan.toml             turn, take images, write them down; the same command goes on after a crash
"""
_EPILOG = """\
Next: labcapture run plan.toml --dry-run
Help for one command: labcapture run --help
Exit codes: 0 done, 1 error, 2 wrong usage, 130 interrupted.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; the exit code."""
    return run_command("labcapture", build_parser, argv)


def program() -> NoReturn:
    """The installed command."""
    run_as_program(main)


@cache
def build_parser() -> Parser:
    """All commands and flags."""
    flags = {
        "--json": "print the summary as one JSON object", "--quiet": "no progress and no messages on stderr",
    }  # fmt: skip
    completion = partial(declare_completion, "labcapture", build_parser)
    declared = (run, cameras, table, view, export, completion)
    return program_parser("labcapture", _OPENING, _DESCRIPTION, _EPILOG, flags, declared)


@command(
    "run",
    flag("plan", type=Path, metavar="PLAN", help="capture plan, a TOML file"),
    flag("--dry-run", action="store_true", help="print poses and time, check limits; move nothing"),
    help="take the images of a plan (the main job)",
    usage=f"{_OPENING}   (labcapture run PLAN [--dry-run])",
    description="Turns the table to every pose of the plan, takes one image with every camera, writes them to the\n"
    "project folder with a journal. Epochs that are recorded already are not taken again.\n"
    "While it runs: p pauses and goes on (or: kill -USR1 PID), Ctrl-C stops table and session at once.",
    epilog="Next: labsurvey adjust FOLDER   (the folder that the plan names)",
)
def run(arguments: argparse.Namespace) -> int:
    """The command ``run``."""
    from capture.plan.plan import read_plan

    plan = read_plan(arguments.plan)
    if arguments.dry_run:
        from capture.plan.report import plan_summary, plan_text

        tell(arguments, plan_summary(plan), f"{plan_text(plan)}\nNext: labcapture run {arguments.plan}")
        return DONE
    from capture.session.run import run_plan

    outcome = run_plan(plan, shown=not is_set(arguments, "quiet"))
    now = f"{outcome.taken} of {outcome.planned} epochs taken"
    now += f", {outcome.before} were there" if outcome.before else ""
    retries = ", ".join(f"{n} x {kind}" for kind, n in sorted(outcome.retries.items()))
    again = " --redetect" if outcome.taken and (plan.project / "observations" / "image_points.csv").exists() else ""
    tell(arguments, outcome.summary(),
         f"{plan.project}: {now} in {outcome.seconds:.1f} s{f'; retried: {retries}' if retries else ''}\n"
         f"Next: labsurvey adjust {plan.project}{again}")  # fmt: skip
    return DONE


@command(
    "cameras",
    flag("driver", nargs="?", default="all", metavar="DRIVER", help="ask this driver only"),
    help="list the cameras that can be reached",
    usage="labcapture cameras   (labcapture cameras [DRIVER])",
    description="Asks every driver whose software is installed; the first column is the address for a plan.",
    epilog="Next: labcapture run plan.toml --dry-run",
)
def cameras(arguments: argparse.Namespace) -> int:
    """The command ``cameras``."""
    from dataclasses import asdict

    from capture.devices.cameras import DRIVERS, describe_driver, discover

    found: list[CameraInfo] = []
    for name in DRIVERS if arguments.driver == "all" else [describe_driver(arguments.driver).name]:
        try:
            found += discover(name)
        except SurveyError as error:
            if arguments.driver != "all":
                raise
            say(arguments, f"{name}: {error}")
        except Exception as error:  # one maker's library that fails must not hide the cameras of the others
            say(arguments, f"{name}: its library failed: {type(error).__name__}: {error}")
    if is_set(arguments, "json"):
        print_json({"cameras": [asdict(info) for info in found]})
        return DONE
    for info in found:
        use = "  in use" if info.in_use else ""
        print(f"{info.address:<32}  {info.vendor} {info.model}  {info.serial}{use}")
    if not found:
        print("no camera answered")
        for driver in DRIVERS.values():
            extra = f"  (pip install 'labsurvey[{driver.extra}]')" if driver.extra else ""
            say(arguments, f"  {driver.name:<10}{driver.reaches}: {driver.address}{extra}")
    return DONE


@command(
    "table",
    flag("plan", nargs="?", type=Path, metavar="PLAN", help="capture plan whose table is meant"),
    flag("--jog", nargs="+", metavar="AXIS=DEG",
         help="turn to an angle (axis1=12.5) or by one (axis1=+0.5, axis1=-0.5r)"),
    flag("--home", action="store_true", help="look for the references"),
    flag("--stop", action="store_true", help="stop all axes"),
    help="list drivers; show, turn, home or stop the table of a plan",
    usage="labcapture table plan.toml   (labcapture table [PLAN] [--jog AXIS=DEG ...] [--home] [--stop])",
    description="Without a plan: the drivers and dialects. With one: where its table is.\n"
    "The plan's limits hold for --jog as for a session.",
    epilog="Next: labcapture run plan.toml --dry-run",
)
def table(arguments: argparse.Namespace) -> int:
    """The command ``table``."""
    from capture.session.table_jobs import driver_list, table_job

    if arguments.plan is None:
        if arguments.jog or arguments.home or arguments.stop:
            arguments.parser.error("name the PLAN whose table is meant")
        print(driver_list())
        return DONE
    if (arguments.jog is not None) + arguments.home + arguments.stop > 1:
        arguments.parser.error("--jog, --home and --stop exclude each other")
    status = table_job(arguments.plan, jog=arguments.jog, home=arguments.home, stop=arguments.stop)
    if is_set(arguments, "json"):
        print_json(status)
        return DONE
    print(f"{status['table']} at {status['address']}")
    for axis in status["axes"]:
        low, high = axis["limits_deg"]
        state = axis["fault"] or ("moving" if axis["moving"] else "at rest")
        print(f"  {axis['name']:<8}{axis['readback_deg']:12.5f} deg   limits {low:g} to {high:g} deg   {state}")
    return DONE


@command(
    "view",
    flag("plan", type=Path, metavar="PLAN", help="capture plan"),
    flag("--port", type=port, default=8780, metavar="N", help="on loopback; 0 takes a free one"),
    flag("--host", default="127.0.0.1", metavar="ADDRESS", help="a loopback address; others are refused"),
    flag("--live", action="store_true", help="open the cameras and show what they see"),
    flag("--allow-move", action="store_true",
         help="let the page turn and stop the table, with the token that is printed"),
    help="watch a session on a local web page",
    usage="labcapture view plan.toml   (labcapture view PLAN [--port N] [--live] [--allow-move])",
    description="Serves a page on this machine only: the last images with the targets found in them, what of each\n"
    "camera's image is covered, progress. --live shows what the cameras see now, while no session runs.",
    epilog="Next: open the address that it prints",
)
def view(arguments: argparse.Namespace) -> int:
    """The command ``view``."""
    from capture.web.serve import serve

    return serve(
        arguments.plan,
        host=arguments.host,
        port=arguments.port,
        live=arguments.live,
        allow_move=arguments.allow_move,
        say=lambda line: say(arguments, line),
    )


@command(
    "export",
    flag("folder", type=project_folder, metavar="FOLDER", help="project folder that was captured"),
    flag("file", type=Path, metavar="FILE.nxs", help="new file"),
    help="write a recorded run as NeXus/HDF5",
    usage="labcapture export lab lab.nxs   (labcapture export FOLDER FILE.nxs)",
    description="Images, setpoints, readbacks and times of all recorded epochs in one NXentry.",
    epilog="Next: labsurvey adjust FOLDER",
)
def export(arguments: argparse.Namespace) -> int:
    """The command ``export``."""
    from capture.session.nexus import export

    summary = export(arguments.folder, arguments.file)
    tell(arguments, summary, f"{arguments.file}: {summary['epochs']} epochs, {summary['images']} images")
    return DONE


if __name__ == "__main__":
    program()
