"""Everything at once, without hardware: controller, cameras, session, adjustment, and the truth to compare with.

A turntable's controller in a process of its own with backlash and a noisy encoder, spoken to over TCP; camera X through
the GigE Vision client from Aravis' camera in another process, Y and Z through Basler's library from its emulator; all
three see the rendered laboratory as the table truly stands. What the session leaves is adjusted as it is.
"""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from capture.cli import main
from capture.simulated.folder import write_lab
from capture.simulated.laboratory import LabSize
from survey.jobs.adjusting.job import adjust_job
from tests.capture.camera_helpers import GIGE, gige_port
from tests.capture.gige_server import GigeServer
from tests.capture.table_server import table_server
from tests.covariances import written_covariances

pytestmark = pytest.mark.slow

COMPARE = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples" / "compare_with_truth.py"))
_AXIS = "{ limits_deg = [-180, 180], wraps = true, speed_deg_s = 400, acceleration_deg_s2 = 4000 }"


def _plan(home, lab, url, angles_file):
    poses = [np.degrees([pose.axis1_rad, pose.axis2_rad]).tolist() for pose in lab.poses]
    emulated = "lab:{home}/room/{name}?via=pylon:0815-000{i}&angles={angles_file}"
    places = {"X": GIGE}
    places |= {n: emulated.format(home=home, name=n, i=i, angles_file=angles_file) for i, n in enumerate("YZ")}
    settings = "settings = { Width = 640, Height = 512, ExposureTime = 10000.0 }"
    cameras = [f'[cameras.{n}]\naddress = "{p}"\n{settings}' for n, p in places.items()]
    text = f"""format = 1
project = "lab"
survey = "room/survey.toml"
[table]
id = "turntable"
driver = "ascii"
address = "{url}"
axes.axis1 = {_AXIS}
axes.axis2 = {_AXIS}
settle = {{ window_s = 0.04, still_deg = 0.02 }}
{chr(10).join(cameras)}
[capture]
fetch_timeout_s = 15.0
quality = false
[poses.t]
kind = "list"
angles_deg = {json.dumps(poses)}
"""
    (home / "plan.toml").write_text(text)
    return home / "plan.toml"


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory):
    home = tmp_path_factory.mktemp("laboratory")
    lab = write_lab(home / "room", 1, LabSize(n_board=4))
    noise = ("--noise", "8", "--backlash", "20", "--speed", "400")
    with gige_port(), table_server(home, *noise) as server, GigeServer(home / "room" / "X", angles=server.truth_file):
        assert main(["run", str(_plan(home, lab, server.url, server.truth_file)), "--quiet"]) == 0
    adjust_job(home / "lab", progress=False)
    return home, lab


def test_all_images_are_there(adjusted):
    home, lab = adjusted
    n = len(lab.poses)
    assert len(list((home / "lab" / "images").rglob("*.png"))) == 3 * n
    rows = (home / "lab" / "observations" / "table_angles.csv").read_text().splitlines()
    assert len(rows) == n + 1


def test_backlash_is_read_back_not_assumed(adjusted):
    """The readback is off the setpoint by half the backlash and the encoder's noise; it, not the setpoint, is used."""
    home, lab = adjusted
    rows = np.genfromtxt(home / "lab" / "observations" / "table_angles.csv", delimiter=",", skip_header=1)[:, 2:4]
    planned = np.degrees([[pose.axis1_rad, pose.axis2_rad] for pose in lab.poses])
    off = 3600 * ((rows - planned + 180.0) % 360.0 - 180.0)
    assert 6.0 < np.sqrt(np.mean(off**2)) < 18.0  # 10 arcsec of backlash, 8 / root 2 of noise


def test_calibration_is_within_its_own_covariance_of_the_truth(adjusted):
    home, _ = adjusted
    solution = json.loads((home / "lab" / "results" / "solution.json").read_text())
    truth = json.loads((home / "room" / "truth.json").read_text())["parameters"]
    errors = np.concatenate([e for _, e in COMPARE["compared"](solution, truth)])
    assert len(errors) == 3 * 8 + 3 * 6 + 6 + 2
    assert np.sqrt(np.mean(errors**2)) < 2.0
    assert np.abs(errors).max() < 4.5
    assert 0.5 < solution["summary"]["sigma0"] < 1.5
    assert solution["summary"]["converged"] is True


def test_each_lens_as_a_whole(adjusted):
    """d' C^-1 d of the eight parameters against chi-square: correlations must be right too."""
    home, _ = adjusted
    solution = json.loads((home / "lab" / "results" / "solution.json").read_text())
    truth = json.loads((home / "room" / "truth.json").read_text())["parameters"]
    blocks = written_covariances(home / "lab" / "results" / "covariance.npz")
    for name, camera in solution["cameras"].items():
        lens = camera["lens"]
        free = [p for p, status in lens["status"].items() if status == "free"]
        d = np.array([lens.get(f"{p}_px", lens.get(p)) - truth[f"lens/{name}"][p] for p in free])
        cov = blocks[f"lens/{name}"]
        if len(cov) > len(free):
            rows = [list(lens["status"]).index(p) for p in free]
            cov = cov[np.ix_(rows, rows)]
        assert d @ np.linalg.solve(cov, d) < chi2.ppf(0.9999, len(free))


def test_sigmas_are_of_use(adjusted):
    home, _ = adjusted
    solution = json.loads((home / "lab" / "results" / "solution.json").read_text())
    for camera in solution["cameras"].values():
        assert max(camera["lens"][f"sigma_{name}_px"] for name in ("fx", "fy", "u0", "v0")) < 3.0
