"""Pairs of a station's eyes through the command line: against the truth of the simulation, and ready to close."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from adjust.model.observations import ImageBlock
from adjust.model.survey import Camera, LensParameter, PoseParameter, Station, Target
from survey.cli import main
from survey.project import write_project
from tests.adjust.relay_station import EYES, LENS, SIZE, Station4, rigid
from tests.survey.test_converting import tracker_files

RUNS = 5
HELD = PoseParameter(Pose3(), "held")


def _json(capsys, *arguments, code=0):
    capsys.readouterr()
    assert main([*map(str, arguments), "--json", "--quiet"]) == code
    return json.loads(capsys.readouterr().out)


def _project(folder, survey):
    """The survey as a project, without points at the very edge of an image."""
    blocks = []
    for b in survey.image_blocks:
        well = ((b.uv > 2) & (b.uv < np.array(SIZE) - 3)).all(axis=1)
        blocks.append(replace(b, point_idx=b.point_idx[well], uv=b.uv[well], cov=b.cov[well]))
    write_project(folder, replace(survey, image_blocks=tuple(blocks)))


def _read(folder):
    """The pairs of a written project by id: pose and covariance."""
    out = {}
    with (folder / "observations" / "pairs.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            R = Rot3.Quaternion(*(float(row[k]) for k in ("qw", "qx", "qy", "qz")))
            t = np.array([float(row[f"t{a}_mm"]) for a in "xyz"]) / 1e3
            cov = np.zeros((6, 6))
            names = ("rx", "ry", "rz", "tx", "ty", "tz")
            for i in range(6):
                for j in range(i, 6):
                    unit = {0: "rad2", 1: "rad_m", 2: "m2"}[(i >= 3) + (j >= 3)]
                    cov[i, j] = cov[j, i] = float(row[f"cov_{names[i]}_{names[j]}_{unit}"])
            out[row["pair_id"]] = row["a_id"], row["b_id"], Pose3(R, t), cov
    return out


def _sigmas(entry):
    """Of a pair, (6,) arcsec and mm."""
    return np.array([*entry["sigma_rotation_arcsec"], *entry["sigma_translation_mm"]])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Projects of one station with fresh noise, and what the command wrote of each."""
    place, station, out = tmp_path_factory.mktemp("pairs"), Station4(41), []
    for seed in range(RUNS):
        _project(place / f"lab{seed}", station.survey(100 + seed, 0.05))
        arguments = ["pairs", str(place / f"lab{seed}"), "--out", str(place / f"closed{seed}"), "--quiet"]
        assert main(arguments) == 0
        out.append(place / f"closed{seed}")
    return station, out


def test_the_sigmas_of_the_pairs_cover_the_truth(written):
    station, folders = written
    tests = {}
    for folder in folders:
        for name, (a, b, found, cov) in _read(folder).items():
            d = Pose3.Logmap(station.pair(*(end.removeprefix("station:") for end in (a, b))).between(found))
            tests.setdefault(name, []).append(d @ np.linalg.solve(cov, d))
    assert len(tests) == 6
    low, high = chi2.ppf([0.0005 / 6, 1 - 0.0005 / 6], 6 * RUNS)
    for name, found in tests.items():
        assert low < sum(found) < high, name


def test_the_project_is_ready_to_close(written, capsys):
    station, folders = written
    summary = _json(capsys, "adjust", folders[0])["summary"]
    assert summary["converged"]
    assert summary["redundancy"] == 18  # three independent triangles of six equations
    solution = json.loads((folders[0] / "results" / "solution.json").read_text())
    assert solution["loops"]["n_loops"] == 3
    for eye in EYES[1:]:
        pose = solution["stations"][eye]["world_from_station"]
        true = station.pair(eye, EYES[0]).translation()
        np.testing.assert_allclose(pose["translation_mm"], 1e3 * true, atol=1.0)


def test_summary_as_json(written, tmp_path, capsys):
    lab = written[1][0].with_name("lab0")
    found = _json(capsys, "pairs", lab)
    assert found["eyes"] == [f"camera:{e}" for e in EYES]
    assert (found["refused"], found["left_out"], found["written"]) == ([], [], None)
    assert len(found["loops"]) == 4
    assert all(loop["closes"] for loop in found["loops"])
    for pair in found["pairs"].values():
        sizes = [np.linalg.norm(pair[k]["sigma_rotation_arcsec"]) for k in ("alone", "loops_closed", "all_at_once")]
        assert sizes[0] > sizes[1] > sizes[2]
    again = _json(capsys, "pairs", lab, "--out", tmp_path / "joint", "--joint")
    assert again["written"] == str(tmp_path / "joint")
    joint = _read(tmp_path / "joint")
    assert list(joint) == ["a-b", "a-c", "a-d"]
    np.testing.assert_allclose(joint["a-c"][3], found["pairs"]["a-c"]["all_at_once"]["cov"], rtol=1e-6, atol=1e-18)
    assert main(["pairs", str(lab)]) == 0
    said = capsys.readouterr().out
    assert "4 eyes, 6 pairs" in said
    assert "loops: 4 triangles, of which 0 do not close" in said


def _with_block(station, seed, sigma_px, turned=None):
    """The station carries a marker block too, which a camera on the wall watches; ``turned``: moves it at one epoch."""
    survey, rng = station.survey(seed, sigma_px), np.random.default_rng(seed + 1000)
    block = rigid(Rot3.Ypr(0.4, -0.3, 0.2).matrix(), np.array([0.05, -0.1, 0.3]))
    wall = rigid(np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]]), np.array([0.1, 0.0, 2.2]))
    names, K = (
        tuple(f"m{i}" for i in range(len(station.x_in_target))),
        np.array([[LENS[0], 0, LENS[3]], [0, LENS[1], LENS[4]], [0, 0, 1.0]]),
    )
    x, blocks = 0.6 * station.x_in_target, []
    for i, head in enumerate(station.room_from_station):
        seen = np.linalg.inv(wall) @ head @ block
        if turned == i:
            seen = seen @ rigid(Rot3.Rz(0.02).matrix(), np.zeros(3))
        uv = cv2.projectPoints(x, cv2.Rodrigues(seen[:3, :3])[0], seen[:3, 3], K, LENS[5:13])[0].reshape(-1, 2)
        cov = np.broadcast_to(np.eye(2) * sigma_px**2, (len(x), 2, 2))
        noisy = uv + rng.normal(0, sigma_px, uv.shape)
        blocks.append(ImageBlock("wall", f"e{i}", "block", np.arange(len(x)), noisy, cov))
    return block, replace(
        survey,
        cameras=(*survey.cameras, Camera("wall", "tripod", SIZE, LensParameter("brown", (), LENS), HELD)),
        stations=(*survey.stations, Station("tripod", "fixed")),
        targets=(*survey.targets, Target("block", names, x, station_id="relay")),
        image_blocks=(*survey.image_blocks, *blocks),
    )


def test_a_marker_block_is_one_more_eye(tmp_path):
    station, total, n = Station4(43), 0.0, 2
    for seed in range(n):
        truth, survey = _with_block(station, 300 + seed, 0.05)
        _project(tmp_path / f"lab{seed}", survey)
        arguments = ["pairs", str(tmp_path / f"lab{seed}"), "--out", str(tmp_path / f"out{seed}"), "--quiet"]
        assert main(arguments) == 0
        found = _read(tmp_path / f"out{seed}")
        assert len(found) == 10
        true = Pose3(np.linalg.inv(truth) @ station.station_from_eye[0])
        d = Pose3.Logmap(true.between(found["a-block"][2]))
        total += d @ np.linalg.solve(found["a-block"][3], d)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * n)
    assert low < total < high


def test_an_epoch_at_which_the_block_was_touched_is_left_out(tmp_path, capsys):
    _, survey = _with_block(Station4(43), 310, 0.05, turned=4)
    _project(tmp_path / "lab", survey)
    found = _json(capsys, "pairs", tmp_path / "lab")
    assert len(found["left_out"]) == 1
    assert "e4" in found["left_out"][0]


def test_trajectories_in_the_folder(tmp_path, capsys):
    folder = tmp_path / "walk"
    (folder / "trajectories").mkdir(parents=True)
    turns = [Rotation.identity(), Rotation.from_rotvec([0.1, 0.5, -0.2]), Rotation.from_rotvec([0.9, 0.0, 0.3])]
    levers = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.05], [0.0, 0.15, -0.1]])
    tracker_files(folder / "trajectories", turns, levers)
    found = _json(capsys, "pairs", folder, "--out", tmp_path / "out")
    assert len(found["pairs"]) == 3
    assert main(["adjust", str(tmp_path / "out"), "--quiet"]) == 0
    capsys.readouterr()
    adjusted = json.loads((tmp_path / "out" / "results" / "solution.json").read_text())["pairs"]
    small = [_sigmas(p["loops_closed"]) / _sigmas(adjusted[name]["adjusted"]) for name, p in found["pairs"].items()]
    assert 1.1 < np.sqrt(np.mean(np.square(small))) < 1.5  # not by sigma0, which is a tenth here
    (said,) = found["warnings"]
    factor = float(re.search(r"are ([\d.]+) times too small", said)[1])
    assert np.sqrt(np.mean(np.square(small))) == pytest.approx(factor, rel=0.03)
    assert not _json(capsys, "pairs", folder, "--out", tmp_path / "star", "--joint")["warnings"]
    written = _read(tmp_path / "out")
    assert len(written) == 3
    for name, (_, _, pose, _) in written.items():
        a, b = ("abc".index(e) for e in name.split("-"))
        true = (turns[b].inv() * turns[a]).as_matrix()
        assert np.linalg.norm(Rot3.Logmap(Rot3(true).between(pose.rotation()))) < 1e-3


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--station", "cellar"], 1, "station 'cellar' has no camera; those with cameras are relay"),
        (["--joint"], 2, "--joint says what is written; name --out DIR too"),
    ],
)
def test_what_cannot_be_done_is_named(written, arguments, code, said, capsys):
    lab = str(written[1][0].with_name("lab0"))
    if code == 2:
        with pytest.raises(SystemExit) as stopped:
            main(["pairs", lab, *arguments])
        assert stopped.value.code == 2
    else:
        assert main(["pairs", lab, *arguments]) == code
    assert said in capsys.readouterr().err


def test_nothing_is_overwritten(written, tmp_path, capsys):
    lab, there = written[1][0].with_name("lab0"), tmp_path / "there"
    there.mkdir()
    (there / "notes.txt").write_text("mine")
    assert main(["pairs", str(lab), "--out", str(there)]) == 1
    assert "there" in capsys.readouterr().err
    assert [p.name for p in Path(there).iterdir()] == ["notes.txt"]
