"""Targets in images, the commands from their start to their end, and where our time goes."""

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.benchmarks import finding, profiles, tables
from tests.benchmarks.session import Session
from tests.data import data_folder

OUR_COMMAND, SCRIPT = "labsurvey adjust rig", "OpenCV's classic script"


def targets(session: Session) -> None:
    """Finding boards."""
    session.say("", "## Targets in images", "")
    session.say(
        "Grey images in memory. Ours fits two blurred edges to every corner and gives its covariance; rms: distance "
        "from where OpenCV projects the points. `findChessboardCornersSB` is slow in large images: left out at 12 "
        "megapixels."
    )  # fmt: skip
    boards = [finding.OURS, finding.TWO, finding.CLASSIC, finding.SECTOR]
    runs = [("26 photographs of 640 x 480", finding.photographs(data_folder("calibration", "opencv_samples")), boards)]
    for width, height in finding.SIZES[: 1 if session.quick else None]:
        names = boards if width < 3000 else boards[:-1]
        size = f"{width} x {height}"
        runs.append((f"board, {size}", finding.rendered(width, height, False), names))
        runs.append((f"ChArUco, {size}", finding.rendered(width, height, True), [*boards[:2], finding.ARUCO]))
    rows = []
    for label, case, names in runs:
        found = session.compete(label, case, case.first(), names, budget=6.0)
        for other in (finding.CLASSIC, finding.ARUCO):
            if other in found:
                what = f"finding, {label}: times as long takes {other} (no covariances)"
                session.compare(what, tables.times_as_long(found[other], found[finding.OURS]), "each: from the images")
        for m in found.values():
            per = 1e3 / len(case.images)
            ratio = tables.ratio(m, found[finding.OURS])
            rms = m.numbers.get("rms_px", np.nan)
            cpu = float(np.median(m.cpu)) if m.cpu else np.nan
            all_found = f"{m.numbers.get('found', 0):.0f} of {len(case.images)}"
            rows.append([label, m.name, f"{per * m.median:.1f}", f"{per * cpu:.1f}", ratio, all_found,
                         "" if np.isnan(rms) else f"{rms:.4f}"])  # fmt: skip
    session.say("", tables.table(("", "", "ms an image", "CPU ms", "ratio to ours", "found", "rms px"), rows))


def start_up(session: Session) -> None:
    """Whole commands, as typed."""
    session.say("", "## Commands from start to end", "")
    session.say("After a first run, which reads the libraries from the disk; 139 readings between 15 points.", "")
    installed, rows = Path(sys.executable).with_name("labsurvey"), []
    program = [str(installed)] if installed.exists() else [sys.executable, "-m", "survey"]
    with tempfile.TemporaryDirectory() as folder:
        lab = str(Path(folder) / "network")
        _seconds([*program, "example", "total-station", lab, "--quiet"])
        what = {
            "labsurvey --help": ([*program, "--help"], 0.2),
            "labsurvey adjust (report and all)": ([*program, "adjust", lab, "--quiet"], 1.5),
            "the libraries alone: numpy, scipy.sparse, gtsam":
                ([sys.executable, "-c", "import numpy, scipy.sparse, gtsam"], None),
        }  # fmt: skip
        for name, (command, wanted) in what.items():
            _seconds(command)
            found = np.array([_seconds(command) for _ in range(3 if session.quick else 15)])
            wall, cpu = np.median(found, axis=0)
            rows.append([name, f"{wall:.3f}", f"{found[:, 0].min():.3f} to {found[:, 0].max():.3f}", f"{cpu:.3f}"])
            if wanted is not None:
                session.claim(f"`{name}`", float(wall), wanted, "s")
        kernel, whole = _stage([*program, "adjust", lab, "--quiet"], "adjust"), float(rows[1][1])
        rows.append(["of labsurvey adjust: the adjustment alone", f"{kernel:.3f}", "", ""])
    what = "139 readings, the whole command: times as long as its adjustment alone"
    session.compare(what, whole / kernel, "the same run", "the rest: libraries, files, report")
    session.say(tables.table(("", "s (median)", "range", "CPU s"), rows))


def script(session: Session) -> None:
    """From photographs to lenses: the whole command beside the script that a user of OpenCV writes."""
    session.say("", "## From 26 small photographs", "")
    session.say(
        "OpenCV's samples, 13 of each of two cameras, 640 x 480. Ours: `labsurvey adjust`, with covariances, tests and "
        "the report. OpenCV: the classic finder, `cornerSubPix`, `calibrateCamera`, `stereoCalibrate`, numbers printed "
        "(`tests/benchmarks/opencv_script.py`). Both whole programs from nothing, loading of libraries included; "
        "“of it” is what the command itself counts.", "",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        rig = _rig(Path(name) / "rig")
        ours = [sys.executable, "-m", "survey", "adjust", str(rig), "--redetect", "--quiet"]
        theirs = [sys.executable, "-m", "tests.benchmarks.opencv_script", str(rig / "images")]
        found: dict[str, list[tuple[float, float]]] = {OUR_COMMAND: [], SCRIPT: []}
        _seconds(ours)
        for _ in range(3 if session.quick else 5):
            found[OUR_COMMAND].append(_seconds(ours))
            found[SCRIPT].append(_seconds(theirs))
        told = subprocess.run(ours, check=False, capture_output=True, text=True).stdout.strip().splitlines()[-1]
    rows = []
    for who, seconds in found.items():
        wall, cpu = np.median(np.array(seconds), axis=0)
        spread = f"{min(s for s, _ in seconds):.3f} to {max(s for s, _ in seconds):.3f}"
        rows.append([who, f"{wall:.3f}", spread, f"{cpu:.3f}", told.strip() if who == OUR_COMMAND else ""])
    session.say(tables.table(("", "s (median)", "range", "CPU s", "of it"), rows))
    ratio = float(np.median(np.array(found[SCRIPT])[:, 1] / np.array(found[OUR_COMMAND])[:, 1]))
    session.compare("26 small photographs to lenses, whole programs: times as long takes OpenCV's classic script "
                    "(no covariances, no report)", ratio, "each: from the images")  # fmt: skip


def _stage(command: list[str], stage: str) -> float:
    """Seconds of one stage as the command itself counts them, in the last line that it prints."""
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip().splitlines()[-1]
    return float(re.findall(rf"{stage} ([\d.]+) s", said)[0])


def _rig(folder: Path) -> Path:
    """The project of the readme's stereo rig with OpenCV's sample images."""
    samples = data_folder("calibration", "opencv_samples")
    for camera in ("left", "right"):
        (folder / "images" / camera).mkdir(parents=True)
        for path in samples.glob(f"{camera}[0-9][0-9].jpg"):
            shutil.copy(path, folder / "images" / camera / path.name.removeprefix(camera))
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    found = re.search(r"```toml\n(.*?)```", readme, re.DOTALL)
    assert found is not None
    (folder / "survey.toml").write_text(found[1], encoding="utf-8")
    return folder


def _seconds(command: list[str]) -> tuple[float, float]:
    """Seconds that passed and seconds of processor time; modules are kept compiled, as ever."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL, env=environment)
    if done.returncode not in (0, 3):  # 3: solved, and something does not fit
        raise RuntimeError(f"{' '.join(command)} ended with code {done.returncode}")
    after, passed = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - begin
    return passed, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def stages(session: Session) -> None:
    """Where our time goes."""
    session.say("", "## Where our time goes", "")
    session.say("One thread, best of three runs, each part without what it calls.", "")
    sizes = [(1, 50, (8, 11))] if session.quick else [(1, 200, (8, 11)), (3, 500, (10, 10)), (12, 300, (10, 10))]
    session.say("Cameras:", "", profiles.cameras(sizes), "")
    points = (200,) if session.quick else (1000, 3000, 10000)
    session.say("Networks of readings:", "", profiles.readings(points), "")
    names = ("parking-garage",) if session.quick else ("parking-garage", "sphere2500", "torus3D")
    session.say("Pose graphs, start values included:", "", profiles.pose_graphs(names))
