"""The published step-by-step methods through the command line, beside the joint adjustment."""

import csv
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.solver import solve
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import PoseParameter
from adjust.published import compare_head
from adjust.published.relay import PaperOptions, adjusted_covariances, euler_covariances, paper_iteration
from adjust.relay.network import network_from_pairs
from adjust.spatial.rigid import rotation_log
from survey.cli import main
from survey.project import write_project
from tests.acceptance.mfns_replica import joint_graph, noisy, replica
from tests.sizes import size


def _json(capsys, *arguments, code=0):
    capsys.readouterr()
    assert main([*map(str, arguments), "--json", "--quiet"]) == code
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def paper():
    return replica()


@pytest.fixture(scope="module")
def lab(paper, tmp_path_factory):
    survey, truth = paper
    folder = tmp_path_factory.mktemp("published") / "lab"
    write_project(folder, noisy(survey, truth, 3), title="Head")
    assert main(["adjust", str(folder), "--method", "published", "--quiet"]) == 0
    return folder


def _solution(folder):
    return json.loads((folder / "results" / "solution.json").read_text())


def test_every_number_of_the_head_stands_beside_the_joint_one(lab):
    solution = _solution(lab)
    found = solution["published"]["head"]
    assert found["main_camera"] == "Z"
    assert set(found["poses"]) == {"world_from_table/turntable", *(f"mount_from_camera/{k}" for k in "XYZ")}
    table, joint = found["poses"]["world_from_table/turntable"], solution["tables"]["turntable"]["world_from_table"]
    for i, axis in enumerate("xyz"):
        assert table[f"t{axis}"]["joint_mm"] == pytest.approx(joint["translation_mm"][i])
        assert table[f"t{axis}"]["joint_sigma_mm"] == pytest.approx(joint["sigma_translation_mm"][i])
        assert table[f"r{axis}"]["joint_deg"] == pytest.approx(joint["rotation_euler_xyz_deg"][i])
        assert table[f"r{axis}"]["joint_sigma_arcsec"] == pytest.approx(joint["sigma_rotation_arcsec"][i])
    for entries in found["poses"].values():
        for name, entry in entries.items():
            unit = "arcsec" if name[0] == "r" else "mm"
            # the steps use the same observations and are not the best estimate
            assert entry["sigma_ratio"] > 0.95
            assert abs(entry[f"difference_{unit}"]) < 4.5 * entry[f"published_sigma_{unit}"]
    # gamma and psi hang on the small turns about the auxiliary axis alone
    assert table["rz"]["sigma_ratio"] > 20.0
    assert "pairs" in solution["published"]["not_run"]
    assert "--method published" in solution["inputs"]["command"]


def test_report_and_terminal_show_it(lab, tmp_path, capsys):
    capsys.readouterr()
    assert main(["adjust", str(lab), "--method", "published", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"table turntable rz deg +-?\d+\.\d+ +\d+\.\d +\d+\.\d +-?\d+\.\d+ +\d+\.\d +\d+\.\d", said)
    assert len(re.findall(r"camera [XYZ] [rt][xyz] (?:deg|mm) ", said)) == 18
    page = (tmp_path / "out" / "results" / "report.html").read_text()
    part = re.search(r'<section id="published">.*?</section>', page, re.S)[0]
    assert part.count("<tr") == 1 + 24
    assert main(["adjust", str(lab), "--out", str(tmp_path / "plain"), "--quiet"]) == 0
    assert 'id="published"' not in (tmp_path / "plain" / "results" / "report.html").read_text()
    assert "published" not in _solution(tmp_path / "plain")


def test_sigmas_through_all_steps_cover_the_truth(paper):
    survey, truth = paper
    runs, squares, claimed = size(6, 3), [], []
    for seed in range(runs):
        graph = joint_graph(noisy(survey, truth, 500 + seed), truth)
        found = compare_head(assemble(graph, solve(graph), AdjustOptions()))
        d, sigma, own = [], [], []
        for pose in found.poses:
            true = truth["world_from_table", "turntable"]
            if pose.name[0] == "mount_from_camera":
                true = truth["mount_from_station", "head"].compose(truth["station_from_camera", pose.name[1]])
            turn = rotation_log(true.rotation().matrix().T @ pose.published.rotation().matrix())
            d.append(np.concatenate([turn, pose.published.translation() - true.translation()]))
            sigma.append(pose.sigma)
            own.append(pose.claimed)
        squares.append((np.concatenate(d) / np.concatenate(sigma)) ** 2)
        claimed.append((np.concatenate(d) / np.concatenate(own)) ** 2)
    total = np.sum(squares, axis=0)
    low, high = chi2.ppf([0.0005 / 24, 1 - 0.0005 / 24], runs)
    assert np.all((low < total) & (total < high))
    assert np.sum(claimed) > 3.0 * chi2.ppf(0.9995, 24 * runs)  # what the steps claim does not


def _turned_frames(survey, world, mount):
    """The same observations with other names of the axes of world, table and body."""
    to_world = Pose3(Rot3(world), np.zeros(3))
    table = replace(survey.tables[0], axes=("y", "x"))
    station = survey.stations[0]
    given = station.mount_from_station.value
    turned = PoseParameter(
        Pose3(given.rotation(), mount @ given.translation()), "prior", np.diag(
            [1e-16, 1e-16, 1e-16, np.inf, 1e-16, 1e-16]),
    )  # fmt: skip
    board = replace(survey.targets[0], carrier_from_target=PoseParameter(to_world, "held"))
    point = survey.points[0]
    foot = replace(point, x_in_world=replace(point.x_in_world, value=world @ point.x_in_world.value))
    return replace(
        survey, tables=(table,), stations=(replace(station, mount_from_station=turned),), targets=(board,),
        points=(foot,),
    )  # fmt: skip


def test_axes_of_other_names_give_the_same(paper, tmp_path, capsys):
    """x, y, z of world and table are names; a survey whose outer axis is y and inner axis x is calibrated alike."""
    survey, truth = paper
    given = noisy(survey, truth, 3)
    mount = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # x -> y, y -> z, z -> x
    world = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    ratios = []
    for name, its in (("as", given), ("other", _turned_frames(given, world, mount))):
        write_project(tmp_path / name, its)
        poses = _json(capsys, "adjust", tmp_path / name, "--method", "published")["published"]["head"]["poses"]
        ratios.append({k: [x[f"published_sigma_{'arcsec' if n[0] == 'r' else 'mm'}"] for n, x in e.items()]
                       for k, e in poses.items()})  # fmt: skip
    for k in "XYZ":  # rotations about the axes of the camera, places along those of the mount
        np.testing.assert_allclose(ratios[1][f"mount_from_camera/{k}"][:3], ratios[0][f"mount_from_camera/{k}"][:3],
                                   rtol=0.02)  # fmt: skip
        places = np.abs(mount) @ ratios[0][f"mount_from_camera/{k}"][3:]
        np.testing.assert_allclose(ratios[1][f"mount_from_camera/{k}"][3:], places, rtol=0.02)


def _copy(lab, tmp_path):
    folder = tmp_path / "lab"
    shutil.copytree(lab, folder, ignore=shutil.ignore_patterns("results"))
    return folder


def test_what_a_project_lacks_is_named(lab, tmp_path, capsys):
    folder = _copy(lab, tmp_path)
    table = folder / "observations" / "table_angles.csv"
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:  # no image with the inner axis alone or the outer axis alone turned
        row["axis1_deg"] = repr(float(row["axis1_deg"]) + 1.0)
        row["axis2_deg"] = repr(float(row["axis2_deg"]) + 1.0)
    with table.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    before = sorted(p.name for p in folder.rglob("*"))
    assert main(["adjust", str(folder), "--method", "published", "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "the published methods cannot be run on this project" in said
    assert re.search(r"camera Z has 0 and 0, and is \d\.\d deg off the axes", said)
    assert "they need measured pairs in use: observations/pairs.csv" in said
    assert sorted(p.name for p in folder.rglob("*")) == before
    assert main(["adjust", str(folder), "--quiet"]) in (0, 3)


def test_a_batch_has_no_published_method(lab, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["adjust", str(lab), str(lab) + "/..", "--method", "published"])
    assert stopped.value.code == 2
    assert "--method published needs a single FOLDER" in capsys.readouterr().err


def test_pairs_by_the_published_iteration(tmp_path, capsys):
    folder = tmp_path / "relay"
    assert main(["example", "relay", str(folder), "--quiet"]) == 0
    found = _json(capsys, "adjust", folder, "--method", "published")["published"]
    assert "stations with motion table: none" in found["not_run"]["head"]
    assert found["pairs"]["n_loops"] == 30
    assert found["pairs"]["steps"]["weighted"]["iterations"] <= 4
    joint = _solution(folder)["pairs"]
    truth = json.loads((folder / "truth.json").read_text())["parameters"]
    total, equal, n = 0.0, 0.0, 0
    for name, entry in found["pairs"]["pairs"].items():
        assert entry["joint"]["sigma_rotation_arcsec"] == joint[name]["adjusted"]["sigma_rotation_arcsec"]
        a, b = (
            Rotation.from_quat(np.roll(truth[f"world_from_station/{s}"]["rotation_quaternion_wxyz"], -1))
            for s in name.split("-")
        )
        for how in ("weighted", "equal_weights"):
            R = Rotation.from_euler("xyz", entry[how]["rotation_euler_xyz_deg"], degrees=True)
            d = ((b.inv() * a).inv() * R).as_rotvec() * 180 / np.pi * 3600
            sigma = np.array(entry[how]["sigma_rotation_arcsec"])
            if how == "weighted":
                total, n = total + np.sum((d / sigma) ** 2), n + 3
            else:
                equal += np.sum((d / sigma) ** 2)
        # whole poses say more than rotations alone
        assert np.all(np.array(entry["weighted"]["sigma_rotation_arcsec"]) > 0.98 * np.array(
            entry["joint"]["sigma_rotation_arcsec"]))  # fmt: skip
    # correlated components: their mean square is 1 within a factor of some
    assert 0.6 < total / n < 1.6
    assert 0.6 < equal / n < 1.6


def test_covariances_of_the_published_iteration_are_its_scatter():
    """Four stations, all pairs, unequal covariances: also where the weights are equal."""
    rng = np.random.default_rng(8)
    stations = [Rotation.from_rotvec(rng.uniform(-1.2, 1.2, 3)) for _ in range(4)]
    sigma = np.radians(np.array([0.02, 0.05, 0.03, 0.08, 0.04, 0.02]))
    ends = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    true = np.array([(stations[j].inv() * stations[i]).as_matrix() for i, j in ends])

    def measured():
        return network_from_pairs([
            Pair(f"{i}-{j}", FrameRef("station", str(i)), FrameRef("station", str(j)),
                 Rot3(R @ Rotation.from_rotvec(s * rng.standard_normal(3)).as_matrix()), s**2 * np.eye(3))
            for (i, j), R, s in zip(ends, true, sigma, strict=True)
        ])  # fmt: skip

    runs, total = size(200, 40), {"weighted": 0.0, "equal": 0.0}
    for _ in range(runs):
        network = measured()
        weighted = PaperOptions(euler_cov=euler_covariances(network))
        for name, options in (("weighted", weighted), ("equal", PaperOptions())):
            found = paper_iteration(network, options)
            cov = adjusted_covariances(found, options, network.cov)
            d = rotation_log(np.swapaxes(true, -1, -2) @ found.b_from_a.rotation)
            total[name] += np.einsum("ei,eij,ej->e", d, np.linalg.inv(cov), d)
    low, high = chi2.ppf([0.0005 / 6, 1 - 0.0005 / 6], 3 * runs)
    for name, found in total.items():
        assert np.all((low < found) & (found < high)), name
