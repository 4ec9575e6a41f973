"""The commands ``plan`` and ``check``: what a survey will give, what it cannot give, before it is adjusted."""

import argparse
from pathlib import Path

from adjust.model.errors import SurveyError
from survey.commands.common import (
    DONE,
    TEST_FAILED,
    is_set,
    not_negative,
    positive,
    print_json,
    require_project,
    say,
    show,
)
from survey.commands.parser import command, flag, project_folder

_DESCRIPTION = """\
With FOLDER/plan.toml: predicts what will be seen and says what sigmas everything will have, which directions are weak,
what to measure next, how exact the parts must be; writes FOLDER/results/plan.html and plan.json. What is observed
already is counted in. Without: counts conditions and redundancy of observations/pairs.csv, which needs no values yet.
"""


@command(
    "plan",
    flag("folder", type=project_folder, nargs="?", metavar="FOLDER", help="folder with survey.toml and plan.toml"),
    flag("--for", nargs="+", dest="wanted", metavar="NAME", default=[],
         help="what is to become precise: lens.X, head.camera_X, point.B*, everything"),
    flag("--add", type=not_negative, default=5, metavar="N", help="candidates to choose (5)"),
    flag("--criterion", choices=("D", "A"), default="D", help="determinant or mean variance (D)"),
    flag("--trials", type=positive, metavar="N", help="simulate and adjust the plan N times"),
    flag("--seed", type=not_negative, default=0, metavar="N", help="of everything random (0)"),
    flag("--jobs", type=positive, metavar="N", help="processes for trials; default: one per processor"),
    flag("--navigation", action="store_true", help="precision of the poses of [navigation]"),
    flag("--place", type=positive, default=0, metavar="N", help="choose places of N beacons for them"),
    flag("--error-analysis", action="store_true", help="pixel error by beacon and camera errors, 10000 trials a point"),
    flag("--pixels", type=float, default=5.0, metavar="PX", help="pixel error allowed in it (5)"),
    flag("--out", type=Path, metavar="DIR", help="write results below DIR, not below FOLDER"),
    help="precision before measuring, what to measure next, tolerances, places for beacons",
    usage="labsurvey plan lab   (labsurvey plan FOLDER [--for NAME ...] [--add N] [--trials N] [--navigation]\n"
    "                              [--place N] | labsurvey plan --error-analysis [--out DIR])",
    description=_DESCRIPTION,
    epilog="Next: labsurvey adjust FOLDER",
)
def plan(arguments: argparse.Namespace) -> int:
    """The command ``plan``."""
    if arguments.error_analysis:
        return _error_analysis(arguments)
    if arguments.folder is None:
        raise SurveyError("name the project folder: labsurvey plan FOLDER; or labsurvey plan --error-analysis")
    require_project(arguments.folder, arguments.out)
    if not (arguments.folder / "plan.toml").is_file():
        return _network(arguments)
    from survey.planning.job import PlanRequest, planning_job

    request = PlanRequest(
        tuple(arguments.wanted), arguments.add, arguments.criterion, arguments.trials or 0, arguments.seed,
        arguments.jobs, arguments.navigation, arguments.place,
    )  # fmt: skip
    outcome = planning_job(arguments.folder, request, out=arguments.out, progress=not is_set(arguments, "quiet"))
    show(arguments, outcome, outcome.paths.values())
    return DONE


def _error_analysis(arguments: argparse.Namespace) -> int:
    from survey.planning.errors import error_analysis_job

    result = error_analysis_job(
        arguments.out, n_trials=arguments.trials or 10_000, seed=arguments.seed, rms_px=arguments.pixels
    )
    show(arguments, result, result.paths.values())
    return DONE


def _network(arguments: argparse.Namespace) -> int:
    """Without a plan.toml: the counts of a network of pairs."""
    from survey.jobs.network import plan_job

    outcome = plan_job(arguments.folder)
    show(arguments, outcome, then=f"\nNext: labsurvey adjust {arguments.folder}")
    return DONE


@command(
    "check",
    flag("folder", type=project_folder, metavar="FOLDER", help="folder with a survey.toml"),
    help="what is weak or suspicious in a project, before it is adjusted",
    usage="labsurvey check lab   (labsurvey check FOLDER)",
    description="Looks at the observations of FOLDER without adjusting them: what they leave undetermined, points\n"
    "without redundancy, names that appear once, epochs without partners, images that are badly covered, boards\n"
    "too far or too flat, suspicious units and sigmas; and what to measure next. Writes nothing.\n"
    "The exit code is 3 where something would stop or spoil the adjustment.",
    epilog="Next: labsurvey adjust FOLDER",
)
def check(arguments: argparse.Namespace) -> int:
    """The command ``check``."""
    require_project(arguments.folder)
    from survey.planning.checking import check_job

    outcome = check_job(arguments.folder)
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(outcome.text())
        say(arguments, f"Next: labsurvey adjust {arguments.folder}")
    return TEST_FAILED if outcome.n_problems else DONE
