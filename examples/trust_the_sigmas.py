"""Can the covariance be believed? Adjust the same survey with fresh noise many times and compare the scatter with it.

Run: python examples/trust_the_sigmas.py
"""

import numpy as np
from gtsam import Pose3

from adjust.adjustment import adjust
from survey.simulate import resample, stereo

RUNS = 60


def main() -> None:
    survey, truth = stereo(seed=1)
    name = ("station_from_camera", "right")
    true = truth[name]
    errors, covariances = [], []
    for run in range(RUNS):
        estimate = adjust(resample(survey, truth, seed=run)).estimates[name]
        if not isinstance(estimate.value, Pose3) or not isinstance(true, Pose3):
            raise TypeError("a camera stands on its station by a pose")
        errors.append(Pose3.Logmap(true.between(estimate.value)))
        covariances.append(estimate.cov)
    scatter = np.sqrt(np.mean(np.square(errors), axis=0))
    claimed = np.sqrt(np.diag(np.mean(covariances, axis=0)))
    print("right camera to left camera      claimed    scatter of", RUNS, "adjustments")
    for i, axis in enumerate("xyz"):
        print(f"rotation about {axis}, arcsec      {_arcsec(claimed[i]):8.2f}   {_arcsec(scatter[i]):8.2f}")
    for i, axis in enumerate("xyz"):
        print(f"translation along {axis}, mm       {1e3 * claimed[3 + i]:8.4f}   {1e3 * scatter[3 + i]:8.4f}")
    squares = [float(e @ np.linalg.solve(c, e)) for e, c in zip(errors, covariances, strict=True)]
    print(f"mean of e' inv(C) e / 6: {np.mean(squares) / 6:.3f}, expected 1 +- {np.sqrt(2 / (6 * RUNS)):.3f}")


def _arcsec(angle: float) -> float:
    return float(np.degrees(angle) * 3600.0)


if __name__ == "__main__":
    main()
