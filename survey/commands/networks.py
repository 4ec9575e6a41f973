"""The commands ``add``, ``remove``, ``pairs`` and ``trackers``."""

import argparse
import time
from pathlib import Path

from survey.commands.common import DONE, begin_adjusting, is_set, require_project, say, show, tell, tested
from survey.commands.excluding import NAMES, names
from survey.commands.parser import command, flag, project_folder

_PAUSE_S = 0.3


@command(
    "add",
    flag("folder", type=project_folder, metavar="FOLDER", help="adjusted project folder"),
    flag("new", type=Path, metavar="NEW", help="folder with what is new"),
    flag("--out", type=Path, metavar="DIR", help="leave FOLDER alone, write the grown project to DIR"),
    flag("--live", action="store_true",
         help="while NEW/observations/pairs.csv is written: say of each pair at once whether it fits; Ctrl-C adds all"),
    help="add stations or observations to an adjusted project",
    usage="labsurvey add lab lab/more   (labsurvey add FOLDER NEW [--out DIR] [--live])",
    description="NEW holds observations/*.csv and, for new stations, cameras, targets, points or tables, a "
    "survey.toml with them.\nFOLDER is adjusted with them from its last solution; on any error it stays as it was.",
    epilog="Next: open FOLDER/results/report.html",
)
def add(arguments: argparse.Namespace) -> int:
    """The command ``add``."""
    begin_adjusting()
    require_project(arguments.folder, arguments.out)
    from survey.jobs.network import add_job

    if arguments.live:
        _tell_live(arguments)
    outcome = add_job(arguments.folder, arguments.new, out=arguments.out, progress=not is_set(arguments, "quiet"))
    show(arguments, outcome, outcome.outcome.paths.values())
    return tested(outcome.outcome.solution["summary"])


def _tell_live(arguments: argparse.Namespace) -> None:
    """Until Ctrl-C."""
    from survey.jobs.growing import Growing

    growing = Growing.begin(arguments.folder, arguments.new)
    say(arguments, f"{growing.session.n_stations} stations; waiting for pairs, Ctrl-C adds them")
    try:
        while True:
            say(arguments, *growing.look())
            time.sleep(_PAUSE_S)
    except KeyboardInterrupt:
        say(arguments, "")


@command(
    "remove",
    *names("project folder, adjusted or not", "what is to be left out", "why; stands in the report"),
    flag("--out", type=Path, metavar="DIR", help="leave FOLDER alone, write the new project to DIR"),
    help="adjust a project again without some observations",
    usage="labsurvey remove lab p3   (labsurvey remove FOLDER NAME [NAME ...] [--reason TEXT] [--out DIR])",
    description="Excludes observations as 'labsurvey exclude' does, adjusts again and says what moved.\nRefuses "
    "what the rest cannot do without; on any error FOLDER stays as it was.\n\n" + NAMES,
    epilog="Next: open FOLDER/results/report.html; labsurvey include FOLDER NAME takes back",
)
def remove(arguments: argparse.Namespace) -> int:
    """The command ``remove``."""
    require_project(arguments.folder, arguments.out)
    from survey.jobs.removing import remove_job

    progress = not is_set(arguments, "quiet")
    outcome = remove_job(
        arguments.folder, arguments.names, out=arguments.out, progress=progress, reason=arguments.reason,
        author=arguments.author,
    )  # fmt: skip
    show(arguments, outcome, outcome.outcome.paths.values())
    return tested(outcome.outcome.solution["summary"])


@command(
    "pairs",
    flag("folder", type=project_folder, metavar="FOLDER", help="project folder with image points"),
    flag("--station", metavar="ID", help="station whose eyes they are; default: the only one with two"),
    flag("--out", type=Path, metavar="DIR", help="write a project with the pairs to the new folder DIR"),
    flag("--joint", action="store_true",
         help="write the station from all eyes at once: one pair from its first eye to each other, already closed"),
    help="pairs of a station's cameras, marker blocks or trackers, from what each of them saw",
    usage="labsurvey pairs lab --out closed   (labsurvey pairs FOLDER [--station ID] [--out DIR] [--joint])",
    description="Each camera is adjusted by itself before its own targets, which stand still; each marker block\n"
    "before a camera that stands still; then every two of them, without a common view.\n"
    "FOLDER/trajectories/EYE.csv (t,x,y,z,qx,qy,qz,qw) are read instead where they are there.\n"
    "DIR becomes a project in which every eye is a station, with observations/pairs.csv.",
    epilog="Next: labsurvey adjust DIR closes the loops",
)
def pairs(arguments: argparse.Namespace) -> int:
    """The command ``pairs``."""
    if arguments.joint and arguments.out is None:
        arguments.parser.error("--joint says what is written; name --out DIR too")
    from survey.jobs.pairs import station_pairs

    outcome = station_pairs(arguments.folder, station=arguments.station, out=arguments.out, joint=arguments.joint)
    show(arguments, outcome, [outcome.written] if outcome.written else [])
    return DONE


@command(
    "trackers",
    flag("files", nargs="+", type=Path, metavar="FILE", help="trajectories, three or more"),
    flag("--out", type=Path, metavar="DIR", help="write the pairs to DIR/pairs.csv"),
    help="clocks, drift and relative poses of trackers on one station, from their trajectories",
    usage="labsurvey trackers a.csv b.csv c.csv   (labsurvey trackers FILE FILE FILE ... [--out DIR])",
    description="Files have lines t,x,y,z,qx,qy,qz,qw (s, m, world_from_eye); a file's name is its tracker's.",
    epilog="Next: labsurvey trackers FILE FILE FILE --out DIR",
)
def trackers(arguments: argparse.Namespace) -> int:
    """The command ``trackers``."""
    files: dict[str, Path] = {path.stem: path for path in arguments.files}
    if len(files) < len(arguments.files):
        arguments.parser.error("two FILEs have the same name, but it names their trackers")
    from survey.jobs.relay import read_trajectories, relay_trackers, tracker_pairs, trackers_text, write_relay_pairs

    found = relay_trackers(read_trajectories(files))
    written = None
    if arguments.out is not None:
        written = write_relay_pairs(arguments.out, tracker_pairs(found).pairs)
    said = {"trackers": list(files), "report": trackers_text(found), "written": written and str(written)}
    tell(arguments, said, trackers_text(found).rstrip("\n"), [written] if written else [])
    return DONE
