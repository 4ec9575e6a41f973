from pathlib import Path

import gtsam
import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.interop.networks.g2o import read_g2o_file, write_g2o
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.converting import convert_job
from survey.project import read
from tests.adjust.pose_networks import network_of_file, simulate, solve_network
from tests.data import data_folder

EDGE = "EDGE_SE3:QUAT 0 1 1 2 3 0 0 0.1 1 " + " ".join(["1 0 0 0 0 0", "1 0 0 0 0", "1 0 0 0", "4 0 0", "4 0", "4"])
VERTEX = "VERTEX_SE3:QUAT {} 0 0 0 0 0 0 1"


def test_gtsam_reads_the_same(tmp_path: Path) -> None:
    path = data_folder("calibration", "pose_graphs") / "smallGrid3D.g2o"
    net = network_of_file(path, start=True)
    graph, values = gtsam.readG2o(str(path), True)
    assert graph.size() == net.n_pairs
    assert values.size() == net.n_stations
    for e in range(0, net.n_pairs, 17):
        factor = graph.at(e)
        i, j = factor.keys()
        assert net.pair_ids[e] == f"{i}-{j}"
        assert factor.measured().rotation().matrix() == pytest.approx(net.rotations[e], abs=1e-6)
        assert factor.measured().translation() == pytest.approx(net.translations[e])
        assert factor.noiseModel().covariance() == pytest.approx(net.cov[e], rel=1e-9, abs=1e-12)
        assert values.atPose3(i).translation() == pytest.approx(net.station_translations[net.index_of[str(i)]])


@pytest.mark.parametrize("information", ["tangent", "quaternion"])
def test_written_networks_come_back(tmp_path: Path, information) -> None:
    net = simulate(4, 3).network
    solution = solve_network(net)
    write_g2o(tmp_path / "n.g2o", net, solution.rotations, solution.translations, information)
    back = network_of_file(tmp_path / "n.g2o", information, start=True)
    assert back.cov == pytest.approx(net.cov, rel=1e-9, abs=1e-15)
    assert back.rotations == pytest.approx(net.rotations, abs=1e-12)
    order = [back.index_of[str(i)] for i in range(net.n_stations)]
    assert back.station_translations[order] == pytest.approx(solution.translations, abs=1e-12)
    assert solve_network(back).omega == pytest.approx(solution.omega, rel=1e-9)


def test_the_two_meanings_of_the_rotation_information_differ_by_four(tmp_path: Path) -> None:
    path = tmp_path / "n.g2o"
    path.write_text("\n".join([VERTEX.format(0), VERTEX.format(1), EDGE]))
    tangent, quaternion = (read_g2o_file(path, meant).survey.pairs for meant in ("tangent", "quaternion"))
    assert np.diag(tangent[0].cov) == pytest.approx([0.25] * 3 + [1.0] * 3)
    assert np.diag(quaternion[0].cov) == pytest.approx([1.0] * 6)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EDGE_SE3:QUAT 0 1 1 2 3", "line 3: expected 28"),
        ("EDGE_SE2 0 1 1 2 3", "line 3: 'EDGE_SE2' is not supported"),
        (EDGE.replace("0 0 0.1 1", "0 0 0 0"), "line 3: the quaternion is zero"),
        (EDGE.replace(" 3 ", " x "), "line 3: expected 28 numbers"),
        (EDGE.replace(" 3 ", " nan "), "line 3: expected 28 finite"),
        (EDGE[:-1] + "-4", "edge 0 1 is not positive definite"),
        (EDGE + "\nFIX 9", "FIX 9 names a vertex"),
        ("VERTEX_SE3:QUAT 2 0 0 0 0 0 0 1", "no EDGE_SE3:QUAT"),
    ],
)
def test_damage_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "n.g2o"
    path.write_text("\n".join([VERTEX.format(0), VERTEX.format(1), line]) + "\n")
    with pytest.raises(SurveyError, match=message):
        read_g2o_file(path)


INDEFINITE = "EDGE_SE3:QUAT {} {} 1 2 3 0 0 0 1 " + " ".join(
    ["4 0 0 0 0 8", "4 0 0 0 0", "4 0 0 0", "9 0 0", "9 0", "9"]  # 4 * 9 < 8 * 8 between x and the turn about z
)


def _partly_indefinite(path: Path) -> Path:
    lines = [*map(VERTEX.format, range(4)), EDGE, INDEFINITE.format(1, 2), INDEFINITE.format(2, 3)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_indefinite_information_is_counted_and_named_with_its_lines(tmp_path: Path) -> None:
    with pytest.raises(SurveyError, match="line 6: the information matrix of edge 1 2") as caught:
        read_g2o_file(_partly_indefinite(tmp_path / "n.g2o"))
    assert "of 3 these 2 are not: 1 2 (line 6), 2 3 (line 7); " in str(caught.value)
    assert "--block-diagonal" in str(caught.value)


def test_blocks_alone_are_read_where_that_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _partly_indefinite(tmp_path / "n.g2o")
    found = read_g2o_file(path, block_diagonal=True)
    assert np.diag(found.survey.pairs[1].cov) == pytest.approx([1 / 9] * 3 + [1 / 4] * 3)
    assert np.count_nonzero(found.survey.pairs[1].cov) == 6
    assert "dropped (block-diagonal reading); as a whole 2 of the matrices are not" in found.notes[0]
    assert main(["convert", str(path), str(tmp_path / "p"), "--block-diagonal"]) == 0
    assert "2 of 3 edges was dropped" in capsys.readouterr().out
    # blocks that are indefinite themselves cannot be helped
    path.write_text(path.read_text().replace("9 0 0 9 0 9", "9 0 0 9 0 -9"))
    with pytest.raises(SurveyError, match=r"line 6: .* not positive definite.*; correct the file"):
        read_g2o_file(path, block_diagonal=True)


@pytest.mark.slow
def test_a_converted_network_gives_the_minimum_of_all_its_pairs(tmp_path: Path) -> None:
    sim = simulate(4, 3, seed=5, extra=8, wrong=2)
    plain = solve_network(sim.network)
    write_g2o(tmp_path / "n.g2o", sim.network, plain.rotations, plain.translations)
    convert_job(tmp_path / "n.g2o", tmp_path / "n")
    kept = adjust_project(read(tmp_path / "n"), progress=False)
    assert all(o.used for o in kept.other_residuals)
    assert kept.omega == pytest.approx(plain.omega, rel=1e-8)
    # its owner may let the program look for wrong pairs
    toml = tmp_path / "n" / "survey.toml"
    assert "reject_pairs = false" in toml.read_text()
    toml.write_text(toml.read_text().replace("reject_pairs = false", "reject_pairs = true"))
    cleaned = adjust_project(read(tmp_path / "n"), progress=False)
    assert sum(not o.used for o in cleaned.other_residuals) == len(sim.wrong) == 2


def test_rotations_alone_cannot_be_written(tmp_path: Path) -> None:
    net = simulate(3, 2, rotations_only=True).network
    with pytest.raises(SurveyError, match="rotations only"):
        write_g2o(tmp_path / "n.g2o", net, net.station_rotations, net.station_translations)
