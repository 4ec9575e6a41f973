"""A head with two cameras before a fixed board and beacons; its images are projected by OpenCV, with noise."""

from pathlib import Path

import cv2
import numpy as np
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.lenses.models import MODELS, camera_constants, project
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.survey import Camera, LensParameter, Point, PointParameter, PoseParameter, Station, Survey, Target
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.converting import adjusted_values
from survey.project import read, write_project
from survey.project.targets import Checkerboard

SIZE = (1280, 960)
SIGMA_PX = 0.1
BOARD = Checkerboard(6, 5, 0.08)
BEACONS = np.array([[-0.3, -0.2, 0.3], [0.7, -0.1, 0.2], [0.1, 0.6, 0.35], [0.5, 0.5, -0.2], [-0.2, 0.4, -0.3]])
FREE = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")
LENSES = {
    "left": {"fx": 1100.0, "fy": 1103.0, "u0": 641.3, "v0": 478.2, "k1": -0.12, "k2": 0.05, "p1": 4e-4, "p2": -3e-4},
    "right": {"fx": 1090.0, "fy": 1091.5, "u0": 634.8, "v0": 481.9, "k1": -0.10, "k2": 0.03, "p1": -2e-4, "p2": 5e-4},
}
LEFT_FROM_RIGHT = Pose3(Rot3(Rotation.from_rotvec([0.02, 0.15, -0.03]).as_matrix()), np.array([0.25, 0.01, -0.02]))
STATION_FROM_LEFT = Pose3(Rot3(Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()), np.array([0.05, 0.02, 0.1]))


def head_poses(n=9, seed=5):
    """world_from_left at n epochs, looking at the middle of the board from 1.2 m and more."""
    rng, out = np.random.default_rng(seed), []
    middle = np.array([0.2, 0.16, 0.0])
    for i in range(n):
        a = 2 * np.pi * i / n
        z = Rotation.from_rotvec([0.5 * np.sin(a), 0.5 * np.cos(a), 0]).as_matrix()[:, 2]
        z = z * -1 if z[2] < 0 else z
        x = np.cross([0, 1, 0], z)
        x /= np.linalg.norm(x)
        R = np.column_stack([x, np.cross(z, x), z]) @ Rotation.from_euler("z", 0.7 * i).as_matrix()
        out.append(Pose3(Rot3(R), middle - z * (1.2 + 0.1 * rng.uniform()) + rng.normal(0, 0.02, 3)))
    return out


def opencv_pixels(lens, camera_from_world, x):
    """Projection by OpenCV."""
    K = np.array([[lens["fx"], 0, lens["u0"]], [0, lens["fy"], lens["v0"]], [0, 0, 1.0]])
    k = np.array([lens.get(n, 0.0) for n in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
    r = Rotation.from_matrix(camera_from_world.rotation().matrix()).as_rotvec()
    return cv2.projectPoints(np.ascontiguousarray(x), r, camera_from_world.translation(), K, k)[0].reshape(-1, 2)


def write_lab(folder: Path, noise=SIGMA_PX, seed=1):
    """The project, adjusted by nobody yet."""
    rng = np.random.default_rng(seed)
    ids, x_board = BOARD.points()
    station_from = {"left": STATION_FROM_LEFT, "right": STATION_FROM_LEFT * LEFT_FROM_RIGHT}
    blocks = []
    for i, world_from_left in enumerate(head_poses()):
        world_from_station = world_from_left * STATION_FROM_LEFT.inverse()
        for name, pose in station_from.items():
            camera_from_world = (world_from_station * pose).inverse()
            for target, x in (("board", x_board), (None, BEACONS)):
                uv = opencv_pixels(LENSES[name], camera_from_world, x)
                inside = ((uv > 0) & (uv < np.array(SIZE) - 1)).all(axis=1)
                uv = (uv + noise * rng.standard_normal(uv.shape))[inside]
                cov = np.tile(SIGMA_PX**2 * np.eye(2), (len(uv), 1, 1))
                blocks.append(ImageBlock(name, f"e{i:02d}", target, np.flatnonzero(inside), uv, cov))
    cameras = tuple(
        Camera(name, "head", SIZE, LensParameter("brown", FREE),
               PoseParameter(station_from[name], "held" if name == "left" else "free"))
        for name in LENSES
    )  # fmt: skip
    survey = Survey(
        cameras, (Station("head", motion="epoch"),),
        targets=(Target("board", ids, x_board, carrier_from_target=PoseParameter(Pose3(), "held")),),
        points=tuple(Point(f"B{i}", PointParameter()) for i in range(len(BEACONS))), image_blocks=tuple(blocks),
    )  # fmt: skip
    write_project(folder, survey, title="lab", target_kinds={"board": BOARD})
    return folder


def adjusted_lab(folder: Path):
    """The project's folder, adjusted, and its values."""
    write_lab(folder)
    adjust_job(folder)
    return folder, adjusted_values(read(folder))


def pixels(values, camera, x_in_station):
    """What a survey's camera makes of points of its station."""
    pose = values.station_from_camera(camera)
    q = np.array([pose.transformTo(x) for x in x_in_station])
    return project(MODELS[camera.lens.model], values.lens(camera), camera_constants(camera), q)


def points_before(values, camera, n=200, seed=2):
    """Points (n, 3) of the station that the camera sees."""
    rng = np.random.default_rng(seed)
    q = np.column_stack([rng.uniform(-0.45, 0.45, n), rng.uniform(-0.35, 0.35, n), np.ones(n)])
    q *= rng.uniform(0.5, 4.0, (n, 1))
    pose = values.station_from_camera(camera)
    return np.array([pose.transformFrom(x) for x in q])


def same_rig(values, back, names, tolerance_px=1e-9):
    """Largest distance between what both make of the same points; frames are joined at the first camera."""
    own = {c.camera_id: c for c in values.survey.cameras}
    other = {c.camera_id: c for c in back.survey.cameras}
    first = next(iter(names))
    join = back.station_from_camera(other[names[first]]) * values.station_from_camera(own[first]).inverse()
    worst = 0.0
    for name, renamed in names.items():
        x = points_before(values, own[name])
        moved = np.array([join.transformFrom(p) for p in x])
        difference = pixels(values, own[name], x) - pixels(back, other[renamed], moved)
        worst = max(worst, float(np.abs(difference).max()))
    assert worst < tolerance_px, worst
    return worst


def world_pixels(values):
    """Predicted image points by (camera, epoch), in the order of the blocks."""
    out = {}
    cameras = {c.camera_id: c for c in values.survey.cameras}
    for block in values.blocks():
        if block.target_id is None:
            x = np.array([values.point(values.survey.points[i].point_id) for i in block.point_idx])
        else:
            target = next(t for t in values.survey.targets if t.target_id == block.target_id)
            pose = values.world_from(FrameRef("target", target.target_id, block.epoch_id))
            x = np.array([pose.transformFrom(p) for p in values.x_in_target(target)[block.point_idx]])
        pose = values.world_from(FrameRef("camera", block.camera_id, block.epoch_id))
        q = np.array([pose.transformTo(p) for p in x])
        camera = cameras[block.camera_id]
        uv = project(MODELS[camera.lens.model], values.lens(camera), camera_constants(camera), q)
        out.setdefault((block.camera_id, block.epoch_id), []).append(uv)
    return {key: np.concatenate(uv) for key, uv in out.items()}
