"""One camera by GTSAM's own factors and optimiser, as someone would write it who has nothing else."""

from time import perf_counter

import gtsam
import numpy as np
from gtsam import Cal3DS2, GeneralSFMFactor2Cal3DS2, Pose3

from tests.benchmarks.data import Calibration
from tests.benchmarks.outcome import Competitor, Outcome

POINT_SIGMA_M = 1e-6  # GTSAM has no factor of a known point with an unknown lens: tight priors instead
_LENS = 0


def _graph(case: Calibration) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(2, float(case.sigma_px))
    first, lens = 1 + len(case.board), case.lens[0]
    values.insert(_LENS, Cal3DS2(*lens[:2], 0.0, *lens[2:4], *lens[4:]))
    for i, uv in enumerate(case.uv):
        values.insert(first + i, Pose3(np.linalg.inv(case.head_from_board[i])))
        for j, z in enumerate(uv):
            graph.push_back(GeneralSFMFactor2Cal3DS2(z, noise, first + i, 1 + j, _LENS))
    tight = gtsam.noiseModel.Isotropic.Sigma(3, POINT_SIGMA_M)
    for j, x in enumerate(case.board):
        values.insert(1 + j, x)
        graph.push_back(gtsam.PriorFactorPoint3(1 + j, x, tight))
    # skew is an unknown of Cal3DS2; all else gets a prior that says nothing
    sigmas = np.where(np.arange(9) == 2, 1e-6, 1e6)
    held = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    graph.push_back(gtsam.PriorFactorCal3DS2(_LENS, values.atCal3DS2(_LENS), held))
    return graph, values


def native_gtsam(case: Calibration) -> Competitor:
    """Levenberg-Marquardt and the marginals of lens and poses."""

    def run() -> Outcome:
        t0 = perf_counter()
        graph, values = _graph(case)
        t1 = perf_counter()
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(1e-12)
        parameters.setAbsoluteErrorTol(1e-10)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        result = optimizer.optimize()
        t2 = perf_counter()
        marginals = gtsam.Marginals(graph, result)
        poses = [1 + len(case.board) + i for i in range(len(case.uv))]
        for key in (_LENS, *poses):
            marginals.marginalCovariance(key)
        t3 = perf_counter()
        lens = np.delete(result.atCal3DS2(_LENS).vector(), 2)
        boards = np.array([result.atPose3(k).inverse().matrix() for k in poses])
        solution = {"lens": lens[None], "camera_from_head": np.eye(4)[None], "head_from_board": boards}
        return Outcome({"build": t1 - t0, "solve": t2 - t1, "precision": t3 - t2}, solution,
                       f"{optimizer.iterations()} steps, points to 1 um")  # fmt: skip

    return run
