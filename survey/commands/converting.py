"""The command ``convert``."""

import argparse
from pathlib import Path

from survey.commands.common import DONE, begin_adjusting, require_project, show
from survey.commands.parser import command, flag, project_folder

FORMATS = (
    "gama", "krumm", "lgc", "csv", "dbat", "aicon", "g2o", "json", "sinex", "colmap", "colmap-text", "opencv", "ros",
    "ros-industrial", "kalibr", "kalibr-target", "mrcal", "mc-calib", "nerf", "urdf", "sdf", "tum", "kitti", "ply",
    "glb", "project",
)  # fmt: skip


@command(
    "convert",
    flag("source", type=project_folder, metavar="FROM", help="file of another program, or project folder"),
    flag("target", type=Path, metavar="TO", help="new project folder, or new file"),
    flag("--format", choices=FORMATS, metavar="NAME",
         help=f"of the file; default: by its ending. One of {', '.join(FORMATS)}"),
    flag("--station", metavar="ID", help="whose cameras or poses, where the format holds those of one"),
    flag("--information", choices=("tangent", "quaternion"), default="tangent",
         help="rotation part of g2o's information: of the rotation vector, or of the quaternion as g2o itself "
         "means it"),
    flag("--block-diagonal", action="store_true",
         help="of g2o's information matrices read only the blocks of translation and of rotation"),
    help="files of other programs to project folders, and projects to files of other programs",
    usage="labsurvey convert tunnel.gkf tunnel   (labsurvey convert FROM TO [--format NAME])",
    description="FROM a file: it becomes a project folder. Read are GNU Gama's .gkf, Krumm's .dat, LGC's .lgc, a\n"
    "plain .csv, DBAT's .xml, AICON's .phc .ior .eor .obc .scale (any of them, or the report .htm), and g2o.\n"
    "FROM a project: TO ends with .gkf .csv .json .snx or .g2o, with adjusted values where there are results;\n"
    ".snx (SINEX) holds the full covariance and adjusts for it. TO must be new.\n"
    "Cameras, both ways: COLMAP's models (folders), OpenCV, ROS, ROS-Industrial, Kalibr, mrcal, MC-Calib,\n"
    "transforms.json, URDF, SDF, TUM, KITTI; only written: PLY and GLB. Most of them need --format.",
    epilog="Next: labsurvey adjust TO",
)
def convert(arguments: argparse.Namespace) -> int:
    """The command ``convert``."""
    if arguments.source.is_dir() and ((arguments.source / "survey.toml").exists() or arguments.format is None):
        require_project(arguments.source)
    begin_adjusting()  # results of a project are adjusted first
    from survey.jobs.converting import convert_job

    outcome = convert_job(
        arguments.source, arguments.target, format=arguments.format, information=arguments.information,
        block_diagonal=arguments.block_diagonal, station=arguments.station,
    )  # fmt: skip
    show(arguments, outcome, then=(f"\nNext: labsurvey adjust {outcome.target}" if outcome.format == "project" else ""))
    return DONE
