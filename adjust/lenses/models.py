"""The lens models by name: parameters, units, constants, start values, and projection of whole arrays both ways.

All models use the camera frame x right, y down, z forward and pixels with the first pixel's centre at (0, 0). The
models in millimetres measure the image with y up from the image's centre (``brown_backward``, ``aicon``) or from the
pixel origin (``brown_backward_dbat``). The formulas are in ``adjust/native/lenses.h``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from adjust.lenses.radial import RadialProfile, invert_radius, radial_profile
from adjust.model.errors import SurveyError, listed
from adjust.model.survey import BoolArray, Camera, FloatArray
from adjust.native import lenses as kernels
from adjust.native.parallel import run_split, split_blocks

RAY_TOLERANCE = 1e-13
"""Newton's last step on a ray, in tangents of the angle to the axis."""
PIXEL_TOLERANCE = 1e-7
"""What a solved point may miss its equation by, px: far above rounding, far below any measurement."""
BEYOND_LIMIT = 1.02
"""Tangential terms move the fold of the image a little off the radius where the radial function turns back."""
WELL_INSIDE = 0.9
"""Share of that radius up to which a solution is the one on this side of the fold, wherever it was started."""
MAX_ITERATIONS = 50
_NEWTON = kernels.Newton(MAX_ITERATIONS, RAY_TOLERANCE, PIXEL_TOLERANCE)


@dataclass(frozen=True)
class LensModel:
    """A lens model: its number in the kernels, its parameters in order and their units.

    backward: the distortion is a correction of the measured point (and the residual is formed after it).
    """

    name: str
    kind: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    backward: bool = False

    @property
    def in_mm(self) -> bool:
        """Whether the parameters are in millimetres, so that the pixel size must be known."""
        return self.kind >= kernels.BROWN_BACKWARD

    @property
    def n(self) -> int:
        """Number of parameters."""
        return len(self.names)


def _model(name: str, kind: int, names_and_units: str, backward: bool = False) -> LensModel:
    """A model from "name:unit name:unit ..."."""
    pairs = [entry.split(":") for entry in names_and_units.split()]
    return LensModel(name, kind, tuple(p[0] for p in pairs), tuple(p[1] for p in pairs), backward)


MODELS: Mapping[str, LensModel] = {
    model.name: model
    for model in (
        _model(
            "brown",
            kernels.BROWN,
            "fx:px fy:px skew:px u0:px v0:px k1:1 k2:1 p1:1 p2:1 k3:1 k4:1 k5:1 k6:1",
        ),
        _model("fisheye", kernels.FISHEYE, "fx:px fy:px skew:px u0:px v0:px k1:1 k2:1 k3:1 k4:1"),
        _model(
            "brown_backward",
            kernels.BROWN_BACKWARD,
            "c:mm xp:mm yp:mm K1:1/mm^2 K2:1/mm^4 K3:1/mm^6 P1:1/mm P2:1/mm B1:1 B2:1",
            backward=True,
        ),
        _model(
            "brown_backward_dbat",
            kernels.BROWN_BACKWARD_DBAT,
            "c:mm px:mm py:mm as:1 K1:1/mm^2 K2:1/mm^4 K3:1/mm^6 P1:1/mm P2:1/mm",
            backward=True,
        ),
        _model(
            "aicon",
            kernels.AICON,
            "ck:mm xh:mm yh:mm A1:1/mm^2 A2:1/mm^4 A3:1/mm^6 B1:1/mm B2:1/mm C1:1 C2:1",
        ),
    )
}


def lens_model(name: LensModel | str) -> LensModel:
    """The model of that name (a model is returned as it is); raises SurveyError with the known names."""
    if isinstance(name, LensModel):
        return name
    if name not in MODELS:
        raise SurveyError(f"lens model {name!r} is not known; choose one of {', '.join(MODELS)}")
    return MODELS[name]


def lens_constants(
    model: LensModel | str, image_size: tuple[int, int], pixel_size_mm: float | None = None, r0_mm: float = 0.0
) -> FloatArray:
    """Constants (4,) of a camera for the kernels: pixel size, image centre u and v (px), balance radius r0 (mm).

    r0_mm: the radius at which AICON's radial distortion is zero; no other model uses it.
    """
    model = lens_model(model)
    if pixel_size_mm is None:
        if model.in_mm:
            raise SurveyError(f"lens model {model.name!r} is in millimetres: state the camera's pixel_size_mm")
        pixel_size_mm = 1.0
    if not (np.isfinite(pixel_size_mm) and pixel_size_mm > 0):
        raise SurveyError(f"pixel_size_mm is {pixel_size_mm}; it must be positive")
    width, height = image_size
    return np.array([pixel_size_mm, (width - 1) / 2, (height - 1) / 2, r0_mm])


def camera_constants(camera: Camera) -> FloatArray:
    """Constants (4,) of a camera of a survey, see :func:`lens_constants`."""
    lens = camera.lens
    return lens_constants(lens.model, camera.image_size, lens.pixel_size_mm, lens.balance_radius_mm)


def default_start(
    model: LensModel | str, image_size: tuple[int, int], focal_px: float, pixel_size_mm: float | None = None
) -> FloatArray:
    """Values (n,) of a camera without distortion, principal point in the middle of the image."""
    model = lens_model(model)
    s, u, v, _ = lens_constants(model, image_size, pixel_size_mm)
    values = np.zeros(model.n)
    if model.kind in (kernels.BROWN, kernels.FISHEYE):
        values[:5] = focal_px, focal_px, 0.0, u, v
    elif model.kind == kernels.BROWN_BACKWARD_DBAT:
        values[:3] = focal_px * s, u * s, v * s
    else:
        values[0] = focal_px * s
    return values


def focal_length_px(model: LensModel, values: FloatArray, constants: FloatArray) -> float:
    """Principal distance in px (mean of fx and fy where there are two)."""
    if model.in_mm:
        return float(values[0] / constants[0])
    return float(values[0] + values[1]) / 2


def lens_derivatives(
    model: LensModel, values: FloatArray, constants: FloatArray, x_in_camera: FloatArray, uv: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (n, 2) px and their derivatives by the lens (n, 2, n_lens) and by the point (n, 2, 3) px/m."""
    residuals, rows = kernels.lens_rows(model.kind, *_arrays(values, constants, x_in_camera, uv))
    return residuals, rows[:, :, : model.n], rows[:, :, kernels.MAX_LENS :]


def lens_residuals(
    model: LensModel, values: FloatArray, constants: FloatArray, x_in_camera: FloatArray, uv: FloatArray
) -> FloatArray:
    """Residuals (n, 2) px, predicted minus observed, of points (n, 3) m against image points (n, 2)."""
    residuals: FloatArray = kernels.lens_residuals(model.kind, *_arrays(values, constants, x_in_camera, uv))
    return residuals


def project(model: LensModel, values: FloatArray, constants: FloatArray, x_in_camera: FloatArray) -> FloatArray:
    """Image points (n, 2) px of points (n, 3) m in the camera frame.

    The backward models are solved for the measured point by Newton from the undistorted one. Raises SurveyError where
    that has no solution inside the radius up to which the correction is one to one; a fisheye's points may lie behind
    the camera, all others must lie in front of it.
    """
    q = np.ascontiguousarray(x_in_camera, dtype=np.float64)
    if model.kind != kernels.FISHEYE and np.any(q[:, 2] <= 0):
        raise SurveyError(f"{int(np.sum(q[:, 2] <= 0))} of {len(q)} points lie behind the camera: no image point")
    if not model.backward:
        return lens_residuals(model, values, constants, q, np.zeros((len(q), 2)))
    uv, found = _measured_points(model, values, constants, q)
    if not found.all():
        angles = np.degrees(np.arctan2(np.hypot(q[:, 0], q[:, 1]), q[:, 2]))[~found]
        raise SurveyError(
            f"{int(np.sum(~found))} of {len(q)} points, {angles.min():.2f} deg or more off the axis, have no image "
            f"point: the correction of {model.name} is one to one only up to "
            f"{monotone_radius_px(model, values, constants):.1f} px from the principal point"
        )
    return uv


def rays(model: LensModel, values: FloatArray, constants: FloatArray, uv: FloatArray) -> FloatArray:
    """Tangents (n, 2) = x/z, y/z of the rays of image points (n, 2) px.

    Raises SurveyError naming the pixels beyond the radius up to which the distortion can be inverted, and those of a
    fisheye at 90 degrees and more (see ``unit_rays``).
    """
    uv = np.ascontiguousarray(uv, dtype=np.float64)
    if model.kind == kernels.FISHEYE:
        unit = unit_rays(model, values, constants, uv)
        behind = unit[:, 2] <= 0
        if behind.any():
            raise SurveyError(f"{_pixels(uv, behind)} lie 90 deg or more off the axis: use unit rays")
        return np.asarray(unit[:, :2] / unit[:, 2:])
    if model.backward:
        on_axis = np.tile([0.0, 0.0, 1.0], (len(uv), 1))
        tangents: FloatArray = -lens_residuals(model, values, constants, on_axis, uv) * (constants[0] / values[0])
        return tangents
    return _forward_rays(model, values, constants, uv)


def unit_rays(model: LensModel, values: FloatArray, constants: FloatArray, uv: FloatArray) -> FloatArray:
    """Unit vectors (n, 3) in the camera frame of image points (n, 2) px, up to 180 degrees for the fisheye."""
    uv = np.ascontiguousarray(uv, dtype=np.float64)
    if model.kind != kernels.FISHEYE:
        tangents, unit = rays(model, values, constants, uv), np.empty((len(uv), 3))
        unit[:, 2] = 1.0 / np.sqrt(1.0 + tangents[:, 0] ** 2 + tangents[:, 1] ** 2)
        unit[:, :2] = tangents * unit[:, 2:]
        return unit
    distorted = _affine_inverse(values, uv)
    theta_d = np.hypot(distorted[:, 0], distorted[:, 1])
    theta, found = invert_radius(radial_profile(model.kind, values, constants), theta_d)
    _require_invertible(model, values, constants, uv, found)
    # sin(theta) / theta_d tends to 1 on the axis
    along = np.divide(np.sin(theta), theta_d, out=np.ones_like(theta), where=theta_d > 0)
    return np.column_stack([distorted * along[:, None], np.cos(theta)])


def monotone_radius_px(model: LensModel, values: FloatArray, constants: FloatArray) -> float:
    """Radius (px, about the principal point) in the image up to which the radial distortion is one to one.

    Infinite where the radial function grows for ever. Inside the image's corners it means that the outer part of the
    image has no meaning in this model: too many terms for the data, or a wrong sign.
    """
    profile = radial_profile(model.kind, values, constants)
    if not np.isfinite(profile.limit):
        return float("inf")
    if model.kind in (kernels.BROWN, kernels.FISHEYE):
        return float(profile.value(np.array([profile.limit]))[0] * min(values[0], values[1]))
    radius_mm = profile.limit if model.backward else float(profile.value(np.array([profile.limit]))[0])
    return float(radius_mm / constants[0])


def principal_point_px(model: LensModel, values: FloatArray, constants: FloatArray) -> FloatArray:
    """Image point (2,) px from which the radial distortion counts."""
    s, centre_u, centre_v, _ = constants
    if not model.in_mm:
        return np.array([values[3], values[4]])
    if model.kind == kernels.BROWN_BACKWARD_DBAT:
        return np.array([values[1] / s, values[2] / s])
    return np.array([centre_u + values[1] / s, centre_v - values[2] / s])


def _arrays(*arrays: FloatArray) -> tuple[FloatArray, ...]:
    """Contiguous float64 arrays, as the kernels take them."""
    return tuple(np.ascontiguousarray(a, dtype=np.float64) for a in arrays)


def _pixels(uv: FloatArray, which: BoolArray) -> str:
    """Some of the named pixels, for a message."""
    bad = uv[which]
    return f"pixels {listed([f'({u:.1f}, {v:.1f})' for u, v in bad], 5)}"


def _require_invertible(
    model: LensModel, values: FloatArray, constants: FloatArray, uv: FloatArray, found: BoolArray
) -> None:
    """Raise SurveyError naming the pixels that have no ray."""
    if not found.all():
        raise SurveyError(
            f"{_pixels(uv, ~found)} have no ray: the distortion of {model.name} is one to one only up to "
            f"{monotone_radius_px(model, values, constants):.1f} px from the principal point; "
            "estimate fewer distortion terms or leave these pixels out"
        )


def _affine_inverse(values: FloatArray, uv: FloatArray) -> FloatArray:
    """Distorted tangents (n, 2) of pixels, for the models with fx fy skew u0 v0."""
    fx, fy, skew, u0, v0 = values[:5]
    y = (uv[:, 1] - v0) / fy
    return np.column_stack([(uv[:, 0] - u0 - skew * y) / fx, y])


def _forward_rays(model: LensModel, values: FloatArray, constants: FloatArray, uv: FloatArray) -> FloatArray:
    """Tangents (n, 2) by Newton on the projection, from the distorted ones or else the inverse of its radial part."""
    profile = radial_profile(model.kind, values, constants)
    if model.kind == kernels.BROWN:
        scale, distorted = 1.0, _affine_inverse(values, uv)
    else:
        s, centre_u, centre_v, _ = constants
        scale = values[0]
        distorted = np.column_stack([(uv[:, 0] - centre_u) * s - values[1], (uv[:, 1] - centre_v) * s + values[2]])
    lens, constants, _, uv = _arrays(values, constants, np.zeros((0, 3)), uv)

    def solved(tangents: FloatArray, uv: FloatArray, most: float) -> BoolArray:
        found = np.zeros(len(uv), dtype=np.bool_)
        runs = split_blocks(np.arange(len(uv) + 1))
        run_split(kernels.tangents_of, runs, kernels.Lens(model.kind, lens, constants), uv, _NEWTON, tangents, found)
        if np.isfinite(profile.limit):
            found &= np.einsum("ij,ij->i", tangents, tangents) <= (profile.limit * most / scale) ** 2
        return found

    tangents = np.ascontiguousarray(distorted / scale)
    found = solved(tangents, uv, WELL_INSIDE)
    if not found.all():  # Newton went astray from the distorted point, or near the fold perhaps to its other side
        again = np.ascontiguousarray(_without_distortion(profile, distorted[~found]) / scale)
        better = solved(again, uv[~found], BEYOND_LIMIT)
        tangents[~found], found[~found] = again, better
    _require_invertible(model, values, constants, uv, found)
    return tangents


def _measured_points(
    model: LensModel, values: FloatArray, constants: FloatArray, q: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Image points (n, 2) px of a backward model by Newton on its correction, and which were found."""
    profile = radial_profile(model.kind, values, constants)
    # x right, y down, mm
    measured = _without_distortion(profile, values[0] * q[:, :2] / q[:, 2:])
    pixel_size_mm, stretch = constants[0], _stretch(model, values)
    principal_point = principal_point_px(model, values, constants)
    start = measured / (pixel_size_mm * stretch) + principal_point
    # yp of brown_backward points up, py of DBAT down as v does
    by_shift = pixel_size_mm * np.array([-1.0, 1.0 if model.kind == kernels.BROWN_BACKWARD else -1.0])

    def equation(uv: FloatArray) -> tuple[FloatArray, FloatArray]:
        residuals, by_lens, _ = lens_derivatives(model, values, constants, q, uv)
        # moving the principal point moves the measured point the other way
        return residuals, by_lens[:, :, 1:3] * by_shift

    uv, solved = _newton(equation, start, focal_length_px(model, values, constants))
    radius = np.linalg.norm((uv - principal_point) * pixel_size_mm * stretch, axis=1)
    return uv, solved & (radius <= profile.limit * BEYOND_LIMIT)


def _stretch(model: LensModel, values: FloatArray) -> FloatArray:
    """Factors (2,) on the measured x and y before the correction."""
    return np.array([1.0 + values[3] if model.kind == kernels.BROWN_BACKWARD_DBAT else 1.0, 1.0])


def _without_distortion(profile: RadialProfile, points: FloatArray) -> FloatArray:
    """Points (n, 2) with their radius taken back through the radial function."""
    radius = np.hypot(points[:, 0], points[:, 1])
    inverse, _ = invert_radius(profile, radius)
    ratio = np.divide(inverse, radius, out=np.ones_like(radius), where=radius > 0)
    return points * ratio[:, None]


def _newton(
    equation: Callable[[FloatArray], tuple[FloatArray, FloatArray]], start: FloatArray, scale: float
) -> tuple[FloatArray, BoolArray]:
    """Solutions (n, 2) of n equations in two unknowns, and which were found with a positive determinant.

    The determinant of every model is positive in the middle of the image; where it is not, the image is turned over.
    ``scale`` turns a step into tangents of angles.
    """
    x = start
    with np.errstate(all="ignore"):
        for _ in range(MAX_ITERATIONS):
            residuals, jacobians = equation(x)
            step, determinant = _solve_2x2(jacobians, residuals)
            x = x - step
            size = np.abs(step).max(axis=1, initial=0.0) / scale
            if not np.any(size > RAY_TOLERANCE * (1.0 + np.abs(x).max(axis=1, initial=0.0) / scale)):
                break
        residuals, jacobians = equation(x)
        _, determinant = _solve_2x2(jacobians, residuals)
        found: BoolArray = (np.abs(residuals).max(axis=1, initial=0.0) < PIXEL_TOLERANCE) & (determinant > 0)
    return x, found


def _solve_2x2(matrices: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solutions (n, 2) of n systems (n, 2, 2), and the determinants (n,)."""
    a, b, c, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1]
    determinant = a * d - b * c
    x = (d * right[:, 0] - b * right[:, 1]) / determinant
    y = (a * right[:, 1] - c * right[:, 0]) / determinant
    return np.column_stack([x, y]), determinant
