"""The command ``check``: text, JSON and exit codes; nothing is written. The page is docs/check.md."""

import json
import re
import shutil
from pathlib import Path

import pytest

from survey.cli import main
from survey.planning.checking import check_job
from tests.data import data_folder


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    return Path(shutil.copytree(data_folder("calibration", "hand_eye_ds1", "every6"), tmp_path / "robot"))


def test_a_sound_project(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = files(robot)
    assert main(["check", str(robot)]) == 0
    shown = capsys.readouterr()
    assert "0 problems" in shown.out
    assert "nothing was adjusted" in shown.out
    assert "redundancy 1420" in shown.out
    assert "Next: labsurvey adjust" in shown.err
    assert files(robot) == before


def test_problems_have_an_exit_code_and_are_in_the_json(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    definition = robot / "survey.toml"
    held = 'world_from_station = { treatment = "held" }\n'
    definition.write_text(definition.read_text().replace(held, "", 1))
    assert main(["check", str(robot), "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert found["problems"] == 1
    (first,) = [f for f in found["findings"] if f["level"] == "problem"]
    assert first["kind"] == "no start values"
    assert first["remedy"]


def test_a_folder_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path / "nothing")]) == 1
    assert "no such folder" in capsys.readouterr().err


def test_the_page_names_every_kind_of_finding() -> None:
    root = Path(__file__).parents[2]
    source = "".join(p.read_text(encoding="utf-8") for p in (root / "adjust/diagnosis/beforehand").glob("*.py"))
    page = (root / "docs/check.md").read_text(encoding="utf-8")
    kinds = set(re.findall(r'Finding\(\s*"(?:problem|weak)", "([^"]+)"', source))
    assert len(kinds) > 8
    assert {k for k in kinds if f"| {k} |" not in page} == set()


def test_what_to_measure_next_comes_from_the_plan(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(data_folder("calibration", "unsynchronised"), tmp_path / "session"))
    assert any("plan.toml" in note for note in check_job(folder).notes)
