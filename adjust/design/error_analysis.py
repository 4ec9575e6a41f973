"""How errors of beacons and of camera poses become errors of image points: Monte Carlo beside first-order propagation.

After section 3 of the three-camera head's paper (equations 4 to 10). The camera stands at the world's origin with its
axes along the world's, so that with ``x = X / Z`` and ``y = Y / Z`` the errors of u are, to first order,

- beacon or camera position by (dX, dY, dZ):  ``alpha (dX - x dZ) / Z``, the same function for both (equations 7, 8);
- camera attitude by Euler angles 2-1-3 (dphi, dtheta, dpsi):  ``alpha (x y dphi - (1 + x^2) dtheta + y dpsi)``.

With equal, independent standard deviations s of the three components, the RMS over beacons that are uniform over the
visible part of the X-Z plane, from depth n to depth f (there x is uniform, and the density of Z grows as Z), is s times

    position:  alpha sqrt((1 + E x^2) E 1/Z^2),        E 1/Z^2 = 2 ln(f / n) / (f^2 - n^2)
    attitude:  alpha sqrt(E (1 + x^2) (1 + x^2 + y^2))

The position integrand has a heavy tail: its mean grows without bound, as the root of the logarithm, when n goes to
zero, so that the RMS of a simulation without a nearest depth depends on the nearest beacon it happened to draw: with N
trials that is about f / sqrt(N). The second order adds ``3 alpha^2 s^4 (1 + 3 E x^2) E 1/Z^4`` with
``E 1/Z^4 = 1 / (n f)^2``; beyond s of about n / 4 no expansion holds, since beacons get behind the camera.
"""

from typing import Literal

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.spatial.rotation_forms import matrix_from_euler

ErrorKind = Literal["beacon position", "camera position", "camera attitude"]
ERROR_KINDS: tuple[ErrorKind, ...] = ("beacon position", "camera position", "camera attitude")


@frozen
class BeaconField:
    """A camera and where its beacons may be: in the image, to the right of the principal point, at some depth.

    The defaults are the paper's: an image of 1280 x 1024 px, beacons from 0 to 1 m in X and Z. ``nearest_m`` = 0 puts
    no limit to the depth; there is no expectation then, only what ``n_trials`` draws give.
    """

    alpha_px: float = 1600.0
    u0_px: float = 640.0
    v0_px: float = 512.0
    image_size: tuple[int, int] = (1280, 1024)
    nearest_m: float = 0.0
    farthest_m: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.nearest_m < self.farthest_m:
            raise SurveyError(
                f"beacons between {self.nearest_m} m and {self.farthest_m} m: give 0 <= nearest_m < farthest_m"
            )
        if not (0.0 < self.u0_px < self.image_size[0] and 0.0 < self.v0_px < self.image_size[1]):
            raise SurveyError(
                f"principal point ({self.u0_px}, {self.v0_px}) px is outside the image of {self.image_size} px"
            )

    @property
    def widest(self) -> float:
        """Largest x = X / Z in the image."""
        return (self.image_size[0] - self.u0_px) / self.alpha_px

    @property
    def heights(self) -> tuple[float, float]:
        """Range of y = Y / Z in the image."""
        return -self.v0_px / self.alpha_px, (self.image_size[1] - self.v0_px) / self.alpha_px

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Beacons (n, 3) m in the camera, uniform over the visible part of the X-Z plane and the image's height."""
        low, high = self.nearest_m**2, self.farthest_m**2
        Z = np.sqrt(high - (high - low) * rng.random(n))  # in (nearest, farthest]: never at the centre itself
        x, y = rng.uniform(0.0, self.widest, n), rng.uniform(*self.heights, n)
        return np.stack([x * Z, y * Z, Z], axis=1)

    def inverse_square(self) -> float:
        """Mean of 1 / Z^2; infinite without a nearest depth."""
        n, f = self.nearest_m, self.farthest_m
        return 2.0 * float(np.log(f / n)) / (f * f - n * n) if n > 0.0 else float("inf")


def pixel_errors(
    kind: ErrorKind, x_in_camera: FloatArray, errors: FloatArray, alpha_px: float = 1600.0
) -> FloatArray:
    """Exact errors (n, 2) px of the image points of beacons (n, 3) m by errors (n, 3) of one kind, in m or rad.

    Equations 6, 8 and 10; the camera's axes are the world's.
    """
    if kind == "camera attitude":
        moved = np.einsum("nij,nj->ni", matrix_from_euler(errors, "213"), x_in_camera)
    else:
        moved = x_in_camera + errors
    return np.asarray(alpha_px * (moved[:, :2] / moved[:, 2:] - x_in_camera[:, :2] / x_in_camera[:, 2:]))


def u_jacobian(kind: ErrorKind, x_in_camera: FloatArray, alpha_px: float = 1600.0) -> FloatArray:
    """Derivatives (n, 3) of u by the three errors of one kind, px per m or rad."""
    X, Y, Z = x_in_camera.T
    x, y = X / Z, Y / Z
    if kind == "camera attitude":
        return alpha_px * np.stack([x * y, -(1.0 + x * x), y], axis=1)
    return alpha_px * np.stack([1.0 / Z, np.zeros_like(Z), -x / Z], axis=1)


def expected_slope(kind: ErrorKind, field: BeaconField) -> float:
    """First-order RMS error of u per unit of sigma, px per m or rad, over all beacons of the field (see the module)."""
    x2, x4 = field.widest**2 / 3.0, field.widest**4 / 5.0
    if kind != "camera attitude":
        return field.alpha_px * float(np.sqrt((1.0 + x2) * field.inverse_square()))
    low, high = field.heights
    y2 = (high**3 - low**3) / (3.0 * (high - low))
    return field.alpha_px * float(np.sqrt(1.0 + 2.0 * x2 + x4 + y2 * (1.0 + x2)))


def second_order(kind: ErrorKind, field: BeaconField, sigmas: FloatArray) -> FloatArray:
    """RMS error of u (k,) px with the next term of the expansion; of attitudes it is below 0.1 % up to a degree."""
    first = (expected_slope(kind, field) * sigmas) ** 2
    if kind == "camera attitude":
        return np.sqrt(first)
    if field.nearest_m == 0.0:
        return np.full(np.shape(sigmas), np.inf)
    inverse_fourth = 1.0 / (field.nearest_m * field.farthest_m) ** 2
    return np.sqrt(first + 3.0 * field.alpha_px**2 * sigmas**4 * (1.0 + field.widest**2) * inverse_fourth)


def tolerance(rms_px: float, slope: float) -> float:
    """The standard deviation (m or rad) of each component that keeps the RMS error of u at ``rms_px``."""
    if not (rms_px > 0.0 and slope > 0.0):
        raise SurveyError(f"no tolerance from {rms_px} px and a slope of {slope} px per unit; both have to be positive")
    return rms_px / slope
