"""Jobs of a relay station: a project folder in, pairs.csv and summaries out."""

from pathlib import Path

import numpy as np
import pytest
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from survey.jobs.relay import read_trajectories, read_trajectory, relay_pairs, relay_text, write_relay_pairs
from survey.project import write_project
from tests.adjust.relay_station import Station4

LINE = "{t}, 0.1, 0.2, 0.3, 0, 0, 0, 1\n"


@pytest.mark.slow
def test_project_folder_to_pairs_csv(tmp_path: Path) -> None:
    station = Station4(31)
    folder = tmp_path / "lab"
    write_project(folder, station.survey(4, 0.05))
    found = relay_pairs(folder)
    assert not found.eyes.refused
    path = write_relay_pairs(tmp_path, found.joint_pairs())
    lines = path.read_text().splitlines()
    head = lines[0].split(",")
    assert len(lines) == 7
    assert "cov_rx_rx_rad2" in head
    for line in lines[1:]:
        row = dict(zip(head, line.split(","), strict=True))
        assert row["pair_id"] == f"{row['a_id'].removeprefix('camera:')}-{row['b_id'].removeprefix('camera:')}"
        true = station.pair(*row["pair_id"].split("-"))
        t: FloatArray = np.array([float(row[f"t{axis}_mm"]) for axis in "xyz"])
        assert np.abs(t - 1e3 * true.translation()).max() < 1.5
    with pytest.raises(SurveyError, match="exists"):
        write_relay_pairs(tmp_path, found.joint_pairs())


def test_summary_names_every_pair_and_gets_better_to_the_right() -> None:
    found = relay_pairs(Station4(32).survey(5, 0.05))
    lines = relay_text(found).splitlines()
    assert lines[0].startswith("4 eyes, 6 pairs; sigma0")
    assert "passed" in lines[0]
    for pair, line in zip(found.eyes.pairs, lines[2:], strict=True):
        numbers = [float(x) for x in line.split()[1:]]
        assert line.startswith(pair.pair_id)
        assert numbers[0] > numbers[2] > numbers[4]


def test_joint_pairs_are_the_truth_within_their_sigmas() -> None:
    station = Station4(33)
    for pair in relay_pairs(station.survey(6, 0.05), "relay").joint_pairs():
        assert isinstance(pair.b_from_a, Pose3)
        d = Pose3.Logmap(station.pair(pair.a.frame_id, pair.b.frame_id).between(pair.b_from_a))
        assert d @ np.linalg.solve(pair.cov, d) < 25.0


def test_trajectory_keeps_repeated_poses_once(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("".join(LINE.format(t=t) for t in (1.0, 1.1, 1.1, 1.2)))
    (found,) = read_trajectories({"x": path})
    assert found.times_s.tolist() == [1.0, 1.1, 1.2]
    assert found.eye.frame_id == "x"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (LINE.format(t=1) + "2, 3\n", r"f:2: 2 columns"),
        (LINE.format(t=1) + LINE.format(t="x"), r"f:2: could not convert"),
        (LINE.format(t=1) + LINE.format(t=0), r"f:2: time 0\.0 goes backwards"),
        (LINE.format(t=1) + LINE.format(t=1).replace("0.1", "0.2"), r"f:2: time 1\.0 comes twice"),
        (LINE.format(t=1) + "2, 0, 0, 0, 0, 0, 0, 0.9\n", r"f:2: .*not a unit quaternion"),
        (LINE.format(t=1), r"f: 1 poses make no trajectory"),
    ],
)
def test_bad_trajectories_are_named(text: str, match: str) -> None:
    with pytest.raises(SurveyError, match=match):
        read_trajectory(text, "x", "f")


def test_blanks_separate_as_commas_do() -> None:
    lines = ["0.0 1 2 3 0 0 0 1", "0.5 1 2 4 0 0 0 1", "1.0 1 2 5 0 0 0 1"]
    blanks, commas = (read_trajectory("\n".join(t), "a") for t in (lines, [x.replace(" ", ",") for x in lines]))
    assert np.array_equal(blanks.times_s, commas.times_s)
    assert np.array_equal(blanks.world_from_eye.translation, commas.world_from_eye.translation)
