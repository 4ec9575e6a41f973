"""A three-camera head on a turntable, simulated, adjusted, compared with the truth: the Python interface in one page.

Run: python examples/simulate_and_adjust.py
"""

import numpy as np
from gtsam import Pose3

from adjust.adjustment import adjust
from survey.simulate import head_on_table


def main() -> None:
    survey, truth = head_on_table(seed=1, n_cameras=3, n_table_epochs=11, n_free_epochs=10)
    adjustment = adjust(survey)
    print(f"sigma0 {adjustment.sigma0:.3f}, redundancy {adjustment.redundancy}")
    print(f"\n{'camera in head':<16}{'sigma, mm':>24}{'error, mm':>24}")
    for camera in survey.cameras:
        name = ("station_from_camera", camera.camera_id)
        estimate, true = adjustment.estimates[name], truth[name]
        if not isinstance(estimate.value, Pose3) or not isinstance(true, Pose3):
            raise TypeError("a camera stands on its station by a pose")
        error = true.between(estimate.value).translation()
        sigma = np.sqrt(np.diag(estimate.cov)[3:])
        print(f"{camera.camera_id:<16}{_mm(sigma):>24}{_mm(error):>24}")
    skew, offset = adjustment.estimates["table_geometry", "turntable"].value[:2]
    print(f"\ntable: non-orthogonality {np.degrees(skew) * 3600.0:.1f} arcsec, axis offset {1e3 * offset:.3f} mm")


def _mm(values: np.ndarray) -> str:
    return "  ".join(f"{1e3 * value:6.3f}" for value in values)


if __name__ == "__main__":
    main()
