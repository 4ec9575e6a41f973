"""The alignment of turntable and board by levels and a laser trace (appendix A.3 of the paper), as observations.

The geometry is that of the published calibration. The board is the world; gravity's direction in it is unknown, and
told by a level on the board. The level on the table then tells two angles, the laser's trace on the board the third.
"""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.stats import chi2

from adjust.adjustment import AdjustOptions, adjust, assemble
from adjust.graph.assembly import StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import solve
from adjust.model.errors import IndeterminateError
from adjust.model.observations import FrameRef, LaserSpot, Level, TableReading
from adjust.model.survey import TILT, Beam, PoseParameter, Survey, VectorParameter, Vertical
from adjust.spatial.rigid import rotation_log
from tests.acceptance.mfns_replica import ARCSEC, joint_graph, laboratory, noisy, replica, rotation, true_poses
from tests.sizes import size

LEVEL_SIGMA, SPOT_SIGMA, TAPE_SIGMA = 15 * ARCSEC, 2e-4, 1e-3
TRACE_DEG = np.linspace(-12.0, 12.0, 9)  # about the table's outer axis
TABLE = ("world_from_table", "turntable")
UP = np.array([0.004, -0.003, 1.0]) / np.linalg.norm([0.004, -0.003, 1.0])  # of the board, before it is levelled
BEAM = np.array([0.003, -0.002, 0.004, 0.006])
BOARD, BASE = FrameRef("target", "board"), FrameRef("table", "turntable")


def spot_of(table: Pose3, angle: float, beam: np.ndarray) -> np.ndarray:
    """Where the line through (o1, o2, 0) along (m1, m2, 1), turned about the table's x axis, meets the board z = 0."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    start, along = turn @ [beam[0], beam[1], 0.0], turn @ [beam[2], beam[3], 1.0]
    p = table.rotation().matrix() @ start + table.translation()
    d = table.rotation().matrix() @ along
    return (p - d * p[2] / d[2])[:2]


def aligned(seed: int | None) -> Survey:
    """Levels and laser trace of the replica's table and board, without noise for None; no images."""
    rng = np.random.default_rng(seed)
    noise = (lambda sigma, n=1: np.zeros(n)) if seed is None else (lambda sigma, n=1: sigma * rng.standard_normal(n))
    table = true_poses()[TABLE]
    lab = laboratory()
    levels = []
    for frame, R in ((BOARD, np.eye(3)), (BASE, table.rotation().matrix())):
        for axis in np.eye(3)[:2]:
            value = float(np.arcsin(R @ axis @ UP)) + float(noise(LEVEL_SIGMA)[0])
            levels.append(Level(f"{frame.kind} {axis}", frame, axis, value, LEVEL_SIGMA))
    spots, readings = [], []
    for i, angle in enumerate(np.radians(TRACE_DEG)):
        xy = spot_of(table, angle, BEAM) + noise(SPOT_SIGMA, 2)
        spots.append(LaserSpot(f"s{i}", "laser", f"laser{i}", "board", xy, SPOT_SIGMA**2 * np.eye(2)))
        angles = np.array([angle, 0.0]) + noise(8 * ARCSEC, 2)
        readings.append(TableReading("turntable", f"laser{i}", angles, (8 * ARCSEC) ** 2 * np.eye(2)))
    cov = np.diag([np.inf] * 3 + [TAPE_SIGMA**2] * 3)
    # the table's place is known to a tape's millimetre; nothing of its rotation but that it is about aligned
    tape = Pose3(Rot3(), table.translation() + table.rotation().matrix() @ noise(TAPE_SIGMA, 3))
    geometry = replace(lab.tables[0].geometry, free=())
    return Survey(
        targets=lab.targets,
        tables=(replace(lab.tables[0], world_from_table=PoseParameter(tape, "prior", cov), geometry=geometry),),
        vertical=Vertical(tilt=VectorParameter(TILT, np.zeros(2), free=TILT)),
        levels=tuple(levels), laser_spots=tuple(spots), table_readings=tuple(readings),
        beams=(Beam("laser", "mount", "turntable"),),
    )  # fmt: skip


def turn_error(pose: Pose3) -> np.ndarray:
    return rotation_log(rotation("C_t^w").T @ pose.rotation().matrix())


def test_levels_and_laser_alone_give_the_alignment_without_images() -> None:
    survey = aligned(None)
    result = adjust(survey)
    assert np.abs(turn_error(result.estimates[TABLE].value)).max() < 1e-9
    np.testing.assert_allclose(result.estimates["beam", "laser"].value, BEAM, atol=1e-9)
    np.testing.assert_allclose(result.estimates["vertical",].value, [-UP[1], UP[0]], atol=2e-8)
    # tilts: a level on each, sqrt(2) of 15 arcsec; yaw: the slope of a line through nine spots of 0.2 mm
    sigma = np.sqrt(np.diag(result.estimates[TABLE].cov))[:3]
    y = np.array([s.xy[1] for s in survey.laser_spots])
    expected = [LEVEL_SIGMA * 2**0.5, LEVEL_SIGMA * 2**0.5, SPOT_SIGMA / np.sqrt(((y - y.mean()) ** 2).sum())]
    np.testing.assert_allclose(sigma, expected, rtol=0.02)


def test_alignment_scatters_as_its_covariance_says() -> None:
    """d' inv(C) d of the rotation over fresh noise, chi-square with three degrees of freedom each."""
    runs, total = size(50, 10), 0.0
    for seed in range(runs):
        estimate = adjust(aligned(seed)).estimates[TABLE]
        d = turn_error(estimate.value)
        total += d @ np.linalg.solve(estimate.cov[:3, :3], d)
    low, high = chi2.ppf([0.0005, 0.9995], 3 * runs)
    assert low < total < high


@pytest.fixture(scope="module")
def images():
    survey, truth = replica(n_table=6, n_hand=3)
    return noisy(survey, truth, 3), truth


def joined(survey: Survey, trace: Survey) -> Survey:
    geometry = survey.tables[0]
    return replace(
        survey, table_readings=survey.table_readings + trace.table_readings, levels=trace.levels, beams=trace.beams,
        laser_spots=trace.laser_spots, vertical=trace.vertical, tables=(geometry,),
    )  # fmt: skip


def test_images_and_alignment_agree_and_are_better_together(images) -> None:
    survey, truth = images
    graph = joint_graph(survey, truth)
    alone = assemble(graph, solve(graph), AdjustOptions())
    trace = aligned(11)
    levelled = adjust(trace)
    together = joined(survey, trace)
    start = StartValues(
        {n[1]: v for n, v in truth.items() if n[0] == "lens"},
        {n: v for n, v in truth.items() if isinstance(v, Pose3)}, {"foot": truth["point", "foot"]},
        {n: v for n, v in truth.items() if n[0] == "table_angles"},
    )  # fmt: skip
    graph = GraphBuilder(together, start.lenses).build(start)
    both = assemble(graph, solve(graph), AdjustOptions())
    a, b, c = (r.estimates[TABLE] for r in (alone, levelled, both))
    d = rotation_log(a.value.rotation().matrix().T @ b.value.rotation().matrix())
    C = a.cov[:3, :3] + b.cov[:3, :3]
    assert d @ np.linalg.solve(C, d) < chi2.ppf(0.999, 3)
    # more observations of the same: nowhere worse than either
    for one in (a.cov[:3, :3], b.cov[:3, :3]):
        assert np.linalg.eigvalsh(one - c.cov[:3, :3]).min() > -1e-12
    error = turn_error(c.value)
    assert error @ np.linalg.solve(c.cov[:3, :3], error) < chi2.ppf(0.999, 3)


def test_without_the_laser_the_yaw_is_open_and_named() -> None:
    survey = replace(aligned(None), laser_spots=(), beams=())
    with pytest.raises(IndeterminateError, match="rotation about world z of the whole survey"):
        adjust(survey)
