"""The command ``check``: text, JSON and exit codes; nothing is written. The page is docs/check.md."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from survey.cli import main
from survey.planning.checking import check_job
from survey.project import SpotBlock, write_project
from survey.simulate import beacons, single_camera
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


@pytest.mark.slow
def test_what_to_measure_next_is_told_without_a_plan(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(data_folder("calibration", "unsynchronised"), tmp_path / "session"))
    outcome = check_job(folder)
    assert len(outcome.next_best) == 5
    assert all("tilted" in name for name in outcome.next_best)  # candidates that are usual, where no plan.toml is


@pytest.mark.slow
@pytest.mark.parametrize("name", ["total-station", "alignment", "relay", "relay-station", "head"])
def test_ready_examples_have_no_findings(name: str, tmp_path: Path) -> None:
    assert main(["example", name, str(tmp_path / "lab"), "--quiet"]) == 0
    outcome = check_job(tmp_path / "lab")
    assert outcome.beforehand.findings == ()
    assert bool(outcome.next_best) == (name not in ("alignment", "relay-station"))  # where nothing usual can be added


def test_a_camera_that_misses_a_corner_is_told_and_where_boards_help_most(tmp_path: Path) -> None:
    survey, _ = single_camera(1)
    middle = (np.array(survey.cameras[0].image_size) - 1.0) / 2.0
    kept = [~((b.uv - middle) * [-1, -1] > 0.35 * middle).all(axis=1) for b in survey.image_blocks]
    blocks = tuple(b.part(k) for b, k in zip(survey.image_blocks, kept, strict=True) if k.sum() > 30)
    write_project(tmp_path, replace(survey, image_blocks=blocks))
    outcome = check_job(tmp_path)
    assert [f.kind for f in outcome.beforehand.findings] == ["corner not covered"]
    assert len(outcome.next_best) == 5
    assert all(re.fullmatch(r"board at the .* of C1, tilted", name) for name in outcome.next_best)
    assert outcome.summary()["coverage"]["C1"]["corners_empty"] == ["top left"]
    assert "measure next (where it can be seen): " in outcome.text()


@pytest.mark.slow
def test_spots_without_names_are_not_held_against_the_survey(tmp_path: Path) -> None:
    survey, _ = beacons(1)
    write_project(tmp_path / "named", survey)
    assert check_job(tmp_path / "named").n_problems == 0
    nights = {b.epoch_id for b in survey.image_blocks if b.target_id is None}
    dark = tuple(b for b in survey.image_blocks if b.epoch_id not in nights)
    spots = [SpotBlock(b.camera_id, b.epoch_id, tuple(f"s{i}" for i in range(len(b.uv))), b.uv, b.cov)
             for b in survey.image_blocks if b.target_id is None]  # fmt: skip
    write_project(tmp_path / "spots", replace(survey, image_blocks=dark), spots=spots)
    outcome = check_job(tmp_path / "spots")
    assert outcome.n_problems == 0
    assert any("images show spots" in note for note in outcome.notes)
