"""Conventions of the photogrammetrist's programs: a camera that looks along -z, with y up."""

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.observations import ImageBlock
from adjust.model.survey import Camera, FloatArray, LensParameter, Point, PoseParameter, Station, Survey

_LOOKING_BACK = np.diag([1.0, -1.0, -1.0])


def world_from_camera(angles: FloatArray, centre: FloatArray) -> Pose3:
    """Pose from omega phi kappa (3,) rad and the projection centre (3,) m: R = Rx(omega) Ry(phi) Rz(kappa).

    Formula: Kraus, Photogrammetry, vol. 1, for a camera looking along -z; ours looks along +z with y down.
    """
    R = Rot3.Rx(angles[0]).matrix() @ Rot3.Ry(angles[1]).matrix() @ Rot3.Rz(angles[2]).matrix()
    return Pose3(Rot3(R @ _LOOKING_BACK), centre)


def moving_camera(
    camera_id: str, image_size: tuple[int, int], lens: LensParameter, start: dict[str, PoseParameter] | None = None
) -> tuple[Camera, Station]:
    """A camera alone on a station that has one pose per epoch."""
    station = Station(f"{camera_id}_body", motion="epoch", epochs=start or {})
    return Camera(camera_id, station.station_id, image_size, lens, PoseParameter(Pose3(), "held")), station


def image_blocks(rows: dict[tuple[str, str], list[tuple[str, float, float, float]]], points: list[Point]) -> Survey:
    """Points and blocks as a survey: by (camera, epoch) rows of point, u, v and sigma (px)."""
    place = {p.point_id: k for k, p in enumerate(points)}
    blocks = []
    for (camera_id, epoch_id), seen in rows.items():
        numbers = np.array([row[1:] for row in seen], dtype=float).reshape(-1, 3)
        idx = np.array([place[row[0]] for row in seen], dtype=np.int64)
        cov = np.eye(2) * numbers[:, 2, None, None] ** 2
        blocks.append(ImageBlock(camera_id, epoch_id, None, idx, numbers[:, :2].copy(), cov))
    return Survey(points=tuple(points), image_blocks=tuple(blocks))
