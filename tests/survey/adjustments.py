"""Adjustments made by hand: a three-camera head on a turntable, a board, beacons, a relay station.

The world is laid out like a real laboratory, the board and beacons are projected by OpenCV, residuals and estimates are
drawn from the covariances that are stated.
"""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from gtsam import Pose3, Rot3
from scipy.stats import chi2

from adjust.model.observations import Distance, FrameRef, ImageBlock, Pair, PositionRef, TableReading
from adjust.model.result import (
    Adjustment,
    Estimate,
    GlobalTest,
    GroupSummary,
    ImageResiduals,
    ObservationResidual,
    ParameterName,
)
from adjust.model.survey import (
    TABLE_GEOMETRY,
    Camera,
    FloatArray,
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
from survey.solution.frames import table_from_mount

LENS_NAMES = ("fx", "fy", "skew", "u0", "v0", "k1", "k2", "p1", "p2", "k3")
LENS_UNITS = ("px", "px", "px", "px", "px", "1", "1", "1", "1", "1")
LENS_FREE = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")
LENSES = {
    "X": (1599.26, 1599.93, 0.0, 632.62, 522.18, -0.130, 0.287, -4.0e-4, -4e-5, 0.0),
    "Y": (1605.35, 1603.54, 0.0, 619.71, 505.99, -0.113, 0.018, -3.1e-4, 5.7e-4, 0.0),
    "Z": (1611.22, 1610.80, 0.0, 649.51, 531.29, -0.105, 0.159, -1.4e-3, 1.8e-3, 0.0),
}
LENS_SIGMAS = {"fx": 0.21, "fy": 0.21, "u0": 0.33, "v0": 0.31, "k1": 9e-4, "k2": 6e-3, "p1": 5e-5, "p2": 5e-5}
POSE_COMPONENTS = ("rx", "ry", "rz", "tx", "ty", "tz")
POSE_UNITS = ("rad", "rad", "rad", "m", "m", "m")
SIZE = (1280, 1024)
SIGMA_PX = 0.115


def random_cov(rng: np.random.Generator, sigmas: FloatArray) -> FloatArray:
    """A covariance with these sigmas and random correlations."""
    n = len(sigmas)
    a = rng.normal(size=(n, 2 * n + 2))
    c = a @ a.T
    d = sigmas / np.sqrt(np.diag(c))
    return c * np.outer(d, d)


def look(eye: FloatArray, at: FloatArray) -> Pose3:
    """``world_from_camera`` with the optical axis from ``eye`` to ``at`` and the image upright (z up)."""
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x)
    return Pose3(Rot3(np.column_stack([x, np.cross(z, x), z])), eye)


@dataclass(frozen=True)
class Lab:
    """What the factory is asked for."""

    n_epochs: int = 24
    n_beacons: int = 18
    seed: int = 7
    noise: float = 1.0
    blunders: int = 0
    head_id: str = "head"


def _beacons(rng: np.random.Generator, n: int) -> FloatArray:
    walls = [(-3.0, None), (4.0, None), (None, 3.2)]
    x = np.empty((n, 3))
    for i in range(n):
        wall = walls[i % 3]
        x[i] = (
            wall[0] if wall[0] is not None else rng.uniform(-2.7, 3.7),
            wall[1] if wall[1] is not None else rng.uniform(-1.5, 3.0),
            rng.uniform(0.4, 2.6),
        )
    return x


def lab_survey(lab: Lab) -> Survey:
    """The laboratory: board 1.2 m in front of camera X at zero angles, beacons on three walls."""
    rng = np.random.default_rng(lab.seed)
    board = np.array([(c * 0.02, r * 0.02, 0.0) for r in range(8) for c in range(11)])
    ids = tuple(f"r{r}c{c}" for r in range(8) for c in range(11))
    block = np.array([(x, y, z) for z in (0.0, 0.06) for y in (0.0, 0.06) for x in (0.0, 0.06)])
    block_ids = tuple(f"m{i}" for i in range(8))
    head = Pose3(Rot3(), (0.0, 0.0, 0.05))
    at = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (-1.0, 0.2, 0.03)}
    cameras = []
    for name, direction in at.items():
        d = np.array(direction)
        pose = look(0.09 * d / np.linalg.norm(d), d)
        lens = LensParameter("brown", LENS_FREE, np.array(LENSES[name]))
        cameras.append(Camera(name, lab.head_id, SIZE, lens, PoseParameter(pose)))
    table_pose = Pose3(Rot3.Rz(0.02), (0.6, 0.4, 1.1))
    board_pose = Pose3(Rot3(np.array([[0, 0, -1.0], [-1.0, 0, 0], [0, 1.0, 0]])) * Rot3.Rx(np.pi), (1.85, 0.5, 1.08))
    relay = Pose3(Rot3.Rz(2.2), (-1.4, 2.0, 1.2))
    xyz = _beacons(rng, lab.n_beacons)
    return Survey(
        cameras=tuple(cameras),
        stations=(
            Station(
                lab.head_id, "table", table_id="turntable",
                mount_from_station=PoseParameter(head, "held"),
            ),
            Station("relay", "fixed", PoseParameter(relay)),
        ),
        tables=(
            Table(
                "turntable", ("x", "z"), PoseParameter(table_pose),
                VectorParameter(
                    TABLE_GEOMETRY, np.array([1.9e-4, 2.1e-4, 0.0, 0.0]), ("non_orthogonality", "axis_offset")
                ),
            ),
        ),
        targets=(
            Target("board", ids, board, carrier_from_target=PoseParameter(board_pose)),
            Target("block", block_ids, block, "relay", carrier_from_target=PoseParameter(Pose3(), "held")),
        ),
        points=tuple(Point(f"B{i + 1}", PointParameter(x)) for i, x in enumerate(xyz)),
    )  # fmt: skip


def pose_of(parameter: PoseParameter) -> Pose3:
    return parameter.value or Pose3()


def _image_blocks(survey: Survey, lab: Lab, angles: FloatArray) -> list[ImageBlock]:
    """What the cameras see, projected by OpenCV."""
    table, (head, relay) = survey.tables[0], survey.stations
    board, block = survey.targets
    things: list[tuple[str | None, Any]] = [
        ("board", pose_of(board.carrier_from_target).transformFrom(board.x_in_target.T).T),
        ("block", pose_of(relay.world_from_station).transformFrom(block.x_in_target.T).T),
        (None, np.array([p.x_in_world.value for p in survey.points])),
    ]
    out = []
    for e, motion in enumerate(table_from_mount(table.axes, {}, angles)):
        head_pose = pose_of(table.world_from_table) * motion * pose_of(head.mount_from_station)
        for camera in survey.cameras:
            world_from_camera = head_pose * pose_of(camera.station_from_camera)
            for target_id, x in things:
                in_camera = world_from_camera.transformTo(x.T).T
                lens = np.asarray(camera.lens.values)
                K = np.array([[lens[0], 0, lens[3]], [0, lens[1], lens[4]], [0, 0, 1.0]])
                uv = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), K, lens[[5, 6, 7, 8]])[0].reshape(-1, 2)
                narrow = np.abs(in_camera[:, :2]).max(axis=1) < 0.5 * in_camera[:, 2]
                seen = narrow & (uv > 0).all(1) & (uv < SIZE).all(1) & (in_camera[:, 2] > 0.3)
                idx = np.flatnonzero(seen)
                if len(idx) >= 3 or (target_id is None and len(idx)):
                    cov = np.tile(np.eye(2) * SIGMA_PX**2, (len(idx), 1, 1))
                    out.append(
                        ImageBlock(camera.camera_id, f"e{e + 1:02d}", target_id, idx, uv[idx].astype(float), cov)
                    )
    return out


def _image_residuals(blocks: list[ImageBlock], lab: Lab, rng: np.random.Generator) -> ImageResiduals:
    ptr = np.concatenate([[0], np.cumsum([len(b.uv) for b in blocks])])
    n = int(ptr[-1])
    redundancy = rng.uniform(0.9, 0.99, (n, 2))
    residuals = lab.noise * rng.normal(0.0, SIGMA_PX, (n, 2)) * np.sqrt(redundancy)
    bad = rng.choice(n, lab.blunders, replace=False)
    residuals[bad] += rng.choice((-1.0, 1.0), (lab.blunders, 2)) * rng.uniform(0.8, 2.0, (lab.blunders, 2))
    standardized = residuals / (SIGMA_PX * np.sqrt(redundancy))
    used = np.ones(n, dtype=bool)
    used[bad[: lab.blunders // 2]] = False
    return ImageResiduals(ptr, residuals, redundancy, standardized, (standardized**2).sum(axis=1), used)


def _other(
    kind: str, ids: tuple[str, ...], components: tuple[str, ...], units: tuple[str, ...],
    observed: FloatArray, sigma: FloatArray, rng: np.random.Generator, noise: float, group: str | None = None,
) -> ObservationResidual:  # fmt: skip
    redundancy = rng.uniform(0.2, 0.9, len(components))
    residual = noise * rng.normal(0.0, sigma) * np.sqrt(redundancy)
    standardized = residual / (sigma * np.sqrt(redundancy))
    return ObservationResidual(
        kind, group or kind, ids, components, units, observed, observed + residual, residual, sigma, redundancy,
        standardized, float((standardized**2).sum()), True,
    )  # fmt: skip


def _estimates(survey: Survey, angles: FloatArray, lab: Lab, rng: np.random.Generator) -> dict[ParameterName, Estimate]:
    out: dict[ParameterName, Estimate] = {}

    def vector(name: ParameterName, value, components, units, sigmas, status) -> None:
        cov = random_cov(rng, np.asarray(sigmas))
        free = (np.asarray(sigmas) > 0).astype(float)
        drawn = np.asarray(value) + free * rng.multivariate_normal(np.zeros(len(free)), cov)
        out[name] = Estimate(name, drawn, components, units, cov * np.outer(free, free), status)

    def pose(name: ParameterName, value: Pose3, sigma_arcsec: float, sigma_mm: float) -> None:
        cov = random_cov(
            rng, np.array([sigma_arcsec / 206264.8] * 3 + [sigma_mm * 1e-3] * 3) * rng.uniform(0.6, 1.6, 6)
        )
        drawn = value.retract(rng.multivariate_normal(np.zeros(6), cov))
        out[name] = Estimate(name, drawn, POSE_COMPONENTS, POSE_UNITS, cov, ("free",) * 6)

    for camera in survey.cameras:
        sigmas = [LENS_SIGMAS.get(n, 0.0) for n in LENS_NAMES]
        status = tuple("free" if n in LENS_FREE else "held" for n in LENS_NAMES)
        vector(("lens", camera.camera_id), camera.lens.values, LENS_NAMES, LENS_UNITS, sigmas, status)
        pose(("station_from_camera", camera.camera_id), pose_of(camera.station_from_camera), 38.0, 0.12)
    relay = survey.stations[1]
    pose(("world_from_station", "relay"), pose_of(relay.world_from_station), 60.0, 0.3)
    table = survey.tables[0]
    pose(("world_from_table", "turntable"), pose_of(table.world_from_table), 9.0, 0.07)
    pose(("carrier_from_target", "board"), pose_of(survey.targets[0].carrier_from_target), 14.0, 0.05)
    vector(
        ("table_geometry", "turntable"), table.geometry.values, TABLE_GEOMETRY, ("rad", "m", "rad", "rad"),
        (2.1e-5, 3e-5, 0.0, 0.0), ("free", "free", "held", "held"),
    )  # fmt: skip
    for e in range(lab.n_epochs):
        name = ("table_angles", "turntable", f"e{e + 1:02d}")
        vector(name, angles[e], ("axis1", "axis2"), ("rad", "rad"), (2.4e-5, 2.2e-5), ("free", "free"))
    for point in survey.points:
        distance = np.linalg.norm(np.asarray(point.x_in_world.value) - (0.6, 0.4, 1.1))
        vector(
            ("point", point.point_id), point.x_in_world.value, ("x", "y", "z"), ("m", "m", "m"),
            rng.uniform(0.5, 2.0, 3) * 1.2e-4 * distance, ("free",) * 3,
        )  # fmt: skip
    return out


def correlate(estimate: Estimate, a: str, b: str, rho: float) -> Estimate:
    """The same estimate with two of its components correlated."""
    cov = estimate.cov.copy()
    i, j = estimate.components.index(a), estimate.components.index(b)
    cov[i, j] = cov[j, i] = rho * np.sqrt(cov[i, i] * cov[j, j])
    return replace(estimate, cov=cov)


def lab_adjustment(lab: Lab | None = None, warnings: tuple[str, ...] = ()) -> Adjustment:
    """A whole adjustment of the laboratory."""
    lab = lab or Lab()
    rng = np.random.default_rng(lab.seed + 1)
    survey = lab_survey(lab)
    # the cameras look along 0, 90 and 169 degrees: each has a third of the epochs in front of the board
    towards = np.resize((0.0, -90.0, -169.0), lab.n_epochs)
    angles = np.radians(
        np.column_stack([rng.uniform(-9.0, 9.0, lab.n_epochs), towards + rng.uniform(-13.0, 13.0, lab.n_epochs)])
    )
    blocks = _image_blocks(survey, lab, angles)
    readings = tuple(
        TableReading("turntable", f"e{e + 1:02d}", angles[e], np.eye(2) * (8 / 206264.8) ** 2)
        for e in range(lab.n_epochs)
    )
    relay = FrameRef("station", "relay")
    board_in_relay = Rot3.Rz(0.3)
    pairs = (Pair("relay-board", FrameRef("target", "board"), relay, board_in_relay, np.eye(3) * 1e-8),)
    x = np.array([p.x_in_world.value for p in survey.points])
    d = np.linalg.norm(np.diff(x, axis=0), axis=1)
    distances = tuple(
        Distance(f"d{i + 1}", PositionRef(f"B{i + 1}"), PositionRef(f"B{i + 2}"), float(d[i]), 3e-4)
        for i in range(min(8, len(d)))
    )
    survey = replace(survey, image_blocks=tuple(blocks), table_readings=readings, pairs=pairs, distances=distances)
    images = _image_residuals(blocks, lab, rng)
    others = [
        _other("table", (r.table_id, r.epoch_id), ("axis1", "axis2"), ("rad", "rad"), r.angles,
               np.full(2, 8 / 206264.8), rng, lab.noise) for r in readings
    ]  # fmt: skip
    others += [
        _other("distance", (d.distance_id, str(d.a.point_id), str(d.b.point_id)), ("distance",), ("m",),
               np.array([d.value]), np.array([d.sigma]), rng, lab.noise) for d in distances
    ]  # fmt: skip
    others.append(
        _other("pair", ("relay-board", "board", "relay"), ("rx", "ry", "rz"), ("rad",) * 3,
               board_in_relay.xyz(), np.full(3, 1e-4), rng, lab.noise)
    )  # fmt: skip
    return _assemble(survey, _estimates(survey, angles, lab, rng), images, others, warnings)


def _assemble(
    survey: Survey, estimates: dict[ParameterName, Estimate], images: ImageResiduals,
    others: list[ObservationResidual], warnings: tuple[str, ...],
) -> Adjustment:  # fmt: skip
    groups = [_group("image", images.used.sum() * 2, images.redundancy[images.used], images.standardized[images.used])]
    for kind in ("table", "distance", "pair"):
        found = [o for o in others if o.group == kind]
        w, r = np.concatenate([o.standardized for o in found]), np.concatenate([o.redundancy for o in found])
        groups.append(_group(kind, len(w), r, w))
    n_observations = sum(g.n_observations for g in groups)
    n_unknowns = sum(int(np.count_nonzero(np.diag(e.cov))) for e in estimates.values())
    redundancy = n_observations - n_unknowns
    omega = sum(g.omega for g in groups) / sum(g.redundancy for g in groups) * redundancy
    test = GlobalTest(omega, redundancy, 0.05, float(chi2.ppf(0.025, redundancy)), float(chi2.ppf(0.975, redundancy)))
    return Adjustment(
        survey, estimates, images, tuple(others), tuple(groups), n_observations, n_unknowns, 0, redundancy, omega,
        float(np.sqrt(omega / redundancy)), test, 6, 3e-7, True, warnings, None,
    )  # fmt: skip


def _group(name: str, n: int, redundancy: FloatArray, standardized: FloatArray) -> GroupSummary:
    return GroupSummary(name, int(n), float(redundancy.sum()), float((redundancy * standardized**2).sum()))
