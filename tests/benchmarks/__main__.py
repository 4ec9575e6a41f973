"""``python -m tests.benchmarks [--quick] [--json FILE] [--doc FILE]``: us and the peers on the same data, in turn."""

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from tests.benchmarks import bundle, tables
from tests.benchmarks.children import MRCAL, Case, Measured, compete
from tests.benchmarks.data import calibration
from tests.benchmarks.stages import where_time_goes
from tests.data import data_folder

SOLVE, PRECISION, TIGHT = "ours: build, solve", "ours: precision", "ours: to the last digit"
START, ALL = "ours: start, build, solve", "ours: adjust (all three)"
CAMERAS, MULTIVIEW = "OpenCV calibrateCamera", "OpenCV calibrateMultiview"
TRUST, PLAIN = "scipy least_squares", "scipy.sparse Gauss-Newton"


class Session:
    """What was asked for, and what has been measured and said so far."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.quick: bool = options.quick
        self.long: bool = options.long
        self.threads: int = options.threads
        self.rounds = 3 if self.quick else 5
        self.measured: list[Measured] = []
        self.text: list[str] = []

    def say(self, *lines: str) -> None:
        """To the terminal now and to the document later."""
        for line in lines:
            print(line, flush=True)
            self.text.append(line)

    def compete(
        self, label: str, case: Case, warm: Case, names: Sequence[str], budget: float = 60.0
    ) -> dict[str, Measured]:
        """Run and remember."""
        print(f"running: {label}", file=sys.stderr)
        found = compete(label, case, warm, names, self.rounds, self.threads, budget)
        self.measured += found
        return {m.name: m for m in found}


def several_cameras(session: Session) -> None:
    """Three cameras, a board moved in front of them."""
    session.say("", "## Three cameras, 10 x 10 corners, 0.1 px", "")
    session.say(
        "Own starts: “start, build, solve”, “adjust” and OpenCV's. From the same rough start (focal length 2 %, poses "
        "0.5 degrees and 5 mm off, no distortion): all others. OpenCV's calibrateCamera takes the cameras one by one, "
        "so its optimum is another one."
    )
    warm = calibration(3, 10)
    for frames in (50,) if session.quick else (50, 200, 500):
        case = calibration(3, frames)
        names = [SOLVE, START, PRECISION, ALL, TIGHT, MRCAL, CAMERAS, PLAIN]
        names += [MULTIVIEW] if frames <= 200 or session.long else []
        names += [TRUST] if frames == 50 else []
        found = session.compete(f"3 x {frames}", case, warm, names, budget=12.0)
        session.say("", f"### {frames} frames", "", tables.times(list(found.values()), found[SOLVE]), "")
        session.say(tables.optima(case, list(found.values()), found[TIGHT], found[PRECISION].solution["sigmas"]))


def one_camera(session: Session) -> None:
    """OpenCV's home ground."""
    images = 50 if session.quick else 200
    case = calibration(1, images, (8, 11), single=True)
    session.say("", f"## One camera, {images} images of 88 corners", "")
    session.say("The same image points, rounded to float32, for all; OpenCV without k3 and to the last digit.", "")
    names = [SOLVE, START, PRECISION, ALL, TIGHT, MRCAL, CAMERAS, PLAIN]
    found = session.compete(f"1 x {images}", case, calibration(1, 10, (8, 11)), names)
    session.say(tables.times(list(found.values()), found[SOLVE]), "")
    session.say(tables.optima(case, list(found.values()), found[TIGHT], found[PRECISION].solution["sigmas"]))


def unknown_points(session: Session) -> None:
    """Bundles."""
    ours, colmap = "ours: build, solve, precision", "COLMAP: solve, covariance"
    warm = bundle.simulated(20, 300, 6)
    session.say("", "## Bundle with unknown points", "")
    folder = data_folder("network", "jaicov")
    found = session.compete("AICON", bundle.aicon(folder), warm, [ours])
    session.say("AICON's network: 115 images, 150 points, 9972 image points, self-calibration, free network.", "")
    session.say(tables.stages(list(found.values())), "")
    numbers = found[ours].numbers
    s0 = numbers["sigma0"] * 5e-4
    session.say(
        f"S0 = {s0:.9e} mm, published {bundle.AICON_S0:.7e}; v'Pv = {numbers['omega']:.5f}, published 12359.40759; "
        f"redundancy {numbers['redundancy']:.0f}, published 18804."
    )
    session.say(
        "", "Simulated, all round a hall. Ours: inner constraints over some ten points, all covariances, redundancy "
        "numbers and tests. COLMAP: two cameras fixed, all covariances (`estimate_ba_covariance`), nothing else.",
    )  # fmt: skip
    for sizes in ((40, 800, 8),) if session.quick else ((100, 3000, 8), (500, 3000, 34)):
        case = bundle.simulated(*sizes)
        session.say("", f"### {sizes[0]} images, {len(case.points)} points, {len(case.uv)} image points", "")
        found = session.compete(f"{sizes[0]} x {len(case.points)}", case, warm, [ours, colmap])
        session.say(tables.times(list(found.values()), found[ours]), "")
        session.say(tables.stages(list(found.values())), "")
        if found[colmap].seconds:
            lens = found[colmap].solution["lens"] - [0, 0, 0.5, 0.5, 0, 0, 0, 0]
            d = np.abs(lens - bundle.free(found[ours].solution))
            omega = [found[name].numbers["omega"] for name in (ours, colmap)]
            session.say(f"Lenses differ by {d[:4].max():.1e} px; v'Pv is {omega[0]:.6f}, COLMAP's {omega[1]:.6f}.")


def scaling(session: Session) -> None:
    """Twelve cameras, up to 1.2 million image points."""
    session.say("", "## Scaling: 12 cameras, 100 corners an image", "")
    warm, sizes = calibration(3, 10), (20, 50) if session.quick else (100, 300, 1000)
    found = []
    for frames in sizes:
        case = calibration(12, frames)
        found.append(session.compete(f"12 x {frames}", case, warm, ["ours: in stages"], 15.0)["ours: in stages"])
    rows = []
    for frames, m in zip(sizes, found, strict=True):
        each = [tables.seconds(float(np.median(s))) for s in m.stages.values()]
        rows.append([str(12 * frames), str(1200 * frames), *each, tables.seconds(m.median), f"{m.peak_mb:.0f}",
                     f"{(m.peak_mb - m.idle_mb) / (1.2 * frames):.2f}"])  # fmt: skip
    head = ("images", "image points", *found[0].stages, "sum", "peak MB", "kB per image point")
    session.say(tables.table(head, rows), "")
    exponent = np.polyfit(np.log(sizes), np.log([m.median for m in found]), 1)[0]
    session.say(f"Time grows with the number of images to the power {exponent:.2f}.")


def stages(session: Session) -> None:
    """Where our time goes."""
    session.say("", "## Where our time goes", "")
    sizes = [(1, 50, (8, 11))] if session.quick else [(1, 200, (8, 11)), (3, 500, (10, 10)), (12, 300, (10, 10))]
    session.say(where_time_goes(sizes))


def networks(session: Session) -> None:
    """Readings and pose networks, each in a process of its own."""
    session.say("", "## Networks of readings and of poses")
    small, large = (("200", "200free"), ("grow", "300", "2")), (("1000", "1000free", "3000"), ("grow", "5000", "2"))
    readings, poses = small if session.quick else large
    runs = [("terrestrial", readings), ("networks", poses)]
    runs += [] if session.quick else [("networks", ("batch", "1000", "10"))]
    threads = {"OPENBLAS_NUM_THREADS": "1", "LABSURVEY_THREADS": str(session.threads)}
    for module, arguments in runs:
        command = ["-m", f"tests.benchmarks.{module}", *arguments]
        print("running:", *command, file=sys.stderr)
        done = subprocess.run(
            [sys.executable, *command], capture_output=True, text=True, check=True, env=os.environ | threads
        )
        session.say("", "`python " + " ".join(command) + "`", "", "```text", done.stdout.rstrip(), "```")


CASES: dict[str, Callable[[Session], None]] = {
    "several": several_cameras, "one": one_camera, "bundle": unknown_points, "scaling": scaling, "stages": stages,
    "networks": networks,
}  # fmt: skip


def main() -> None:
    """Run the cases that were asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small cases, three rounds")
    parser.add_argument("--long", action="store_true", help="also what takes minutes: calibrateMultiview, 500 frames")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="cases to run")
    parser.add_argument("--threads", type=int, default=1, help="threads of every competitor (default 1)")
    parser.add_argument("--json", type=Path, help="write all measurements to this file")
    parser.add_argument("--doc", type=Path, help="write the tables to this Markdown file")
    options = parser.parse_args()
    session = Session(options)
    session.say("# Benchmarks", "", f"Measured by `{_command()}`.", "", _machine(options.threads))
    for name in options.only:
        CASES[name](session)
    if options.json:
        options.json.write_text(json.dumps([_plain(m) for m in session.measured], indent=1))
    if options.doc:
        options.doc.write_text("\n".join(session.text) + "\n")


def _command() -> str:
    return "python -m tests.benchmarks " + " ".join(sys.argv[1:])


def _machine(threads: int) -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    packages = ", ".join(
        f"{name} {version(name)}"
        for name in ("gtsam", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "pycolmap")
    )
    return (
        f"{model}, {os.cpu_count()} cores, {threads} thread{'s' * (threads != 1)} for every competitor; Python "
        f"{platform.python_version()}, {packages}. The competitors of a table ran in turn, each in its own process, "
        "warmed up on a small case; times are medians, ratios run by run with their range. The machine had "
        "other work: small differences mean nothing."
    )


def _plain(m: Measured) -> dict[str, object]:
    return {name: value for name, value in vars(m).items() if name != "solution"}


if __name__ == "__main__":
    main()
