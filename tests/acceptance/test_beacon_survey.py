"""Beacons surveyed by the cameras themselves: nothing is known of them, scale and datum come from what is given."""

import json
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.stats import chi2

from adjust.adjustment import adjust
from adjust.lenses.models import MODELS
from adjust.model.observations import Distance, FrameRef, ImageBlock, PositionRef
from adjust.model.survey import Camera, LensParameter, Point, PoseParameter, Station, Survey
from survey.cli import FAILED, main
from survey.project import write_project
from survey.simulate import beacons, resample

SIGMA_PX = 0.1


def held(pose):
    return PoseParameter(pose, "held")


@pytest.fixture(scope="module")
def known_head():
    """A calibrated head on a table of known axes among ten beacons nobody has measured: the baselines are the scale."""
    survey, truth = beacons(4, n_table_epochs=5, n_free_epochs=3, n_night_epochs=8)
    blocks = tuple(b for b in survey.image_blocks if b.target_id is None)
    epochs = {b.epoch_id for b in blocks}
    table = replace(survey.tables[0], world_from_table=held(truth["world_from_table", "turntable"]), geometry=replace(
        survey.tables[0].geometry, values=truth["table_geometry", "turntable"], free=()))  # fmt: skip
    cameras = tuple(
        replace(c, lens=replace(c.lens, values=truth["lens", c.camera_id], free=()),
                station_from_camera=held(truth["station_from_camera", c.camera_id]))
        for c in survey.cameras
    )  # fmt: skip
    readings = tuple(r for r in survey.table_readings if r.epoch_id in epochs)
    return replace(survey, cameras=cameras, tables=(table,), targets=(), image_blocks=blocks, table_readings=readings,
                   coordinates=(), distances=()), truth  # fmt: skip


def squared_error(result, truth):
    """d' inv(C) d of all points together, and its dimension."""
    names = [("point", p.point_id) for p in result.survey.points]
    d = np.concatenate([result.estimates[n].value - truth[n] for n in names])
    return float(d @ np.linalg.solve(result.precision.joint(names), d)), len(d)


def test_from_the_table_and_the_baselines_of_the_head(known_head):
    survey, truth = known_head
    total, dims = 0.0, 0
    for seed in range(8):
        square, n = squared_error(adjust(resample(survey, truth, seed)), truth)
        total, dims = total + square, dims + n
    low, high = chi2.ppf([1e-3, 1 - 1e-3], dims)
    assert low < total < high


def test_through_the_command_line(known_head, tmp_path):
    survey, truth = known_head
    write_project(tmp_path, survey)
    assert main(["adjust", str(tmp_path), "--quiet"]) != FAILED
    points = json.loads((tmp_path / "results" / "solution.json").read_text())["points"]
    assert set(points) == {p.point_id for p in survey.points}
    for name, p in points.items():
        error = np.array([p["x_mm"], p["y_mm"], p["z_mm"]]) - 1e3 * truth["point", name]
        sigma = np.array([p["sigma_x_mm"], p["sigma_y_mm"], p["sigma_z_mm"]])
        assert np.all(np.abs(error) < 5.0 * sigma)


def three_tripods(seed, tape):
    """Three cameras that stand still around 24 points; one is held, nothing else is known but, perhaps, a distance."""
    rng = np.random.default_rng(seed)
    lens = np.zeros(len(MODELS["brown"].names))
    lens[[0, 1, 3, 4]] = 1500.0, 1500.0, 639.5, 511.5
    x = rng.uniform(-0.8, 0.8, (24, 3)) + (0.0, 0.0, 4.0)
    places = [Pose3(), Pose3(Rot3.Ry(-0.5), np.array([2.0, 0.1, 0.3])), Pose3(Rot3.Ry(0.5), np.array([-2.0, 0.2, 0.4]))]
    blocks = []
    for i, pose in enumerate(places):
        p = np.array([pose.transformTo(q) for q in x])
        uv = 1500.0 * p[:, :2] / p[:, 2:] + (639.5, 511.5) + rng.normal(0.0, SIGMA_PX, (24, 2))
        blocks.append(ImageBlock(f"c{i}", "all", None, np.arange(24), uv, np.tile(SIGMA_PX**2 * np.eye(2), (24, 1, 1))))
    ends = [PositionRef(frame=FrameRef("station", s)) for s in ("s0", "s1")]
    distance = float(np.linalg.norm(places[1].translation())) + rng.normal(0.0, 3e-4)
    survey = Survey(
        cameras=tuple(Camera(f"c{i}", f"s{i}", (1280, 1024), LensParameter("brown", (), lens), held(Pose3()))
                      for i in range(3)),
        stations=tuple(Station(f"s{i}", "fixed", held(Pose3()) if i == 0 else PoseParameter()) for i in range(3)),
        points=tuple(Point(f"P{k:02d}") for k in range(24)),
        image_blocks=tuple(blocks),
        distances=(Distance("tape", *ends, distance, 3e-4),) if tape else (),
    )  # fmt: skip
    return survey, {("point", f"P{k:02d}"): x[k] for k in range(24)}


def test_scale_from_one_taped_distance():
    total, dims = 0.0, 0
    for seed in range(6):
        survey, truth = three_tripods(seed, tape=True)
        square, n = squared_error(adjust(survey), truth)
        total, dims = total + square, dims + n
    low, high = chi2.ppf([1e-3, 1 - 1e-3], dims)
    assert low < total < high


def test_missing_scale_is_refused_by_name(tmp_path, capsys):
    survey, _ = three_tripods(1, tape=False)
    write_project(tmp_path, survey)
    assert main(["adjust", str(tmp_path), "--quiet"]) == FAILED
    error = capsys.readouterr().err
    assert "scale" in error
    assert "distance" in error
