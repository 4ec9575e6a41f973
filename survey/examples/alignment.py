"""The example "alignment": a board to be made parallel to a levelled turntable by levels and a laser; no images."""

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.survey import FloatArray
from adjust.spatial.vertical import tilted
from survey.folder.text import json_text

ARCSEC = np.pi / 648000.0
UP = tilted(np.array([0.0, 0.0, 1.0]), np.array([90.0, -60.0]) * ARCSEC)[0]
OFF = np.radians([0.35, -0.22, 0.55])
"""What the board is turned too much about its own axes before anybody has turned it, rad."""
CENTRE = np.array([-0.1, 0.07, 0.6])
"""Origin of the board in the frame of the table, m."""
BEAM = np.array([0.004, -0.003, 0.01, 0.02])
LEVEL_SIGMA_G, SPOT_SIGMA_MM, TABLE_SIGMA_ARCSEC = 5e-5, 0.05, 8.0
TRACE_DEG = np.arange(-10.0, 10.1, 2.5)

DEFINITION = """# A board above a turntable, to be made parallel to it (levels, then the trace of a laser).
format = 1
title = "Alignment of the board"

[tables.turntable]
axes = ["x", "z"]
sigma_arcsec = [8.0, 8.0]
world_from_table = { treatment = "held" }          # the frame of the table is that of the world
geometry = { free = [] }

[targets.board]
kind = "checkerboard"
columns = 11
rows = 8
square_mm = 20.0
# where a tape puts it, to 2 mm; nothing is known of how it is turned
pose = { treatment = "prior", translation_mm = [-100.0, 70.0, 600.0], rotation_euler_xyz_deg = [0.0, 0.0, 0.0], \
sigma_translation_mm = 2.0, sigma_rotation_deg = inf }

[vertical]                                         # told by the level on the table
free = ["tilt_1", "tilt_2"]

[beams.laser]                                      # on the mount, about along its z axis
mount = "turntable"
axis = "z"

[align.board]
body = "target:board"
onto = "table:turntable"
tolerance_arcsec = 200.0
pitch_mm = 0.5
feet_mm = { left = [0.0, 0.0], right = [200.0, 0.0], far = [100.0, -140.0] }
"""


def board_pose(off: FloatArray) -> Pose3:
    """Where a board stands that is turned too much by ``off`` (3,) rad."""
    return Pose3(Rot3.Expmap(off), CENTRE)


def alignment_files(seed: int, off: FloatArray = OFF) -> dict[str, str]:
    """The project's files by their path; ``off``: how the board stands now."""
    rng = np.random.default_rng(seed)
    board = np.asarray(board_pose(off).matrix())
    levels = ["level_id,frame_id,axis,value_g,sigma_g"]
    for name, frame, R in (("table", "table:turntable", np.eye(3)), ("board", "target:board", board[:3, :3])):
        for i, axis in enumerate("xy"):
            force = float(R[:, i] @ UP) + LEVEL_SIGMA_G * rng.standard_normal()
            levels.append(f"{name}_{axis},{frame},{axis},{force:.7f},{LEVEL_SIGMA_G:g}")
    spots = ["spot_id,beam_id,epoch_id,target_id,x_mm,y_mm,sigma_mm"]
    angles = ["epoch_id,table_id,axis1_deg,axis2_deg"]
    for k, degrees in enumerate(TRACE_DEG, 1):
        x, y = 1e3 * _spot(board, np.radians(degrees)) + SPOT_SIGMA_MM * rng.standard_normal(2)
        spots.append(f"s{k},laser,e{k},board,{x:.3f},{y:.3f},{SPOT_SIGMA_MM:g}")
        a1, a2 = np.array([degrees, 0.0]) + TABLE_SIGMA_ARCSEC / 3600.0 * rng.standard_normal(2)
        angles.append(f"e{k},turntable,{a1:.6f},{a2:.6f}")
    truth = {"note": "true values of the simulation; nothing reads this file", "seed": seed,
             "off_deg": np.degrees(off).tolist(), "up_in_world": UP.tolist(), "beam": BEAM.tolist()}  # fmt: skip
    return {
        "survey.toml": DEFINITION,
        "observations/levels.csv": "\n".join(levels) + "\n",
        "observations/laser_spots.csv": "\n".join(spots) + "\n",
        "observations/table_angles.csv": "\n".join(angles) + "\n",
        "truth.json": json_text(truth),
    }


def _spot(world_from_board: FloatArray, angle: float) -> FloatArray:
    """Where the beam, turned about the table's x axis, meets the board, (2,) m in the board."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    start, along = turn @ np.array([BEAM[0], BEAM[1], 0.0]), turn @ np.array([BEAM[2], BEAM[3], 1.0])
    R, t = world_from_board[:3, :3], world_from_board[:3, 3]
    p, d = R.T @ (start - t), R.T @ along
    return np.asarray((p - d * p[2] / d[2])[:2])
