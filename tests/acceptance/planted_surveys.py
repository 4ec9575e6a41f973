"""Small good surveys of many kinds, with their truth, into which mistakes are planted."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache

import numpy as np
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.model.observations import FrameRef, ImageBlock, Pair
from adjust.model.survey import FloatArray, PoseParameter, Station, Survey, Target
from survey.simulate import LabSize, beacons, full_lab, head_on_table, relay, resample, stereo
from survey.simulate.scene import Scene, Truth
from tests.adjust.terrestrial_networks import measured, polar_network

SMALL_LAB = LabSize(7, 4, 4, 4, 5)
Path = Callable[[float], Pose3]


@cache
def survey_of(kind: str, seed: int) -> tuple[Survey, Truth]:
    """A good survey of a kind, with its truth."""
    return KINDS[kind](seed)


def board_path(t: float) -> Pose3:
    """A board that a hand carries about before two cameras; t in intervals between epochs."""
    turn = Rotation.from_euler("xyz", [25 * np.sin(0.7 * t), 22 * np.cos(0.55 * t), 20 * np.sin(0.4 * t)], degrees=True)
    middle = np.array([0.10 + 0.07 * np.sin(0.5 * t), 0.05 * np.cos(0.6 * t), 0.85 + 0.12 * np.sin(0.35 * t)])
    R = turn.as_matrix()
    return Pose3(Rot3(R), middle - R @ np.array([0.1, 0.0625, 0.0]))


def rig(seed: int, n: int = 18) -> tuple[Survey, Truth]:
    """Two cameras on a bar before a board on a smooth path."""
    survey, truth = stereo(seed, n_pairs=n)
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks))
    truth = truth | {("carrier_from_target", "board", e): board_path(i) for i, e in enumerate(epochs)}
    return resample(survey, truth, seed), truth


def tripods(seed: int) -> tuple[Survey, Truth]:
    """Two tripods with a camera each, and a board held by hand; the first is the world."""
    survey, truth = stereo(seed)
    left, right = survey.cameras
    held = PoseParameter(Pose3(), "held")
    cameras = (left, replace(right, station_id="post", station_from_camera=held))
    truth = truth | {("world_from_station", "post"): truth["station_from_camera", "right"],
                     ("station_from_camera", "right"): Pose3()}  # fmt: skip
    return replace(survey, cameras=cameras, stations=(*survey.stations, Station("post"))), truth


def held_lens(seed: int) -> tuple[Survey, Truth]:
    """Two cameras on a bar; lens and place of the second one were calibrated before."""
    survey, truth = stereo(seed)
    lens, place = np.asarray(truth["lens", "right"]), PoseParameter(truth["station_from_camera", "right"], "held")
    left, right = survey.cameras
    cameras = left, replace(right, lens=replace(right.lens, free=(), values=lens), station_from_camera=place)
    return replace(survey, cameras=cameras), truth


def small_head(seed: int) -> tuple[Survey, Truth]:
    """Three cameras on a two-axis table before a board."""
    return head_on_table(seed, n_table_epochs=9, n_free_epochs=5)


def sweep_angles(t: float, middle: FloatArray) -> FloatArray:
    """Angles of a table that does not stop, rad; t in intervals between epochs."""
    return np.asarray(middle + np.radians([5.0 * np.sin(0.6 * t), 6.0 * np.cos(0.45 * t)]))


def sweep(seed: int, n: int = 14) -> tuple[Survey, Truth]:
    """One camera on a two-axis table that moves smoothly before a board, and images by hand."""
    survey, truth = head_on_table(seed, n_cameras=1, n_table_epochs=n, n_free_epochs=6)
    epochs = [r.epoch_id for r in survey.table_readings]
    middle = np.asarray(truth["table_angles", "turntable", epochs[0]])
    truth = truth | {("table_angles", "turntable", e): sweep_angles(i, middle) for i, e in enumerate(epochs)}
    return resample(survey, truth, seed), truth


def hand_path(t: float) -> Pose3:
    """``world_from_hand`` of a robot that looks down at a board and turns about it."""
    turn = Rotation.from_euler("xyz", [180 + 22 * np.sin(0.9 * t), 24 * np.cos(0.7 * t), 60 * np.sin(0.5 * t)],
                               degrees=True)  # fmt: skip
    aim = turn.apply([0.0, 0.0, 1.0])
    place = np.array([0.6, 0.1, 0.0]) - (0.75 + 0.12 * np.sin(0.8 * t)) * aim
    return Pose3(Rot3(turn.as_matrix()), place)


ROBOT_COV = np.diag(np.repeat([2e-4, 2e-4], 3) ** 2)
HAND_FROM_CAMERA = Pose3(Rot3.RzRyRx(0.02, -0.03, 0.5), np.array([0.05, 0.02, 0.08]))
BOARD_PLACE = Pose3(Rot3.RzRyRx(np.pi + 0.01, 0.02, 0.3), np.array([0.52, 0.12, 0.01]))


def hand(seed: int, n: int = 16, on_hand: bool = True) -> tuple[Survey, Truth]:
    """A robot with a camera on its hand before a board; or the board on its hand before a camera."""
    good, given = stereo(seed)
    home = "hand" if on_hand else "rack"
    camera = replace(good.cameras[0], camera_id="C", station_id=home, station_from_camera=PoseParameter())
    board = good.targets[0]
    target = Target("board", board.point_ids, board.x_in_target, None if on_hand else "hand")
    stations = [Station("hand", "epoch"), Station("rack", world_from_station=PoseParameter(Pose3(), "held"))]
    first, eye = hand_path(0.0), hand_path(0.0) * HAND_FROM_CAMERA
    truth: Truth = {
        ("lens", "C"): given["lens", "left"], ("world_from_station", "rack"): Pose3(),
        ("station_from_camera", "C"): HAND_FROM_CAMERA if on_hand else eye,
        ("carrier_from_target", "board"): BOARD_PLACE if on_hand else first.inverse() * BOARD_PLACE,
    }  # fmt: skip
    blocks, pairs, n_points = [], [], len(board.point_ids)
    for i in range(n):
        epoch, pose = f"p{i + 1:02d}", hand_path(i)
        if not on_hand:  # the camera sees what it would see from the hand
            pose = eye * (pose * HAND_FROM_CAMERA).inverse() * first
        truth["world_from_station", "hand", epoch] = pose
        cov = np.tile(0.1**2 * np.eye(2), (n_points, 1, 1))
        blocks.append(ImageBlock("C", epoch, "board", np.arange(n_points), np.zeros((n_points, 2)), cov))
        ends = FrameRef("world"), FrameRef("station", "hand", epoch)
        pairs.append(Pair(f"robot{i + 1:02d}", *ends, Pose3(), ROBOT_COV))
    survey = Survey(cameras=(camera,), stations=tuple(stations[: 2 - on_hand]), targets=(target,),
                    image_blocks=tuple(blocks), pairs=tuple(pairs))  # fmt: skip
    return resample(survey, truth, seed), truth


def base(seed: int) -> tuple[Survey, Truth]:
    """A camera that sees the board on a robot's hand."""
    return hand(seed, on_hand=False)


def hall(seed: int, plane: bool = False) -> tuple[Survey, Truth]:
    """A network of four set-ups and eight points."""
    survey, truth = polar_network(seed, plane=plane)
    return measured(survey, truth, seed + 100), dict(truth)


def plane(seed: int) -> tuple[Survey, Truth]:
    """A network in a plane."""
    return hall(seed, plane=True)


def poses(seed: int) -> tuple[Survey, Truth]:
    """Ten stations and the poses measured between them; the first is the world."""
    rng = np.random.default_rng(seed)
    n = 10
    place = [Pose3(Rot3.Expmap(rng.normal(0.0, 0.4, 3)), np.array([4.0 * (i // 2), 3.0 * (i % 2), rng.normal()]))
             for i in range(n)]  # fmt: skip
    edges = [(i, j) for i in range(n) for j in range(i + 1, min(i + 4, n))]
    stations = tuple(
        Station(f"T{i}", world_from_station=PoseParameter(place[0], "held") if i == 0 else PoseParameter())
        for i in range(n)
    )
    pairs = tuple(_pair(i, j) for i, j in rng.permutation(edges).tolist())
    truth: Truth = {("world_from_station", f"T{i}"): p for i, p in enumerate(place)}
    return resample(Survey(stations=stations, pairs=pairs), truth, seed), truth


def _pair(i: int, j: int) -> Pair:
    ends = FrameRef("station", f"T{i}"), FrameRef("station", f"T{j}")
    cov = np.diag(np.repeat([3e-4, 1e-3], 3) ** 2)
    return Pair(f"p{i}-{j}", *ends, Pose3(), cov, "north" if max(i, j) > 5 else "south")


KINDS: Mapping[str, Callable[[int], tuple[Survey, Truth]]] = {
    "stereo": stereo,
    "rig": rig,
    "tripods": tripods,
    "held lens": held_lens,
    "head": small_head,
    "sweep": sweep,
    "lab": lambda seed: full_lab(seed, size=SMALL_LAB),
    "beacons": lambda seed: beacons(seed, n_night_epochs=8, n_table_epochs=6, n_free_epochs=4),
    "relay": relay,
    "hand": hand,
    "base": base,
    "hall": hall,
    "plane": plane,
    "poses": poses,
}


def seen(scene: Scene, block: ImageBlock) -> FloatArray:
    """(n, 2) px that a block truly shows."""
    name = block.target_id
    points = scene.world_points() if name is None else scene.target_points(name, block.epoch_id)
    return np.asarray(scene.project(block.camera_id, block.epoch_id, points[block.point_idx]))
