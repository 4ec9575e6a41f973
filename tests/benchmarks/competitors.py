"""What is timed: one function per competitor, from a case to its solution and the seconds of its stages."""

from collections.abc import Callable
from time import perf_counter
from typing import Any

import cv2
import numpy as np

from adjust.adjustment import AdjustOptions, adjust, assemble
from adjust.frames.unknowns import Unknowns
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import SolveOptions, solve
from adjust.model.survey import FloatArray, Survey
from adjust.start import find_start
from tests.benchmarks import least_squares
from tests.benchmarks.data import SIZE, Calibration, free_lens, matrix, rough_start, survey
from tests.benchmarks.mrcal_tool import mrcal_tool
from tests.benchmarks.native_gtsam import native_gtsam
from tests.benchmarks.outcome import Competitor, Outcome


def ours_solve(case: Calibration) -> Competitor:
    """Graph and least squares from the rough start."""
    given, start = survey(case), rough_start(case)

    def run() -> Outcome:
        t0 = perf_counter()
        graph = GraphBuilder(given, start.lenses).build(start)
        t1 = perf_counter()
        solved = solve(graph)
        t2 = perf_counter()
        return Outcome({"build": t1 - t0, "solve": t2 - t1}, _ours(given, graph.unknowns, solved.values),
                       f"{solved.iterations} steps", {"omega": solved.omega})  # fmt: skip

    return run


def ours_start_solve(case: Calibration) -> Competitor:
    """Start values from the image points alone, graph, least squares."""
    given = survey(case)

    def run() -> Outcome:
        t0 = perf_counter()
        start = find_start(given)
        t1 = perf_counter()
        graph = GraphBuilder(given, start.lenses).build(start)
        t2 = perf_counter()
        solved = solve(graph)
        t3 = perf_counter()
        return Outcome({"find_start": t1 - t0, "build": t2 - t1, "solve": t3 - t2},
                       _ours(given, graph.unknowns, solved.values), f"{solved.iterations} steps")  # fmt: skip

    return run


def ours_precision(case: Calibration) -> Competitor:
    """All covariances, redundancy numbers, standardized residuals and tests, from the solution."""
    given, start = survey(case), rough_start(case)
    graph = GraphBuilder(given, start.lenses).build(start)
    solved = solve(graph)

    def run() -> Outcome:
        t0 = perf_counter()
        result = assemble(graph, solved, AdjustOptions())
        t1 = perf_counter()
        sigmas = [np.sqrt(np.diag(result.estimates[("lens", c.camera_id)].cov)) for c in given.cameras]
        solution = _ours(given, graph.unknowns, solved.values) | {"sigmas": np.array([free_lens(s) for s in sigmas])}
        return Outcome({"precision": t1 - t0}, solution)

    return run


def ours_everything(case: Calibration) -> Competitor:
    """``adjust``: start values, least squares, precision."""
    given = survey(case)

    def run() -> Outcome:
        t0 = perf_counter()
        result = adjust(given)
        return Outcome({"adjust": perf_counter() - t0}, {}, f"sigma0 {result.sigma0:.4f}")

    return run


def ours_in_stages(case: Calibration) -> Competitor:
    """Graph, least squares and precision from the rough start."""
    given, start = survey(case), rough_start(case)

    def run() -> Outcome:
        t0 = perf_counter()
        graph = GraphBuilder(given, start.lenses).build(start)
        t1 = perf_counter()
        solved = solve(graph)
        t2 = perf_counter()
        assemble(graph, solved, AdjustOptions())
        t3 = perf_counter()
        return Outcome({"build": t1 - t0, "solve": t2 - t1, "precision": t3 - t2}, {}, f"{solved.iterations} steps")

    return run


def ours_tight(case: Calibration) -> Competitor:
    """Least squares to the last digit: the optimum that the others are compared with."""
    given, start = survey(case), rough_start(case)

    def run() -> Outcome:
        t0 = perf_counter()
        graph = GraphBuilder(given, start.lenses).build(start)
        solved = solve(graph, SolveOptions(max_step=1e-9))
        return Outcome({"solve": perf_counter() - t0}, _ours(given, graph.unknowns, solved.values))

    return run


def _ours(given: Survey, unknowns: Unknowns, values) -> dict[str, FloatArray]:
    lens = [free_lens(unknowns.vectors[("lens", c.camera_id)].full(values)) for c in given.cameras]
    heads, boards = [np.eye(4)], []
    for name, unknown in unknowns.by_name.items():
        if name[0] == "station_from_camera":
            heads.append(values.atPose3(unknown.key).inverse().matrix())
        elif name[0] == "carrier_from_target":
            boards.append((int(name[2][1:]), values.atPose3(unknown.key).matrix()))
    return {"lens": np.array(lens), "camera_from_head": np.array(heads),
            "head_from_board": np.array([m for _, m in sorted(boards, key=lambda b: b[0])])}  # fmt: skip


TIGHT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-15)


def opencv_cameras(case: Calibration) -> Competitor:
    """``cv2.calibrateCamera`` for one camera after the other, without k3, to the last digit."""
    board = case.board.astype(np.float32)
    views = [case.uv[case.camera == c].astype(np.float32) for c in range(len(case.lens))]

    def run() -> Outcome:
        t0 = perf_counter()
        found = [
            cv2.calibrateCamera([board] * len(v), list(v), SIZE, None, None, flags=cv2.CALIB_FIX_K3, criteria=TIGHT)
            for v in views
        ]
        seconds = perf_counter() - t0
        solution = {"lens": np.array([_opencv_lens(k, d) for _, k, d, _, _ in found])}
        if len(views) == 1:
            solution["camera_from_head"] = np.eye(4)[None]
            solution["head_from_board"] = np.array([_opencv_pose(r, t) for r, t in zip(*found[0][3:5], strict=True)])
        return Outcome({"calibrateCamera": seconds}, solution)

    return run


def opencv_multiview(case: Calibration) -> Competitor:
    """``cv2.calibrateMultiview``: all cameras together; it finds its own start."""
    n, cameras = len(case.head_from_board), len(case.lens)
    board = case.board.astype(np.float32)
    views = [list(case.uv[case.camera == c].astype(np.float32)) for c in range(cameras)]

    def run() -> Outcome:
        t0 = perf_counter()
        _, K, d, R, T, *_ = cv2.calibrateMultiview(
            [board] * n, views, [SIZE] * cameras, np.ones((cameras, n), np.uint8), np.zeros(cameras, np.uint8),
            None, None, None, None, np.full(cameras, cv2.CALIB_FIX_K3, np.int32), 0, TIGHT,
        )  # fmt: skip
        seconds = perf_counter() - t0
        lens = np.array([_opencv_lens(k, x) for k, x in zip(K, d, strict=True)])
        heads = np.array([_opencv_pose(r, t) for r, t in zip(R, T, strict=True)])
        return Outcome({"calibrateMultiview": seconds}, {"lens": lens, "heads_only": heads})

    return run


def _opencv_lens(k: Any, d: Any) -> FloatArray:
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *np.ravel(d)[:4]])


def _opencv_pose(r: Any, t: Any) -> FloatArray:
    r = np.asarray(r)
    return matrix(cv2.Rodrigues(r)[0].ravel() if r.size == 9 else r.ravel(), np.ravel(t))


def scipy_trust_region(case: Calibration) -> Competitor:
    """scipy's least squares with the sparse Jacobian, cut off after 100 evaluations."""
    return _plain(case, lambda: least_squares.trust_region(case, 100))


def scipy_gauss_newton(case: Calibration) -> Competitor:
    """Gauss-Newton on numpy and scipy.sparse."""
    return _plain(case, lambda: least_squares.gauss_newton(case))


def _plain(case: Calibration, method: Callable[[], tuple[dict[str, FloatArray], str]]) -> Competitor:
    def run() -> Outcome:
        t0 = perf_counter()
        solution, note = method()
        return Outcome({"solve": perf_counter() - t0}, solution, note)

    return run


CALIBRATION: dict[str, Callable[[Calibration], Competitor]] = {
    "ours: build, solve": ours_solve,
    "ours: start, build, solve": ours_start_solve,
    "ours: precision": ours_precision,
    "ours: adjust (all three)": ours_everything,
    "ours: in stages": ours_in_stages,
    "ours: to the last digit": ours_tight,
    "OpenCV calibrateCamera": opencv_cameras,
    "OpenCV calibrateMultiview": opencv_multiview,
    "mrcal-calibrate-cameras": mrcal_tool,
    "plain GTSAM: solve, marginals": native_gtsam,
    "scipy least_squares": scipy_trust_region,
    "scipy.sparse Gauss-Newton": scipy_gauss_newton,
}
