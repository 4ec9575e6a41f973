"""Simulated calibrations and bundles, projected by OpenCV, and the same data as a survey of ours.

A case travels between processes (and between Python installations) as one ``.npz`` file of plain arrays.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.graph.assembly import StartValues
from adjust.model.observations import ImageBlock
from adjust.model.result import ParameterName
from adjust.model.survey import Camera, FloatArray, IntArray, LensParameter, PoseParameter, Station, Survey, Target

SIZE = (1280, 1024)
FREE = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")
TRUE_LENS = np.array([1600.0, 1598.0, 636.0, 515.0, -0.13, 0.12, -4e-4, 2e-4])
_BROWN = [0, 1, 3, 4, 5, 6, 7, 8]  # places of FREE in the model "brown"


@dataclass(frozen=True, eq=False)
class Calibration:
    """Cameras on a head, a board moved from epoch to epoch; every view shows the whole board.

    board: (N, 3) m. uv: (V, N, 2) px of the views. camera, epoch: (V,). sigma_px. shape: (2,) rows and columns.
    lens: (C, 8) in the order of ``FREE``, camera_from_head (C, 4, 4) and head_from_board (F, 4, 4): a rough start.
    """

    board: FloatArray
    uv: FloatArray
    camera: IntArray
    epoch: IntArray
    sigma_px: FloatArray
    shape: IntArray
    lens: FloatArray
    camera_from_head: FloatArray
    head_from_board: FloatArray

    def save(self, path: Path) -> None:
        np.savez(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @staticmethod
    def load(path: Path) -> "Calibration":
        with np.load(path) as data:
            return Calibration(**{f.name: data[f.name] for f in fields(Calibration)})


def matrix(rotvec: FloatArray, t: FloatArray) -> FloatArray:
    """(4, 4) from a rotation vector (rad) and a translation."""
    m = np.eye(4)
    m[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    m[:3, 3] = t
    return m


def pixels(x_in_camera: FloatArray, lens: FloatArray) -> FloatArray:
    """OpenCV's image points (n, 2) of points (n, 3) in the camera frame."""
    k = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    return np.asarray(cv2.projectPoints(x_in_camera, np.zeros(3), np.zeros(3), k, lens[4:])[0][:, 0])


def calibration(
    cameras: int, epochs: int, shape: tuple[int, int] = (10, 10), sigma_px: float = 0.1, seed: int = 1,
    single: bool = False,
) -> Calibration:  # fmt: skip
    """Cameras 80 mm apart, turned a little towards each other. single: image points rounded to float32."""
    rng = np.random.default_rng(seed)
    v, u = (index.ravel() for index in np.mgrid[: shape[0], : shape[1]])
    board = np.column_stack([u, v, np.zeros_like(u)]) * (5 / 256)  # m; exact in float32 too, which OpenCV takes
    lenses = TRUE_LENS + rng.normal(size=(cameras, 8)) * [3, 3, 5, 5, 0.005, 0.01, 1e-4, 1e-4]
    heads = [matrix(rng.normal(size=3) * 0.02 * (c > 0), np.array([-0.08 * (c % 4), -0.08 * (c // 4), 0.0]))
             for c in range(cameras)]  # fmt: skip
    boards = np.empty((epochs, 4, 4))
    uv = np.empty((epochs, cameras, len(board), 2))
    for e in range(epochs):
        uv[e] = np.inf
        while not np.all((uv[e] >= 0) & (uv[e] <= np.array(SIZE) - 1)):
            boards[e] = _placed(rng, board, cameras)
            for c in range(cameras):
                m = heads[c] @ boards[e]
                uv[e, c] = pixels(board @ m[:3, :3].T + m[:3, 3], lenses[c])
    uv += rng.normal(size=uv.shape) * sigma_px
    if single:
        uv = uv.astype(np.float32).astype(np.float64)
        board = board.astype(np.float32).astype(np.float64)
    epoch, camera = (index.ravel() for index in np.mgrid[:epochs, :cameras])
    return Calibration(
        board, uv.reshape(-1, len(board), 2), camera, epoch, np.array(sigma_px), np.array(shape),
        _rough_lenses(lenses), _shaken(rng, np.array(heads)), _shaken(rng, boards),
    )  # fmt: skip


def _placed(rng: np.random.Generator, board: FloatArray, cameras: int) -> FloatArray:
    """A board somewhere in front of the head, tilted up to 35 degrees, turned by any angle."""
    tilt = matrix(np.array([*rng.uniform(-0.6, 0.6, 2), 0.0]), np.zeros(3))
    turn = matrix(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]), np.zeros(3))
    centre = np.eye(4)
    centre[:3, 3] = -board.mean(axis=0)
    depth = rng.uniform(0.5, 0.9) + 0.05 * cameras
    place = np.eye(4)
    middle = np.array([0.04 * (min(cameras, 4) - 1), 0.04 * ((cameras - 1) // 4)])
    place[:3, 3] = [*(rng.uniform(-0.25, 0.25, 2) * depth + middle), depth]
    return np.asarray(place @ tilt @ turn @ centre)


def _rough_lenses(lenses: FloatArray) -> FloatArray:
    """Focal length 2 % off, principal point in the middle of the image, no distortion."""
    rough = np.zeros_like(lenses)
    rough[:, :2] = lenses[:, :2] * 1.02
    rough[:, 2:4] = (np.array(SIZE) - 1) / 2
    return rough


def _shaken(rng: np.random.Generator, poses: FloatArray) -> FloatArray:
    """Poses about 0.5 degrees and 5 mm off; the first of the head's cameras defines the head and stays."""
    out = np.array([p @ matrix(rng.normal(size=3) * 0.01, rng.normal(size=3) * 0.005) for p in poses])
    same = np.all(poses == np.eye(4), axis=(1, 2))
    out[same] = np.eye(4)
    return out


def survey(case: Calibration) -> Survey:
    """The same data as a survey of ours."""
    held = PoseParameter(Pose3(), "held")
    n = len(case.board)
    cameras = tuple(
        Camera(f"c{c}", "head", SIZE, LensParameter("brown", FREE), PoseParameter() if c else held)
        for c in range(len(case.lens))
    )
    target = Target("board", tuple(f"p{i}" for i in range(n)), case.board, motion="epoch")
    cov = np.tile(np.eye(2) * float(case.sigma_px) ** 2, (n, 1, 1))
    blocks = tuple(
        ImageBlock(f"c{c}", f"e{e}", "board", np.arange(n), uv, cov)
        for c, e, uv in zip(case.camera, case.epoch, case.uv, strict=True)
    )
    return Survey(cameras=cameras, stations=(Station("head", "fixed", held),), targets=(target,), image_blocks=blocks)


def rough_start(case: Calibration) -> StartValues:
    """The rough start of the case as our graph takes it."""
    lenses = {}
    for c, values in enumerate(case.lens):
        full = np.zeros(13)
        full[_BROWN] = values
        lenses[f"c{c}"] = full
    poses: dict[ParameterName, Pose3] = {
        ("station_from_camera", f"c{c}"): Pose3(np.linalg.inv(m)) for c, m in enumerate(case.camera_from_head)
    }
    poses |= {("carrier_from_target", "board", f"e{e}"): Pose3(m) for e, m in enumerate(case.head_from_board)}
    return StartValues(lenses, poses, {})


def free_lens(values: FloatArray) -> FloatArray:
    """The components ``FREE`` of a full vector of the model "brown"."""
    return np.asarray(values[_BROWN])
