"""Pose networks between g2o files and project folders, and trajectories of trackers, through the commands."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from survey.cli import main
from survey.commands.converting import FORMATS
from survey.jobs.converting import READERS, WRITERS
from survey.project import read


def test_formats_of_the_command_are_those_that_are_read_or_written():
    assert set(FORMATS) == {*READERS, *WRITERS, "project"}


def _lines(n=5, seed=1, noise=1e-3):
    """A ring with one chord as the words of a g2o file; vertex 3 is the one that FIX names."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(n, rng), rng.uniform(-5, 5, (n, 3))
    rows = [("VERTEX_SE3:QUAT", str(i), *t[i], *R[i].as_quat()) for i in range(n)]
    for i, j in [*((i, (i + 1) % n) for i in range(n)), (0, 2)]:
        turn = R[i].inv() * R[j] * Rotation.from_rotvec(noise * rng.standard_normal(3))
        step = R[i].inv().apply(t[j] - t[i]) + noise * rng.standard_normal(3)
        A = rng.normal(size=(6, 6))
        info = 1e6 * (A @ A.T + 3 * np.eye(6))
        rows.append(("EDGE_SE3:QUAT", str(i), str(j), *step, *turn.as_quat(), *info[np.triu_indices(6)]))
    return rows


def _write(path, rows):
    path.write_text("".join(" ".join(map(str, row)) + "\n" for row in rows), encoding="utf-8")
    return path


def _parsed(path):
    """Numbers by kind and ids, quaternions with a positive last component."""
    out = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        k = {"VERTEX_SE3:QUAT": 2, "EDGE_SE3:QUAT": 3, "FIX": 2}[words[0]]
        row = np.array(words[k:], dtype=float)
        if len(row) and row[6] < 0:
            row[3:7] *= -1
        out[tuple(words[:k])] = row
    return out


@pytest.mark.parametrize("information", ["tangent", "quaternion"])
def test_there_and_back_nothing_changes(tmp_path, information, capsys):
    source = _write(tmp_path / "ring.g2o", [*_lines(), ("FIX", "3")])
    flag = ["--information", information]
    assert main(["convert", str(source), str(tmp_path / "ring"), *flag]) == 0
    assert "5 stations" in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "ring"), str(tmp_path / "back.g2o"), *flag, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["format"], said["stations"], said["pairs"], said["left_out"]) == ("g2o", 5, 6, [])
    old, new = _parsed(source), _parsed(tmp_path / "back.g2o")
    assert set(old) == set(new)
    for key, row in old.items():
        np.testing.assert_allclose(new[key], row, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(row).max(initial=0.0)))


def test_a_project_holds_the_first_station_and_is_what_the_words_say(tmp_path):
    rows = _lines()
    assert main(["convert", str(_write(tmp_path / "a.g2o", rows)), str(tmp_path / "a")]) == 0
    survey = read(tmp_path / "a").survey
    treatments = {s.station_id: s.world_from_station.treatment for s in survey.stations}
    assert treatments == {"0": "held", "1": "free", "2": "free", "3": "free", "4": "free"}
    edge = next(row for row in rows if row[:3] == ("EDGE_SE3:QUAT", "1", "2"))
    pair = next(p for p in survey.pairs if p.pair_id == "1-2")
    # the edge i j holds i_from_j
    assert (pair.a.frame_id, pair.b.frame_id) == ("2", "1")
    np.testing.assert_allclose(pair.b_from_a.translation(), edge[3:6], atol=1e-12)
    # translations first in g2o, rotations first here
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = edge[10:]
    info = upper + np.triu(upper, 1).T
    np.testing.assert_allclose(np.linalg.inv(pair.cov)[3:, 3:], info[:3, :3], rtol=1e-8)
    np.testing.assert_allclose(np.linalg.inv(pair.cov)[:3, 3:], info[3:, :3], rtol=1e-7)


@pytest.mark.slow
def test_an_adjusted_project_gives_its_adjusted_poses(tmp_path, capsys):
    source = _write(tmp_path / "a.g2o", _lines())
    assert main(["convert", str(source), str(tmp_path / "a")]) == 0
    main(["adjust", str(tmp_path / "a"), "--quiet"])
    capsys.readouterr()
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "out"), "--format", "g2o"]) == 0
    assert "(adjusted)" in capsys.readouterr().out
    found = json.loads((tmp_path / "a/results/solution.json").read_text())["stations"]
    new, old = _parsed(tmp_path / "out"), _parsed(source)
    for i in range(5):
        x_mm = found[str(i)]["world_from_station"]["translation_mm"]
        np.testing.assert_allclose(1e3 * new["VERTEX_SE3:QUAT", str(i)][:3], x_mm, atol=1e-9)
    far = max(np.abs(new[k] - old[k]).max() for k in old if k[0] == "VERTEX_SE3:QUAT")
    assert 1e-5 < far < 1e-2


def test_what_is_there_is_not_replaced_and_what_cannot_be_held_is_refused(tmp_path, capsys):
    source = _write(tmp_path / "a.g2o", _lines())
    folder = tmp_path / "a"
    assert main(["convert", str(source), str(folder)]) == 0
    before = (folder / "survey.toml").read_bytes()
    assert main(["convert", str(source), str(folder)]) == 1
    assert "there is a project already" in capsys.readouterr().err
    assert (folder / "survey.toml").read_bytes() == before
    assert main(["convert", str(folder), str(source)]) == 1
    assert "is there already" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "none.g2o"), str(tmp_path / "b")]) == 1
    assert "no such file" in capsys.readouterr().err
    distances = "distance_id,from_id,to_id,value_mm,sigma_mm\nd,station:0,station:1,1000,1\n"
    (folder / "observations/distances.csv").write_text(distances)
    assert main(["convert", str(folder), str(tmp_path / "c.g2o")]) == 1
    assert "nothing but poses of fixed stations" in capsys.readouterr().err
    assert not (tmp_path / "c.g2o").exists()


@pytest.mark.slow
def test_names_and_unused_pairs_are_said_to_be_lost(tmp_path, capsys):
    folder = tmp_path / "a"
    assert main(["convert", str(_write(tmp_path / "a.g2o", _lines())), str(folder)]) == 0
    for path in (folder / "survey.toml", folder / "observations/pairs.csv"):
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace("stations.4", "stations.tripod").replace("station:4", "station:tripod"))
    assert main(["remove", str(folder), "0-2", "--quiet"]) in (0, 3)
    capsys.readouterr()
    assert main(["convert", str(folder), str(tmp_path / "b.g2o"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["pairs"] == 5
    assert said["left_out"][0] == "left out, pairs not in use: 0-2"
    assert "tripod" in said["left_out"][1]


def tracker_files(folder, turns, levers):
    """Files of trackers on one station that is carried about: time, position, quaternion."""
    rng, t = np.random.default_rng(3), np.arange(0.0, 40.0, 0.1)
    f = np.array([[0.31, 0.47, 0.73], [0.23, 0.37, 0.59]])
    body = Rotation.from_rotvec(0.6 * np.sin(2 * np.pi * f[0] * t[:, None] / 2 + [0.1, 0.9, 2.0]))
    x = 0.5 * np.sin(2 * np.pi * f[1] * t[:, None] / 2 + [0.5, 1.5, 2.5])
    paths = []
    for name, turn, lever in zip("abc", turns, levers, strict=True):
        eye = body * turn * Rotation.from_rotvec(1e-4 * rng.standard_normal((len(t), 3)))
        place = x + body.apply(lever) + 1e-4 * rng.standard_normal((len(t), 3))
        rows = np.column_stack([t, place, eye.as_quat()])
        paths.append(folder / f"{name}.csv")
        np.savetxt(paths[-1], rows, delimiter=",", fmt="%.12g")
    return paths


@pytest.mark.slow
def test_trackers_are_joined(tmp_path, capsys):
    turns = [Rotation.identity(), Rotation.from_rotvec([0.1, 0.5, -0.2]), Rotation.from_rotvec([0.9, 0.0, 0.3])]
    levers = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.05], [0.0, 0.15, -0.1]])
    paths = tracker_files(tmp_path, turns, levers)
    assert main(["trackers", *map(str, paths), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert "clock of b: " in capsys.readouterr().out
    header, *rows = (tmp_path / "out/pairs.csv").read_text().splitlines()
    row = next(r for r in (dict(zip(header.split(","), line.split(","), strict=True)) for line in rows)
               if {r["a_id"], r["b_id"]} == {"camera:a", "camera:b"})  # fmt: skip
    b_from_a = turns[1].inv() if row["a_id"] == "camera:a" else turns[1]
    found = Rotation.from_quat([float(row[c]) for c in ("qx", "qy", "qz", "qw")])
    assert (found * b_from_a.inv()).magnitude() < 1e-3
    assert main(["trackers", str(paths[0]), str(tmp_path / "none.csv"), "--quiet"]) == 1
    assert "cannot be read" in capsys.readouterr().err
