"""Difference and uncertainty of lenses against what mrcal makes of the same calibrations of real images."""

import numpy as np
import pytest
from gtsam import Rot3

from adjust.lenses.compared import Optics, lens_difference, pixel_grid, projection_covariance, worst_sigma
from adjust.lenses.models import lens_constants, lens_model, project
from tests.acceptance import published
from tests.data import data_folder

SIZE = (6016, 4016)


class Splined(Optics):
    """mrcal's splined stereographic lens, as its documentation writes it: a cubic B-spline surface bends the plane."""

    def bend(self, u, ux, uy):
        grid = self.values[4:].reshape(len(uy), len(ux), 2)
        a, b = (u[:, 0] - ux[0]) / (ux[1] - ux[0]), (u[:, 1] - uy[0]) / (uy[1] - uy[0])
        i = np.clip(np.floor(a).astype(int), 1, len(ux) - 3)
        j = np.clip(np.floor(b).astype(int), 1, len(uy) - 3)
        four = np.arange(-1, 3)
        near = grid[(j[:, None] + four)[:, :, None], (i[:, None] + four)[:, None, :]]
        du = np.einsum("nj,ni,njik->nk", _cubic(b - j), _cubic(a - i), near)
        return self.values[:2] * (u + du) + self.values[2:4]

    def points(self, uv, distance):
        u = (uv - self.values[2:4]) / self.values[:2]
        for _ in range(100):
            u = u + (uv - self.bend(u, *self.constants)) / self.values[:2]
        r = np.linalg.norm(u, axis=1)
        theta = 2.0 * np.arctan(r / 2.0)
        away = np.column_stack([u * (np.sin(theta) / r)[:, None], np.cos(theta)])
        return away if np.isinf(distance) else distance * away


def _cubic(t):
    return np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=-1) / 6.0


@pytest.fixture(scope="module")
def opencv():
    solution = published.mrcal_solution(data_folder("calibration", "mrcal") / "opencv8-0.npz")
    model = lens_model("brown")
    at = [model.names.index(name) for name in published.MRCAL_LENS]
    values, cov = np.zeros(model.n), np.zeros((model.n, model.n))
    values[at], cov[np.ix_(at, at)] = solution.lens, solution.lens_cov
    return Optics(model, values, lens_constants(model, SIZE, None)), cov


@pytest.mark.parametrize(("key", "distance"), [("inf", np.inf), ("1m", 1.0)])
def test_the_difference_to_a_splined_lens_is_mrcals(opencv, key, distance):
    """mrcal looks from its first lens to the splined one, here from the splined one back: at the pixels it leads to.

    It minimises angles, here pixels are: the two fits differ by what that weighs, a tenth of a pixel where 1.3 px are
    shown, and none of pixels leaves less.
    """
    place = data_folder("calibration", "mrcal_splined")
    lens, found = np.load(place / "splined-0.npz"), np.load(place / "diff_opencv8_splined.npz")
    splined = Splined(opencv[0].model, lens["reopt_intrinsics"].ravel(), (lens["ux"], lens["uy"]))
    q0 = found["q0"].reshape(-1, 2)
    inside = np.linalg.norm(q0 - (np.array(SIZE) - 1) / 2.0, axis=1) < 1500.0
    theirs, Rt = found[f"{key}_r1500_diffvec"].reshape(-1, 2)[inside], found[f"{key}_r1500_Rt"]
    uv = q0[inside] + theirs
    back = (splined.points(uv, distance) - Rt[3]) @ Rt[:3]
    if np.isinf(distance):
        again = project(opencv[0].model, opencv[0].values, opencv[0].constants, back)
        np.testing.assert_allclose(again, q0[inside], atol=1e-5)  # with its own rotation, its own difference
    ours = lens_difference(splined, opencv[0], uv, distance)
    turn = Rot3(Rt[:3]) * ours.second_from_first.rotation()
    assert np.degrees(np.linalg.norm(Rot3.Logmap(turn))) < 0.005  # of 1.25 deg
    assert np.linalg.norm(ours.shift + theirs, axis=1).max() < 0.13
    size = [np.sqrt((x**2).sum(axis=1).mean()) for x in (ours.shift, theirs)]
    assert 0.97 * size[1] < size[0] < size[1]


def test_the_uncertainty_of_projection_is_mrcals(opencv):
    """Of points at infinity. mrcal averages over its boards what the camera may turn, here it is fitted over the image:

    a quarter of a sigma between them, none on the average, where sigmas go from 0.03 to 2 px.
    """
    place = data_folder("calibration", "mrcal_splined")
    found = np.load(place / "opencv8-0_uncertainty_sigma1px.npz")
    q, uv = found["q"].reshape(-1, 2), pixel_grid(SIZE, 25)
    fitted = np.arange(len(q) + len(uv)) >= len(q)
    ours = worst_sigma(projection_covariance(opencv[0], np.vstack([q, uv]), np.inf, opencv[1], fitted)[: len(q)])
    theirs = worst_sigma(found["cov_inf"].reshape(-1, 2, 2))
    assert theirs.max() > 50 * theirs.min()
    ratio = ours / theirs
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
    assert ratio.min() > 0.8
    assert ratio.max() < 1.3
