"""Real data with published results, read into surveys: the inputs of the data folders and what their sources print.

Nothing here starts from a published value: where a start is needed the program has to find it. What was published is
read into values of its own, with its sigmas, for the tests to compare with.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from gtsam import Pose3, Rot3

from adjust.lenses.models import MODELS
from adjust.model.observations import ImageBlock
from adjust.model.survey import (
    Camera,
    FloatArray,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
    Target,
    Tie,
    VectorParameter,
    VectorPrior,
)

HELD = PoseParameter(Pose3(), "held")
# photogrammetry's camera looks along -z with y up
_LOOKING_BACK = np.diag([1.0, -1.0, -1.0])


# --- DBAT camcal: 21 images of a sheet of 100 points, four of them control points -------------------------------------

DBAT_IMAGE_SIZE = (2272, 1704)
DBAT_PIXEL_SIZE_MM = 5.43764 / 1704
_DBAT_LENS_TITLES = {
    "Camera Constant": "c",
    "px - principal point x": "px",
    "py - principal point y": "py",
    "as - off-unit aspect parameter": "as",
    "K1 - radial distortion 1": "K1",
    "K2 - radial distortion 2": "K2",
    "K3 - radial distortion 3": "K3",
    "P1 - decentering distortion 1": "P1",
    "P2 - decentering distortion 2": "P2",
}
_DBAT_STATION_TITLES = ("Omega", "Phi", "Kappa", "Xc", "Yc", "Zc")


@dataclass(frozen=True, eq=False)
class Printed:
    """A number as a report prints it; ``half_digit`` is half a unit of its last digit."""

    value: float
    half_digit: float


@dataclass(frozen=True, eq=False)
class DbatReport:
    """What a DBAT report prints: lens and stations as (value, deviation), angles in degrees, lengths in mm or m.

    stations: image name (P8250021) -> Omega Phi Kappa Xc Yc Zc.
    """

    sigma0: Printed
    redundancy: int
    n_unknowns: int
    n_observations: int
    rms_px: Printed
    lens: dict[str, tuple[Printed, Printed]]
    stations: dict[str, dict[str, tuple[Printed, Printed]]]


@dataclass(frozen=True, eq=False)
class DbatSolution:
    """DBAT's result files in full precision: lens (9,), stations omega phi kappa (rad) X Y Z (m) and their sigmas."""

    lens: FloatArray
    stations: dict[str, FloatArray]
    station_sigmas: dict[str, FloatArray]


def dbat_survey(folder: Path, start_focal_mm: float = 7.5) -> Survey:
    """The calibration of ``dbat_camcal``: one station per image, its camera frame; control held, other points free.

    Only the focal length the images' EXIF gives is known at the start.
    """
    names = _dbat_image_names(folder)
    rows = np.loadtxt(folder / "camcaldemo/measurements/markpts.txt", delimiter=",")
    control = np.loadtxt(folder / "ref/camcal-fixed.txt", delimiter=",", usecols=(0, 2, 3, 4))
    fixed = {int(row[0]): row[1:] for row in control}
    ids = sorted({int(i) for i in rows[:, 1]})
    points = tuple(Point(str(i), PointParameter(fixed[i], "held") if i in fixed else PointParameter()) for i in ids)
    blocks = []
    for image, name in names.items():
        own = rows[rows[:, 0] == image]
        cov = np.eye(2) * own[:, 4, None, None] ** 2
        blocks.append(ImageBlock("camera", name, None, np.searchsorted(ids, own[:, 1]), own[:, 2:4].copy(), cov))
    model = MODELS["brown_backward_dbat"]
    width, height = DBAT_IMAGE_SIZE
    values = np.zeros(model.n)
    values[:3] = start_focal_mm, width / 2 * DBAT_PIXEL_SIZE_MM, height / 2 * DBAT_PIXEL_SIZE_MM
    lens = LensParameter(model.name, model.names, values, pixel_size_mm=DBAT_PIXEL_SIZE_MM)
    return Survey(
        cameras=(Camera("camera", "body", DBAT_IMAGE_SIZE, lens, HELD),),
        stations=(Station("body", motion="epoch"),),
        points=points,
        image_blocks=tuple(blocks),
    )


def _dbat_image_names(folder: Path) -> dict[int, str]:
    """Image number -> name without ending."""
    lines = (folder / "camcaldemo/images/images.txt").read_text().splitlines()
    rows = [line.split(",") for line in lines if line and not line.startswith("#")]
    return {int(number): Path(path.strip()).stem for number, path in rows}


def dbat_report(path: Path) -> DbatReport:
    """Parse a report of DBAT 0.9 (``camcal-dbatreport.txt`` is the converged one of the two here)."""
    lens: dict[str, tuple[Printed, Printed]] = {}
    stations: dict[str, dict[str, tuple[Printed, Printed]]] = {}
    head: dict[str, str] = {}
    photo, title, value = "", "", None
    for line in path.read_text().splitlines():
        key, _, rest = (part.strip() for part in line.partition(":"))
        if key.startswith("Photo ") and rest.endswith(".JPG"):
            photo = rest.removesuffix(".JPG")
            stations[photo] = {}
        elif key == "Value":
            value = _printed(rest)
        elif key == "Deviation" and value is not None:
            if title in _DBAT_LENS_TITLES:
                lens[_DBAT_LENS_TITLES[title]] = (value, _printed(rest))
            elif title in _DBAT_STATION_TITLES:
                stations[photo][title] = (value, _printed(rest))
        elif not rest:
            title = key
        if rest:
            head.setdefault(key, rest)
        elif key.startswith("Redundancy"):
            head["Redundancy"] = key.split()[1]
    return DbatReport(
        sigma0=_printed(head["Sigma0"]),
        redundancy=int(head["Redundancy"]),
        n_unknowns=int(head["Number of params"].split()[0]),
        n_observations=int(head["Number of observations"].split()[0]),
        rms_px=_printed(head["Overall point RMS"]),
        lens=lens,
        stations=stations,
    )


def dbat_solution(folder: Path) -> DbatSolution:
    """DBAT's camera XML and station list.

    The list says degrees but holds radians; the sigmas of its angles are degrees, and those of its positions were
    multiplied by 180 / pi. The XML's aspect is 1 - as.
    """
    xml = (folder / "camcaldemo/result/c4040z.xml").read_text()

    def numbers(tag: str) -> list[float]:
        return [float(x) for x in xml.split(f"<{tag}>")[1].split(f"</{tag}>")[0].split(",")]

    lens = np.array([*numbers("cc"), *numbers("pp"), 1 - numbers("aspect")[0], *numbers("K"), *numbers("P")])
    stations, sigmas = {}, {}
    for line in (folder / "camcaldemo/result/camera_stations.txt").read_text().splitlines():
        if line.startswith("#"):
            continue
        *fields, label = (part.strip() for part in line.split(","))
        row = np.array([float(x) for x in fields[2:]])
        name = label.removesuffix(".JPG")
        stations[name] = np.concatenate([row[3:6], row[:3]])
        sigmas[name] = np.radians(np.concatenate([row[9:12], row[6:9]]))
    return DbatSolution(lens, stations, sigmas)


def _printed(text: str) -> Printed:
    """The first number of a text with half a unit of its last printed digit."""
    token = text.split()[0]
    mantissa, _, exponent = token.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return Printed(float(token), 0.5 * 10.0 ** (int(exponent or 0) - decimals))


def world_from_camera(parameters: FloatArray) -> Pose3:
    """Pose from omega phi kappa (rad) X Y Z (m): R = Rx(omega) Ry(phi) Rz(kappa) of a camera looking along -z."""
    omega, phi, kappa = parameters[:3]
    R = Rot3.Rx(omega).matrix() @ Rot3.Ry(phi).matrix() @ Rot3.Rz(kappa).matrix()
    return Pose3(Rot3(R @ _LOOKING_BACK), parameters[3:])


def station_parameters(pose: Pose3) -> FloatArray:
    """Omega phi kappa (rad) X Y Z (m) of ``world_from_camera``."""
    R = pose.rotation().matrix() @ _LOOKING_BACK
    omega, phi, kappa = np.arctan2(-R[1, 2], R[2, 2]), np.arcsin(R[0, 2]), np.arctan2(-R[0, 1], R[0, 0])
    return np.array([omega, phi, kappa, *pose.translation()])


def station_parameter_jacobian(pose: Pose3) -> FloatArray:
    """(6, 6) derivative of ``station_parameters`` by the tangent (rotation, translation, in the camera frame)."""
    _, phi, kappa = station_parameters(pose)[:3]
    Rz = Rot3.Rz(kappa).matrix()
    Ry = Rot3.Ry(phi).matrix()
    # the rotation vector in the camera frame that a unit change of each angle makes
    vectors = np.column_stack([Rz.T @ Ry.T @ [1, 0, 0], Rz.T @ [0, 1, 0], [0, 0, 1]])
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = np.linalg.inv(_LOOKING_BACK @ vectors)
    jacobian[3:, 3:] = pose.rotation().matrix()
    return jacobian


# --- mrcal: 186 views of a board, OpenCV's lens with eight coefficients -----------------------------------------------

MRCAL_LENS = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""mrcal's order of the intrinsics."""


@dataclass(frozen=True, eq=False)
class MrcalSolution:
    """mrcal's optimum: lens (12,) with covariance, board poses in the camera frame, warp, and its statistics."""

    lens: FloatArray
    lens_cov: FloatArray
    camera_from_board: dict[str, Pose3]
    warp: FloatArray
    sigma_px: float
    cost: float
    board_cost: float


def mrcal_survey(path: Path, regularised: bool) -> Survey:
    """The calibration of ``opencv8-0.npz``: the camera is the world, the board moves, its warp is free.

    regularised: with mrcal's weak priors on the distortion and the image centre, without which its optimum is only met
    within a third of a sigma. An observation of weight w has sigma 1 / w px; a negative weight marks an outlier.
    """
    data = np.load(path)
    observations = data["observations"]
    views, rows, columns, _ = observations.shape
    v, u = (index.ravel() for index in np.mgrid[:rows, :columns])
    x_in_target = np.column_stack([u, v, np.zeros_like(u)]) * float(data["spacing"])
    width, height = (int(x) for x in data["imagersize"])
    lens = LensParameter("brown", MRCAL_LENS, prior=_mrcal_prior(observations, width, height) if regularised else None)
    blocks = tuple(_mrcal_block(k, observations[k].reshape(-1, 3)) for k in range(views))
    board = Target(
        "board",
        tuple(f"r{r}c{c}" for r, c in zip(v, u, strict=True)),
        x_in_target,
        motion="epoch",
        warp=VectorParameter(("warp_x", "warp_y"), np.zeros(2), free=("warp_x", "warp_y")),
    )
    return Survey(
        cameras=(Camera("camera", "body", (width, height), lens, HELD),),
        stations=(Station("body", "fixed", HELD),),
        targets=(board,),
        image_blocks=blocks,
    )


def mrcal_solution(path: Path) -> MrcalSolution:
    """mrcal's published optimum."""
    data = np.load(path)
    poses = {_view(k): Pose3(Rot3.Expmap(row[:3]), row[3:]) for k, row in enumerate(data["rt_ref_frame"])}
    return MrcalSolution(
        data["intrinsics"][0],
        data["cov_intrinsics"],
        poses,
        data["warp"],
        float(data["sigma_px"]),
        float(data["cost"]),
        float(data["cost_boards"]),
    )


def _view(k: int) -> str:
    return f"view{k:03d}"


def _mrcal_block(k: int, observed: FloatArray) -> ImageBlock:
    weight = np.abs(observed[:, 2])
    cov = np.eye(2) / weight[:, None, None] ** 2
    idx = np.arange(len(observed))
    return ImageBlock("camera", _view(k), "board", idx, observed[:, :2].copy(), cov, used=observed[:, 2] > 0)


def _mrcal_prior(observations: FloatArray, width: int, height: int) -> VectorPrior:
    """mrcal's regularisation: a 200th of the observations' weight in each of its two halves."""
    names = MRCAL_LENS[2:]
    total = 2 * observations[..., 0].size * 0.005 / 2
    weights = np.full(len(names), np.sqrt(total / 32))
    weights[-3:] *= 5  # the denominator
    weights[:2] = np.sqrt(total / (2 * 500.0**2))
    mean = np.zeros(len(names))
    mean[:2] = (width - 1) / 2, (height - 1) / 2
    return VectorPrior(names, mean, np.diag(weights**-2))


# --- OpenCV's chessboard pairs: 13 views, 9 x 6 corners, 25 mm --------------------------------------------------------

OPENCV_SQUARE_M = 0.025
OPENCV_SIDES = ("left", "right")


@dataclass(frozen=True, eq=False)
class OpenCvSolution:
    """``left_intrinsics.yml``: fx fy u0 v0, k1 k2 p1 p2 k3, board poses per epoch, rms distance in each view."""

    lens: FloatArray
    camera_from_board: dict[str, Pose3]
    rms_px: float
    view_rms_px: dict[str, float]


def opencv_images(folder: Path, side: str) -> dict[str, Path]:
    """Epoch -> image file of one side."""
    names = np.load(folder / f"{side}_corners.npz")["names"]
    return {_opencv_epoch(str(name), side): folder / str(name) for name in names}


def opencv_survey(
    folder: Path,
    sides: tuple[str, ...] = OPENCV_SIDES,
    free: tuple[str, ...] = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3"),
    same_focal_length: bool = True,
    sigma_px: float = 0.2,
    corners: dict[str, dict[str, FloatArray]] | None = None,
) -> Survey:
    """One or both cameras on a head that is the world; the board moves from epoch to epoch.

    same_focal_length: fy follows fx, as in the published calibrations. With both sides the head's frame is the left
    camera's, and ``station_from_camera`` of the right one is free.
    corners: side -> epoch -> (54, 2) px instead of the stored ones.
    """
    ties = (Tie("fy", "fx"),) if same_focal_length and "fy" in free else ()
    cameras, blocks = [], []
    for k, side in enumerate(sides):
        data = np.load(folder / f"{side}_corners.npz")
        width, height = (int(x) for x in data["imsize"])
        lens = LensParameter("brown", tuple(n for n in free if not (ties and n == "fy")), ties=ties)
        cameras.append(Camera(side, "head", (width, height), lens, PoseParameter() if k else HELD))
        for name, uv in zip(data["names"], data["corners"], strict=True):
            epoch = _opencv_epoch(str(name), side)
            seen = uv if corners is None else corners[side][epoch]
            cov = np.tile(np.eye(2) * sigma_px**2, (len(seen), 1, 1))
            blocks.append(ImageBlock(side, epoch, "board", np.arange(len(seen)), seen, cov))
        columns, rows = (int(x) for x in data["grid"])
    v, u = (index.ravel() for index in np.mgrid[:rows, :columns])
    x_in_target = np.column_stack([u, v, np.zeros_like(u)]) * OPENCV_SQUARE_M
    board = Target("board", tuple(f"r{r}c{c}" for r, c in zip(v, u, strict=True)), x_in_target, motion="epoch")
    return Survey(
        cameras=tuple(cameras),
        stations=(Station("head", "fixed", HELD),),
        targets=(board,),
        image_blocks=tuple(blocks),
    )


def opencv_wide_corners(folder: Path, side: str) -> dict[str, FloatArray]:
    """Epoch -> (54, 2) px as OpenCV's calibration sample finds them, refined in a window of half-width 11 px.

    That window is wider than a square of the far board in left02: neighbours pull corners there by up to 6 px. The
    published calibration has these errors (its rms in that view is 1.18 px); the stored corners do not.
    """
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.1)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK | cv2.CALIB_CB_NORMALIZE_IMAGE
    found = {}
    for epoch, path in opencv_images(folder, side).items():
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise OSError(f"{path} is no readable image")
        _, rough = cv2.findChessboardCorners(image, (9, 6), flags=flags)
        fine = cv2.cornerSubPix(image, rough, (11, 11), (-1, -1), criteria)
        found[epoch] = fine.reshape(-1, 2).astype(np.float64)
    return found


def opencv_left_solution(folder: Path) -> OpenCvSolution:
    """The published calibration of the left camera."""
    storage = cv2.FileStorage(str(folder / "left_intrinsics.yml"), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    coefficients = storage.getNode("distortion_coefficients").mat().ravel()
    poses = storage.getNode("extrinsic_parameters").mat()
    views = storage.getNode("per_view_reprojection_errors").mat().ravel()
    epochs = list(opencv_images(folder, "left"))
    return OpenCvSolution(
        np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients]),
        {e: Pose3(Rot3.Expmap(p[:3]), p[3:]) for e, p in zip(epochs, poses, strict=True)},
        float(storage.getNode("avg_reprojection_error").real()),
        {e: float(r) for e, r in zip(epochs, views, strict=True)},
    )


def _opencv_epoch(name: str, side: str) -> str:
    return Path(name).stem.removeprefix(side)


# --- AICON: 115 images of 150 points with self-calibration ------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AiconResult:
    """AICON's adjusted network: lens (10,) mm, images omega phi kappa (rad) X Y Z (m), points (m).

    image, point: (n,) ids of the image points used; measured, residuals: (n, 2) mm, y up, computed - observed.
    """

    lens: FloatArray
    r0_mm: float
    images: dict[int, FloatArray]
    points: dict[int, FloatArray]
    image: list[int]
    point: list[int]
    measured: FloatArray
    residuals: FloatArray


def aicon_result(folder: Path) -> AiconResult:
    """Read .ior (ck xh yh A1 A2 r0 / A3 / B1 B2 / C1 C2), .eor (mm, rad), .obc (mm) and .phc (mm).

    ck is negative in the file. The last but one column of the .phc tells which image points were used;
    those of points without coordinates were not adjusted.
    """
    lines = (folder / "example.ior").read_text().splitlines()
    _, _, ck, xh, yh, a1, a2, r0 = (float(x) for x in lines[0].split()[:8])
    a3, b1, b2, c1, c2 = (float(x) for line in lines[1:4] for x in line.split()[:2])
    images = {}
    for line in (folder / "example.eor").read_text().splitlines():
        number, _, *fields = line.split()
        row = np.array([float(x) for x in fields[:6]])
        images[int(number)] = np.concatenate([row[3:], row[:3] / 1000])
    points = {}
    for line in (folder / "example.obc").read_text().splitlines():
        point, *fields = line.split()
        points[int(point)] = np.array([float(x) for x in fields[:3]]) / 1000
    rows = np.array([line.split()[:10] for line in (folder / "example.phc").read_text().splitlines()], dtype=float)
    rows = rows[(rows[:, 9] == 1) & np.isin(rows[:, 1], list(points))]
    lens = np.array([-ck, xh, yh, a1, a2, a3, b1, b2, c1, c2])
    ids = rows[:, :2].astype(int)
    return AiconResult(lens, r0, images, points, list(ids[:, 0]), list(ids[:, 1]), rows[:, 2:4], rows[:, 6:8])
