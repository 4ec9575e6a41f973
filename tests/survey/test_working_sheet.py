"""The working sheet: what it says is what aligns the board; it knows what is significant."""

import json
from pathlib import Path

import numpy as np
import pytest
from gtsam import Rot3

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.examples.alignment import OFF, alignment_files
from survey.jobs.aligning import align_job
from survey.jobs.working_sheet import steps

FEET_MM = {"left": (0.0, 0.0), "right": (200.0, 0.0), "far": (100.0, -140.0)}

ARCSEC = np.pi / 648000


def write(folder: Path, seed: int, off: np.ndarray = OFF, **changes: str) -> Path:
    for name, text in {**alignment_files(seed, off), **changes}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def definition(*pairs: tuple[str, str]) -> str:
    text = alignment_files(1)["survey.toml"]
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.slow
def test_what_is_off_is_found_with_an_honest_sigma(tmp_path: Path) -> None:
    """The rotation that the simulation gave the board, over noise: d' inv(C) d, three degrees of freedom each."""
    total, runs = 0.0, 12
    for seed in range(runs):
        sheet = align_job(write(tmp_path, seed), progress=False).sheets[0]
        d = np.asarray(Rot3.Logmap(Rot3.Expmap(OFF).between(Rot3.Expmap(sheet.off))))
        total += d @ np.linalg.solve(sheet.cov, d)
    assert 12.0 < total < 75.0  # chi-square with 36 degrees of freedom, 0.01 % on each side
    assert sheet.state == "turn"


def test_the_feet_make_the_board_parallel(tmp_path: Path) -> None:
    """Plain geometry: the feet moved by what the sheet says span a plane parallel to the table, to the sigmas."""
    sheet = align_job(write(tmp_path, 3), progress=False).sheets[0]
    R = Rot3.Expmap(OFF).matrix()
    moved = [R @ np.array([*np.array(FEET_MM[f.name]) / 1e3, f.move]) for f in sheet.feet]
    normal = np.cross(moved[1] - moved[0], moved[2] - moved[0])
    tilt = np.hypot(*normal[:2]) / abs(normal[2])
    before = np.hypot(*R[:2, 2])
    assert tilt < 60 * ARCSEC < before / 20
    assert min(f.move for f in sheet.feet) == 0.0
    assert sum(f.stays for f in sheet.feet) == 1
    for foot in sheet.feet:
        assert foot.turns == pytest.approx(foot.move / 0.5e-3)


def test_rounds_until_the_board_is_aligned(tmp_path: Path) -> None:
    """An operator who turns as told (to 3 %) is done after the second round; the rounds are kept."""
    off, states = OFF.copy(), []
    for seed in range(5):
        outcome = align_job(write(tmp_path, seed, off), progress=False)
        states.append(outcome.sheets[0].state)
        if outcome.aligned:
            break
        turned = Rot3.Expmap(-outcome.sheets[0].off * 1.03)
        off = np.asarray(Rot3.Logmap(Rot3.Expmap(off).compose(turned)))
    assert states[0] == "turn"
    assert states[-1] == "aligned"
    assert len(states) <= 3
    assert np.abs(off).max() < 200 * ARCSEC
    rows = (tmp_path / "results" / "alignment_rounds.csv").read_text().splitlines()
    assert len(rows) == 1 + len(states)
    assert steps(outcome.sheets[0]) == []
    page = (tmp_path / "results" / "alignment.html").read_text()
    assert "Nothing to do" in page
    assert page.count("<tr>") > len(states)
    align_job(tmp_path, progress=False)  # the same readings are no new round
    assert (tmp_path / "results" / "alignment_rounds.csv").read_text().splitlines() == rows


def test_which_way(tmp_path: Path) -> None:
    """Turned counter-clockwise too far: back clockwise; the x axis up at its end: the feet there go down."""
    write(tmp_path, 1, np.radians([0.0, -0.3, 0.0]))  # -y: the end of the x axis is too high
    sheet = align_job(tmp_path, progress=False).sheets[0]
    stays = next(f.name for f in sheet.feet if f.stays)
    moves = {f.name: f.move for f in sheet.feet}
    assert stays == "right"
    assert moves["left"] == pytest.approx(0.2 * np.radians(0.3), abs=3e-5)
    assert moves["far"] == pytest.approx(0.1 * np.radians(0.3), abs=3e-5)
    text = steps(sheet)
    assert text[0] == "Leave the foot right as it is."
    assert any(s.startswith("Raise the foot left by 1.0") for s in text)
    write(tmp_path, 1, np.radians([0.0, 0.0, 0.5]))
    text = steps(align_job(tmp_path, progress=False).sheets[0])
    assert text[0].startswith("Turn target board clockwise by 0.5")
    assert "seen from its front (its z axis points at you)" in text[0]
    write(tmp_path, 1, np.radians([0.0, 0.0, -0.5]))
    assert "counter-clockwise" in steps(align_job(tmp_path, progress=False).sheets[0])[0]


def test_too_coarse_levels_say_measure_better(tmp_path: Path) -> None:
    """Ten times the tolerance: the sheet asks for better levels instead of sending the operator turning."""
    files = alignment_files(1, np.zeros(3))
    coarse = files["observations/levels.csv"].replace("5e-05", "0.005")
    write(tmp_path, 1, np.zeros(3), **{"observations/levels.csv": coarse})
    sheet = align_job(tmp_path, progress=False).sheets[0]
    assert sheet.state == "measure"
    assert any("Measure better about the x axis" in step for step in steps(sheet))
    assert not any(step.startswith("Raise") for step in steps(sheet))


def test_levelling_alone_with_the_yaw_held(tmp_path: Path) -> None:
    """The first step of the method, before there is a laser."""
    text = definition(
        ('treatment = "prior"', 'held = ["rz", "tx", "ty", "tz"]'),
        (", sigma_translation_mm = 2.0, sigma_rotation_deg = inf", ""),
    )
    write(tmp_path, 1, **{"survey.toml": text, "observations/laser_spots.csv": "spot_id,beam_id,epoch_id,target_id,"
                                                                             "x_mm,y_mm,sigma_mm\n"})  # fmt: skip
    sheet = align_job(tmp_path, progress=False).sheets[0]
    assert [axis.state for axis in sheet.axes] == ["turn", "turn", "held"]
    np.testing.assert_allclose(sheet.off[:2], OFF[:2], atol=6e-5 * 3)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path, 1)
    assert main(["align", str(tmp_path), "--quiet", "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert found["tasks"]["board"]["state"] == "turn"
    assert found["tasks"]["board"]["axes"]["z"]["off_arcsec"] == pytest.approx(OFF[2] / ARCSEC, abs=300)
    assert main(["align", str(tmp_path), "--quiet"]) == 3
    out = capsys.readouterr().out
    assert "board: target board onto table turntable: to be turned" in out
    assert "Raise the foot" in out


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('body = "target:board"', 'body = "station:x"', r"align.board.body: .*unknown station 'x'"),
        ("far = [100.0, -140.0]", "far = [100.0, 0.0]", "align.board.feet_mm: found 3 feet; three that are not in a"),
        ('onto = "table:turntable"', 'onto = "target:board"', "body and onto are the same"),
        ('onto = "table:turntable"', 'onto = "mount:turntable"', "write 'mount:turntable@epoch_id'"),
        ("tolerance_arcsec", "tolerance_arcs", "unknown key; did you mean 'tolerance_arcsec'"),
    ],
)
def test_faults(tmp_path: Path, old: str, new: str, message: str) -> None:
    write(tmp_path, 1, **{"survey.toml": definition((old, new))})
    with pytest.raises(SurveyError, match=message):
        align_job(tmp_path, progress=False)


def test_a_wanted_rotation(tmp_path: Path) -> None:
    """The board is to stand turned by a quarter about z: then it is 89 deg off, which is refused as no error."""
    text = definition(('onto = "table:turntable"', 'onto = "table:turntable"\nrotation_euler_xyz_deg = [0, 0, 90]'))
    write(tmp_path, 1, **{"survey.toml": text})
    with pytest.raises(SurveyError, match="the body is 89 deg off"):
        align_job(tmp_path, progress=False)
