"""The command ``compare`` on two epochs of a chain of stations."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adjust.model.observations import Distance, ImageBlock, PositionRef
from adjust.model.survey import Survey
from adjust.observations.copies import copied_observations, shared_observations
from survey.cli import main
from survey.project import write_project
from tests.adjust.test_deformation import chain, measured, small


def _files(folder: Path):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


@pytest.fixture
def epochs(tmp_path):
    moved, rng = chain(), np.random.default_rng(4)
    moved[3] = moved[3] @ small(np.r_[0, 0, np.radians(60 / 3600), 5e-4, 0, 0])
    for name, poses, held in (("spring", chain(), 0), ("autumn", moved, 5)):
        write_project(tmp_path / name, measured(poses, rng, held=held))
    return tmp_path / "spring", tmp_path / "autumn"


def _json(capsys, *arguments, code=0):
    capsys.readouterr()
    assert main(["compare", *map(str, arguments), "--json", "--quiet"]) == code
    return json.loads(capsys.readouterr().out)


def test_the_station_that_moved_is_in_the_summary_in_units_for_people(epochs, capsys):
    before = [_files(f) for f in epochs]
    found = _json(capsys, *epochs)
    assert [_files(f) for f in epochs] == before
    assert [(d["a"], d["b"]) for d in found["deformations"] if d["significant"]] == [("S2", "S3"), ("S3", "S4")]
    own = found["deformations"][3]
    miss = (own["rotation_arcsec"][2] - 60) / own["sigma_rotation_arcsec"][2]
    assert abs(miss) < 4
    assert 3 < own["sigma_rotation_arcsec"][2] < 15
    miss = (own["displacement_mm"][0] - 0.5) / own["sigma_displacement_mm"][0]
    assert abs(miss) < 4
    assert 0.03 < own["sigma_displacement_mm"][0] < 0.15
    np.testing.assert_allclose(own["rotation_euler_xyz_arcsec"], own["rotation_arcsec"], atol=0.05)
    assert own["test"]["freedom"] == 6
    assert own["test"]["p"] < 1e-6
    assert found["redundancy"] == [24, 24]


def test_the_table_marks_what_moved(epochs, capsys):
    assert main(["compare", *map(str, epochs), "--quiet"]) == 0
    text = capsys.readouterr().out
    assert "2 of 5 relations moved" in text
    rows = [line for line in text.splitlines() if line.startswith("  S")]
    assert [row.split("  ")[1].strip() for row in rows if row.endswith(" *")] == ["S2 - S3", "S3 - S4"]
    assert {len(row.split()) for row in rows} == {3 + 12 + 1, 3 + 12 + 2}


def test_rotations_leave_the_displacement_empty(tmp_path, capsys):
    rng = np.random.default_rng(12)
    for name in "ab":
        write_project(tmp_path / name, measured(chain(), rng, rotations=True))
    found = _json(capsys, tmp_path / "a", tmp_path / "b")
    assert found["deformations"][0]["displacement_mm"] == [None] * 3
    assert found["deformations"][0]["test_displacement"] == {"chi_square": None, "freedom": 0, "p": None}
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--quiet"]) == 0
    text = capsys.readouterr().out
    assert "      -      -      -" in text
    assert "0.000" not in text
    assert "rotations alone were measured: they are compared, displacements are not known" in text
    assert all(m["displacement_mm"] == [None] * 3 for m in found["congruence"]["motions"])
    assert all(m["sigma_rotation_arcsec"][0] > 1.0 for m in found["congruence"]["motions"])


@pytest.mark.slow
def test_errors_say_which_folder(epochs, tmp_path, capsys):
    assert main(["compare", str(epochs[0]), str(tmp_path / "none")]) == 1
    assert f"{tmp_path / 'none'}: no such folder" in capsys.readouterr().err
    survey = measured(chain(), np.random.default_rng(1))
    lonely = type(survey)(stations=survey.stations, pairs=survey.pairs[:3])
    write_project(tmp_path / "lonely", lonely)
    assert main(["compare", str(epochs[0]), str(tmp_path / "lonely"), "--quiet"]) == 1
    error = capsys.readouterr().err
    assert str(tmp_path / "lonely") in error
    assert "S4" in error


def test_images_without_detection_are_not_passed_over(epochs, capsys):
    with (epochs[1] / "survey.toml").open("a") as stream:
        stream.write('\n[cameras.C]\nstation = "S0"\nimage_size_px = [64, 48]\n')
        stream.write('lens = { model = "brown", free = ["fx", "fy", "u0", "v0"] }\n')
    (epochs[1] / "images" / "C").mkdir(parents=True)
    (epochs[1] / "images" / "C" / "e1.png").write_bytes(b"")
    assert main(["compare", *map(str, epochs), "--quiet"]) == 1
    assert f"run 'labsurvey detect {epochs[1]}' first" in capsys.readouterr().err


def test_an_epoch_and_what_was_added_to_it_are_not_independent(epochs, tmp_path, capsys):
    survey = measured(chain(), np.random.default_rng(1))
    write_project(tmp_path / "first", survey)
    write_project(tmp_path / "again", measured(chain(), np.random.default_rng(2)))
    write_project(tmp_path / "grown", replace(survey, pairs=survey.pairs[:-1]))
    found = _json(capsys, tmp_path / "first", tmp_path / "grown")
    assert found["warnings"][0].startswith(f"{len(survey.pairs) - 1} observations have the same values in both")
    assert not any("independent" in w for w in _json(capsys, tmp_path / "first", tmp_path / "again")["warnings"])


def test_single_numbers_may_be_read_twice():
    def tape(*values):
        ends = [PositionRef(p) for p in "AB"]
        return Survey(distances=tuple(Distance(f"d{k}", *ends, v, 1e-3) for k, v in enumerate(values)))

    first = tape(1.001, 1.002, 1.003, 1.004, 1.005, 1.006, 1.007)
    assert shared_observations(first, tape(1.001, 1.002, 1.003, 1.005, 1.004, 1.007, 1.008)) == {}
    assert shared_observations(first, tape(1.001, 1.002, 1.003, 1.004)) == {"distances": 4}
    assert shared_observations(tape(1.0, 2.0), tape(1.0, 2.0)) == {}


def test_pairs_that_were_copied_are_named(tmp_path, capsys):
    survey = measured(chain(), np.random.default_rng(1))
    first = survey.pairs[0]
    write_project(tmp_path, replace(survey, pairs=(*survey.pairs, replace(first, pair_id="copy"))))
    assert main(["adjust", str(tmp_path), "--quiet"]) == 0
    said = capsys.readouterr()
    assert f"1 pairs have the very values of others of the same ({first.pair_id} = copy): what was copied" in said.out
    assert f"labsurvey exclude {tmp_path} pairs:copy" in said.out
    assert copied_observations(survey) == {}


def test_images_and_single_numbers_that_were_copied_are_told_from_those_made_again():
    ends, rng = (PositionRef("A"), PositionRef("B")), np.random.default_rng(1)

    def image(epoch, uv):
        return ImageBlock("X", epoch, "board", np.arange(len(uv)), uv, np.tile(np.eye(2), (len(uv), 1, 1)))

    def tape(*values):
        return tuple(Distance(f"d{k}", *ends, v, 1e-3) for k, v in enumerate(values))

    uv = rng.uniform(0, 1000, (4, 2))
    blocks = (image("e1", uv), image("e2", uv), image("e3", np.vstack([uv[:3], uv[3:] + 1.0])), image("e4", uv[:3]))
    assert copied_observations(Survey(image_blocks=blocks)) == {"images": (("X/e1", "X/e2"),)}
    copied, again = [1.0] * 7, [1.0, 1.001] * 4
    assert len(copied_observations(Survey(distances=tape(*copied)))["distances"]) == 6
    assert copied_observations(Survey(distances=tape(*again))) == {}  # six of seven, of a tape with few digits
    assert copied_observations(Survey(distances=tape(*copied[:6]))) == {}
