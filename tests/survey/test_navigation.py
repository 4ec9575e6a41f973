"""The job behind ``labsurvey navigate``, on a simulated laboratory written to a folder."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.jobs.navigating.job import NavigateRequest, navigate_job
from survey.project import SpotBlock, write_project
from survey.simulate import Scene, beacons


@pytest.fixture(scope="module")
def lab():
    return beacons(seed=4, n_table_epochs=5, n_free_epochs=4, n_night_epochs=8)


@pytest.fixture
def folder(lab, tmp_path):
    write_project(tmp_path / "lab", lab[0])
    return tmp_path / "lab"


@pytest.fixture
def unnamed(lab, tmp_path):
    survey, _ = lab
    blocks = [b for b in survey.image_blocks if b.target_id is not None]
    spots = [
        SpotBlock(b.camera_id, b.epoch_id, tuple(f"s{i}" for i in range(len(b.uv))), b.uv[::-1], b.cov[::-1])
        for b in survey.image_blocks
        if b.target_id is None
    ]
    write_project(tmp_path / "dark", replace(survey, image_blocks=tuple(blocks)), spots=spots)
    return tmp_path / "dark"


def _distances(outcome, lab):
    """Squared error in sigmas of every pose against the truth."""
    scene, out = Scene(*lab), []
    for epoch in outcome.trajectory.epochs:
        true = Pose3(scene.world_from_station("head", epoch.epoch_id))
        between = epoch.world_from_station.between(true)
        d = np.concatenate([Rot3.Logmap(between.rotation()), between.translation()])
        out.append(d @ np.linalg.solve(epoch.cov, d))
    return np.array(out)


@pytest.mark.slow
@pytest.mark.parametrize("use_table", [True, False])
def test_named_spots(folder, lab, use_table):
    outcome = navigate_job(folder, NavigateRequest(use_table=use_table), progress=False)
    assert len(outcome.trajectory.epochs) == 8
    if use_table:
        # 8 poses of six components that share one calibration
        assert {e.status for e in outcome.trajectory.epochs} <= {"fixed", "bridged"}
        assert _distances(outcome, lab).max() < 30.0
    else:
        assert all(e.status != "bridged" for e in outcome.trajectory.epochs)
        assert any(e.undetermined for e in outcome.trajectory.epochs if e.n_beacons < 3) or all(
            e.n_beacons >= 3 for e in outcome.trajectory.epochs
        )


@pytest.mark.slow
def test_table_names_the_spots(unnamed, lab):
    outcome = navigate_job(unnamed, progress=False)
    truth = {(b.camera_id, b.epoch_id): b for b in lab[0].image_blocks if b.target_id is None}
    names = [p.point_id for p in lab[0].points]
    known = set(outcome.calibration.beacons.beacon_ids)
    checked = 0
    for epoch in outcome.trajectory.epochs:
        cameras = [c for c, e in truth if e == epoch.epoch_id]
        for camera, labels in zip(cameras, epoch.labels, strict=True):
            expected = [names[i] for i in truth[camera, epoch.epoch_id].point_idx[::-1]]
            assert all(a in (None, b) for a, b in zip(labels, expected, strict=True))
            checked += sum(a == b for a, b in zip(labels, expected, strict=True) if b in known)
    assert checked > 10
    assert _distances(outcome, lab).max() < 30.0


def test_files_and_summary(folder, capsys):
    assert main(["navigate", str(folder), "--quiet", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    with open(folder / "results/trajectory.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == summary["epochs"] == 8
    assert float(rows[0]["sigma_x_mm"]) > 0
    assert rows[0]["labels"].count(":") >= 1
    entries = json.loads((folder / "results/trajectory.json").read_text())["epochs"]
    cov = np.array(entries[rows[0]["epoch_id"]]["covariance"])
    assert np.linalg.eigvalsh(cov)[0] > 0
    sigma = np.degrees(np.sqrt(np.diag(cov)[:3])) * 3600
    assert float(rows[0]["sigma_rx_arcsec"]) == pytest.approx(sigma[0])


def test_quiet_says_nothing_and_text_counts(folder, capsys):
    assert main(["navigate", str(folder), "--quiet"]) == 0
    found = capsys.readouterr()
    assert found.err == ""
    assert "8 poses of head" in found.out


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (NavigateRequest(epochs=("nowhere",)), "no beacon was observed at epoch nowhere"),
        (NavigateRequest(station="cellar"), "no camera is on station 'cellar'"),
    ],
)
def test_what_is_not_there_is_named(folder, request_, words):
    with pytest.raises(SurveyError, match=words):
        navigate_job(folder, request_, progress=False)


def _table_of_times(folder, rows):
    path = folder / "times.csv"
    path.write_text("\n".join(["epoch_id,time_s", *(f"{e},{t}" for e, t in rows)]) + "\n")
    return path


def test_epochs_come_in_the_order_of_their_times(folder):
    names = [f"n{i + 1:02d}" for i in range(8)]
    order = [3, 0, 1, 2, 7, 6, 5, 4]
    path = _table_of_times(folder, [(names[k], 0.5 * i + 0.1 * i * i) for i, k in enumerate(order)])
    outcome = navigate_job(folder, NavigateRequest(times=path), progress=False)
    assert [e.epoch_id for e in outcome.trajectory.epochs] == [names[k] for k in order]
    assert {e.status for e in outcome.trajectory.epochs} <= {"fixed", "bridged"}


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([("n01", 0.0)], "no time for epoch n02, n03, n04, n05, n06"),
        ([("n01", 0.0), ("n01", 1.0)], "times.csv:3: epoch 'n01' is there twice"),
        ([("n01", "soon")], "times.csv:2: epoch 'n01' has the time 'soon', give seconds"),
        ([(f"n{i + 1:02d}", 1.0) for i in range(8)], "have the same time"),
        ([], "the columns epoch_id and time_s are needed"),
    ],
)
def test_bad_times_are_named(folder, rows, words):
    with pytest.raises(SurveyError, match=words):
        navigate_job(folder, NavigateRequest(times=_table_of_times(folder, rows)), progress=False)


def _poses(outcome):
    return np.array([e.world_from_station.matrix() for e in outcome.trajectory.epochs])


@pytest.mark.slow
def test_calibration_is_used_again_until_something_changes(folder, capsys):
    first = navigate_job(folder, progress=False)
    again = navigate_job(folder, progress=False)
    assert (first.calibration.reused, again.calibration.reused) == (False, True)
    np.testing.assert_array_equal(_poses(first), _poses(again))
    for a, b in zip(first.trajectory.epochs, again.trajectory.epochs, strict=True):
        np.testing.assert_array_equal(a.cov, b.cov)
    assert "has not changed" in again.text()
    fewer = NavigateRequest(epochs=tuple(e.epoch_id for e in first.trajectory.epochs[:3]))
    readings = folder / "observations/table_angles.csv"
    text = readings.read_text().splitlines()
    header, row = text[0].split(","), text[1].split(",")
    k = next(i for i, name in enumerate(header) if name.startswith("axis1"))
    row[k] = repr(float(row[k]) + 1e-4)
    readings.write_text("\n".join([text[0], ",".join(row), *text[2:]]) + "\n")
    assert not navigate_job(folder, fewer, progress=False).calibration.reused


def test_epochs_that_were_not_asked_for_take_no_part(folder):
    """One epoch alone has the calibration, and the pose, that it has among all."""
    every = navigate_job(folder, progress=False)
    for epoch in every.trajectory.epochs[:2]:
        alone = navigate_job(folder, NavigateRequest(epochs=(epoch.epoch_id,)), progress=False)
        assert alone.calibration.reused
        assert "not asked for" not in alone.text()
        np.testing.assert_array_equal(alone.trajectory.epochs[0].world_from_station.matrix(),
                                      epoch.world_from_station.matrix())  # fmt: skip


def test_epochs_that_calibrate_all_the_same_are_named(lab, tmp_path):
    """A camera that shows no target has its place on the head from beacons alone."""
    survey, truth = lab
    cameras = tuple(
        replace(c, lens=replace(c.lens, values=truth["lens", c.camera_id], free=())) for c in survey.cameras
    )
    blocks = tuple(b for b in survey.image_blocks if b.target_id is None or b.camera_id != "Y")
    write_project(tmp_path / "lab", replace(survey, cameras=cameras, image_blocks=blocks))
    outcome = navigate_job(tmp_path / "lab", NavigateRequest(epochs=("n01",)), progress=False)
    assert "epochs that were not asked for (n02, n03" in outcome.text()


@pytest.mark.slow
def test_damaged_calibration_is_made_anew(folder):
    navigate_job(folder, progress=False)
    path = folder / "results/navigation_calibration.npz"
    path.write_bytes(path.read_bytes()[:100])
    assert not navigate_job(folder, progress=False).calibration.reused
