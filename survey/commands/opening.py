"""The commands ``open`` and ``runs``: the workbench of a project, and the runs it keeps."""

import argparse
import os
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from survey.commands.common import DONE, not_negative, positive, require_project, say, tell
from survey.commands.parser import command, flag, project_folder
from survey.folder.kept import undo_killed

if TYPE_CHECKING:
    from survey.workbench.pages.beginning import Beginning
    from survey.workbench.session import Workbench

_PATIENCE_S = 10.0
_ACTIONS = ("list", "compare", "pin", "unpin", "restore")


@command(
    "open",
    flag("folder", type=project_folder, metavar="FOLDER", help="project folder"),
    flag("--at", metavar="PLACE", default="", help="what to show first: '#image=X/hX05', '#point=B07'"),
    flag("--port", type=not_negative, default=8790, metavar="N", help="0 takes a free one"),
    flag("--host", default="127.0.0.1", metavar="ADDRESS", help="loopback: 127.0.0.1 or ::1"),
    flag("--read-only", action="store_true", help="look only; nothing can be changed"),
    flag("--no-browser", action="store_true", help="print the address, open no browser"),
    help="look at a project in the browser: find what is wrong, leave it out, adjust again",
    usage="labsurvey open lab   (labsurvey open FOLDER [--at PLACE] [--port N] [--read-only] [--no-browser])",
    description="Serves the workbench of a project on this machine alone, under an address that holds a token, "
    "until Ctrl-C. What is decided there goes to observations/exclusions.csv and survey.toml at once; results and "
    "runs are written by Save.\n\nFrom another machine: ssh -L 8790:127.0.0.1:8790 THIS_MACHINE",
    epilog="Next: labsurvey adjust FOLDER, labsurvey runs FOLDER",
)
def open_project(arguments: argparse.Namespace) -> int:
    """The command ``open``."""
    if not _holds_images(arguments.folder):
        require_project(arguments.folder)
    import webbrowser

    from survey.workbench.guard import loopback_address, new_token
    from survey.workbench.live import Listening
    from survey.workbench.server import Server

    folder, port, place = arguments.folder, arguments.port, arguments.at
    host = loopback_address(arguments.host, port)
    read_only = arguments.read_only or not os.access(folder, os.W_OK)
    if read_only and not arguments.read_only:
        say(arguments, f"{folder}: cannot be written; it is open for reading only")
    token = new_token()
    server = Server(lambda: _shown(folder, read_only), token, f"labsurvey_{port}")
    endings = {signal.SIGINT, signal.SIGTERM}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, endings)  # in all threads from here on: this one waits for them
    try:
        with Listening(server, host, port) as listening:
            address = f"{listening.address}#token={token}" + (f"&{place.lstrip('#')}" if place else "")
            print(address, flush=True)
            say(arguments, "Ctrl-C ends it")
            if not arguments.no_browser:
                webbrowser.open(address)
            waiting = threading.get_ident()
            server.work.opened.add_done_callback(
                lambda found: signal.pthread_kill(waiting, signal.SIGTERM) if found.exception() else None
            )
            signal.sigwait(endings)
            if server.work.opened.done() and server.work.opened.exception():
                server.work.told.wait(0.0 if arguments.no_browser else _PATIENCE_S)  # the page says it too
                server.work.opened.result()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return DONE


def _shown(folder: Path, read_only: bool) -> "Workbench | Beginning":
    """The project of a folder, or its images; read while the browser starts and loads the page."""
    from survey.workbench.pages.beginning import Beginning
    from survey.workbench.session import Workbench

    return (Workbench if (folder / "survey.toml").is_file() else Beginning)(folder, read_only=read_only)


def _holds_images(folder: Path) -> bool:
    """Whether a folder is no project, but may become one by the images in it."""
    undo_killed(folder)
    if (folder / "survey.toml").is_file() or not folder.is_dir():
        return False
    from survey.project.images import IMAGE_ENDINGS

    return any(p.suffix.lower() in IMAGE_ENDINGS for at in ("*", "*/*", "images/*/*") for p in folder.glob(at))


@command(
    "runs",
    flag("folder", type=project_folder, metavar="FOLDER", help="project folder"),
    flag("action", nargs="?", choices=_ACTIONS, default="list", metavar="ACTION", help=", ".join(_ACTIONS)),
    flag("numbers", nargs="*", type=positive, metavar="N", help="numbers of runs"),
    help="the runs of a project: list, compare any two, pin, restore",
    usage="labsurvey runs lab   (labsurvey runs FOLDER [list | compare A B | pin N | unpin N | restore N])",
    description="Every run of adjust that changed anything is kept under FOLDER/runs. compare: every parameter in "
    "sigmas of A, and the verdict. pin: keep it for ever; of the others the last 50 stay. restore: survey.toml and "
    "exclusions as they were then, where that can be solved.",
    epilog="Next: labsurvey runs FOLDER compare 1 2",
)
def runs(arguments: argparse.Namespace) -> int:
    """The command ``runs``."""
    wanted = {"list": 0, "compare": 2}.get(arguments.action, 1)
    if len(arguments.numbers) != wanted:
        arguments.parser.error(f"{arguments.action} takes {wanted} number{'s' * (wanted != 1)} of runs")
    require_project(arguments.folder)
    tell(arguments, *_done(arguments))
    return DONE


def _done(arguments: argparse.Namespace) -> tuple[dict[str, object], str]:
    from survey.solution.earlier.changes import solution_changes
    from survey.solution.earlier.runs import list_runs, load_run, pin_run

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
