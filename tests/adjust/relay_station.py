"""A simulated relay station whose eyes share nothing: four cameras, each before its own plate; projected by OpenCV."""

import cv2
import numpy as np
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.survey import Camera, FloatArray, LensParameter, PoseParameter, Station, Survey, Target
from adjust.relay.eyes.sequences import EyeSequence
from adjust.spatial.rigid_motions import Motions
from survey.simulate.scene import BROWN

EYES = ("a", "b", "c", "d")
LENS = np.array([1500.0, 1500.0, 0.0, 640.0, 512.0, -0.1, 0.05, 1e-4, -1e-4, 0.0, 0.0, 0.0, 0.0])
SIZE = (1280, 1024)
HELD = PoseParameter(Pose3(), "held")


def rigid(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """(4, 4)."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out


def motions(matrices: FloatArray) -> Motions:
    """From (n, 4, 4)."""
    return Motions(matrices[:, :3, :3].copy(), matrices[:, :3, 3].copy())


def poses(found: Motions) -> list[Pose3]:
    """As GTSAM's type, one by one."""
    assert found.translation is not None
    return [Pose3(rigid(r, t)) for r, t in zip(found.rotation, found.translation, strict=True)]


def random_rigid(rng: np.random.Generator, n: int, turn: float, shift: float) -> FloatArray:
    """(n, 4, 4), rotation vectors and shifts uniform in a cube."""
    rotation = Rotation.from_rotvec(rng.uniform(-turn, turn, (n, 3))).as_matrix()
    return np.array([rigid(r, t) for r, t in zip(rotation, rng.uniform(-shift, shift, (n, 3)), strict=True)])


class Station4:
    """Truth: the cameras look to the four sides, the plates stand two metres away; the station is turned by hand."""

    def __init__(self, seed: int, n_epochs: int = 10, turn_rad: float = 0.18) -> None:
        rng = np.random.default_rng(seed)
        self.station_from_eye, self.room_from_target = [], []
        for i in range(len(EYES)):
            turned = Rotation.from_euler("z", 90.0 * i, degrees=True).as_matrix()
            looking = turned @ np.array([[0, 0, 1.0], [-1.0, 0, 0], [0, -1.0, 0]])  # z of the camera along the side
            wobble = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()
            self.station_from_eye.append(rigid(looking @ wobble, turned @ [0.15, 0.02, 0.01]))
            self.room_from_target.append(rigid(looking @ wobble.T, turned @ [2.0, 0.1, 0.0]))
        self.room_from_station = random_rigid(rng, n_epochs, turn_rad, 0.15)
        grid = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 6), np.linspace(-0.28, 0.28, 5)), axis=-1).reshape(-1, 2)
        self.x_in_target = np.column_stack([grid, 0.1 * rng.random(len(grid))])

    def survey(self, seed: int, sigma_px: float, free_lens: tuple[str, ...] = ()) -> Survey:
        """Noisy images of every camera at every epoch; camera a and plate Ta are the datum."""
        rng = np.random.default_rng(seed)
        epochs = tuple(f"e{i}" for i in range(len(self.room_from_station)))
        names = tuple(f"p{i}" for i in range(len(self.x_in_target)))
        blocks, cov = [], np.broadcast_to(np.eye(2) * sigma_px**2, (len(names), 2, 2))
        for i, eye in enumerate(EYES):
            for epoch, station in zip(epochs, self.room_from_station, strict=True):
                seen = np.linalg.inv(station @ self.station_from_eye[i]) @ self.room_from_target[i]
                K = np.array([[LENS[0], 0, LENS[3]], [0, LENS[1], LENS[4]], [0, 0, 1.0]])
                uv = cv2.projectPoints(self.x_in_target, cv2.Rodrigues(seen[:3, :3])[0], seen[:3, 3], K, LENS[5:13])[0]
                uv = uv.reshape(-1, 2)
                inside = ((uv > 0) & (uv < np.array(SIZE))).all(axis=1)
                noise = rng.normal(0, sigma_px, uv.shape)
                blocks.append(
                    ImageBlock(eye, epoch, f"T{eye}", np.flatnonzero(inside), (uv + noise)[inside], cov[inside])
                )
        lens = LensParameter("brown", free_lens, LENS)
        assert len(LENS) == len(BROWN)
        first = PoseParameter(Pose3(self.station_from_eye[0]), "held")
        plate = PoseParameter(Pose3(self.room_from_target[0]), "held")
        free = PoseParameter()
        return Survey(
            cameras=tuple(Camera(e, "relay", SIZE, lens, first if e == "a" else free) for e in EYES),
            stations=(Station("relay", "epoch"),),
            targets=tuple(
                Target(f"T{e}", names, self.x_in_target, carrier_from_target=plate if e == "a" else free) for e in EYES
            ),
            image_blocks=tuple(blocks),
        )

    def pair(self, a: str, b: str) -> Pose3:
        """True ``b_from_a``."""
        X = self.station_from_eye
        return Pose3(np.linalg.inv(X[EYES.index(b)]) @ X[EYES.index(a)])


class Trackers:
    """Truth of k eyes on one station, each counting in a world of its own."""

    def __init__(self, seed: int, k: int = 3, n: int = 12, turn_rad: float = 0.6) -> None:
        self.rng = np.random.default_rng(seed)
        self.station_from_eye = np.concatenate([np.eye(4)[None], random_rigid(self.rng, k - 1, 2.0, 0.3)])
        self.room_from_world = np.concatenate([np.eye(4)[None], random_rigid(self.rng, k - 1, 2.0, 3.0)])
        self.room_from_station = random_rigid(self.rng, n, turn_rad, 0.5)

    def poses(self, eye: int) -> FloatArray:
        """True ``world_from_eye`` (n, 4, 4)."""
        return np.asarray(
            np.linalg.inv(self.room_from_world[eye]) @ self.room_from_station @ self.station_from_eye[eye]
        )

    def measured(self, sigma_rad: float = 1e-4, sigma_m: float = 1e-3) -> list[EyeSequence]:
        """Poses with noise of full, different covariances."""
        return [self.sequence(eye, sigma_rad, sigma_m) for eye in range(len(self.station_from_eye))]

    def sequence(self, eye: int, sigma_rad: float, sigma_m: float) -> EyeSequence:
        """Poses of one eye."""
        poses = self.poses(eye)
        sigma = np.repeat([sigma_rad, sigma_m], 3)
        mix = self.rng.normal(size=(len(poses), 6, 6))
        cov = sigma[:, None] * (np.eye(6) + 0.1 * mix @ np.swapaxes(mix, 1, 2)) * sigma
        e = [np.linalg.cholesky(c) @ self.rng.normal(size=6) for c in cov]
        noisy = np.array([p @ Pose3.Expmap(d).matrix() for p, d in zip(poses, e, strict=True)])
        ids = tuple(f"e{i}" for i in range(len(poses)))
        name = "abcdef"[eye]
        return EyeSequence(FrameRef("camera", name), ids, motions(noisy), cov, (f"w{name}",) * len(ids))


def turn_between(a: Pose3, b: Pose3) -> float:
    """Angle in rad."""
    return float(np.linalg.norm(Rot3.Logmap(a.rotation().between(b.rotation()))))
