"""Two calibrations of a camera compared, and what a calibration leaves open, pixel by pixel.

A lens alone says little: a turned or moved camera with another principal point sees the same. Differences are therefore
shown after the motion that the camera frame may have made has been fitted (as mrcal's projection differences are, see
its documentation "differencing", Kogan 2017), and uncertainties are either those of a point that is fixed to the body
which carries the camera, or, for a camera by itself, those of the difference so fitted, to first order.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from gtsam import Pose3, Rot3

from adjust.lenses.models import (
    LensModel,
    camera_constants,
    lens_derivatives,
    lens_model,
    monotone_radius_px,
    principal_point_px,
    project,
    unit_rays,
)
from adjust.model.arrays import BoolArray, FloatArray
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Estimate, ParameterName
from adjust.model.survey import Camera

GRID = 24
"""Columns of the pixels at which lenses are looked at."""
_STEPS = 30
_SMALL = 1e-12


@frozen(eq=False)
class Optics:
    """A camera as it projects: ``values`` (n,) of a lens model and its ``constants`` (4,)."""

    model: LensModel
    values: FloatArray
    constants: FloatArray

    def points(self, uv: FloatArray, distance: float) -> FloatArray:
        """Points (n, 3) m at this range (``inf``: unit vectors) that are seen at (n, 2) px."""
        away = unit_rays(self.model, self.values, self.constants, uv)
        return away if np.isinf(distance) else distance * away


@frozen(eq=False)
class Difference:
    """Where the second camera sees what the first one sees at ``uv`` (n, 2) px, minus that: ``shift`` (n, 2) px.

    second_from_first: the motion that was fitted; without translation for points at infinity. fitted: (n,) the pixels
    that took part.
    """

    uv: FloatArray
    shift: FloatArray
    second_from_first: Pose3
    fitted: BoolArray


def optics_of(camera: Camera, estimates: Mapping[ParameterName, Estimate]) -> Optics:
    """A camera with its adjusted lens. Raises SurveyError where there is none."""
    estimate = estimates.get(("lens", camera.camera_id))
    if estimate is None or isinstance(estimate.value, Pose3):
        raise SurveyError(f"camera {camera.camera_id}: this solution has no lens of it")
    model = lens_model(camera.lens.model)
    if len(estimate.value) != model.n:
        raise SurveyError(f"camera {camera.camera_id}: this solution has a lens of another model than {model.name}")
    return Optics(model, np.asarray(estimate.value, dtype=float), camera_constants(camera))


def invertible(lens: Optics, uv: FloatArray) -> BoolArray:
    """Pixels (n,) inside the radius up to which the distortion is one to one."""
    centre = principal_point_px(lens.model, lens.values, lens.constants)
    radius = monotone_radius_px(lens.model, lens.values, lens.constants)
    return np.asarray(np.linalg.norm(uv - centre, axis=1) < 0.999 * radius)


def covered(uv: FloatArray, points: FloatArray, reach: float) -> BoolArray:
    """Pixels (n,) with an observed point within ``reach`` px."""
    if not len(points):
        return np.zeros(len(uv), dtype=np.bool_)
    from scipy.spatial import cKDTree  # here: it takes long to load

    return np.asarray(cKDTree(points).query(uv)[0] <= reach)


def pixel_grid(image_size: tuple[int, int], columns: int = GRID) -> FloatArray:
    """Pixels (n, 2) evenly over an image, its corners among them."""
    width, height = image_size
    rows = max(2, round(columns * height / width))
    u, v = np.meshgrid(np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows))
    return np.column_stack([u.ravel(), v.ravel()])


def compared_pixels(
    lenses: Sequence[Optics], image_size: tuple[int, int], observed: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Pixels (n, 2) over an image at which all these lenses are one to one, and which have observed points near."""
    uv = pixel_grid(image_size)
    uv = uv[np.logical_and.reduce([invertible(lens, uv) for lens in lenses])]
    return uv, covered(uv, observed, image_size[0] / GRID)


def lens_difference(
    first: Optics, second: Optics, uv: FloatArray, distance: float = np.inf, fitted: BoolArray | None = None
) -> Difference:
    """The difference of two calibrations with the motion of the camera frame fitted over the pixels ``fitted``.

    distance: m, of the points that are seen; at infinity a rotation is fitted, else a translation too. Gauss-Newton on
    the squares of the shifts (px). Raises SurveyError where fewer than 3 pixels take part.
    """
    part = np.ones(len(uv), dtype=np.bool_) if fitted is None else fitted
    if int(part.sum()) < 3:
        raise SurveyError(f"only {int(part.sum())} pixels to compare two lenses at; name more of the image")
    points, dim = first.points(uv, distance), 3 if np.isinf(distance) else 6
    # the rays of the same pixels in the second camera begin the fit: both lenses may look in other directions
    start = Rot3.ClosestTo(second.points(uv[part], np.inf).T @ first.points(uv[part], np.inf))
    motion = Pose3(start, np.zeros(3))
    for _ in range(_STEPS):
        residuals, by_motion = _shift(second, motion, points[part], uv[part], dim)
        step = -np.linalg.lstsq(by_motion.reshape(-1, dim), residuals.ravel(), rcond=None)[0]
        motion = motion.compose(Pose3.Expmap(np.concatenate([step, np.zeros(6 - dim)])))
        if np.linalg.norm(step) < _SMALL:
            break
    moved = np.asarray(motion.transformFrom(np.ascontiguousarray(points.T))).T
    return Difference(uv, project(second.model, second.values, second.constants, moved) - uv, motion, part)


def _shift(
    optics: Optics, motion: Pose3, points: FloatArray, uv: FloatArray, dim: int
) -> tuple[FloatArray, FloatArray]:
    """Shifts (n, 2) px and their derivatives (n, 2, dim) by a tangent on the right of ``motion``."""
    moved = np.asarray(motion.transformFrom(np.ascontiguousarray(points.T))).T
    here = project(optics.model, optics.values, optics.constants, moved)
    _, by_point = image_derivatives(optics, moved, here)
    return here - uv, motion_derivatives(by_point @ motion.rotation().matrix(), points)[:, :, :dim]


def image_derivatives(optics: Optics, points: FloatArray, uv: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of image points by the lens (n, 2, n_lens) and by the point (n, 2, 3).

    The residual of a backward model is zero at the image point; its derivative by that point is solved for.
    """
    _, by_lens, by_point = lens_derivatives(optics.model, optics.values, optics.constants, points, uv)
    if not optics.model.backward:
        return by_lens, by_point
    by_uv = np.empty((len(uv), 2, 2))
    for k, step in enumerate(1e-3 * np.eye(2)):
        ahead, behind = (lens_derivatives(optics.model, optics.values, optics.constants, points, uv + s * step)[0]
                         for s in (1.0, -1.0))  # fmt: skip
        by_uv[:, :, k] = (ahead - behind) / 2e-3
    return np.asarray(-np.linalg.solve(by_uv, by_lens)), np.asarray(-np.linalg.solve(by_uv, by_point))


def motion_derivatives(by_point: FloatArray, points: FloatArray) -> FloatArray:
    """From the derivative by a point to that by a motion Exp(tangent) of it: rotation, then translation."""
    x, y, z = points.T
    zero = np.zeros_like(x)
    turned = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], axis=1)
    return np.concatenate([by_point @ turned, by_point], axis=2)


def projection_covariance(
    optics: Optics, uv: FloatArray, distance: float, cov: FloatArray,
    fitted: BoolArray | None = None,
) -> FloatArray:  # fmt: skip
    """Covariances (n, 2, 2) px^2 of where a point at ``distance`` (m) is seen, that the camera sees at ``uv`` now.

    cov: (n_lens, n_lens) of all lens values, or joint (n_lens + 6, n_lens + 6) with the tangent of
    ``station_from_camera`` behind them. With the mount the point is fixed to the body that carries the camera, and
    nothing is fitted. Without, the motion of the camera frame that explains most of
    a change of the lens, over the pixels ``fitted``, is taken out: to first order the covariance of
    :func:`lens_difference`.
    """
    points, n = optics.points(uv, distance), len(optics.values)
    by_lens, by_point = image_derivatives(optics, points, uv)
    dim = 3 if np.isinf(distance) else 6
    if len(cov) == n + 6:
        # station_from_camera * Exp(t): a point of the station moves by Exp(-t) in the camera
        by_mount = -motion_derivatives(by_point, points)
        by_mount[:, :, dim:] = 0.0
        rows = np.concatenate([by_lens, by_mount], axis=2)
        return np.asarray(rows @ cov @ rows.swapaxes(1, 2))
    part = np.ones(len(uv), dtype=np.bool_) if fitted is None else fitted
    by_motion = motion_derivatives(by_point, points)[:, :, :dim]
    gain = np.linalg.lstsq(by_motion[part].reshape(-1, dim), by_lens[part].reshape(-1, n), rcond=None)[0]
    rows = by_lens - by_motion @ gain
    return np.asarray(rows @ cov @ rows.swapaxes(1, 2))


def worst_sigma(cov: FloatArray) -> FloatArray:
    """Sigmas (n,) px in the worst direction of covariances (n, 2, 2)."""
    return np.asarray(np.sqrt(np.clip(np.linalg.eigvalsh(cov)[:, -1], 0.0, None)))
