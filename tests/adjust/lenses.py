"""Lenses with every parameter away from zero, for the tests of the lens models."""

import numpy as np

from adjust.lenses.models import MODELS, LensModel, lens_constants, unit_rays
from adjust.model.survey import FloatArray

IMAGE_SIZE = (640, 480)
PIXEL_SIZE_MM = 0.01
R0_MM = 2.0

VALUES = {
    "brown": [800, 810, 1.5, 320, 240, -0.1, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.005],
    "fisheye": [400, 410, 1.5, 320, 240, 0.01, -0.02, 0.003, 0.001],
    "brown_backward": [8, 0.1, -0.2, 1e-3, 1e-5, 1e-6, 2e-4, -1e-4, 3e-4, -2e-4],
    "brown_backward_dbat": [8, 3.2, 2.4, 3e-4, 1e-3, 1e-5, 1e-6, 2e-4, -1e-4],
    "aicon": [8, 0.1, -0.2, -1e-3, 1e-5, 1e-6, 2e-4, -1e-4, 3e-4, -2e-4],
}
NAMES = tuple(VALUES)


def lens(name: str) -> tuple[LensModel, FloatArray, FloatArray]:
    """Model, values and constants."""
    model = MODELS[name]
    return model, np.array(VALUES[name], dtype=float), lens_constants(model, IMAGE_SIZE, PIXEL_SIZE_MM, R0_MM)


def points_in_camera(n: int, seed: int = 1) -> FloatArray:
    """(n, 3) m: about 20 degrees to either side, some very near the axis."""
    rng = np.random.default_rng(seed)
    q = rng.uniform([-0.4, -0.3, 0.9], [0.4, 0.3, 1.2], (n, 3))
    q[:3, :2] *= 1e-5
    return q


def slopes(model: LensModel, values: FloatArray, constants: FloatArray, uv: FloatArray) -> FloatArray:
    """Tangents (n, 2) = x/z, y/z of the rays of image points (n, 2) px."""
    unit = unit_rays(model, values, constants, uv)
    return np.asarray(unit[:, :2] / unit[:, 2:])
