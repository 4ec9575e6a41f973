"""A part of the published experiment from rendered images: corners found, and what they are worth."""

import numpy as np
from scipy.stats import chi2

from tests.acceptance.mfns_replica import SIGMA_PX, replica
from tests.acceptance.mfns_tables import rendered_block


def test_corners_of_rendered_images_are_found_with_honest_covariances() -> None:
    survey, truth = replica()
    tests, errors = [], []
    for seed, (camera_id, epoch_id) in enumerate((("Z", "tZ03"), ("X", "hX02"), ("Y", "tY05"))):
        block, error = rendered_block(survey, truth, camera_id, epoch_id, seed)
        assert len(error) == 88
        errors.append(error)
        tests.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(block.cov), error))
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < SIGMA_PX / 3  # what the published corners are good to
    total, n = np.concatenate(tests).sum(), 2 * 88 * 3
    # renderer and detector blur differently (squares of pixels, Gaussian edges): sigmas may be a fifth off, not more
    assert chi2.ppf(0.001, n) / 1.44 < total < chi2.ppf(0.999, n) * 1.44
