"""What people get wrong at compare, navigate and pairs: what is said, the exit code, and that nothing is written."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from survey.cli import main
from survey.jobs.relay import read_trajectory
from tests.survey.test_converting import tracker_files

Edit = Callable[[list[str]], list[str]]


@pytest.fixture(scope="module")
def labs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project of readings, one of the same with other names, and a station with three trackers."""
    root = tmp_path_factory.mktemp("labs")
    assert main(["example", "total-station", str(root / "ts"), "--quiet"]) == 0
    shutil.copytree(root / "ts", root / "other")
    for path in [root / "other" / "survey.toml", *(root / "other" / "observations").glob("*.csv")]:
        path.write_text(re.sub(r"\bB(\d\d)\b", r"P\1", path.read_text()))
    (root / "walk" / "trajectories").mkdir(parents=True)
    turns = [Rotation.identity(), Rotation.from_rotvec([0.1, 0.5, -0.2]), Rotation.from_rotvec([0.9, 0.0, 0.3])]
    tracker_files(root / "walk" / "trajectories", turns, np.array([[0.0, 0, 0], [0.2, 0, 0.05], [0, 0.15, -0.1]]))
    return root


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("compare ts ts", r"ts: is the first epoch itself; name the folder of another epoch"),
        ("compare ts ts/../ts", r"is the first epoch itself"),
        ("navigate ts", r"survey.toml: there is no camera; navigation needs a calibrated one"),
        ("pairs ts", r"no station has two eyes \(cameras, or marker blocks that another camera saw\) for a pair"),
    ],
)
def test_what_is_wrong_is_said(
    labs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str, said: str
) -> None:
    monkeypatch.chdir(labs)
    before = sorted(labs.rglob("*"))
    assert main([*command.split(), "--quiet"]) == 1
    assert re.search(said, capsys.readouterr().err)
    assert sorted(labs.rglob("*")) == before


def test_epochs_of_other_names_are_not_compared_in_silence(labs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", str(labs / "ts"), str(labs / "other"), "--quiet"]) in (0, 3)
    assert "only 3 stations and points stand in both epochs" in (out := capsys.readouterr().out)
    assert re.search(r"ts: B01, B02, B03, B04 and 8 more; \S*other: P01, P02, P03, P04 and 8 more", out)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda rows: rows[:3], r"eye b: 3 poses are too few; record about ten a second"),
        (lambda rows: rows[:2], r"b.csv: 2 poses make no trajectory; record about ten a second"),
        (lambda rows: rows[:7], r"eyes a and b: their trajectories are together for 0.\d\d s outside of gaps; record"),
        (lambda rows: [r.replace(",", ";") for r in rows], r"b.csv:1: 1 columns, expected .* between commas or blanks"),
        (lambda rows: ["nan" + rows[0][rows[0].index(",") :], *rows[1:]], r"b.csv:1: found nan, .*must be finite"),
        (lambda rows: [r.rpartition(",")[0] + ",2" for r in rows], r"b.csv:1: qx,qy,qz,qw is not a unit .*length is 2"),
        (lambda rows: [f"{r.split(',')[0]},{rows[0].split(',', 1)[1]}" for r in rows],
         r"eyes a and b: their turning speeds agree at no time offset .*or it hardly turned"),
    ],
)  # fmt: skip
def test_trajectories_that_cannot_be_meant(
    labs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], edit: Edit, said: str
) -> None:
    shutil.copytree(labs / "walk", tmp_path / "walk")
    path = tmp_path / "walk" / "trajectories" / "b.csv"
    path.write_text("\n".join(edit(path.read_text().splitlines())))
    assert main(["pairs", str(tmp_path / "walk"), "--out", str(tmp_path / "out"), "--quiet"]) == 1
    assert re.search(said, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_millimetres_are_told(labs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(labs / "walk", tmp_path / "walk")
    path = tmp_path / "walk" / "trajectories" / "b.csv"
    table = np.loadtxt(path, delimiter=",")
    np.savetxt(path, table * np.array([1.0, 1e3, 1e3, 1e3, 1.0, 1.0, 1.0, 1.0]), delimiter=",", fmt="%.12g")
    assert main(["pairs", str(tmp_path / "walk"), "--quiet"]) == 0
    out = capsys.readouterr().out
    assert "warning: lengths of b times 0.001 are those of a: one of the two is not in metres" in out
    assert "lengths of c" not in out


@pytest.mark.slow
def test_gaps_are_left_out(labs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(labs / "walk", tmp_path / "walk")
    path = tmp_path / "walk" / "trajectories" / "b.csv"
    rows = path.read_text().splitlines()
    path.write_text("\n".join([*rows[:150], *rows[200:]]))  # five seconds lost
    assert main(["pairs", str(tmp_path / "walk"), "--quiet"]) == 0
    assert "global test passed" in capsys.readouterr().out


@pytest.mark.parametrize(
    "first", ["t,x,y,z,qx,qy,qz,qw", "\ufefft_s, x_m, y_m, z_m, qx, qy, qz, qw", "t x y z qx qy qz qw"]
)
def test_a_first_line_may_name_the_columns(tmp_path: Path, first: str) -> None:
    rows = [f"{0.1 * i:.1f},0,0,{i},0,0,0,1" for i in range(6)]
    (tmp_path / "a.csv").write_text("\n".join([first, *rows]), encoding="utf-8")
    from survey.folder.text import read_text

    assert len(read_trajectory(read_text(tmp_path / "a.csv"), "a").times_s) == 6
