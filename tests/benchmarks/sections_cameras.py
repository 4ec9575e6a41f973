"""Cameras: calibrations and bundles beside their peers, and how our time grows."""

import numpy as np

from tests.benchmarks import bundle, tables
from tests.benchmarks.children import MRCAL, Measured
from tests.benchmarks.data import calibration
from tests.benchmarks.plots import Line
from tests.benchmarks.session import Session
from tests.data import data_folder

SOLVE, PRECISION, TIGHT = "ours: build, solve", "ours: precision", "ours: to the last digit"
START, ALL, STAGES = "ours: start, build, solve", "ours: adjust (all three)", "ours: in stages"
CAMERAS, MULTIVIEW = "OpenCV calibrateCamera", "OpenCV calibrateMultiview"
TRUST, PLAIN = "scipy least_squares", "scipy.sparse Gauss-Newton"
TOOL, NATIVE = "mrcal-calibrate-cameras", "plain GTSAM: solve, marginals"


def lines(sizes: list[int], found: list[dict[str, Measured]], names: list[str]) -> list[Line]:
    """Medians over sizes, one line a competitor."""
    return [
        Line(name, np.array(sizes, dtype=float), np.array([f[name].median if name in f else np.nan for f in found]),
             name.startswith("ours"))
        for name in names
    ]  # fmt: skip


def several_cameras(session: Session) -> None:
    """Three cameras, a board moved in front of them."""
    session.say("", "## Three cameras, 10 x 10 corners, 0.1 px", "")
    session.say(
        "Own starts: “start, build, solve”, “adjust”, mrcal's tool and OpenCV's. From the same rough start (focal "
        "length 2 %, poses 0.5 degrees and 5 mm off, no distortion): all others. OpenCV's calibrateCamera takes the "
        "cameras one by one, and so does the lens of calibrateMultiview: their optimum is another one. mrcal optimize "
        "and scipy give no covariances, “precision” is all of ours. mrcal's tool starts a process, finds its start, "
        "optimises several times and writes models. The column of ratios is to “in stages”, which begins at the rough "
        "start: rows with starts of their own are to be read against “adjust”."
    )
    warm, sizes, runs = calibration(3, 10), (50,) if session.quick else (50, 200, 500), []
    for frames in sizes:
        case = calibration(3, frames)
        names = [STAGES, SOLVE, START, PRECISION, ALL, TIGHT, MRCAL, CAMERAS, PLAIN, MULTIVIEW]
        names += [TRUST, TOOL] if frames == 50 else []
        found = session.compete(f"3 x {frames}", case, warm, names, budget=10.0)
        runs.append(found)
        session.say("", f"### {frames} frames", "", tables.times(list(found.values()), found[STAGES]), "")
        session.say(tables.optima(case, list(found.values()), found[TIGHT], found[PRECISION].solution["sigmas"]))
        session.say("", tables.against(found, STAGES, [MRCAL, PLAIN], "build, solve, precision, from the rough start"))
        own = "start, build, solve, precision, each from its own start"
        session.say("", tables.against(found, ALL, [MULTIVIEW, CAMERAS, TOOL], own))
        what = f"3 cameras x {frames}, solution and every covariance: times as long takes"
        ratio = tables.times_as_long(found[MRCAL], found[STAGES])
        session.claim(f"{what} mrcal's optimiser (no covariances)", ratio, 4.0, "", True, "both: the same rough start")
        what = f"3 cameras x {frames}, from nothing to every covariance: times as long takes"
        if frames == 500:
            wide = tables.times_as_long(found[MULTIVIEW], found[ALL])
            session.claim(f"{what} calibrateMultiview (no covariances)", wide, 100.0, "", True, "each: its own start")
        alone = tables.times_as_long(found[CAMERAS], found[ALL])
        session.compare(f"{what} calibrateCamera (cameras one by one, no covariances)", alone, "each: its own start")
    shown = [STAGES, SOLVE, ALL, MRCAL, CAMERAS, MULTIVIEW, PLAIN]
    session.picture("cameras", lines(list(sizes), runs, shown), "Three cameras", "frames")


def one_camera(session: Session) -> None:
    """OpenCV's home ground."""
    images = 50 if session.quick else 200
    session.say("", "## One camera, 88 corners", "")
    session.say("The same image points, rounded to float32, for all; OpenCV without k3 and to the last digit.", "")
    for n in (images,) if session.quick else (50, images):
        case = calibration(1, n, (8, 11), single=True)
        names = [STAGES, SOLVE, START, PRECISION, ALL, TIGHT, MRCAL, CAMERAS, PLAIN]
        names += [NATIVE, TRUST] if n == 50 else []
        found = session.compete(f"1 x {n}", case, calibration(1, 10, (8, 11)), names, budget=12.0)
        session.say("", f"### {n} images", "", tables.times(list(found.values()), found[STAGES]), "")
        sigmas = found[PRECISION].solution["sigmas"]
        session.say(tables.optima(case, list(found.values()), found[TIGHT], sigmas))
        if found[CAMERAS].seconds:
            apart = np.abs(found[CAMERAS].solution["lens"] - found[SOLVE].solution["lens"]) / sigmas
            session.claim(f"1 camera x {n}: lens from OpenCV's", float(apart.max()), 1e-6, "sigmas")


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
        f"All together {tables.seconds(found[ours].median)} s. S0 = {s0:.9e} mm, published {bundle.AICON_S0:.7e}; "
        f"v'Pv = {numbers['omega']:.5f}, published 12359.40759; "
        f"redundancy {numbers['redundancy']:.0f}, published 18804."
    )
    session.claim("AICON's bundle with every covariance and redundancy number", found[ours].median, 0.3, "s")
    session.say(
        "", "Simulated, all round a hall. Ours: inner constraints over some ten points, all covariances, redundancy "
        "numbers and tests. COLMAP: two cameras fixed, all covariances (`estimate_ba_covariance`), nothing else.",
    )  # fmt: skip
    sizes, runs = ((40, 800, 8),) if session.quick else ((100, 3000, 8), (500, 3000, 34)), []
    for size in sizes:
        case = bundle.simulated(*size)
        session.say("", f"### {size[0]} images, {len(case.points)} points, {len(case.uv)} image points", "")
        found = session.compete(f"{size[0]} x {len(case.points)}", case, warm, [ours, colmap], budget=30.0)
        runs.append(found)
        what = f"{size[0]} images x {len(case.points)} points: times as long takes COLMAP"
        session.claim(what, tables.times_as_long(found[colmap], found[ours]), 2.0 if size[0] == 500 else 1.0, "", True,
                      "both: the same start values")
        session.say(tables.times(list(found.values()), found[ours]), "")
        session.say(tables.stages(list(found.values())), "")
        if found[colmap].seconds:
            lens = found[colmap].solution["lens"] - [0, 0, 0.5, 0.5, 0, 0, 0, 0]
            d = np.abs(lens - bundle.free(found[ours].solution))
            omega = [found[name].numbers["omega"] for name in (ours, colmap)]
            session.say(f"Lenses differ by {d[:4].max():.1e} px; v'Pv is {omega[0]:.6f}, COLMAP's {omega[1]:.6f}.")
    points = [size[0] for size in sizes]
    session.picture("bundles", lines(points, runs, [ours, colmap]), "Bundles of some 3000 points", "images")


def scaling(session: Session) -> None:
    """Twelve cameras, up to 1.2 million image points."""
    session.say("", "## Scaling: 12 cameras, 100 corners an image", "")
    warm, sizes = calibration(3, 10), (20, 50) if session.quick else (100, 300, 1000)
    found = []
    for frames in sizes:
        case = calibration(12, frames)
        found.append(session.compete(f"12 x {frames}", case, warm, [STAGES], 15.0)[STAGES])
    rows = []
    for frames, m in zip(sizes, found, strict=True):
        each = [tables.seconds(float(np.median(s))) for s in m.stages.values()]
        rows.append([str(12 * frames), str(1200 * frames), *each, tables.seconds(m.median), f"{m.peak_mb:.0f}",
                     f"{(m.peak_mb - m.idle_mb) / (1.2 * frames):.2f}"])  # fmt: skip
    head = ("images", "image points", *found[0].stages, "sum", "peak MB", "kB per image point")
    session.say(tables.table(head, rows))
    last = found[-1]
    if sizes[-1] == 1000:
        session.claim("12 cameras x 1000 images, solution, sigmas, redundancy numbers", last.median, 10.0, "s")
        session.claim("12 cameras x 1000 images, memory", last.peak_mb, 1500.0, "MB")
    images = np.array([12.0 * frames for frames in sizes])
    every = [Line("sum", images, np.array([m.median for m in found]), True)]
    every += [Line(s, images, np.array([float(np.median(m.stages[s])) for m in found])) for s in found[0].stages]
    session.claim("12 cameras: exponent of time by images", every[0].exponent, 1.1)
    session.picture("scaling", every, "Twelve cameras", "images")
