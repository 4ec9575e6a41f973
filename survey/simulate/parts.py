"""The pieces of the simulated laboratory and where they stand.

Sizes and lenses of the head follow the published three-camera head (image 1280 x 1024, focal length about 1600 px,
lenses and camera positions of its tables 2 and 3, 11 x 8 corners of 20 mm, 8 arcsec per table axis). The room is laid
out in the frame of the table: outer axis x level, inner axis z upright when both angles are zero; the board hangs
obliquely above the table. World is the frame of the board.
"""

from copy import deepcopy
from typing import Literal

import numpy as np
from gtsam import Pose3

from adjust.model.survey import BoolArray, FloatArray, Point, Station, Table
from adjust.spatial.averaging import wrapped
from adjust.spatial.rigid import rigid
from survey.project.targets import Charuco, Checkerboard, MarkerGrid, TargetKind
from survey.simulate.draft import (
    ARCSEC,
    HELD,
    Draft,
    Shot,
    centre,
    hand_pose,
    looking_at,
    outline,
    pixel_in_cell,
    ray,
    rotation_vector,
    table_angles,
)
from survey.simulate.scene import Scene, rotation_about, transform

BOARD = Checkerboard(11, 8, 0.020)
CHARUCO = Charuco(9, 6, 0.030, 0.022, "DICT_5X5_100")
UP = np.array([0.0, 0.0, 1.0])
WALL_X, WALL_Y, CEILING = 2.5, 2.0, 1.8
_BOARD_BORDER = 0.034  # squares around the inner corners, and some white
_MARGIN_PX = 8.0
_TRIALS, _RUN = 4000, 100

_HEAD_LENSES = {
    "X": {"fx": 1599.26, "fy": 1599.93, "u0": 632.62, "v0": 522.18, "k1": -0.1301, "k2": 0.2870, "p1": -4.0e-4,
          "p2": -0.4e-4},
    "Y": {"fx": 1605.35, "fy": 1603.54, "u0": 619.71, "v0": 505.99, "k1": -0.1128, "k2": 0.0178, "p1": -3.1e-4,
          "p2": 5.7e-4},
    "Z": {"fx": 1611.22, "fy": 1610.80, "u0": 649.51, "v0": 531.29, "k1": -0.1048, "k2": 0.1588, "p1": -13.7e-4,
          "p2": 18.4e-4},
}  # fmt: skip
_HEAD_PLACES_MM = {"X": (76.13, -36.84, 78.89), "Y": (-32.50, 75.71, 77.00), "Z": (34.16, 30.83, 119.71)}
_HEAD_AXES = {
    "X": rotation_about("y", np.pi / 2)[:3, :3],
    "Y": rotation_about("x", -np.pi / 2)[:3, :3],
    "Z": np.eye(3),
}


def wide_lens(rng: np.random.Generator, focal_px: float) -> dict[str, float]:
    """A lens off the shelf: some barrel distortion, a principal point some pixels from the middle."""
    fx = focal_px + rng.normal(0.0, 8.0)
    return {
        "fx": fx,
        "fy": fx + rng.normal(0.0, 0.5),
        "u0": 639.5 + rng.normal(0.0, 8.0),
        "v0": 511.5 + rng.normal(0.0, 8.0),
        "k1": -0.20 + rng.normal(0.0, 0.02),
        "k2": 0.10 + rng.normal(0.0, 0.02),
        "p1": rng.normal(0.0, 4e-4),
        "p2": rng.normal(0.0, 4e-4),
    }


def add_head(draft: Draft, n_cameras: int) -> tuple[str, ...]:
    """The head on the table, with cameras X, Y, Z at right angles and, beyond three, more that look anywhere."""
    draft.stations.append(Station("head", "table", table_id="turntable", mount_from_station=HELD))
    draft.truth["mount_from_station", "head"] = Pose3()
    names = ("X", "Y", "Z", *(f"C{number}" for number in range(4, n_cameras + 1)))[:n_cameras]
    for name in names:
        misaligned = rotation_vector(draft.rng.normal(0.0, 0.6, 3))
        if name in _HEAD_AXES:
            axes, place, lens = _HEAD_AXES[name], np.array(_HEAD_PLACES_MM[name]) / 1e3, _HEAD_LENSES[name]
        else:
            direction = draft.rng.normal(0.0, 1.0, 3) + 1e-3
            axes = looking_at(direction, np.cross(direction, draft.rng.normal(0.0, 1.0, 3)))
            place, lens = 0.09 * axes[:, 2], wide_lens(draft.rng, 1600.0)
        draft.add_camera(name, "head", lens, rigid(axes @ misaligned, place))
    return names


def add_table(draft: Draft, non_orthogonality_arcsec: float, axis_offset_mm: float) -> None:
    """The two-axis table below the board (held at identity); the board is seen 0.75 m away, tilted by some 25 deg."""
    draft.add_target("board", BOARD, np.eye(4), held=True)
    towards = _board_in_table()
    tilt = rotation_vector(draft.rng.normal(0.0, 3.0, 3) + (18.0, 16.0, 6.0))
    table_from_world = looking_at(towards, -np.cross([1.0, 0.0, 0.0], towards)) @ tilt
    place = 0.75 * towards - table_from_world @ centre(BOARD)
    geometry = np.array([non_orthogonality_arcsec * ARCSEC, axis_offset_mm / 1e3, 0.0, 0.0])
    draft.tables.append(Table("turntable"))
    draft.truth["world_from_table", "turntable"] = Pose3(np.linalg.inv(rigid(table_from_world, place)))
    draft.truth["table_geometry", "turntable"] = geometry


def _board_in_table() -> FloatArray:
    obliquely = np.radians(40.0)
    return np.array([0.0, -np.sin(obliquely), np.cos(obliquely)])


def shoot_board_from_table(draft: Draft, camera_id: str, n: int) -> None:
    """``n`` epochs of the table with the whole board in one camera, over its whole frame and on both faces."""
    scene, trial = draft.scene(), 0
    places = deepcopy(draft.rng).uniform(0.0, 1.0, (_TRIALS, 2))
    for number in range(n):
        angles, trial = _next_whole(scene, camera_id, number, places, trial)
        draft.shots.append(Shot(camera_id, add_table_epoch(draft, "t", angles), ("board",)))
    draft.rng.uniform(0.0, 1.0, (trial, 2))  # those that were needed


def _next_whole(
    scene: Scene, camera_id: str, number: int, places: FloatArray, trial: int
) -> tuple[FloatArray, int]:
    """Angles (2,) of the first trial from ``trial`` on that shows the whole board, and the trial after it.

    places: (_TRIALS, 2) within the cell aimed at, which is the next one after a hundred in vain.
    """
    while trial < _TRIALS:
        run = trial // _RUN
        pixels = pixel_in_cell(number + run, places[trial : _RUN * (run + 1)])
        angles = _aimed(scene, camera_id, pixels, face=number % 2)
        seen = np.flatnonzero(_shows_board(scene, camera_id, angles))
        if len(seen):
            return angles[seen[0]], trial + int(seen[0]) + 1
        trial = _RUN * (run + 1)
    raise ValueError(f"no room for another image of the board in camera {camera_id}")


def _aimed(scene: Scene, camera_id: str, pixels: FloatArray, face: int) -> FloatArray:
    """Angles (n, 2) that bring the board's middle near pixels (n, 2); NaN where the table cannot.

    The camera stands off the table's centre and moves as it turns, hence the few rounds.
    """
    mount_from_camera = scene.pose("station_from_camera", camera_id)
    table_from_world = np.linalg.inv(scene.pose("world_from_table", "turntable")).astype(np.float64)
    board = transform(table_from_world, centre(BOARD)[None])
    wanted = (mount_from_camera[:3, :3] @ ray(scene.truth, camera_id, pixels)[..., None])[..., 0]
    angles = table_angles(wanted, board, face)
    for _ in range(3):
        place = (scene.table_from_mount("turntable", angles) @ mount_from_camera)[:, :3, 3]
        angles = table_angles(wanted, board - place, face)
    return angles


def _shows_board(scene: Scene, camera_id: str, angles: FloatArray) -> BoolArray:
    """(n,) whether the whole board is in the image with the table at angles (n, 2)."""
    pose = scene.world_from_turned("head", angles) @ scene.pose("station_from_camera", camera_id)
    border = transform(scene.world_from_target("board"), outline(BOARD, _BOARD_BORDER))
    whole = np.ones(len(angles), bool)
    for points in (border[::4], border):  # the corners first: of most trials one is outside
        left = np.flatnonzero(whole)
        x = (points - pose[left, None, :3, 3]) @ pose[left, :3, :3]
        uv = scene.pixels(camera_id, "", x.reshape(-1, 3)).reshape(*x.shape[:2], 2)
        whole[left] = scene.inside(camera_id, uv, _MARGIN_PX).all(axis=1)
    return whole


def add_table_epoch(draft: Draft, letter: str, angles: FloatArray) -> str:
    """One more position of the table, (2,) rad."""
    number = 1 + sum(epoch_id[0] == letter for epoch_id in draft.table_epochs)
    epoch_id = f"{letter}{number:02d}"
    draft.truth["table_angles", "turntable", epoch_id] = angles
    draft.table_epochs.append(epoch_id)
    return epoch_id


def shoot_board_by_hand(draft: Draft, camera_id: str, n: int) -> None:
    """``n`` epochs with the head taken off the table and held before the board."""
    camera = draft.truth["station_from_camera", camera_id]
    camera_from_station = np.linalg.inv(camera.matrix()) if isinstance(camera, Pose3) else np.eye(4)
    for number in range(n):
        shot = Shot(camera_id, f"h{camera_id}{number + 1:02d}", ("board",))
        camera_from_board = _by_hand(draft, shot, number, (0.45, 1.0), _BOARD_BORDER)
        pose = Pose3(np.linalg.inv(camera_from_board) @ camera_from_station)
        draft.truth["world_from_station", "head", shot.epoch_id] = pose


def shoot_target_by_hand(
    draft: Draft, camera_id: str, target_id: str, epochs: list[str], distance_m: tuple[float, float], border_m: float
) -> None:
    """A target held before a camera of a fixed station, once per epoch."""
    world_from_camera = draft.scene().world_from_camera(camera_id)
    for number, epoch_id in enumerate(epochs):
        camera_from_target = _by_hand(draft, Shot(camera_id, epoch_id, (target_id,)), number, distance_m, border_m)
        draft.truth["carrier_from_target", target_id, epoch_id] = Pose3(world_from_camera @ camera_from_target)


def _by_hand(
    draft: Draft, shot: Shot, number: int, distance_m: tuple[float, float], border_m: float
) -> FloatArray:
    """camera_from_target (4, 4) with which the image, which is taken, shows the whole target."""
    (target_id,) = shot.target_ids
    kind, scene = draft.kinds[target_id], draft.scene()
    border = outline(kind, border_m)
    for _ in range(_TRIALS):
        camera_from_target = hand_pose(draft, shot.camera_id, kind, number, distance_m)
        uv = scene.pixels(shot.camera_id, shot.epoch_id, transform(camera_from_target, border))
        if scene.inside(shot.camera_id, uv, _MARGIN_PX).all():
            draft.shots.append(shot)
            return camera_from_target
    raise ValueError(f"no pose of {target_id} is fully in camera {shot.camera_id}")


def world_from_room(draft: Draft) -> FloatArray:
    """(4, 4): the room is laid out in the frame of the table."""
    pose = draft.truth.get(("world_from_table", "turntable"))
    matrix: FloatArray = pose.matrix() if isinstance(pose, Pose3) else np.eye(4)
    return matrix


def wall_grid(number: int) -> MarkerGrid:
    """Twelve markers of 120 mm on a plate; four plates use ids 0 to 47."""
    return MarkerGrid(4, 3, 0.120, 0.040, "DICT_4X4_50", first_id=12 * number)


def wall_centres() -> list[FloatArray]:
    """Middles of the four walls at the height of the table, (3,) m in the room, counter-clockwise from +x."""
    return [np.array(place) for place in ((WALL_X, 0, 0), (0, WALL_Y, 0), (-WALL_X, 0, 0), (0, -WALL_Y, 0))]


def add_wall_grids(draft: Draft, held: tuple[str, ...] = ()) -> None:
    """A plate of markers on each wall, hung by eye."""
    for number, wall in enumerate(wall_centres()):
        kind: TargetKind = wall_grid(number)
        rotation = looking_at(wall, -UP) @ rotation_vector(draft.rng.normal(0.0, 2.0, 3))
        middle = wall + UP * 0.05 + draft.rng.normal(0.0, 0.03, 3)
        room_from_grid = rigid(rotation, middle - rotation @ centre(kind))
        name = f"G{number + 1}"
        draft.add_target(name, kind, world_from_room(draft) @ room_from_grid, held=name in held)


def add_beacons(draft: Draft) -> None:
    """Two light-emitting diodes on each wall, left and right of the plate, and two on the ceiling: B01 to B10."""
    rng = draft.rng
    places = []
    for wall in wall_centres():
        along = np.cross(UP, wall / np.linalg.norm(wall))
        places += [wall + side * rng.uniform(0.42, 0.56) * along + UP * rng.uniform(-0.28, 0.34) for side in (-1, 1)]
    places += [np.array([side * rng.uniform(0.2, 0.35), rng.uniform(-0.2, 0.2), CEILING]) for side in (-1, 1)]
    in_world = np.array(places) @ world_from_room(draft)[:3, :3].T + world_from_room(draft)[:3, 3]
    for number, x in enumerate(in_world, start=1):
        draft.points.append(Point(f"B{number:02d}"))
        draft.truth["point", f"B{number:02d}"] = x


def turn_to_walls(draft: Draft, letter: str, n: int) -> list[str]:
    """``n`` epochs of the table with the level cameras on the walls, one wall after the other, both faces in turn."""
    epochs = []
    for number in range(n):
        level = np.pi * (number // 4 % 2)
        wobble = np.radians(draft.rng.uniform(-5.0, 5.0, 2))
        angles = np.array([level, number % 4 * np.pi / 2]) + wobble
        epochs.append(add_table_epoch(draft, letter, wrapped(angles)))
    return epochs


def add_relay(draft: Draft, motion: Literal["fixed", "epoch"], place: tuple[float, float, float]) -> FloatArray:
    """A relay station of four cameras, one for each wall; its frame is that of camera R1.

    Returns room_from_station (4, 4) as the station stands when it is set up at ``place``.
    """
    rng = draft.rng
    offsets = [0.06 * wall / np.linalg.norm(wall) for wall in wall_centres()]
    room_from_camera = []
    for wall, offset in zip(wall_centres(), offsets, strict=True):
        at = np.array(place) + offset
        attitude = looking_at(wall - at, -UP) @ rotation_vector(rng.normal(0.0, 1.0, 3))
        room_from_camera.append(rigid(attitude, at))
    station_from_room = np.linalg.inv(room_from_camera[0])
    draft.stations.append(Station("relay", motion))
    if motion == "fixed":
        draft.truth["world_from_station", "relay"] = Pose3(world_from_room(draft) @ room_from_camera[0])
    for number, pose in enumerate(room_from_camera):
        lens = wide_lens(rng, 1200.0)
        draft.add_camera(f"R{number + 1}", "relay", lens, station_from_room @ pose, held=number == 0)
    return room_from_camera[0]
