"""A project folder with values for everything, nothing measured, and a plan: the head on its table before a board."""

from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.model.survey import PointParameter, PoseParameter
from survey.project import Sigmas, write_project
from survey.simulate import beacons

PLAN = """
image_sigma_px = 0.115
wanted = ["head.camera_*"]

[seen]
widest_incidence_deg = 65

[[epochs]]                       # the table carries the head before the board
name = "t"
table = "turntable"
angles_deg = [{angles}]
targets = ["board"]
points = false

[[epochs]]                       # beacons in the dark
name = "n"
table = "turntable"
grid_deg = [[-40, 40, 40], [-180, 120, 60]]
targets = []

[[epochs]]                       # the head held by hand before the board
name = "hX"
by_hand = {{ camera = "X", target = "board", count = 3, distance_mm = [500, 900], tilt_deg = 35 }}
points = false

[[epochs]]
name = "hY"
by_hand = {{ camera = "Y", target = "board", count = 3, distance_mm = [500, 900], tilt_deg = 35, seed = 2 }}
points = false

[[epochs]]
name = "hZ"
by_hand = {{ camera = "Z", target = "board", count = 3, distance_mm = [500, 900], tilt_deg = 35, seed = 3 }}
points = false

[[coordinates]]
of = [{names}]
sigma_mm = 0.4

[[distances]]
from = "B01"
to = "B02"
sigma_mm = 0.3

[[candidates.epochs]]
name = "c"
table = "turntable"
angles_deg = [{more}]
targets = ["board"]
points = false

[[candidates.distances]]
from = "B03"
to = "B07"
sigma_mm = 0.1

[[candidates.points]]
id = "N1"
x_mm = [{beacon}]
sigma_mm = 0.4

[[required]]
of = "head.camera_*"
sigma_rotation_deg = 0.02
sigma_translation_mm = 0.15

[navigation]
station = "head"
sigma_px = 0.2
volume_mm = [[-100, 100], [-100, 100], [0, 0]]
steps = [2, 2, 1]
attitudes_euler_xyz_deg = [[0, 0, 0]]
turn_about = "z"
turn_steps = 4
required_rotation_deg = 0.17
required_translation_mm = 2.0
room_mm = [[-1500, 1500], [-1500, 1500], [-1200, 1200]]
places = 6
beacon_sigma_mm = 0.4
"""


def lab_survey(seed=3, epochs=8):
    """(survey with values at the truth and no observations, truth, table angles (deg) that show the board)."""
    survey, truth = beacons(seed, n_table_epochs=epochs, n_free_epochs=3, n_night_epochs=2)
    board = {b.epoch_id for b in survey.image_blocks if b.target_id == "board"}
    angles = [np.degrees(truth["table_angles", r.table_id, r.epoch_id]).round(4).tolist()
              for r in survey.table_readings if r.epoch_id in board]  # fmt: skip

    def at(name, parameter):
        value = truth.get(name)
        return replace(parameter, value=value) if isinstance(value, Pose3) else parameter

    cameras = tuple(
        replace(
            c,
            lens=replace(c.lens, values=np.asarray(truth["lens", c.camera_id])),
            station_from_camera=at(("station_from_camera", c.camera_id), c.station_from_camera),
        )
        for c in survey.cameras
    )
    tables = tuple(
        replace(
            t,
            world_from_table=PoseParameter(truth["world_from_table", t.table_id]),
            geometry=replace(t.geometry, values=np.asarray(truth["table_geometry", t.table_id])),
        )
        for t in survey.tables
    )
    points = tuple(replace(p, x_in_world=PointParameter(truth["point", p.point_id])) for p in survey.points)
    bare = replace(survey, cameras=cameras, tables=tables, points=points, image_blocks=(), table_readings=(),
                   distances=(), coordinates=())  # fmt: skip
    return bare, truth, angles


def write_lab(folder, plan=PLAN, epochs=8):
    """Write the project and its plan; (survey, truth)."""
    survey, truth, angles = lab_survey(epochs=epochs)
    sigmas = Sigmas(0.115, {}, {"turntable": np.full(2, np.radians(8 / 3600))})
    write_project(folder, survey, title="Planned lab", sigmas=sigmas)
    more = angles[2::4]
    first = [a for a in angles if a not in more]
    beacon = 1e3 * (np.asarray(truth["point", "B01"]) + [0.1, 0.1, 0.0])
    text = plan.format(
        angles=", ".join(map(str, first)),
        more=", ".join(map(str, more)),
        names=", ".join(f'"{p.point_id}"' for p in survey.points),
        beacon=", ".join(f"{v:.1f}" for v in beacon),
    )
    (folder / "plan.toml").write_text(text)
    return survey, truth
