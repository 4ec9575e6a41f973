"""Targets in images: ours beside OpenCV's finders, in time and in distance from where the points are."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.survey import BoolArray, FloatArray, IntArray
from survey.detection import detect_image
from survey.project.dictionaries import charuco_board
from survey.project.targets import Charuco, Checkerboard
from survey.simulate.rendering import BrownCamera, Imaging, PlacedTarget, render
from tests.benchmarks.cases import Arrays
from tests.benchmarks.outcome import Competitor, Outcome

SIZES = ((640, 480), (1280, 1024), (2592, 1944), (4096, 3000))
VIEWS = ((0.3, 0.25, 0.2), (-0.5, 0.4, -0.4))
BOARD, CHARUCO = Checkerboard(9, 6, 0.02), Charuco(9, 6, 0.02, 0.015, "4X4_50")


@dataclass(frozen=True, eq=False)
class Pictures(Arrays):
    """images (k, h, w) of 8 bit; truth (k, n, 2) px of the target's points, empty where it is not known; charuco."""

    images: IntArray
    truth: FloatArray
    charuco: BoolArray

    @property
    def target(self) -> Checkerboard | Charuco:
        """What is to be found."""
        return CHARUCO if self.charuco else BOARD

    def first(self) -> "Pictures":
        """The first image alone."""
        return Pictures(self.images[:1], self.truth[:1], self.charuco)


def photographs(folder: Path) -> Pictures:
    """OpenCV's 26 sample images of a board of 9 x 6 corners."""
    names = sorted(folder.glob("*[0-9][0-9].jpg"))
    images = np.array([cv2.imread(str(name), cv2.IMREAD_GRAYSCALE) for name in names])
    return Pictures(images, np.zeros((len(names), 0, 2)), np.array(False))


def rendered(width: int, height: int, charuco: bool) -> Pictures:
    """Two views, lens blur 0.7 px, noise of 2 grey values."""
    target = CHARUCO if charuco else BOARD
    focal = 1.25 * width
    camera = BrownCamera((width, height), focal, focal, (width - 1) / 2, (height - 1) / 2, (-0.2, 0.05, 1e-3, -5e-4))
    images, truth = [], []
    for seed, (a, b, c) in enumerate(VIEWS):
        x, R = target.points()[1], Rot3.Rx(a) * Rot3.Ry(b) * Rot3.Rz(c)
        pose = Pose3(R, np.array([0.005, -0.003, 0.35]) - R.matrix() @ x.mean(0))
        images.append(render(camera, [PlacedTarget(target, pose)], imaging=Imaging(0.7, 2.0), seed=seed))
        K = np.array([[focal, 0, camera.cx], [0, focal, camera.cy], [0, 0, 1]])
        turn = cv2.Rodrigues(R.matrix())[0]
        truth.append(cv2.projectPoints(x, turn, pose.translation(), K, np.array(camera.distortion))[0].reshape(-1, 2))
    return Pictures(np.array(images), np.array(truth), np.array(charuco))


Finder = Callable[[np.ndarray], FloatArray]


def _ours(case: Pictures) -> Finder:
    return lambda image: detect_image(image, case.target).uv


def _classic(case: Pictures) -> Finder:
    size = BOARD.columns, BOARD.rows
    half = (11, 11) if case.images.shape[1] > 1000 else (5, 5)
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-3)

    def find(image):
        ok, corners = cv2.findChessboardCorners(image, size)
        if not ok:
            return np.zeros((0, 2))
        return cv2.cornerSubPix(image, corners, half, (-1, -1), until).reshape(-1, 2)

    return find


def _sector(case: Pictures) -> Finder:
    size = BOARD.columns, BOARD.rows

    def find(image):
        ok, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
        return corners.reshape(-1, 2) if ok else np.zeros((0, 2))

    return find


def _charuco(case: Pictures) -> Finder:
    detector = cv2.aruco.CharucoDetector(charuco_board(CHARUCO))

    def find(image):
        corners = detector.detectBoard(image)[0]
        return np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2)

    return find


def _over_images(finder: Callable[[Pictures], Finder], threads: int) -> Callable[[Pictures], Competitor]:
    def make(case: Pictures) -> Competitor:
        find = finder(case)

        def run() -> Outcome:
            t0 = perf_counter()
            if threads > 1:
                with ThreadPoolExecutor(threads) as pool:
                    found = list(pool.map(find, case.images))
            else:
                found = [find(image) for image in case.images]
            seconds = perf_counter() - t0
            numbers = {"found": float(sum(len(f) > 0 for f in found)), "rms_px": _rms(found, case.truth)}
            return Outcome({"images": seconds}, {}, "", numbers)

        return run

    return make


def _rms(found: list[FloatArray], truth: FloatArray) -> float:
    """Root mean square of the coordinates' errors, every point found against the nearest true one."""
    if truth.shape[1] == 0:
        return float("nan")
    errors = []
    for uv, points in zip(found, truth, strict=True):
        d = uv[:, None] - points[None]
        errors.append(np.take_along_axis(d, np.argmin((d**2).sum(axis=2), axis=1)[:, None, None], axis=1)[:, 0])
    every = np.concatenate(errors)
    return float(np.sqrt((every**2).mean())) if len(every) else float("nan")


OURS, TWO = "ours", "ours, two images at a time"
CLASSIC, SECTOR = "findChessboardCorners, cornerSubPix", "findChessboardCornersSB"
ARUCO = "CharucoDetector"
FINDING: dict[str, Callable[[Pictures], Competitor]] = {
    OURS: _over_images(_ours, 1), TWO: _over_images(_ours, 2), CLASSIC: _over_images(_classic, 1),
    SECTOR: _over_images(_sector, 1), ARUCO: _over_images(_charuco, 1),
}  # fmt: skip
