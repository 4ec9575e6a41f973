"""What a turntable's geometry may hold: how its axes stand to each other, and how they move as they turn.

With x, y the two axes after the turning one in cyclic order and a its angle as read, every axis turns its load by

    Shift(radial_x, radial_y, axial) Turn_x(tilt_x) Turn_y(tilt_y) Turn(a + zero + angle)

where ``angle`` (errors of graduation and eccentricity of the encoder) and ``axial`` are ``sum cos_k cos(k a) + sin_k
sin(k a)`` over k = 1, 2, ..., and ``radial_x + i radial_y`` (run-out) and ``tilt_x + i tilt_y`` (wobble) are
``sum (re_k + i im_k) exp(i k a)`` over k = -1, 2, -2, 3, ...: order 0 is the place of the axis and +1 that of its load,
which are unknowns already (motions of an axis as in ISO 230-7).
"""

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache

from adjust.model.frozen import frozen

HARMONICS: Mapping[str, str] = {"angle": "rad", "axial": "m", "radial": "m", "tilt": "rad"}
"""Kinds of harmonics and their units."""
HIGHEST = 8
"""Order up to which there are names."""
_REAL, _COMPLEX = ("cos", "sin"), ("re", "im")
_NAME = re.compile(r"(angle|axial|radial|tilt)_([12])_(cos|sin|re|im)_([mp]?)([1-9]\d*)")


@frozen
class Harmonic:
    """One component: of which kind and axis (0 or 1), its signed order k, and whether it is the second of its pair."""

    kind: str
    axis: int
    order: int
    second: bool

    @property
    def term(self) -> str:
        """The name of the pair that only means something together."""
        sign = "" if self.kind in ("angle", "axial") else "+" if self.order > 0 else "-"
        return f"{self.kind}_{self.axis + 1}_order_{sign}{abs(self.order)}"


@lru_cache(1024)
def harmonic(name: str) -> Harmonic | None:
    """What a component of a table's geometry is; None where it is no harmonic, or one that cannot be told."""
    found = _NAME.fullmatch(name)
    if found is None:
        return None
    kind, axis, part, sign, order = found.groups()
    k, real = int(order) * (-1 if sign == "m" else 1), kind in ("angle", "axial")
    if real != (part in _REAL) or real != (sign == "") or k > HIGHEST or k < -HIGHEST or (not real and k == 1):
        return None
    return Harmonic(kind, int(axis) - 1, k, part in ("sin", "im"))


def harmonic_names(kind: str, axis: int, highest: int) -> tuple[str, ...]:
    """All components of a kind up to an order, of axis 0 or 1."""
    if kind in ("angle", "axial"):
        return tuple(f"{kind}_{axis + 1}_{part}_{k}" for k in range(1, highest + 1) for part in _REAL)
    orders = [sign + str(k) for k in range(1, highest + 1) for sign in "mp" if (sign, k) != ("p", 1)]
    return tuple(f"{kind}_{axis + 1}_{part}_{order}" for order in orders for part in _COMPLEX)


def unit_of(name: str) -> str:
    """The unit of a component of a table's geometry."""
    found = harmonic(name)
    return HARMONICS[found.kind] if found is not None else "m" if name == "axis_offset" else "rad"


def in_order(names: Sequence[str]) -> list[str]:
    """Harmonics by axis, kind and order."""

    def place(name: str) -> tuple[int, int, int, bool, bool]:
        h = harmonic(name)
        return (0, 0, 0, False, False) if h is None else (
            h.axis, list(HARMONICS).index(h.kind), abs(h.order), h.order > 0, h.second)  # fmt: skip

    return sorted(names, key=place)
