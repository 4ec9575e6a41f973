"""A lens in the parameters of another model: the closest one over the whole image, how close, and its covariance.

The camera frame stays what it is, so no pose changes. Forward and backward models, tangent and angle, do not contain
each other: the conversion is a least-squares fit over the image, and states its largest difference anywhere in it.
What can be had in closed form is: affinity and skew (the start of the fit, exact without distortion) and the balance
radius of AICON's polynomial.
"""

from collections.abc import Sequence

import numpy as np

from adjust.lenses.compared import Optics, image_derivatives
from adjust.lenses.models import LensModel, lens_derivatives, principal_components, project
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.native import lenses as kernels

FIT_STEPS = (48, 36)
CHECK_STEPS = (160, 120)
STEP_TOLERANCE_PX = 1e-10
"""The fit ends when a step moves the image by less than this (rms)."""
MAX_ITERATIONS = 100
SMALLEST_SINGULAR = 1e-11
"""Relative singular value of the scaled fit below which a combination of parameters cannot be told apart."""
_DIFFERENCE_PX = 0.01
# k4 k5 k6 repeat nearly what k1 k2 k3 do: only on request
_USUALLY_HELD = ("k4", "k5", "k6")


@frozen(eq=False)
class Conversion:
    """A converted lens.

    values: (m,) in the order of the new model. jacobian: (m, n) derivative of the new values by the old ones.
    cov: (m, m) propagated from the old covariance (None without one); it says nothing of the difference of the models.
    rms_px, largest_difference_px: distance in the image between what both models make of one ray, over a grid finer
    than the fitted one; largest_at: the pixel (u, v) where it is largest.
    """

    values: FloatArray
    jacobian: FloatArray
    cov: FloatArray | None
    rms_px: float
    largest_difference_px: float
    largest_at: tuple[float, float]


def convert(
    model_from: LensModel,
    values: FloatArray,
    constants_from: FloatArray,
    model_to: LensModel,
    constants_to: FloatArray,
    image_size: tuple[int, int],
    *,
    free: Sequence[str] | None = None,
    cov: FloatArray | None = None,
) -> Conversion:
    """The lens of ``model_to`` nearest to the given one over the image.

    free: parameters of the new model to be fitted (None: all but the rational terms); the others are zero.
    cov: (n, n) covariance of ``values``.
    Raises SurveyError where a pixel has no ray in the old model or a ray no pixel in the new one, and where the free
    parameters cannot be told apart.
    """
    values = np.asarray(values, dtype=np.float64)
    columns = _free_columns(model_to, free)
    old, uv = Optics(model_from, values, constants_from), _grid(image_size, FIT_STEPS)
    rays, same_image = _rays(old, model_to, uv), np.array_equal(constants_from[:3], constants_to[:3])
    if model_from.kind == model_to.kind == kernels.AICON and free is None and same_image:
        fitted = rebalance_aicon(values, constants_from[3], constants_to[3])
    else:
        fitted = _fit(model_to, _start(old, model_to, constants_to, columns), constants_to, columns, rays, uv)
    jacobian = _jacobian(old, Optics(model_to, fitted, constants_to), columns, rays, uv)

    check = _grid(image_size, CHECK_STEPS)
    seen = project(model_to, fitted, constants_to, _rays(old, model_to, check))
    differences = np.linalg.norm(seen - check, axis=1)
    worst = int(np.argmax(differences))
    return Conversion(
        values=fitted,
        jacobian=jacobian,
        cov=None if cov is None else jacobian @ cov @ jacobian.T,
        rms_px=float(np.sqrt(np.mean(differences**2))),
        largest_difference_px=float(differences[worst]),
        largest_at=(float(check[worst, 0]), float(check[worst, 1])),
    )


def rebalance_aicon(values: FloatArray, r0_from_mm: float, r0_to_mm: float) -> FloatArray:
    """The same AICON lens (10,) with another balance radius, exactly; r0 = 0 is the unbalanced polynomial.

    With the ideal radius rho and D(rho) = A1 rho^2 + A2 rho^4 + A3 rho^6, the image keeps its place when ck becomes
    g ck, A_i become A_i / g^(2i+1), B_i become B_i / g^2, C_i become C_i / g, and g solves
    g - D(r0_to / g) = 1 - D(r0_from).
    """
    a = values[3:6]

    def radial(r: float) -> tuple[float, float]:
        powers = np.array([r**2, r**4, r**6])
        return float(a @ powers), float(a @ np.array([2 * r, 4 * r**3, 6 * r**5]))

    target = 1.0 - radial(r0_from_mm)[0]
    g = target
    for _ in range(MAX_ITERATIONS):
        distortion, slope = radial(r0_to_mm / g)
        step = (g - distortion - target) / (1.0 + slope * r0_to_mm / g**2)
        g -= step
        if not (np.isfinite(g) and g > 0):
            break
        if abs(step) < 1e-15:
            out = values * 1.0
            out[0] *= g
            out[3:6] = a / g ** np.array([3, 5, 7])
            out[6:8] /= g**2
            out[8:10] /= g
            return out
    raise SurveyError(f"this lens cannot be balanced at r0 = {r0_to_mm} mm: its distortion there is too large")


def _free_columns(model: LensModel, free: Sequence[str] | None) -> list[int]:
    """Positions of the fitted parameters."""
    if free is None:
        return [i for i, name in enumerate(model.names) if model.kind != kernels.BROWN or name not in _USUALLY_HELD]
    unknown = [name for name in free if name not in model.names]
    if unknown:
        raise SurveyError(f"lens model {model.name!r} has no parameter {unknown}; it has {', '.join(model.names)}")
    return [i for i, name in enumerate(model.names) if name in free]


def _grid(image_size: tuple[int, int], steps: tuple[int, int]) -> FloatArray:
    """Pixels (n, 2) evenly over the image, its outer edges included."""
    width, height = image_size
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, steps[0] + 1), np.linspace(-0.5, height - 0.5, steps[1] + 1))
    return np.column_stack([u.ravel(), v.ravel()])


def _rays(old: Optics, model_to: LensModel, uv: FloatArray) -> FloatArray:
    """Unit rays (n, 3), all of them in front of the camera unless the new model sees behind it."""
    directions = old.points(uv, np.inf)
    behind = directions[:, 2] <= 0
    if model_to.kind != kernels.FISHEYE and behind.any():
        u, v = uv[behind][0]
        raise SurveyError(
            f"{int(behind.sum())} of {len(uv)} pixels, such as ({u:.0f}, {v:.0f}), look 90 deg or more off the axis: "
            f"{model_to.name} has no image of them; convert within a smaller radius"
        )
    return directions


def _start(old: Optics, model_to: LensModel, constants_to: FloatArray, columns: list[int]) -> FloatArray:
    """Principal point, focal lengths and skew of the old lens on its axis, in the new parameters; no distortion."""
    axis = np.array([[0.0, 0.0, 1.0]])
    centre = project(old.model, old.values, old.constants, axis)
    (fx, skew, _), (_, fy, _) = image_derivatives(old, axis, centre)[1][0]
    if not (fx > 0 and fy > 0):
        raise SurveyError(f"the {old.model.name} lens turns its image over (fx {fx:.3g}, fy {fy:.3g} px)")
    start, (at, per_px, origin) = np.zeros(model_to.n), principal_components(model_to, constants_to)
    start[at] = per_px * (centre[0] - origin)
    if not model_to.in_mm:
        start[:3] = fx, fy, skew
    else:
        start[0] = fy * constants_to[0]
        if model_to.kind == kernels.BROWN_BACKWARD_DBAT:
            start[3] = fy / fx - 1.0
        else:
            start[8:10] = (fy / fx - 1.0, skew / fx) if model_to.backward else (fx / fy - 1.0, -skew / fy)
    start[np.setdiff1d(np.arange(model_to.n), columns)] = 0.0
    for name, value in zip(model_to.names[: 1 if model_to.in_mm else 2], start.tolist(), strict=False):
        if value == 0.0:  # there is no image without it
            raise SurveyError(f"{name} of the {model_to.name} lens must be among the fitted parameters")
    return start


def _fit(
    model: LensModel, start: FloatArray, constants: FloatArray, columns: list[int], rays: FloatArray, uv: FloatArray
) -> FloatArray:
    """Gauss-Newton on the model's own residuals; a step that does not improve the fit is halved."""

    def squares(values: FloatArray) -> float:
        return float(np.sum(lens_derivatives(model, values, constants, rays, uv)[0] ** 2))

    values = start
    for _ in range(MAX_ITERATIONS):
        residuals, by_lens, _ = lens_derivatives(model, values, constants, rays, uv)
        fit = _factorised(by_lens[:, :, columns].reshape(-1, len(columns)), [model.names[i] for i in columns])
        step = np.zeros(model.n)
        step[columns] = -np.linalg.solve(fit.R, fit.Q.T @ residuals.ravel()) / fit.scale
        moved = np.sqrt(np.mean((by_lens @ step) ** 2))
        if moved < STEP_TOLERANCE_PX:
            return np.asarray(values + step)
        before = float(np.sum(residuals**2))
        while moved > STEP_TOLERANCE_PX and not squares(values + step) <= before * (1 + 1e-12):
            step /= 2
            moved /= 2
        values = values + step
    raise SurveyError(
        f"no {model.name} lens with {', '.join(model.names[i] for i in columns)} fits this one: after {MAX_ITERATIONS} "
        f"steps the fit still moves by {moved:.1e} px; fit fewer parameters or a smaller part of the image"
    )


@frozen(eq=False)
class _Factorised:
    """QR decomposition of a matrix whose columns were divided by ``scale``."""

    Q: FloatArray
    R: FloatArray
    scale: FloatArray


def _factorised(matrix: FloatArray, names: list[str]) -> _Factorised:
    """The matrix of a fit, ready to solve; raises SurveyError naming what it cannot tell apart."""
    scale = np.linalg.norm(matrix, axis=0)
    if np.any(scale == 0):
        raise SurveyError(f"the image says nothing of {[n for n, s in zip(names, scale, strict=True) if s == 0]}")
    Q, R = np.linalg.qr(matrix / scale)
    _, singular, directions = np.linalg.svd(R)
    if singular[-1] < SMALLEST_SINGULAR * singular[0]:
        share = np.abs(directions[-1])
        together = [n for n, s in zip(names, share, strict=True) if s > 0.1 * share.max()]
        raise SurveyError(f"the image cannot tell {', '.join(together)} apart: fit fewer of them")
    return _Factorised(Q, R, scale)


def _jacobian(old: Optics, new: Optics, columns: list[int], rays: FloatArray, uv: FloatArray) -> FloatArray:
    """Derivative (m, n) of the fitted parameters x by the old ones.

    A pixel keeps its place while its ray q follows the old lens: dq = -(dr/dq)^+ (dr/dlens) dlens, across the ray. The
    fit keeps J'r = 0, so (J'J + S) dx = -(J'A + T) dlens with J = dr/dx, A = dr/dlens and, since the models differ,
    the second-order parts S = (dJ/dx)' r and T = (dJ/dlens)' r (by central differences; they vanish with the misfit).
    """
    _, by_old, by_q_old = lens_derivatives(old.model, old.values, old.constants, rays, uv)
    model_to, n_old = new.model, old.model.n
    ray_by_old = -np.linalg.pinv(by_q_old) @ by_old

    def new_lens(values: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        residuals, by_new, by_q = lens_derivatives(model_to, values, new.constants, q, uv)
        return residuals.ravel(), by_new[:, :, columns].reshape(-1, len(columns)), by_q

    residuals, J, by_q = new_lens(new.values, rays)
    A = (by_q @ ray_by_old).reshape(-1, n_old)
    fit = _factorised(J, [model_to.names[i] for i in columns])
    S = np.zeros((len(columns), len(columns)))
    for k, i in enumerate(columns):
        step = np.zeros(model_to.n)
        step[i] = _DIFFERENCE_PX / fit.scale[k] * np.sqrt(len(J))
        change = new_lens(new.values + step, rays)[1] - new_lens(new.values - step, rays)[1]
        S[:, k] = change.T @ residuals / (2 * step[i])
    T = np.zeros((len(columns), n_old))
    for i in np.flatnonzero(np.any(A != 0, axis=0)).tolist():
        size = _DIFFERENCE_PX / np.linalg.norm(A[:, i]) * np.sqrt(len(J))
        moved = size * ray_by_old[:, :, i]
        change = new_lens(new.values, rays + moved)[1] - new_lens(new.values, rays - moved)[1]
        T[:, i] = change.T @ residuals / (2 * size)

    # multiplied by inv(R') on the left, so that the condition number is not squared
    left = np.linalg.solve(fit.R.T, S / fit.scale / fit.scale[:, None])
    normal = np.eye(len(columns)) + np.linalg.solve(fit.R.T, left.T).T
    right = fit.Q.T @ A + np.linalg.solve(fit.R.T, T / fit.scale[:, None])
    jacobian = np.zeros((model_to.n, n_old))
    jacobian[columns] = -np.linalg.solve(fit.R, np.linalg.solve(normal, right)) / fit.scale[:, None]
    return jacobian
