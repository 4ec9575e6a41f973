"""The radial part of the lens models: where it is one to one, and its inverse there.

Every model maps a radius r (tangent of the angle to the axis, the angle itself for the fisheye, mm for the models in
mm) to ``f(r) = r N(r^2) / D(r^2)``, N and D polynomials with ascending coefficients.
"""

from functools import lru_cache

import numpy as np
from numpy.polynomial import polynomial

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray
from adjust.native import lenses as kernels

SMALLEST_ROOT = 1e-12
"""Reciprocals of squared radii below this mean that the radius is out of any camera's sight."""


@frozen(eq=False)
class RadialProfile:
    """A radial function f(r) = r N(r^2) / D(r^2) that grows from 0 to ``limit`` (infinite where it always grows)."""

    numerator: FloatArray
    denominator: FloatArray
    limit: float

    def value(self, radius: FloatArray) -> FloatArray:
        """f, element by element."""
        w = np.asarray(radius) ** 2
        f: FloatArray = radius * polynomial.polyval(w, self.numerator) / polynomial.polyval(w, self.denominator)
        return f


def radial_profile(kind: int, values: FloatArray, constants: FloatArray) -> RadialProfile:
    """The radial function of a lens: undistorted to distorted radius, measured to corrected for backward models."""
    v = [float(x) for x in values]
    if kind == kernels.BROWN:
        return _profile((1.0, v[5], v[6], v[9]), (1.0, v[10], v[11], v[12]))
    if kind == kernels.FISHEYE:
        return _profile((1.0, *v[5:9]), largest=float(np.pi))
    if kind == kernels.BROWN_BACKWARD:
        return _profile((1.0, *v[3:6]))
    if kind == kernels.BROWN_BACKWARD_DBAT:
        return _profile((1.0, *v[4:7]))
    w0 = float(constants[3]) ** 2
    balance = w0 * (v[3] + w0 * (v[4] + w0 * v[5]))
    return _profile((1.0 - balance, *v[3:6]))


def invert_radius(profile: RadialProfile, target: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Radii r with f(r) = target below the profile's limit, and which were found (the others are at the limit)."""
    return kernels.radii_of(profile.numerator, profile.denominator, profile.limit, np.ascontiguousarray(target))


@lru_cache(64)  # a search for start values asks again and again for the lens without distortion
def _profile(
    numerator: tuple[float, ...], denominator: tuple[float, ...] = (1.0,), largest: float = float("inf")
) -> RadialProfile:
    """The profile with its limit: the first radius where f stops growing or its denominator vanishes."""
    top, bottom = np.array(numerator), np.array(denominator)
    limit = min(_first_root(_growth(top, bottom)), _first_root(bottom), largest)
    return RadialProfile(top, bottom, limit)


def _growth(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Numerator of df/dr over D^2, a polynomial in w = r^2: (N + 2 w N') D - 2 w N D'."""
    orders = 2 * np.arange(len(numerator))
    first = polynomial.polymul(numerator * (1 + orders), denominator)
    second = polynomial.polymul(numerator, denominator * 2 * np.arange(len(denominator)))
    return np.asarray(polynomial.polysub(first, second), dtype=np.float64)


def _first_root(coefficients: FloatArray) -> float:
    """Radius at the smallest positive zero of a polynomial in r^2, infinite without one.

    Solved for 1 / r^2, because then the leading coefficient is the one at r = 0, which is never small.
    """
    if coefficients[0] <= 0:
        return 0.0
    if np.all(coefficients >= 0.0):  # Descartes' rule of signs
        return float("inf")
    reciprocals = np.roots(coefficients)
    real = reciprocals.real[np.abs(reciprocals.imag) <= 1e-9 * np.abs(reciprocals)]
    largest = float(np.max(real, initial=0.0))
    return float(largest**-0.5) if largest > SMALLEST_ROOT else float("inf")
