"""Loops of pairs through the command: eyes that are no stations, mounts with play, what results say of each loop."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gtsam import Pose3

from adjust.model.observations import Closure
from survey.cli import main
from survey.planning.checking import check_job
from survey.project import AdjustmentOptions, read, write_project
from tests.adjust.test_relay_closed import ARCSEC, eyes, rig

MOUNT = Closure("plate", ("C1-C2", "C2-C3", "C1-C3"), 300.0 * ARCSEC, 1e-3)
LENS = """[cameras.{0}.lens]
model = "brown"
free = ["fx"]
values = {{ fx = 800.0, fy = 800.0, u0 = 319.5, v0 = 239.5 }}
"""


def project(folder: Path, closures: str = "", form: str = "closed", tilt_arcsec: float = 0.0) -> Path:
    """The network of eyes as a folder; tilt: of the pair that the mount is at, as another mounting would give it."""
    survey = eyes(1)
    lines = ["format = 1", 'title = "eyes"', "[adjustment]", f'pairs = "{form}"', "[stations.R1]", "[stations.R2]"]
    for camera in survey.cameras:
        lines += [f"[cameras.{camera.camera_id}]", 'station = "R1"', "image_size_px = [640, 480]",
                  LENS.format(camera.camera_id)]  # fmt: skip
    for target in survey.targets:
        lines += [f"[targets.{target.target_id}]", 'kind = "points"', 'station = "R2"',
                  'file = "block.csv"']  # fmt: skip
    (folder / "observations").mkdir(parents=True)
    (folder / "survey.toml").write_text("\n".join([*lines, closures]) + "\n")
    (folder / "block.csv").write_text("point_id,x_mm,y_mm,z_mm\na,0,0,0\nb,100,0,0\nc,0,100,0\nd,0,0,100\n")
    names = [f"cov_{a}_{b}_{u}" for a, b, u in _upper()]
    rows = [",".join(["pair_id,a_id,b_id,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm", *names])]
    for p in survey.pairs:
        motion = p.b_from_a
        if p.pair_id == "C1-C3":
            motion = motion.compose(Pose3.Expmap(np.array([tilt_arcsec * ARCSEC, 0, 0, 0, 0, 0])))
        q = motion.rotation().toQuaternion()
        numbers = [q.w(), q.x(), q.y(), q.z(), *(1e3 * motion.translation())]
        cov = [p.cov[i, j] for i in range(6) for j in range(i, 6)]
        ends = f"{p.a.kind}:{p.a.frame_id},{p.b.kind}:{p.b.frame_id}"
        rows.append(f"{p.pair_id},{ends}," + ",".join(f"{x:.17g}" for x in [*numbers, *cov]))
    (folder / "observations" / "pairs.csv").write_text("\n".join(rows) + "\n")
    return folder


def _upper() -> list[tuple[str, str, str]]:
    names, units = ("rx", "ry", "rz", "tx", "ty", "tz"), ("rad2", "rad_m", "m2")
    return [(names[i], names[j], units[(i >= 3) + (j >= 3)]) for i in range(6) for j in range(i, 6)]


def adjusted(folder: Path) -> dict:
    assert main(["adjust", str(folder), "--quiet"]) in (0, 3)
    return json.loads((folder / "results" / "solution.json").read_text())


def test_loops_between_eyes_close(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    solution = adjusted(project(tmp_path / "lab"))
    loops = solution["loops"]
    assert loops["form"] == "closed"
    assert loops["solved_by"] == "conditions"
    assert loops["n_loops"] == loops["n_listed"] == 5
    assert solution["summary"]["redundancy"] == 30
    for entry in loops["worst_first"]:
        assert entry["misclosure_arcsec"] > 1.0
        assert entry["misclosure_after_arcsec"] < 1e-6
        assert entry["misclosure_after_mm"] < 1e-8
    for pair in solution["pairs"].values():
        assert min(pair["adjusted"]["sigma_rotation_arcsec"]) > 0.0
    shown = capsys.readouterr().out
    assert "loops: 5, closed by the adjustment" in shown
    page = (tmp_path / "lab" / "results" / "report.html").read_text()
    assert "all loops closed as conditions" in page


def test_a_mount_takes_what_it_may(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A tilt of the mount by twice its sigma: nothing fits without the closure, and all does with it."""
    stiff = adjusted(project(tmp_path / "stiff", tilt_arcsec=600.0))
    assert not stiff["pairs"]["C1-C3"]["used"]
    text = '[closures.plate]\npairs = ["C1-C2", "C2-C3", "C1-C3"]\nsigma_arcsec = 300\nsigma_mm = 1'
    solution = adjusted(project(tmp_path / "soft", text, tilt_arcsec=600.0))
    entry = solution["closures"]["plate"]
    assert solution["pairs"]["C1-C3"]["used"]
    assert solution["summary"]["global_test"]["passed"]
    assert entry["misclosure_arcsec"] == pytest.approx(600.0, abs=100.0)
    assert entry["play_arcsec"] == pytest.approx(600.0, abs=100.0)
    assert 1.0 < entry["play_over_sigma"] < 3.0
    through = [e for e in solution["loops"]["worst_first"] if "C1-C3" in e["pairs"]]
    others = [e for e in solution["loops"]["worst_first"] if "C1-C3" not in e["pairs"]]
    assert through
    assert all(e["misclosure_after_arcsec"] == pytest.approx(entry["play_arcsec"], rel=1e-3) for e in through)
    assert all(e["misclosure_after_arcsec"] < 1e-6 for e in others)
    assert "mount plate" in capsys.readouterr().out
    assert "Loops through a mount" in (tmp_path / "soft" / "results" / "report.html").read_text()


@pytest.mark.parametrize(
    ("text", "form", "message"),
    [
        ('[closures.plate]\npairs = ["C1-C2", "C2-C3", "C1-C3"]\nsigma_arcsec = 3', "poses", 'pairs = "closed"'),
        ('[closures.plate]\npairs = ["C1-C2", "C9-C3", "C1-C3"]\nsigma_arcsec = 3', "closed",
         "survey.toml: closure 'plate': there is no pair 'C9-C3'"),
        ('[closures.plate]\npairs = ["C1-C2", "C2-C3", "C1-C3"]\nsigma_arcsec = 0', "closed", "sigma_arcsec"),
        ('[closures.plate]\npairs = ["C1-C2", "C2-C3"]\nsigma_arcsec = 1\nsigma_mm = -1', "closed", "not negative"),
        ('[closures.plate]\npairs = ["C1-C2"]\nsigma = 1', "closed", "sigma"),
        ("", "loops", "pairs"),
    ],
)  # fmt: skip
def test_wrong_closures_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, form: str, message: str
) -> None:
    assert main(["adjust", str(project(tmp_path / "lab", text, form)), "--quiet"]) == 1
    said = capsys.readouterr().err
    assert message in said
    assert "Traceback" not in said


def test_what_will_be_adjusted_is_checked(tmp_path: Path) -> None:
    """Eyes without images are no problem where their loops are closed, as the adjustment does."""
    said = check_job(project(tmp_path / "lab")).summary()
    assert said["problems"] == 0
    assert said["redundancy"] == 30
    assert check_job(project(tmp_path / "poses", form="poses")).n_problems > 0


def test_options_are_written_as_they_are_read(tmp_path: Path) -> None:
    options = AdjustmentOptions(pairs="closed", closures=(MOUNT,))
    write_project(tmp_path / "lab", eyes(1), options=options)
    again = read(tmp_path / "lab").options
    assert again.pairs == "closed"
    (closure,) = again.closures
    assert replace(closure, rotation_sigma=0.0, translation_sigma=0.0) == replace(
        MOUNT, rotation_sigma=0.0, translation_sigma=0.0
    )
    assert closure.rotation_sigma == pytest.approx(MOUNT.rotation_sigma, rel=1e-12)
    assert closure.translation_sigma == pytest.approx(MOUNT.translation_sigma, rel=1e-12)


@pytest.mark.slow
def test_eyes_beside_cameras_with_images(tmp_path: Path) -> None:
    """One graph: a block and a camera that no image shows, between two cameras that see boards."""
    survey, _ = rig(True)
    options = AdjustmentOptions(pairs="closed", reject_points=False)
    write_project(tmp_path / "lab", survey, options=options)
    solution = adjusted(tmp_path / "lab")
    alone = tmp_path / "alone"
    write_project(alone, replace(survey, pairs=(), cameras=survey.cameras[:2], targets=survey.targets[:-1],
                                 stations=survey.stations[:-1]), options=replace(options, pairs="poses"))  # fmt: skip
    without = adjusted(alone)
    assert {"camera X", "target M"} <= set(solution["stations"])
    assert set(solution["cameras"]) == {"left", "right"}
    assert solution["summary"]["redundancy"] - without["summary"]["redundancy"] == 6 * (4 - 2)
    assert solution["summary"]["global_test"]["passed"]
    assert solution["loops"]["solved_by"] == "poses"
    (loop,) = solution["loops"]["worst_first"]
    assert set(loop["pairs"]) == {"l-M", "M-X", "l-X"}
    assert loop["misclosure_arcsec"] > 1.0
    assert loop["misclosure_after_arcsec"] < 1e-6
    now, then = (s["cameras"]["right"]["station_from_camera"]["sigma_translation_mm"] for s in (solution, without))
    assert sum(now) < sum(then)
