"""Bundles with unknown points: AICON's published network, and a simulated one that COLMAP's adjustment solves too."""

import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from time import perf_counter

import numpy as np
import pycolmap
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.assembly import StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import solve
from adjust.model.observations import Distance, ImageBlock, PositionRef
from adjust.model.result import ParameterName
from adjust.model.survey import (
    Camera,
    Datum,
    FloatArray,
    IntArray,
    LensParameter,
    Point,
    PoseParameter,
    Station,
    Survey,
)
from tests.acceptance import published
from tests.benchmarks.data import FREE, SIZE, TRUE_LENS, free_lens, matrix, pixels
from tests.benchmarks.outcome import Competitor, Outcome

AICON_PIXEL_MM = 0.004
AICON_SIZE = (8688, 5792)
AICON_FREE = ("ck", "xh", "yh", "A1", "A2", "B1", "B2")
AICON_S0 = 4.0536263e-4
"""Published, mm: the a priori 0.0005 mm times the root of the variance ratio."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """Images of unknown points. uv: (K, 2) px of ``point`` (K,) in ``image`` (K,); sigma: (K, 2) px.

    lens, world_from_camera (I, 4, 4), points (P, 3) m: the start. names: ids of the points. bar: (2,) points, length
    and sigma in m, empty where there is none. aicon: whether the lens is AICON's (in mm, with ``r0_mm``).
    """

    uv: FloatArray
    image: IntArray
    point: IntArray
    sigma: FloatArray
    lens: FloatArray
    world_from_camera: FloatArray
    points: FloatArray
    names: FloatArray
    bar: FloatArray
    aicon: FloatArray
    r0_mm: FloatArray

    def save(self, path: Path) -> None:
        np.savez(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @staticmethod
    def load(path: Path) -> "Bundle":
        with np.load(path) as data:
            return Bundle(**{f.name: data[f.name] for f in fields(Bundle)})


def simulated(images: int, points: int, per_point: int, seed: int = 2) -> Bundle:
    """A hall of points, cameras all round; every point in about ``per_point`` images, 0.3 px."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (points, 3)) * [2.0, 2.0, 0.8]
    poses, rows = np.array([_all_round(rng) for _ in range(images)]), []
    seen = [[] for _ in range(points)]  # type: list[list[tuple[int, FloatArray]]]
    for i, pose in enumerate(poses):
        q = (x - pose[:3, 3]) @ pose[:3, :3]
        uv = pixels(q, TRUE_LENS)
        for n in np.flatnonzero(np.all((uv > 0) & (uv < np.array(SIZE)), axis=1)):
            seen[int(n)].append((i, uv[n]))
    for p, views in enumerate(seen):
        for k in rng.permutation(len(views))[:per_point]:
            rows.append((views[k][0], p, *views[k][1]))
    table = np.array(sorted(rows))
    uv = table[:, 2:] + rng.normal(size=(len(table), 2)) * 0.3
    used, point = np.unique(table[:, 1].astype(int), return_inverse=True)
    start = np.array([p @ matrix(rng.normal(size=3) * 2e-3, rng.normal(size=3) * 3e-3) for p in poses])
    lens = TRUE_LENS * [1.002, 1.002, 1, 1, 0.9, 0.9, 0, 0] + [0, 0, 2, 2, 0, 0, 0, 0]
    return Bundle(
        uv, table[:, 0].astype(int), point, np.full(uv.shape, 0.3), lens, start,
        x[used] + rng.normal(size=(len(used), 3)) * 2e-3, used, np.zeros(0), np.array(False), np.array(0.0),
    )  # fmt: skip


def _all_round(rng: np.random.Generator) -> FloatArray:
    direction = rng.normal(size=3) * [1, 1, 0.5]
    place = direction / np.linalg.norm(direction) * rng.uniform(4.5, 6.5)
    z = rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.2] - place
    z /= np.linalg.norm(z)
    x = np.cross(rng.normal(size=3), z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, np.cross(z, x), z, place])
    return pose


def aicon(folder: Path, seed: int = 3) -> Bundle:
    """AICON's network: the image points and sigmas of its report, started a little off its solution."""
    given, rng = published.aicon_result(folder), np.random.default_rng(seed)
    report = _reported(folder / "example.htm")
    images, names = sorted(given.images), sorted(set(given.point))
    at_image, at_point = {n: i for i, n in enumerate(images)}, {n: i for i, n in enumerate(names)}
    rows = sorted((image, point) for point, image in report if point in at_point and image in at_image)
    table = np.array([report[point, image] for image, point in rows])
    uv = table[:, :2] * [1.0, -1.0] / AICON_PIXEL_MM + (np.array(AICON_SIZE) - 1) / 2
    poses = np.array([published.world_from_camera(given.images[n]).matrix() for n in images])
    poses = np.array([p @ matrix(rng.normal(size=3) * 1e-3, rng.normal(size=3) * 1e-3) for p in poses])
    bar = next(line.split() for line in (folder / "example.scale").read_text().splitlines())
    ends = [at_point[int(p)] for p in bar[2:4]]
    lens = given.lens.copy()
    lens[0] += 0.05
    return Bundle(
        uv, np.array([at_image[image] for image, _ in rows]), np.array([at_point[point] for _, point in rows]),
        table[:, 2:] / AICON_PIXEL_MM, lens, poses,
        np.array([given.points[n] for n in names]) + rng.normal(size=(len(names), 3)) * 1e-3, np.array(names),
        np.array([*ends, float(bar[4]) / 1000, float(bar[5]) / 1000]), np.array(True), np.array(given.r0_mm),
    )  # fmt: skip


def _reported(report: Path) -> dict[tuple[int, int], tuple[float, ...]]:
    """Image points of the report by (point, image): x, y and their a priori sigmas, mm."""
    out: dict[tuple[int, int], tuple[float, ...]] = {}
    inside = False
    for line in re.sub("<[^>]*>", "", report.read_text(encoding="latin1")).splitlines():
        if "***" in line and "zur" in line:
            inside = "Bildkoordinaten" in line
        words = line.split()
        if inside and len(words) == 12 and re.fullmatch(r"\d+", words[0]) and re.fullmatch(r"[-\d.]+", words[2]):
            out[int(words[0]), int(words[1])] = tuple(float(words[i]) for i in (2, 3, 6, 7))
    return out


def survey(case: Bundle) -> Survey:
    """The bundle as a survey of ours: one station per image, free points, inner constraints.

    AICON's over the points with names of at most three characters, as its published adjustment; else over ten.
    """
    held = PoseParameter(Pose3(), "held")
    lens = LensParameter("brown", FREE)
    if case.aicon:
        lens = LensParameter("aicon", AICON_FREE, case.lens, None, (), AICON_PIXEL_MM, float(case.r0_mm))
    camera = Camera("camera", "body", AICON_SIZE if case.aicon else SIZE, lens, held)
    ids = tuple(str(n) for n in case.names)
    blocks = []
    ends = np.searchsorted(case.image, np.arange(len(case.world_from_camera) + 1))  # images stand in order
    for i in range(len(case.world_from_camera)):
        k = slice(ends[i], ends[i + 1])
        blocks.append(
            ImageBlock("camera", f"i{i}", None, case.point[k], case.uv[k], np.eye(2) * case.sigma[k][:, None] ** 2)
        )
    bars = ()
    if len(case.bar):
        a, b = (PositionRef(ids[int(p)]) for p in case.bar[:2])
        bars = (Distance("bar", a, b, float(case.bar[2]), float(case.bar[3])),)
    datum = Datum("inner", tuple(n for n in ids if len(n) <= 3) if case.aicon else ids[:: len(ids) // 10])
    return Survey(cameras=(camera,), stations=(Station("body", "epoch"),), points=tuple(Point(n) for n in ids),
                  image_blocks=tuple(blocks), distances=bars, datum=datum)  # fmt: skip


def start(case: Bundle) -> StartValues:
    """The start of the bundle as our graph takes it."""
    lens = case.lens
    if not case.aicon:
        lens = np.zeros(13)
        lens[[0, 1, 3, 4, 5, 6, 7, 8]] = case.lens
    poses: dict[ParameterName, Pose3] = {
        ("world_from_station", "body", f"i{i}"): Pose3(m) for i, m in enumerate(case.world_from_camera)
    }
    return StartValues({"camera": lens}, poses, {str(n): x for n, x in zip(case.names, case.points, strict=True)})


def ours(case: Bundle) -> Competitor:
    """Graph, least squares, precision of everything."""
    given, begin = survey(case), start(case)

    def run() -> Outcome:
        t0 = perf_counter()
        graph = GraphBuilder(given, begin.lenses).build(begin)
        t1 = perf_counter()
        solved = solve(graph)
        t2 = perf_counter()
        result = assemble(graph, solved, AdjustOptions())
        t3 = perf_counter()
        lens = graph.unknowns.vectors[("lens", "camera")].full(solved.values)
        numbers = {"omega": result.omega, "redundancy": float(result.redundancy), "sigma0": result.sigma0}
        return Outcome({"build": t1 - t0, "solve": t2 - t1, "precision": t3 - t2}, {"lens": np.asarray(lens)},
                       f"{solved.iterations} steps", numbers)  # fmt: skip

    return run


def colmap(case: Bundle) -> Competitor:
    """COLMAP's bundle adjustment (Ceres), lens OPENCV, all of the lens refined; then the covariances of everything.

    The datum is two cameras, as COLMAP has it; it gives no redundancy numbers and no tests.
    """

    def run() -> Outcome:
        scene = _scene(case)
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_principal_point = True
        options.print_summary = False
        options.ceres.solver_options.num_threads = 1
        options.ceres.solver_options.gradient_tolerance = 1e-10
        options.ceres.solver_options.function_tolerance = 1e-12
        config = pycolmap.BundleAdjustmentConfig()
        for i in range(len(case.world_from_camera)):
            config.add_image(i + 1)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        t0 = perf_counter()
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
        summary = adjuster.solve()
        t1 = perf_counter()
        covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), scene, adjuster)
        t2 = perf_counter()
        lens = np.asarray(scene.cameras[1].params)
        # Ceres' cost is half the sum of squares in px
        cost = 2.0 * summary.ceres_summary.final_cost if hasattr(summary, "ceres_summary") else float("nan")
        points = [] if covariance is None else [covariance.get_point_cov(i) for i in scene.points3D]
        numbers = {"omega": cost / 0.3**2, "covariances": float(sum(c is not None for c in points))}
        return Outcome({"solve": t1 - t0, "precision": t2 - t1}, {"lens": lens}, "", numbers)

    return run


def _scene(case: Bundle) -> pycolmap.Reconstruction:
    scene = pycolmap.Reconstruction()
    # COLMAP's first pixel has its centre at (0.5, 0.5)
    params = case.lens + np.array([0, 0, 0.5, 0.5, 0, 0, 0, 0])
    scene.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="OPENCV", width=SIZE[0], height=SIZE[1], params=params)
    )
    tracks = [pycolmap.Track() for _ in case.points]
    for i, pose in enumerate(case.world_from_camera):
        k = np.flatnonzero(case.image == i)
        image = pycolmap.Image(name=f"i{i}", keypoints=case.uv[k] + 0.5, camera_id=1, image_id=i + 1)
        inverse = np.linalg.inv(pose)
        rotation = pycolmap.Rotation3d(Rotation.from_matrix(inverse[:3, :3]).as_quat())
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, inverse[:3, 3]))
        for n, p in enumerate(case.point[k]):
            tracks[int(p)].add_element(i + 1, n)
    for x, track in zip(case.points, tracks, strict=True):
        scene.add_point3D(x, track)
    return scene


def free(solution: dict[str, FloatArray]) -> FloatArray:
    """The lens of our solution in the order of COLMAP's model OPENCV."""
    return free_lens(solution["lens"])


BUNDLE: dict[str, Callable[[Bundle], Competitor]] = {
    "ours: build, solve, precision": ours,
    "COLMAP: solve, covariance": colmap,
}
