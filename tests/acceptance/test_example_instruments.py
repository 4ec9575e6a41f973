"""The example of the beacons: the command line, the truth, and sigmas that can be believed."""

import json

import numpy as np
from scipy.stats import chi2

from survey.cli import main
from survey.examples.beacons import beacon_files
from survey.jobs.adjusting.steps import adjust_project
from survey.project import read

BEACONS = [f"B{i + 1:02d}" for i in range(12)]


def turned_onto(x, truth):
    """The truth turned about z and shifted onto x, both (n, 3): what levelled instruments leave open."""
    a, b = truth - truth.mean(axis=0), x - x.mean(axis=0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    c, s = np.cos(angle), np.sin(angle)
    return a @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + x.mean(axis=0)


def test_beacons_scatter_about_the_truth_as_their_covariance_says(tmp_path):
    """Shape of twelve beacons: 36 coordinates less four motions, over several seeds."""
    total, omega, redundancy, seeds = 0.0, 0.0, 0, range(1, 9)
    for seed in seeds:
        for name, text in beacon_files(seed).items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(text)
        result = adjust_project(read(tmp_path), progress=False)
        true = json.loads((tmp_path / "truth.json").read_text())["parameters"]
        x = np.array([result.estimates["point", b].value for b in BEACONS])
        e = (x - turned_onto(x, np.array([true[f"point/{b}"] for b in BEACONS]))).ravel()
        Q = result.precision.joint([("point", b) for b in BEACONS])
        assert np.linalg.matrix_rank(Q, tol=1e-12 * np.abs(Q).max() * 1e3) == 32
        total += e @ np.linalg.pinv(Q, rcond=1e-9) @ e
        assert result.datum_defect == 4
        omega, redundancy = omega + result.omega, redundancy + result.redundancy
    for value, freedom in ((total, 32 * len(seeds)), (omega, redundancy)):
        low, high = chi2.ppf([0.0005, 0.9995], freedom)
        assert low < value < high


def test_commands(tmp_path, capsys):
    for name, command in (("total-station", "adjust"), ("alignment", "align")):
        folder = str(tmp_path / name)
        assert main(["example", name, folder, "--quiet"]) == 0
        capsys.readouterr()
        code = main([command, folder, "--quiet", "--json"])
        found = json.loads(capsys.readouterr().out)
        if command == "align":
            assert (code, found["aligned"]) == (3, False)
            continue
        assert code == 0
        solution = json.loads((tmp_path / name / "results" / "solution.json").read_text())
        assert set(solution["setups"]) == {"S1a", "S2a", "S3a"}
        assert solution["instruments"]["total_station"]["sigma_distance_offset_mm"] < 0.3
        assert solution["vertical"]["up_in_world"] == [0.0, 0.0, 1.0]
        # a reading without an id is called by its row
        assert main(["remove", folder, "r11", "--quiet"]) in (0, 3)
        assert "removed: terrestrial:r11" in capsys.readouterr().out
        rows = (tmp_path / name / "observations" / "exclusions.csv").read_text().splitlines()
        assert [row.split(",")[:3] for row in rows[1:]] == [["reading", "terrestrial:r11", "excluded"]]


def test_report_shows_instruments_surfaces_and_beams_in_both_languages(tmp_path):
    from survey.jobs.adjusting.outcome import run_info
    from survey.report.page import report_html

    assert main(["example", "alignment", str(tmp_path / "a"), "--quiet"]) == 0
    project = read(tmp_path / "a")
    result = adjust_project(project, progress=False)
    run = run_info(project, {})
    english, german = (report_html(result, run, in_language=name) for name in ("en", "de"))
    assert "Laser beam laser (mount turntable, along z)" in english
    assert "Laserstrahl laser" in german
    assert "<code>tilt_1</code>" in english
    assert "upwards in the world: (" in english
