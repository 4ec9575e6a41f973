"""Ready simulated surveys, each with its truth: ``(survey, truth) = stereo(seed)``."""

from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.model.frozen import frozen
from adjust.model.observations import Coordinates, Distance, PositionRef
from adjust.model.survey import Station, Survey
from survey.project.targets import Checkerboard, MarkerGrid
from survey.simulate import parts as parts
from survey.simulate.draft import ARCSEC, HELD, Draft, Shot, image_blocks, outline, rotation_vector, table_readings
from survey.simulate.noise import resample
from survey.simulate.scene import Truth, rotation_about, shift_along

CORNER_SIGMA_PX = 0.115
TABLE_SIGMA_ARCSEC = 8.0
BEACON_SIGMA_MM = 0.4
DISTANCE_SIGMA_MM = 0.3
WITHOUT_COORDINATES = ("B04", "B10")
MEASURED_DISTANCES = (("B01", "B02"), ("B03", "B04"), ("B05", "B06"), ("B07", "B08"), ("B09", "B10"))
SMALL_BOARD = Checkerboard(9, 6, 0.025)


@frozen
class LabSize:
    """How much is measured in the whole laboratory; numbers of epochs are per camera where cameras are named."""

    n_table_epochs: int = 11
    n_free_epochs: int = 8
    n_wall_epochs: int = 4
    n_night_epochs: int = 8
    n_charuco_epochs: int = 7


def observed(draft: Draft, seed: int, sigma_px: float, table_sigma_arcsec: float = TABLE_SIGMA_ARCSEC) -> Survey:
    """The draft with noisy images and table readings."""
    scene = draft.scene()
    readings = table_readings(draft, "turntable", table_sigma_arcsec * ARCSEC) if draft.tables else []
    ideal = replace(
        scene.survey,
        image_blocks=tuple(image_blocks(scene, draft.shots, sigma_px)),
        table_readings=tuple(readings),
        coordinates=_surveyed(draft),
        distances=_taped(draft),
    )
    return resample(ideal, draft.truth, seed)


def _surveyed(draft: Draft) -> tuple[Coordinates, ...]:
    names = [p.point_id for p in draft.points if p.point_id not in WITHOUT_COORDINATES]
    cov = (BEACON_SIGMA_MM / 1e3) ** 2 * np.eye(3)
    return tuple(Coordinates((PositionRef(name),), np.zeros((1, 3)), cov) for name in names)


def _taped(draft: Draft) -> tuple[Distance, ...]:
    if not draft.points:
        return ()
    return tuple(
        Distance(f"{a}-{b}", PositionRef(a), PositionRef(b), 0.0, DISTANCE_SIGMA_MM / 1e3)
        for a, b in MEASURED_DISTANCES
    )


def single_camera_draft(seed: int, n_images: int) -> Draft:
    """One camera on a tripod and a checkerboard held by hand; world, station and camera frames are one."""
    draft = Draft(np.random.default_rng(seed))
    draft.stations.append(Station("tripod", world_from_station=HELD))
    draft.truth["world_from_station", "tripod"] = Pose3()
    draft.add_camera("C1", "tripod", parts.wide_lens(draft.rng, 1400.0), np.eye(4), held=True)
    draft.add_target("board", SMALL_BOARD, None)
    epochs = [f"e{number + 1:02d}" for number in range(n_images)]
    parts.shoot_target_by_hand(draft, "C1", "board", epochs, (0.45, 0.95), 0.04)
    return draft


def single_camera(seed: int, *, n_images: int = 12, sigma_px: float = 0.1) -> tuple[Survey, Truth]:
    """One camera and ``n_images`` of a hand-held board."""
    draft = single_camera_draft(seed, n_images)
    return observed(draft, seed, sigma_px), draft.truth


def stereo_draft(seed: int, n_pairs: int) -> Draft:
    """Two cameras on a bar, slightly converging, and a board held by hand that both see whole."""
    draft = Draft(np.random.default_rng(seed))
    draft.stations.append(Station("bar", world_from_station=HELD))
    draft.truth["world_from_station", "bar"] = Pose3()
    draft.add_camera("left", "bar", parts.wide_lens(draft.rng, 1400.0), np.eye(4), held=True)
    turned = rotation_about("y", np.radians(-12.0))
    turned[:3, :3] = turned[:3, :3] @ rotation_vector(draft.rng.normal(0.0, 0.7, 3))
    draft.add_camera("right", "bar", parts.wide_lens(draft.rng, 1400.0), shift_along("x", 0.2) @ turned)
    draft.add_target("board", SMALL_BOARD, None)
    number = 0
    while sum(shot.camera_id == "right" for shot in draft.shots) < n_pairs:
        epoch_id = f"e{len(draft.shots) // 2 + 1:02d}"
        parts.shoot_target_by_hand(draft, "left", "board", [epoch_id], (0.55, 1.0), 0.04)
        shot = Shot("right", epoch_id, ("board",))
        number += 1
        if draft.outline_visible(shot, "board", outline(SMALL_BOARD, 0.04), 8.0):
            draft.shots.append(shot)
        else:
            draft.shots.pop()
        if number > 100 * n_pairs:
            raise ValueError("the two cameras hardly see the same")
    return draft


def stereo(seed: int, *, n_pairs: int = 12, sigma_px: float = 0.1) -> tuple[Survey, Truth]:
    """Two cameras and ``n_pairs`` epochs of a hand-held board; the left camera is the frame."""
    draft = stereo_draft(seed, n_pairs)
    return observed(draft, seed, sigma_px), draft.truth


def _head_draft(
    seed: int, n_cameras: int, n_table_epochs: int, n_free_epochs: int, skewness_arcsec: float, offset_mm: float
) -> Draft:
    draft = Draft(np.random.default_rng(seed))
    names = parts.add_head(draft, n_cameras)
    parts.add_table(draft, skewness_arcsec, offset_mm)
    for name in names:
        parts.shoot_board_from_table(draft, name, n_table_epochs)
    for name in names:
        parts.shoot_board_by_hand(draft, name, n_free_epochs)
    return draft


def head_on_table(
    seed: int,
    *,
    n_cameras: int = 3,
    n_table_epochs: int = 11,
    n_free_epochs: int = 10,
    sigma_px: float = CORNER_SIGMA_PX,
    non_orthogonality_arcsec: float = 60.0,
    axis_offset_mm: float = 0.35,
) -> tuple[Survey, Truth]:
    """The head on the two-axis table before the fixed board (world), with table and by-hand epochs for each camera."""
    draft = _head_draft(seed, n_cameras, n_table_epochs, n_free_epochs, non_orthogonality_arcsec, axis_offset_mm)
    return observed(draft, seed, sigma_px), draft.truth


def beacons(
    seed: int,
    *,
    n_night_epochs: int = 8,
    n_table_epochs: int = 11,
    n_free_epochs: int = 10,
    sigma_px: float = CORNER_SIGMA_PX,
) -> tuple[Survey, Truth]:
    """``head_on_table`` and ten beacons on walls and ceiling, most with surveyed coordinates, and five distances."""
    draft = _head_draft(seed, 3, n_table_epochs, n_free_epochs, 60.0, 0.35)
    parts.add_beacons(draft)
    _shoot_night(draft, n_night_epochs, ("X", "Y", "Z"))
    return observed(draft, seed, sigma_px), draft.truth


def _shoot_night(draft: Draft, n_epochs: int, camera_ids: tuple[str, ...]) -> None:
    """Beacons alone; images without any are not kept."""
    scene = draft.scene()
    for epoch_id in parts.turn_to_walls(draft, "n", n_epochs):
        for camera_id in camera_ids:
            uv = scene.project(camera_id, epoch_id, scene.world_points())
            if scene.inside(camera_id, uv, 12.0).any():
                draft.shots.append(Shot(camera_id, epoch_id, beacons=True))


def relay(seed: int, *, n_epochs: int = 12, sigma_px: float = CORNER_SIGMA_PX) -> tuple[Survey, Truth]:
    """A relay station of four cameras, turned from wall to wall before four plates of markers; plate G1 is held."""
    draft = Draft(np.random.default_rng(seed))
    parts.add_wall_grids(draft, held=("G1",))
    room_from_station = parts.add_relay(draft, "epoch", (0.0, 0.0, 0.0))
    for number in range(n_epochs):
        epoch_id = f"e{number + 1:02d}"
        turned = rotation_about("z", number % 4 * np.pi / 2)
        turned[:3, :3] = turned[:3, :3] @ rotation_vector(draft.rng.uniform(-9.0, 9.0, 3))
        turned[:3, 3] = draft.rng.uniform(-0.6, 0.6, 3) * (1.0, 1.0, 0.3)
        draft.truth["world_from_station", "relay", epoch_id] = Pose3(turned @ room_from_station)
        for camera in draft.cameras:
            _shoot_grids(draft, camera.camera_id, epoch_id)
    return observed(draft, seed, sigma_px), draft.truth


def _shoot_grids(draft: Draft, camera_id: str, epoch_id: str) -> None:
    """An image of the plates that are wholly in view; none where there is none."""
    shot = Shot(camera_id, epoch_id)
    names = [name for name, kind in draft.kinds.items() if isinstance(kind, MarkerGrid)]
    seen = tuple(n for n in names if draft.outline_visible(shot, n, outline(draft.kinds[n], 0.03), 8.0))
    if seen:
        draft.shots.append(replace(shot, target_ids=seen))


def full_lab_draft(seed: int, size: LabSize = LabSize()) -> Draft:
    """Everything together: head on the table, board, plates on the walls, beacons, and a relay station of four cameras.

    By day the head and the relay cameras see the plates (``w..``, ``r01``), by night the beacons (``n..``, ``q01``);
    each relay camera also sees a ChArUco board held by hand.
    """
    draft = _head_draft(seed, 3, size.n_table_epochs, size.n_free_epochs, 60.0, 0.35)
    parts.add_wall_grids(draft)
    parts.add_beacons(draft)
    parts.add_relay(draft, "fixed", (0.7, -0.5, 0.15))
    relay_cameras = tuple(c.camera_id for c in draft.cameras if c.station_id == "relay")
    for epoch_id in parts.turn_to_walls(draft, "w", size.n_wall_epochs):
        for camera_id in ("X", "Y"):
            _shoot_grids(draft, camera_id, epoch_id)
    _shoot_night(draft, size.n_night_epochs, ("X", "Y", "Z"))
    draft.add_target("charuco", parts.CHARUCO, None)
    for camera_id in relay_cameras:
        _shoot_grids(draft, camera_id, "r01")
        draft.shots.append(Shot(camera_id, "q01", beacons=True))
        epochs = [f"c{camera_id}{number + 1:02d}" for number in range(size.n_charuco_epochs)]
        parts.shoot_target_by_hand(draft, camera_id, "charuco", epochs, (0.45, 1.0), 0.034)
    return draft


def full_lab(seed: int, *, size: LabSize = LabSize(), sigma_px: float = CORNER_SIGMA_PX) -> tuple[Survey, Truth]:
    """The whole laboratory of the example, as observations without images."""
    draft = full_lab_draft(seed, size)
    return observed(draft, seed, sigma_px), draft.truth
