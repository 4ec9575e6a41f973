"""Units that people type and read, and the SI values inside."""

import math

import numpy as np
import numpy.typing as npt

from adjust.model.arrays import FloatArray

RAD_PER_DEG = math.pi / 180.0
RAD_PER_ARCSEC = math.pi / 648000.0
RAD_PER_GON = math.pi / 200.0
_SI = {
    "mm": (1.0, 1e3), "m": (1.0, 1.0), "mm2": (1.0, 1e6), "deg": (RAD_PER_DEG, 1.0), "arcsec": (RAD_PER_ARCSEC, 1.0),
    "gon": (RAD_PER_GON, 1.0), "mgon": (RAD_PER_GON / 1e3, 1.0), "cc": (RAD_PER_GON / 1e4, 1.0), "rad": (1.0, 1.0),
    "px": (1.0, 1.0), "ppm": (1.0, 1e6), "ppm_per_K": (1.0, 1e6), "mm_per_m": (1.0, 1e3), "s": (1.0, 1.0),
    "ms": (1.0, 1e3), "us": (1.0, 1e6), "1": (1.0, 1.0),
}  # fmt: skip
"""Of every unit by what a value is multiplied, and by what divided: dividing rounds once, 20 mm is exactly 0.02 m."""


def unit_in(name: str) -> str:
    """The unit that a name ends with, as ``sigma_mm`` does; "1" where it has none."""
    return max((unit for unit in _SI if name.endswith(f"_{unit}")), key=len, default="1")


def to_si(value: npt.ArrayLike, unit: str) -> FloatArray:
    """Values in ``unit`` as metres, radians, pixels or plain numbers; the same shape."""
    if unit not in _SI:
        raise ValueError(f"unknown unit {unit!r}; known: {tuple(_SI)}")
    (factor, divisor), x = _SI[unit], np.asarray(value, dtype=float)
    return x if factor == divisor else np.asarray(x * factor if divisor == 1.0 else x / divisor)


def from_si(x: npt.ArrayLike, unit: str) -> FloatArray:
    """The inverse of ``to_si``, to the last bit where a double can do that; the same shape."""
    x = np.asarray(x, dtype=float)
    factor, divisor = _SI[unit]
    first = np.asarray(x * (divisor / factor))
    if factor == divisor or not first.size:
        return first
    # The shortest decimal that returns: 0.1 mm is written as 0.1, not as 0.09999999999999999.
    candidates = [np.round(first, 9), first, np.nextafter(first, np.inf), np.nextafter(first, -np.inf)]
    result = first.copy()
    for candidate in reversed(candidates):
        result = np.where(to_si(candidate, unit) == x, candidate, result)
    return result
