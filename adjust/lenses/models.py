"""The lens models by name: parameters, units, constants, start values, and projection of whole arrays both ways.

All models use the camera frame x right, y down, z forward and pixels with the first pixel's centre at (0, 0). The
models in millimetres measure the image with y up from the image's centre (``brown_backward``, ``aicon``) or from the
pixel origin (``brown_backward_dbat``). The formulas are in ``adjust/native/lenses.h``.
"""

from collections.abc import Mapping

import numpy as np

from adjust.lenses.radial import RadialProfile, invert_radius, radial_profile
from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, Camera, FloatArray
from adjust.native import lenses as kernels

RAY_TOLERANCE = 1e-8
"""Newton's last step on a ray, in tangents of the angle to the axis: what is left is of the size of its square."""
BEYOND_LIMIT = 1.02
"""Tangential terms move the fold of the image a little off the radius where the radial function turns back."""
WELL_INSIDE = 0.9
"""Share of that radius up to which a solution is the one on this side of the fold, wherever it was started."""
MAX_ITERATIONS = 50
_NEWTON = kernels.Newton(MAX_ITERATIONS, RAY_TOLERANCE)


@frozen
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


FOCAL, CENTRE = ("fx", "fy", "c", "ck"), ("u0", "v0", "xp", "yp", "px", "py", "xh", "yh")
"""What the models call principal distance and principal point."""


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
    constants, values = lens_constants(model, image_size, pixel_size_mm), np.zeros(model.n)
    at, per_px, origin = principal_components(model, constants)
    values[: 1 if model.in_mm else 2] = focal_px * (constants[0] if model.in_mm else 1.0)
    values[at] = per_px * (constants[1:3] - origin)
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


def unit_rays(
    model: LensModel, values: FloatArray, constants: FloatArray, uv: FloatArray, out: FloatArray | None = None
) -> FloatArray:
    """Unit vectors (n, 3) in the camera frame of image points (n, 2) px, up to 180 degrees for the fisheye.

    out: where they go. Raises SurveyError naming the pixels beyond the radius up to which the distortion is one to one;
    in a backward model every point has a ray.
    """
    lens, uv = kernels.Lens(model.kind, *_arrays(values, constants)), np.ascontiguousarray(uv, dtype=np.float64)
    if model.backward:
        return kernels.rays_of(lens, uv, _NEWTON, np.inf, out=out)[0]
    profile = radial_profile(model.kind, values, constants)
    if model.kind == kernels.FISHEYE:
        distorted = _distorted(lens, uv)
        theta_d = np.hypot(distorted[:, 0], distorted[:, 1])
        theta, found = invert_radius(profile, theta_d)
        # sin(theta) / theta_d tends to 1 on the axis
        along = np.divide(np.sin(theta), theta_d, out=np.ones_like(theta), where=theta_d > 0)
        unit = np.concatenate([distorted * along[:, None], np.cos(theta)[:, None]], axis=1, out=out)
    else:
        scale = values[0] if model.in_mm else 1.0
        unit, found = kernels.rays_of(lens, uv, _NEWTON, profile.limit * WELL_INSIDE / scale, out=out)
        if not found.all():  # Newton went astray from the axis, or near the fold perhaps to its other side
            rest = np.ascontiguousarray(uv[~found])
            start = np.ascontiguousarray(_without_distortion(profile, _distorted(lens, rest)) / scale)
            again = kernels.rays_of(lens, rest, _NEWTON, profile.limit * BEYOND_LIMIT / scale, start)
            unit[~found], found[~found] = again
    if not found.all():
        lost = listed([f"({u:.1f}, {v:.1f})" for u, v in uv[~found]], 5)
        raise SurveyError(
            f"pixels {lost} have no ray: the distortion of {model.name} is one to one only up to "
            f"{monotone_radius_px(model, values, constants):.1f} px from the principal point; "
            "estimate fewer distortion terms or leave these pixels out"
        )
    return unit


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
    at, per_px, origin = principal_components(model, constants)
    return np.asarray(values[at] / per_px + origin)


def principal_components(model: LensModel, constants: FloatArray) -> tuple[list[int], FloatArray, FloatArray]:
    """Which two parameters are the principal point, in what per pixel (2,), and from which pixel (2,) they count."""
    if not model.in_mm:
        return [3, 4], np.ones(2), np.zeros(2)
    if model.kind == kernels.BROWN_BACKWARD_DBAT:
        return [1, 2], constants[0] * np.ones(2), np.zeros(2)
    return [1, 2], constants[0] * np.array([1.0, -1.0]), constants[1:3]  # y upwards from the middle of the image


def _arrays(*arrays: FloatArray) -> tuple[FloatArray, ...]:
    """Contiguous float64 arrays, as the kernels take them."""
    return tuple(np.ascontiguousarray(a, dtype=np.float64) for a in arrays)


def _distorted(lens: kernels.Lens, uv: FloatArray) -> FloatArray:
    """Pixels (n, 2) in the plane of the radial function of a forward model: tangents, of ``aicon`` mm, y down."""
    if lens.kind == kernels.AICON:
        s, centre_u, centre_v, _ = lens.constants
        return np.column_stack([(uv[:, 0] - centre_u) * s - lens.values[1], (uv[:, 1] - centre_v) * s + lens.values[2]])
    fx, fy, skew, u0, v0 = lens.values[:5]
    y = (uv[:, 1] - v0) / fy
    return np.column_stack([(uv[:, 0] - u0 - skew * y) / fx, y])


def _measured_points(
    model: LensModel, values: FloatArray, constants: FloatArray, q: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Image points (n, 2) px of a backward model by Newton on its correction, and which were found."""
    profile = radial_profile(model.kind, values, constants)
    # x right, y down, mm
    measured = _without_distortion(profile, values[0] * q[:, :2] / q[:, 2:])
    stretch = np.array([1.0 + values[3] if model.kind == kernels.BROWN_BACKWARD_DBAT else 1.0, 1.0])
    mm_of_px, principal_point = constants[0] * stretch, principal_point_px(model, values, constants)
    focal, lens = focal_length_px(model, values, constants), kernels.Lens(model.kind, *_arrays(values, constants))
    uv, solved = kernels.image_points_of(lens, q, _NEWTON, focal, measured / mm_of_px + principal_point)
    radius = np.linalg.norm((uv - principal_point) * mm_of_px, axis=1)
    return uv, solved & (radius <= profile.limit * BEYOND_LIMIT)


def _without_distortion(profile: RadialProfile, points: FloatArray) -> FloatArray:
    """Points (n, 2) with their radius taken back through the radial function."""
    radius = np.hypot(points[:, 0], points[:, 1])
    inverse, _ = invert_radius(profile, radius)
    ratio = np.divide(inverse, radius, out=np.ones_like(radius), where=radius > 0)
    return points * ratio[:, None]
