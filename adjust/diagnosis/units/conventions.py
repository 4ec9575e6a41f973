"""The ways in which a number is misread, each with the words for it: true value = ``mend`` (value as read).

Ratios of units and conventions of angles are exact; a ratio that observations show is compared with them.
"""

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from adjust.diagnosis.hypothesis import Place
from adjust.model.frozen import frozen
from adjust.model.observations import ReadingKind
from adjust.model.survey import FloatArray, IntArray

ANGLES: tuple[ReadingKind, ...] = ("direction", "angle", "azimuth", "zenith")
TURNS: tuple[ReadingKind, ...] = ("direction", "angle", "azimuth")
_SMALLER = 0.1
UNITS = {"m": "metres", "mm": "millimetres", "deg": "degrees", "gon": "gon", "mgon": "milligon", "arcsec": "arcseconds",
          "cc": "cc"}  # fmt: skip
"""Words for the units in which tables can be written."""
LENGTHS: tuple[ReadingKind, ...] = ("slope_distance", "horizontal_distance", "height_difference")


@frozen(eq=False)
class Written:
    """How the tables of a project write what was observed, as far as that is known.

    units: in which the numbers of a quantity stand ("mm", "gon"), by table and quantity: ``terrestrial.value``,
    ``pairs.sigma``. euler: (3,) rad about x, y, z of the pairs whose rotation is given by these, by id, as they stand:
    a rotation does not say beyond which turn they were.
    """

    units: Mapping[str, frozenset[str]] = field(default_factory=dict)
    euler: Mapping[str, FloatArray] = field(default_factory=dict)

    def words(self, quantity: str) -> frozenset[str]:
        """The units of a quantity in words; none where they are not known."""
        return frozenset(UNITS[u] for u in self.units.get(quantity, ()))

    def can_be(self, said: str, quantity: str) -> bool:
        """Whether "are gon, read as degrees" can be: what a table can be written in is read in its own unit."""
        known, read = self.words(quantity), said.split()[-1]
        return not known or read in known or read not in UNITS.values()


UNKNOWN = Written()


@frozen(eq=False)
class Scope:
    """Readings or pairs (rows) that are mended together; text: what they are called."""

    rows: IntArray
    text: str
    place: Place


@frozen
class Misreading:
    """True value = factor * read + offset (rad or m).

    name: of the kind of mistake. said: what is wrong with the values. kinds: of readings that can be misread so.
    """

    name: str
    said: str
    factor: float
    offset: float
    kinds: tuple[ReadingKind, ...]

    def mend(self, values: FloatArray) -> FloatArray:
        """(n,) true values of values as they were read."""
        return np.asarray(self.factor * values + self.offset)

    def text(self, whose: str) -> str:
        """What is wrong with which of them; whose: "their" or "its"."""
        what = "its decimal point" if self.name == "slipped decimal" else f"{whose} values"
        return f"{what} {self.said}"

    def may_be(self, widest: float) -> bool:
        """Whether values of which the largest is that (rad or m) can have been read so: a circle has one turn.

        Two of them are allowed for. A unit that is larger than a tenth of the one it was read as leaves readings
        beyond a turn, save where all of them lie in a small sector.
        """
        if self.kinds[0] not in ANGLES or self.offset:
            return True
        turned = abs(self.factor) > _SMALLER or widest > 2.0 * np.pi
        return turned and abs(self.factor) * widest <= 4.0 * np.pi


def shrinking(factor: float, n: int) -> float:
    """What n numbers that become smaller by a factor add to minus twice the log likelihood of those that were read.

    The density of ``y`` is that of ``factor * y`` times ``factor``: else a unit that makes all of them nearly zero, and
    so less than their sigmas, would explain whatever contradicts in them. What makes them larger earns nothing by that.
    """
    return -2.0 * n * min(0.0, float(np.log(abs(factor))))


def _scaled(name: str, kinds: tuple[ReadingKind, ...], ratios: dict[str, float]) -> list[Misreading]:
    return [Misreading(name, said, ratio, 0.0, kinds) for said, ratio in ratios.items()]


UNIT_OF_LENGTHS = "unit of lengths"
LENGTH_RATIOS = {
    "are metres, read as millimetres": 1000.0,
    "are millimetres, read as metres": 0.001,
    "are inches, read as millimetres": 25.4,
    "are millimetres, read as inches": 1.0 / 25.4,
    "are feet, read as metres": 0.3048,
    "are metres, read as feet": 1.0 / 0.3048,
    "are centimetres, read as millimetres": 10.0,
    "are centimetres, read as metres": 0.01,
    "are inches, read as metres": 0.0254,
    "are micrometres, read as metres": 1e-6,
    "are micrometres, read as millimetres": 1e-3,
}
ANGLE_RATIOS = {
    "are gon, read as degrees": 0.9,
    "are degrees, read as gon": 1.0 / 0.9,
    "are radians, read as degrees": 180.0 / np.pi,
    "are radians, read as gon": 200.0 / np.pi,
    "are degrees, read as radians": np.pi / 180.0,
    "are gon, read as radians": np.pi / 200.0,
    "are arcseconds, read as degrees": 1.0 / 3600.0,
    "are degrees, read as arcseconds": 3600.0,
}
MISREADINGS: tuple[Misreading, ...] = (
    *_scaled(UNIT_OF_LENGTHS, LENGTHS, LENGTH_RATIOS),
    *_scaled("unit of angles", ANGLES, ANGLE_RATIOS),
    Misreading("sense of rotation", "count the other way round", -1.0, 0.0, TURNS),
    Misreading("angles from another zero", "are elevations, read as zenith angles", -1.0, np.pi / 2.0, ("zenith",)),
    Misreading("angles from another zero", "are nadir angles, read as zenith angles", -1.0, np.pi, ("zenith",)),
    Misreading("angles from another zero", "are zenith angles of the second face", -1.0, 2.0 * np.pi, ("zenith",)),
    Misreading("sign of height differences", "have the other sign", -1.0, 0.0, ("height_difference",)),
)
SLIPS = (10.0, 0.1, 100.0, 0.01)


def misreadings(written: Written, table: str) -> list[Misreading]:
    """The ways in which the values of a table can be misread, of those that say the same the first."""
    every = [m for m in MISREADINGS if written.can_be(m.said, f"{table}.value")]
    return list({(m.kinds, m.factor, m.offset): m for m in reversed(every)}.values())[::-1]


def slips(kind: ReadingKind, value: float) -> list[Misreading]:
    """Of the decimal point, tried on single values alone."""
    return [Misreading("slipped decimal", f"has slipped: {value:.9g} for {f * value:.9g} (SI)", f, 0.0, (kind,))
            for f in SLIPS]  # fmt: skip
