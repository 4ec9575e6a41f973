"""The command plan: the page docs/planning.md is carried out as it stands."""

import json
import re
import shlex
from pathlib import Path

import pytest

from survey.cli import main

PAGE = Path(__file__).resolve().parents[2] / "docs" / "planning.md"


def blocks(kind):
    found = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.S | re.M)
    return [text for own, text in found if own == kind]


@pytest.fixture
def lab(tmp_path, monkeypatch):
    folder = tmp_path / "lab"
    folder.mkdir()
    survey, plan = blocks("toml")[:2]
    (folder / "survey.toml").write_text(survey)
    (folder / "plan.toml").write_text(plan)
    monkeypatch.chdir(tmp_path)
    return folder


def run(capsys, *arguments):
    assert main([*arguments, "--json", "--quiet"]) == 0
    return json.loads(capsys.readouterr().out)


def commands():
    lines = [line for block in blocks("") for line in block.splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("labsurvey ")]


def same(line, shown):
    """Word by word, numbers within the last digit that is shown or so: another processor rounds otherwise."""
    a, b = line.split(), shown.split()
    return len(a) == len(b) and all(x == y or close(x, y) for x, y in zip(a, b, strict=True))


def close(x, y):
    try:
        return float(x) == pytest.approx(float(y), rel=0.02, abs=2e-3)
    except ValueError:
        return False


def test_the_commands_of_the_page_run_and_print_what_it_shows(lab, capsys):
    ran = [c for c in commands() if "--trials" not in c]
    assert [c[1] for c in ran] == ["lab", "lab", "lab", "lab", "--error-analysis"]
    shown = [line for block in blocks("text") for line in block.splitlines()]
    numbers = 0
    for command in ran:
        assert main([*command, "--quiet"]) == 0
        out = capsys.readouterr().out
        if command in (["plan", "lab"], ["plan", "--error-analysis", "--out", "errors"]):
            for line in out.splitlines():
                assert any(same(line, s) for s in shown), line
                numbers += 1
    assert numbers > 50
    page = (lab / "results" / "plan.html").read_text(encoding="utf-8")
    assert "Where to put beacons" in page
    assert page.count("<svg") >= 5
    assert (Path("errors") / "error_analysis.html").is_file()


def test_json_and_files(lab, capsys):
    found = run(capsys, "plan", str(lab), "--place", "12", "--out", "there")
    assert not (lab / "results").exists()
    written = json.loads((Path("there") / "results" / "plan.json").read_text())
    assert written["sigmas"] == found["sigmas"]
    assert found["observations"] - found["unknowns"] == found["redundancy"]
    assert sum(g["observations"] for g in found["groups"].values()) == found["observations"]
    assert len(found["selection"]["chosen"]) == 5
    gains = [g["ln_det"] for g in found["selection"]["candidates"]]
    assert gains == sorted(gains, reverse=True)
    assert len(gains) > 25
    after = found["selection"]["wanted"]["station_from_camera.Z.tz"]
    assert after["sigma_after_mm"] < after["sigma_before_mm"]
    assert found["navigation"]["beacons"] == 18  # six of the survey, which stay
    assert min(found["navigation"]["beacons_seen"]) >= 3
    assert len(found["navigation"]["placement"]["x_mm"]) == 12
    assert found["navigation"]["placement"]["ids"] == [f"N{i}" for i in range(1, 13)]
    measure = found["navigation"]["placement"]["measure"]
    assert found["navigation"]["placement"]["final"] <= measure[-1]
    found = run(capsys, "plan", str(lab), "--add", "1", "--out", "there")
    again = run(capsys, "plan", str(lab), "--add", "1", "--out", "again")
    first, second = ({k: v for k, v in x.items() if k not in ("seconds", "written")} for x in (found, again))
    assert first == second


def test_adding_what_was_chosen_makes_the_plan_as_precise_as_said(lab, capsys):
    found = run(capsys, "plan", str(lab), "--add", "1", "--for", "head.camera_Z")
    best = found["selection"]["chosen"][0]
    assert best["kind"] == "epoch"
    angles = re.search(r"\((.*) deg\)", best["name"])[1]
    text = (lab / "plan.toml").read_text()
    extra = f'[[epochs]]\nname = "extra"\ntable = "turntable"\nangles_deg = [[{angles}]]\n'
    extra += 'targets = ["board"]\npoints = false\n'
    (lab / "plan.toml").write_text(text.replace("[[coordinates]]", extra + "[[coordinates]]", 1))
    more = run(capsys, "plan", str(lab), "--add", "0")
    for name, entry in found["selection"]["wanted"].items():
        *owner, component = name.split(".")
        unit = "arcsec" if component.startswith("r") else "mm"
        sigma = more["sigmas"][".".join(owner)][f"sigma_{component}_{unit}"]
        assert sigma == pytest.approx(entry[f"sigma_after_{unit}"], rel=1e-5)


def test_what_goes_wrong_is_said(lab, capsys):
    assert main(["plan"]) == 1
    assert "name the project folder" in capsys.readouterr().err
    (lab / "plan.toml").unlink()
    assert main(["plan", str(lab)]) == 1
    assert "pairs.csv" in capsys.readouterr().err
    (lab / "plan.toml").write_text("image_sigma_px = 0.1\n[[epochs]]\nname = 't'\ncount = 1\ncameras = ['Q']\n")
    assert main(["plan", str(lab)]) == 1
    assert "unknown camera 'Q'" in capsys.readouterr().err
    assert main(["plan", "--error-analysis", "--pixels", "-1"]) == 1
    assert "must be positive" in capsys.readouterr().err
