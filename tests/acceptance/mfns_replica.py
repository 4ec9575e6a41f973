"""The published three-camera calibration as a simulation: tables 2 and 3 are the truth, OpenCV takes the images.

Where the paper is silent: the board's corners reach from the origin to x = 200 and y = -140 mm (they have to, for
camera Z to see them from its place); camera Z is turned by six angles about the main axis, the first of them zero, and
by five about the auxiliary axis, over all the range that keeps the board in view; cameras X and Y at random within
theirs. The printed height of the body's origin, 576.91 mm, is taken as -576.91: it is a caliper reading, and with that
sign alone the printed origins of body and table are apart along the table's main axis (by 108 mm).
"""

from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import solve
from adjust.model.observations import Distance, FrameRef, ImageBlock, PositionRef, TableReading
from adjust.model.result import Adjustment
from adjust.model.survey import (
    TABLE_GEOMETRY,
    Camera,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
    Table,
    Target,
    VectorParameter,
)
from adjust.published import CpcInput, TableImages, body_on_main_axis, calibrate, single_camera_survey, table_images
from adjust.spatial.rigid import rotation_log
from survey.simulate import BROWN, Scene, resample

ARCSEC = np.pi / 180 / 3600
CAMERAS = ("X", "Y", "Z")
FREE_LENS = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")
LENSES = {
    "X": (1599.26136, 1599.93302, 632.61591, 522.17870, -0.13013, 0.28701, -0.00040, -0.00004),
    "Y": (1605.35286, 1603.54359, 619.71227, 505.99361, -0.11276, 0.01776, -0.00031, 0.00057),
    "Z": (1611.21596, 1610.79607, 649.51210, 531.29472, -0.10481, 0.15881, -0.00137, 0.00184),
}
LENS_SIGMAS = {  # as printed in table 2
    "X": (1.78966, 1.64101, 1.62023, 1.61823, 0.00336, 0.02243, 0.00029, 0.00031),
    "Y": (1.66249, 1.73608, 1.80177, 1.93821, 0.00301, 0.01776, 0.00034, 0.00030),
    "Z": (2.14183, 2.14219, 1.39920, 1.34749, 0.00338, 0.02341, 0.00021, 0.00022),
}
ANGLES_DEG = {
    "C_t^w": (-0.0110, 0.1263, 0.0861),
    "C_x^b": (-0.5788, -90.3523, 0.0395),
    "C_y^b": (90.1636, -0.5501, 0.1925),
    "C_z^b": (-0.1076, -0.7211, 1.1690),
}
VECTORS_MM = {
    "r_wb^w": (33.8407, -128.9401, -576.9100),
    "r_wt^w": (34.0949, -128.9281, -684.7134),
    "r_bx^b": (76.1319, -36.8373, 78.8949),
    "r_by^b": (-32.5004, 75.7149, 76.9967),
    "r_bz^b": (34.1604, 30.8251, 119.7096),
}
PRINTED_SIGMAS = {  # table 3, deg and mm
    "C_t^w": (0.0485, 0.0657, 0.0443),
    "C_x^b": (0.0413, 0.0990, 0.0153),
    "C_y^b": (0.0301, 0.0920, 0.0157),
    "C_z^b": (0.0485, 0.0657, 0.0443),
    "r_wb^w": (0.2932, 0.2932, 0.2456),
    "r_wt^w": (0.1496, 0.1496, 0.1496),
    "r_bx^b": (0.2529, 0.4498, 0.4959),
    "r_by^b": (0.5358, 0.0825, 0.1963),
    "r_bz^b": (0.3097, 0.3097, 0.2932),
}
CALIPER_SIGMA_MM = 0.2456
SIGMA_PX = 0.115
MAIN_DEG = (0.0, -90.0, -8.0, 12.0, 26.0, 38.0)  # of camera Z, about the main axis, then about the auxiliary one
AUXILIARY_DEG = (-8.2, -5.5, -3.0, 1.2, 2.2)


def rotation(name):
    """C_a^b of table 3, by plain lines from equation 9: the frame turned about 2, then 1, then 3."""
    phi, theta, psi = np.radians(ANGLES_DEG[name])
    c, s = np.cos, np.sin
    about_2 = np.array([[c(theta), 0, -s(theta)], [0, 1, 0], [s(theta), 0, c(theta)]])
    about_1 = np.array([[1, 0, 0], [0, c(phi), s(phi)], [0, -s(phi), c(phi)]])
    about_3 = np.array([[c(psi), s(psi), 0], [-s(psi), c(psi), 0], [0, 0, 1]])
    return about_3 @ about_1 @ about_2


HEIGHT_MM = (VECTORS_MM["r_wb^w"][2] - VECTORS_MM["r_wt^w"][2]) / rotation("C_t^w")[2, 2]
# the truth has the body on the main axis, which the printed origin misses by 0.02 mm
TRUE_MM = VECTORS_MM | {"r_wb^w": VECTORS_MM["r_wt^w"] + HEIGHT_MM * rotation("C_t^w")[:, 2]}


def rigid(R, t_mm):
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = R, np.asarray(t_mm) / 1e3
    return m


def true_poses():
    truth = {
        ("world_from_table", "turntable"): Pose3(rigid(rotation("C_t^w"), VECTORS_MM["r_wt^w"])),
        ("mount_from_station", "head"): Pose3(rigid(np.eye(3), (0.0, 0.0, HEIGHT_MM))),
        ("table_geometry", "turntable"): np.zeros(4),
        ("carrier_from_target", "board"): Pose3(),
        ("point", "foot"): np.array([*VECTORS_MM["r_wb^w"][:2], 0.0]) / 1e3,
    }
    for camera_id in CAMERAS:
        k = camera_id.lower()
        lens = dict(zip(FREE_LENS, LENSES[camera_id], strict=True))
        truth["lens", camera_id] = np.array([lens.get(name, 0.0) for name in BROWN])
        truth["station_from_camera", camera_id] = Pose3(rigid(rotation(f"C_{k}^b"), VECTORS_MM[f"r_b{k}^b"]))
    return truth


def laboratory():
    column, row = np.meshgrid(np.arange(11), np.arange(8))
    x = np.stack([0.02 * column.ravel(), -0.02 * row.ravel(), np.zeros(88)], axis=1)
    ids = tuple(f"{c}.{r}" for c, r in zip(column.ravel(), row.ravel(), strict=True))
    foot = PointParameter(np.array([*VECTORS_MM["r_wb^w"][:2], 0.0]) / 1e3, "held")
    return Survey(
        cameras=tuple(Camera(k, "head", (1280, 1024), LensParameter("brown", FREE_LENS)) for k in CAMERAS),
        stations=(
            Station("head", "table", table_id="turntable", mount_from_station=body_on_main_axis(HEIGHT_MM / 1e3)),
        ),
        tables=(Table("turntable", geometry=VectorParameter(TABLE_GEOMETRY, np.zeros(4))),),
        targets=(Target("board", ids, x, carrier_from_target=PoseParameter(Pose3(), "held")),),
        points=(Point("foot", foot),),
    )


class _Camera:
    """Takes images of the whole board, at random."""

    def __init__(self, survey, truth, seed):
        self.scene, self.truth, self.rng = Scene(survey, truth), truth, np.random.default_rng(seed)
        self.blocks, self.readings = [], []

    def image(self, camera_id, epoch_id):
        uv = self.scene.project(camera_id, epoch_id, self.scene.target_points("board", epoch_id))
        if not self.scene.inside(camera_id, uv, 8.0).all():
            return False
        cov = np.tile(SIGMA_PX**2 * np.eye(2), (88, 1, 1))
        self.blocks.append(ImageBlock(camera_id, epoch_id, "board", np.arange(88), uv, cov))
        return True

    def on_table(self, camera_id, n, draw):
        epochs, taken = [f"t{camera_id}{i + 1:02d}" for i in range(n)], 0
        for _ in range(5000):
            name = ("table_angles", "turntable", epochs[taken])
            self.truth[name] = np.radians(draw(taken, self.rng))
            if self.image(camera_id, epochs[taken]):
                self.readings.append(TableReading(*name[1:], self.truth[name], (8 * ARCSEC) ** 2 * np.eye(2)))
                taken += 1
            if taken == n:
                return
        raise ValueError(f"camera {camera_id} does not see the board {n} times")

    def by_hand(self, camera_id, n):
        for i in range(n):
            name = ("world_from_station", "head", f"h{camera_id}{i + 1:02d}")
            for _ in range(5000):
                tilt = Rot3.Expmap(np.radians(self.rng.uniform(-35, 35, 3)))
                place = self.rng.uniform((-0.05, -0.25, -0.65), (0.25, 0.10, -0.35))
                world_from_camera = Pose3(tilt, place)
                self.truth[name] = world_from_camera * self.truth["station_from_camera", camera_id].inverse()
                if self.image(camera_id, name[2]):
                    break
            else:
                raise ValueError(f"camera {camera_id} does not see the board by hand")


def _angles_of_z(i, _):
    n = len(MAIN_DEG)
    return (0.0, MAIN_DEG[i]) if i < n else (AUXILIARY_DEG[(i - n) % len(AUXILIARY_DEG)], 0.0)


def _angles_of_y(_, rng):
    return rng.uniform((50, -40), (130, 40))


def _angles_of_x(i, rng):
    return (1, -1)[i % 2] * rng.uniform((50, 50), (130, 130))


def replica(seed=1, n_table=11, n_hand=10):
    """The survey with error-free observations, and its truth."""
    survey, truth = laboratory(), true_poses()
    camera = _Camera(survey, truth, seed)
    for camera_id, draw in zip(CAMERAS, (_angles_of_x, _angles_of_y, _angles_of_z), strict=True):
        camera.on_table(camera_id, n_table, draw)
        camera.by_hand(camera_id, n_hand)
    origin = PositionRef(frame=FrameRef("station", "head", "tZ01"))
    caliper = Distance("caliper", origin, PositionRef("foot"), -VECTORS_MM["r_wb^w"][2] / 1e3, CALIPER_SIGMA_MM / 1e3)
    survey = replace(survey, image_blocks=tuple(camera.blocks), table_readings=tuple(camera.readings),
                     distances=(caliper,))  # fmt: skip
    return survey, truth


def true_start(truth):
    """The truth as start values."""
    lenses = {name[1]: value for name, value in truth.items() if name[0] == "lens"}
    poses = {name: value for name, value in truth.items() if isinstance(value, Pose3)}
    vectors = {name: value for name, value in truth.items() if name[0] == "table_angles"}
    return StartValues(lenses, poses, {"foot": truth["point", "foot"]}, vectors)


def joint_graph(survey, truth) -> AdjustmentGraph:
    start = true_start(truth)
    return GraphBuilder(survey, start.lenses).build(start)


def camera_graph(survey, truth, camera_id) -> AdjustmentGraph:
    """One camera alone; its station is the camera itself."""
    single, start = single_camera_survey(survey, camera_id), true_start(truth)
    scene = Scene(survey, truth)
    poses = {("world_from_station", "head", b.epoch_id): Pose3(scene.world_from_camera(camera_id, b.epoch_id))
             for b in single.image_blocks}  # fmt: skip
    return GraphBuilder(single, start.lenses).build(StartValues(start.lenses, poses, {}))


def noisy(survey, truth, seed):
    return resample(survey, truth, seed)


def cpc_input(survey, images: dict[str, TableImages]) -> CpcInput:
    """What the paper's method gets: every camera's poses, the readings, the caliper."""
    caliper = survey.distances[0]
    return CpcInput(images["Z"], (images["X"], images["Y"]), -caliper.value, caliper.sigma, 8 * ARCSEC)


def images_of(calibrated: dict[str, Adjustment], survey) -> dict[str, TableImages]:
    return {k: table_images(result, survey.table_readings) for k, result in calibrated.items()}


def stepwise(survey, truth):
    """The paper's method on one survey."""
    calibrated = {k: assemble(g, solve(g), AdjustOptions())
                  for k in CAMERAS if (g := camera_graph(survey, truth, k))}  # fmt: skip
    return calibrate(cpc_input(survey, images_of(calibrated, survey)))


QUANTITIES = tuple(PRINTED_SIGMAS)  # three components each: turns about the axes of the frame on the right, or x, y, z


def paper_errors(poses, height):
    """Errors (27,) deg and mm of QUANTITIES: (world_from_table, {camera: station_from_camera}), height in m."""
    table, cameras = poses
    out = {}
    for name in QUANTITIES:
        k = name[3 if name[0] == "r" else 2].upper()
        pose = table if name in ("C_t^w", "r_wt^w", "r_wb^w") else cameras[k]
        if name[0] == "C":
            out[name] = np.degrees(rotation_log(rotation(name).T @ pose.rotation().matrix()))
        else:
            place = pose.transformFrom(np.array([0.0, 0.0, height])) if name == "r_wb^w" else pose.translation()
            out[name] = 1e3 * np.asarray(place) - TRUE_MM[name]
    return np.concatenate([out[name] for name in QUANTITIES])


def stepwise_errors(found):
    cameras = {k: found.station_from_camera(k) for k in CAMERAS}
    out = paper_errors((found.world_from_table, cameras), float(found.mount_from_station.translation()[2]))
    at = 3 * QUANTITIES.index("r_wb^w")  # the paper's own, from A14
    out[at : at + 3] = found.vectors["r_wb^w"].value_mm - TRUE_MM["r_wb^w"]
    return out


def joint_errors(poses):
    cameras = {k: poses["station_from_camera", k] for k in CAMERAS}
    return paper_errors((poses["world_from_table", "turntable"], cameras),
                        float(poses["mount_from_station", "head"].translation()[2]))  # fmt: skip


def joint_poses(graph, values):
    """The poses of ``values`` by parameter name."""
    unknowns = graph.unknowns.by_name
    return {n: values.atPose3(u.key) for n, u in unknowns.items() if u.kind == "pose" and n[0] != "world_from_station"}


def print_table(columns):
    """Rows of QUANTITIES; columns: name -> (27,)."""
    print("\n" + " " * 12 + "".join(f"{name:>12}" for name in columns))
    for i, (name, axis) in enumerate((q, a) for q in QUANTITIES for a in "xyz"):
        print(f"{name:>9} {axis} " + "".join(f"{values[i]:12.4f}" for values in columns.values()))
