"""The examples of image points without images: a head calibrated as published, and a relay station of four cameras."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.observations import ImageBlock, TableReading
from adjust.model.survey import (
    TABLE_GEOMETRY,
    Camera,
    FloatArray,
    LensParameter,
    PoseParameter,
    Station,
    Survey,
    Table,
    Target,
    VectorParameter,
)
from survey.examples.folders import truth_json
from survey.project import write_project
from survey.simulate.draft import ARCSEC, FREE_LENS, HELD, IMAGE_SIZE
from survey.simulate.scene import BROWN, Scene, Truth

_TRIES = 20_000


def head_files(seed: int) -> dict[str, str]:
    """Three cameras on a two-axis table before one board, after the published geometry: 11 images each, 10 by hand.

    Camera Z looks along the inner axis; its images are about one axis at a time, as the published steps need them.
    """
    sigma_px, rng = 0.115, np.random.default_rng(seed)
    table = Pose3(Rot3.Ypr(0.0015, 0.0022, -0.0002), np.array([0.034, -0.129, -0.685]))
    mount = Pose3(Rot3(), np.array([0.0, 0.0, 0.108]))  # held: what the frame of the head is, no image tells
    looks = {"X": Rot3.Ry(np.pi / 2), "Y": Rot3.Rx(-np.pi / 2), "Z": Rot3()}
    places = {"X": (0.076, -0.037, 0.079), "Y": (-0.033, 0.076, 0.077), "Z": (0.034, 0.031, 0.120)}
    truth: Truth = {
        ("world_from_table", "turntable"): table, ("table_geometry", "turntable"): np.zeros(4),
        ("mount_from_station", "head"): mount,
        ("carrier_from_target", "board"): Pose3(),
    }  # fmt: skip
    for k, look in looks.items():
        wobble = Rot3.Expmap(rng.normal(0.0, 0.008, 3))
        truth["station_from_camera", k] = Pose3(look * wobble, np.array(places[k]))
        truth["lens", k] = _lens(rng, 1600.0)
    corners = np.stack(np.meshgrid(0.02 * np.arange(11), -0.02 * np.arange(8)), axis=-1).reshape(-1, 2)
    board = Target("board", tuple(f"c{i}" for i in range(88)), np.column_stack([corners, np.zeros(88)]),
                   carrier_from_target=HELD)  # fmt: skip
    survey = Survey(
        cameras=tuple(Camera(k, "head", IMAGE_SIZE, LensParameter("brown", FREE_LENS)) for k in looks),
        stations=(Station("head", "table", table_id="turntable", mount_from_station=PoseParameter(mount, "held")),),
        tables=(Table("turntable", geometry=VectorParameter(TABLE_GEOMETRY, np.zeros(4))),),
        targets=(board,),
    )
    photographer = _Photographer(survey, truth, sigma_px, rng)
    draws: dict[str, Callable[[int], FloatArray]] = {
        "X": lambda i: (1, -1)[i % 2] * rng.uniform((50, 50), (130, 130)),
        "Y": lambda _: rng.uniform((50, -40), (130, 40)),
        "Z": lambda i: np.array([0.0, rng.uniform(-95, 40)] if i < 6 else [rng.uniform(-8.5, 3.5), 0.0]),
    }
    for k in looks:
        for i in range(11):
            photographer.on_table(k, f"t{k}{i + 1:02d}", lambda i=i, k=k: draws[k](i))  # type: ignore[misc]  # defaults bind
        for i in range(10):
            photographer.by_hand(k, f"h{k}{i + 1:02d}")
    return _files(photographer.survey(), truth, seed, "Three-camera head on a two-axis table")


def station_files(seed: int) -> dict[str, str]:
    """Four cameras on one relay station, each before a plate of its own, turned and moved by hand to twelve places."""
    rng, names = np.random.default_rng(seed), ("front", "left", "back", "right")
    grid = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 6), np.linspace(-0.28, 0.28, 5)), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, 0.1 * rng.random(len(grid))])
    truth: Truth = {}
    cameras, targets = [], []
    looking = Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    for i, name in enumerate(names):
        turned = Rot3.Rz(i * np.pi / 2)
        own = truth["lens", name] = _lens(rng, 1500.0)
        wobble = Rot3.Expmap(rng.normal(0.0, 0.05, 3))
        place = turned.rotate(np.array([0.15, 0.02, 0.01]))
        truth["station_from_camera", name] = Pose3(turned * looking * wobble, place)
        plate = Pose3(turned * looking, turned.rotate(np.array([2.0, 0.1, 0.0])))
        truth["carrier_from_target", f"plate_{name}"] = plate
        lens = LensParameter("brown", (), own)
        cameras.append(Camera(name, "relay", IMAGE_SIZE, lens, PoseParameter() if i else _held(truth, name)))
        ids = tuple(f"p{j}" for j in range(len(points)))
        targets.append(Target(f"plate_{name}", ids, points, carrier_from_target=PoseParameter(
            plate if not i else None, "held" if not i else "free")))  # fmt: skip
    survey = Survey(cameras=tuple(cameras), stations=(Station("relay", "epoch"),), targets=tuple(targets))
    photographer = _Photographer(survey, truth, 0.05, rng)
    for j in range(12):
        epoch = f"e{j + 1:02d}"
        truth["world_from_station", "relay", epoch] = Pose3(
            Rot3.Expmap(rng.uniform(-0.2, 0.2, 3)), rng.uniform(-0.15, 0.15, 3)
        )
        for name in names:
            photographer.image(name, epoch, f"plate_{name}", least=20)
    return _files(photographer.survey(), truth, seed, "Relay station of four cameras")


def truth_pose(truth: Truth, name: tuple[str, ...]) -> Pose3:
    """A true pose."""
    value = truth[name]
    if not isinstance(value, Pose3):
        raise TypeError(f"the truth of {name} is not a pose")
    return value


def _held(truth: Truth, camera_id: str) -> PoseParameter:
    return PoseParameter(truth_pose(truth, ("station_from_camera", camera_id)), "held")


def _lens(rng: np.random.Generator, focal: float) -> FloatArray:
    value = {"fx": focal, "fy": focal, "u0": 640.0, "v0": 512.0, "k1": -0.12, "k2": 0.15, "p1": -2e-4, "p2": 2e-4}
    value |= {k: x + s * rng.standard_normal() for k, x, s in (("fx", focal, 4.0), ("u0", 640.0, 8.0))}
    return np.array([value.get(name, 0.0) for name in BROWN])


class _Photographer:
    """Takes noisy images of whole targets, or of most of them."""

    def __init__(self, survey: Survey, truth: Truth, sigma_px: float, rng: np.random.Generator) -> None:
        self._given, self._truth, self._sigma, self._rng = survey, truth, sigma_px, rng
        self._scene = Scene(survey, truth)
        self._blocks: list[ImageBlock] = []
        self._readings: list[TableReading] = []

    def image(self, camera_id: str, epoch_id: str, target_id: str, least: int) -> bool:
        """Whether at least so many of its points are in the picture; then it is kept."""
        uv = self._scene.project(camera_id, epoch_id, self._scene.target_points(target_id, epoch_id))
        seen = np.flatnonzero(self._scene.inside(camera_id, uv, 8.0))
        if len(seen) < least:
            return False
        cov = np.tile(self._sigma**2 * np.eye(2), (len(seen), 1, 1))
        noisy = uv[seen] + self._sigma * self._rng.standard_normal((len(seen), 2))
        self._blocks.append(ImageBlock(camera_id, epoch_id, target_id, seen, noisy, cov))
        return True

    def on_table(self, camera_id: str, epoch_id: str, draw: Callable[[], FloatArray]) -> None:
        """At angles (deg) from which the whole board is seen, with readings good to 8 arcsec."""
        name = ("table_angles", "turntable", epoch_id)
        for _ in range(_TRIES):
            angles = np.radians(draw())
            self._truth[name] = angles
            if self.image(camera_id, epoch_id, "board", 88):
                read = angles + 8.0 * ARCSEC * self._rng.standard_normal(2)
                self._readings.append(TableReading("turntable", epoch_id, read, (8.0 * ARCSEC) ** 2 * np.eye(2)))
                return
        raise ValueError(f"camera {camera_id} does not see the board from the table")

    def by_hand(self, camera_id: str, epoch_id: str) -> None:
        """Somewhere before the board."""
        name = ("world_from_station", "head", epoch_id)
        camera = truth_pose(self._truth, ("station_from_camera", camera_id))
        for _ in range(_TRIES):
            tilt = Rot3.Expmap(np.radians(self._rng.uniform(-35, 35, 3)))
            place = self._rng.uniform((-0.05, -0.25, -0.65), (0.25, 0.10, -0.35))
            self._truth[name] = Pose3(tilt, place).compose(camera.inverse())
            if self.image(camera_id, epoch_id, "board", 88):
                return
        raise ValueError(f"camera {camera_id} does not see the board by hand")

    def survey(self) -> Survey:
        """With all that was taken."""
        return replace(self._given, image_blocks=tuple(self._blocks), table_readings=tuple(self._readings))


def _files(survey: Survey, truth: Truth, seed: int, title: str) -> dict[str, str]:
    with tempfile.TemporaryDirectory() as place:
        write_project(Path(place), survey, title=title)
        found = {str(p.relative_to(place)): p.read_text(encoding="utf-8")
                 for p in sorted(Path(place).rglob("*")) if p.is_file()}  # fmt: skip
    return found | {"truth.json": truth_json(truth, seed)}
