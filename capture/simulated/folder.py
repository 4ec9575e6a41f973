"""The folder of a simulated laboratory: what the processes that play its parts agree on.

``lab.json`` says how to make it, ``angles.json`` how the table stands now, ``survey.toml`` (and
``observations/coordinates.csv``) is what its owner knows and gives to the session, ``truth.json`` what nobody reads.
"""

import json
import secrets
from dataclasses import asdict
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from capture.simulated.angles import write_angles
from capture.simulated.laboratory import (
    BEACON_EXPOSURE_US,
    CAMERA_IDS,
    IMAGE_SIZE,
    LabPose,
    LabSize,
    SimulatedLab,
    furnished_lab,
    make_lab,
)
from survey.examples.truth import truth_json
from survey.folder.whole import whole_folder
from survey.simulate.parts import BOARD

LAB, ANGLES = "lab.json", "angles.json"
_COORDINATES_SIGMA_MM = 0.4
_DEFAULT = LabSize()


def write_lab(folder: Path, seed: int, size: LabSize = _DEFAULT) -> SimulatedLab:
    """Make a laboratory and write its folder, new or empty; the table stands at zero.

    Raises SurveyError where the folder holds something.
    """
    lab = make_lab(seed, size)
    description = {"format": 1, "seed": seed, "poses": [asdict(pose) for pose in lab.poses]}
    with whole_folder(Path(folder)) as place:
        (place / LAB).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
        (place / "truth.json").write_text(truth_json(lab.truth, seed), encoding="utf-8")
        (place / "survey.toml").write_text(_survey_toml(lab), encoding="utf-8")
        if size.n_beacon:
            (place / "observations").mkdir()
            (place / "observations" / "coordinates.csv").write_text(_coordinates(lab), encoding="utf-8")
        write_angles(place / ANGLES, 0.0, 0.0)
    return lab


def read_lab(folder: Path, noise_seed: int | None = None) -> SimulatedLab:
    """The laboratory of a folder, with noise of its own unless ``noise_seed`` says which.

    Raises SurveyError where the folder holds none.
    """
    file = Path(folder) / LAB
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        poses = (LabPose(**{**pose, "camera_ids": tuple(pose["camera_ids"])}) for pose in told["poses"])
        noise_seed = secrets.randbits(32) if noise_seed is None else noise_seed
        return furnished_lab(int(told["seed"]), tuple(poses), noise_seed)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise SurveyError(f"{file}: no simulated laboratory ({error}); write one first") from error


def _survey_toml(lab: SimulatedLab) -> str:
    text = """# A head with three cameras on a two-axis table before a board that hangs in the laboratory: simulated.
format = 1
title = "Simulated laboratory"
"""
    for camera_id in CAMERA_IDS:
        text += f"""
[cameras.{camera_id}]
station = "head"
image_size_px = [{IMAGE_SIZE[0]}, {IMAGE_SIZE[1]}]

[cameras.{camera_id}.lens]
model = "brown"
free = ["fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2"]
"""
    text += f"""
[stations.head]
motion = "table"
table = "turntable"
mount_from_station = {{ treatment = "held" }}        # the frame of the head is that of the table's inner axis

[tables.turntable]
axes = ["x", "z"]                                  # outermost first
sigma_arcsec = 8.0
world_from_table = {{ treatment = "free" }}
geometry = {{ free = ["non_orthogonality", "axis_offset"] }}

[targets.board]
kind = "checkerboard"
columns = {BOARD.columns}
rows = {BOARD.rows}
square_mm = {1e3 * BOARD.square_m:.1f}
pose = {{ treatment = "held" }}                      # the board is the world
"""
    return text + _beacons(lab) + _END


_END = """
[sigmas]
image_px = 0.1                                     # where the detector gives none

[datum]
kind = "given"                                     # the board is held

[adjustment]
alpha = 0.05
"""


def _beacons(lab: SimulatedLab) -> str:
    if not lab.draft.points:
        return ""
    points = "\n".join(f"[points.{p.point_id}]" for p in lab.draft.points)
    cameras = ", ".join(f'"{name}"' for name in CAMERA_IDS)
    dark = ", ".join(f'"{p.epoch_id}"' for p in lab.poses if p.exposure_us == BEACON_EXPOSURE_US)
    return f"""
{points}

[spots]                                            # images in which beacons are looked for
cameras = [{cameras}]
epochs = [{dark}]
diameter_px = [1.5, 12.0]
gate_px = 15.0
"""


def _coordinates(lab: SimulatedLab) -> str:
    rng = np.random.default_rng((lab.seed, 1))
    sigma = f"{_COORDINATES_SIGMA_MM:.1f}"
    lines = ["point_id,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm"]
    for point in lab.draft.points:
        true = lab.draft.scene().vector("point", point.point_id)
        x, y, z = 1e3 * true + rng.normal(0.0, _COORDINATES_SIGMA_MM, 3)
        lines.append(f"{point.point_id},{x:.3f},{y:.3f},{z:.3f},{sigma},{sigma},{sigma}")
    return "\n".join(lines) + "\n"
