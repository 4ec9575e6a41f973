"""Units that people type and read, and the SI values inside."""

import math

import numpy as np
import numpy.typing as npt

from adjust.model.survey import FloatArray

RAD_PER_DEG = math.pi / 180.0
RAD_PER_ARCSEC = math.pi / 648000.0
RAD_PER_GON = math.pi / 200.0
_PER_UNIT = {"gon": RAD_PER_GON, "mgon": RAD_PER_GON / 1e3, "cc": RAD_PER_GON / 1e4}
_UNITS = ("mm", "m", "deg", "arcsec", "gon", "mgon", "cc", "px", "rad", "mm2", "ppm", "mm_per_m", "ppm_per_K", "ms",
          "us", "s", "1")  # fmt: skip


def unit_in(name: str) -> str:
    """The unit that a name ends with, as ``sigma_mm`` does; "1" where it has none."""
    return max((unit for unit in _UNITS if name.endswith(f"_{unit}")), key=len, default="1")


def to_si(value: npt.ArrayLike, unit: str) -> FloatArray:
    """Values in ``unit`` as metres, radians, pixels or plain numbers; the same shape."""
    x = np.asarray(value, dtype=float)
    match unit:
        case "mm":
            return np.asarray(x / 1000.0)  # dividing rounds once: 20 mm is exactly 0.02 m
        case "mm2":
            return np.asarray(x / 1e6)
        case "deg":
            return np.asarray(x * RAD_PER_DEG)
        case "arcsec":
            return np.asarray(x * RAD_PER_ARCSEC)
        case "gon" | "mgon" | "cc":
            return np.asarray(x * _PER_UNIT[unit])
        case "ppm" | "ppm_per_K":
            return np.asarray(x / 1e6)
        case "mm_per_m" | "ms":
            return np.asarray(x / 1e3)
        case "us":
            return np.asarray(x / 1e6)
        case "m" | "rad" | "px" | "s" | "1":
            return x
    raise ValueError(f"unknown unit {unit!r}; known: {_UNITS}")


def from_si(x: npt.ArrayLike, unit: str) -> FloatArray:
    """The inverse of ``to_si``, to the last bit where a double can do that; the same shape."""
    x = np.asarray(x, dtype=float)
    factors = {
        "mm": 1e3, "mm2": 1e6, "deg": 1 / RAD_PER_DEG, "arcsec": 1 / RAD_PER_ARCSEC, "ppm": 1e6, "mm_per_m": 1e3,
        "ppm_per_K": 1e6, "ms": 1e3, "us": 1e6,
    }  # fmt: skip
    factor = ({name: 1 / rad for name, rad in _PER_UNIT.items()} | factors).get(unit, 1.0)
    first = np.asarray(x * factor)
    if factor == 1.0 or not first.size:
        return first
    # The shortest decimal that returns: 0.1 mm is written as 0.1, not as 0.09999999999999999.
    candidates = [np.round(first, 9), first, np.nextafter(first, np.inf), np.nextafter(first, -np.inf)]
    result = first.copy()
    for candidate in reversed(candidates):
        result = np.where(to_si(candidate, unit) == x, candidate, result)
    return result
