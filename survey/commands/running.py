"""The command ``runs``."""

import argparse
from typing import Any

from survey.commands.common import DONE, is_set, positive, print_json
from survey.commands.parser import project_folder


def declare_runs(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``runs`` to the commands."""
    parser = commands.add_parser(
        "runs",
        help="the runs of a project: list, compare any two, pin, restore",
        usage="labsurvey runs lab   (labsurvey runs FOLDER [list | compare A B | pin N | unpin N | restore N])",
        description="Every run of adjust that changed anything is kept under FOLDER/runs. compare: every parameter in "
        "sigmas of A, and the verdict. pin: keep it for ever; of the others the last 50 stay. restore: survey.toml and "
        "exclusions as they were then, where that can be solved.",
        epilog="Next: labsurvey runs FOLDER compare 1 2",
        **shaped,
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="project folder")
    actions = ("list", "compare", "pin", "unpin", "restore")
    parser.add_argument("action", nargs="?", choices=actions, default="list", metavar="ACTION", help=", ".join(actions))
    parser.add_argument("numbers", nargs="*", type=positive, metavar="N", help="numbers of runs")
    parser.set_defaults(run=_runs)


def _runs(arguments: argparse.Namespace) -> int:
    from survey.folder.kept import require_project

    wanted = {"list": 0, "compare": 2}.get(arguments.action, 1)
    if len(arguments.numbers) != wanted:
        arguments.parser.error(f"{arguments.action} takes {wanted} number{'s' * (wanted != 1)} of runs")
    require_project(arguments.folder)
    found, text = _done(arguments)
    if is_set(arguments, "json"):
        print_json(found)
    else:
        print(text)
    return DONE


def _done(arguments: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from survey.solution.changes import solution_changes
    from survey.solution.runs import list_runs, load_run, pin_run

    folder, numbers = arguments.folder, arguments.numbers
    if arguments.action == "compare":
        changes = solution_changes(*(load_run(folder, n) for n in numbers))
        return changes.as_dict(), changes.text()
    if arguments.action in ("pin", "unpin"):
        run = pin_run(folder, numbers[0], arguments.action == "pin")
        return run.as_dict(), run.text()
    if arguments.action == "restore":
        from survey.workbench.session import Workbench

        bench = Workbench(folder)
        notes = bench.restore(numbers[0])
        said = "\n".join([f"restored: run {numbers[0]}", *notes, f"Next: labsurvey adjust {folder}"])
        return {"restored": numbers[0], "notes": list(notes)}, said
    runs = list_runs(folder)
    lines = [r.text() for r in runs] or [f"no run is kept yet; 'labsurvey adjust {folder}' keeps one"]
    return {"runs": [r.as_dict() for r in runs]}, "\n".join(lines)
