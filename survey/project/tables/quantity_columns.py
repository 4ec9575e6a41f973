"""One quantity of a table that may stand in one of several columns, each with its unit; angles also as text."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from adjust.model.survey import BoolArray, FloatArray
from survey.folder.units import to_si
from survey.project.tables.reading import Table, first_row

ANGLE_UNITS = ("deg", "gon", "arcsec", "mgon", "cc")
_DMS = re.compile(r"([+-]?)(\d+)-(\d+)-(\d+(?:\.\d*)?)")


def quantity(table: Table, name: str, units: Sequence[str], positive: bool = False) -> FloatArray:
    """Values (n,) in SI from whichever column ``name_unit`` gives them, nan where none does; raises where two do."""
    out = np.full(len(table), np.nan)
    source = ""
    for unit in units:
        column = f"{name}_{unit}"
        values = to_si(table.positive(column) if positive else table.numbers(column), unit)
        twice = ~np.isnan(values) & ~np.isnan(out)
        if twice.any():
            raise table.error(first_row(twice), f"{column}: {source} is given too; keep one of the two")
        if not np.isnan(values).all():
            source = column
        out = np.where(np.isnan(values), out, values)
    return out


def dms_angles(table: Table, column: str) -> FloatArray:
    """Angles (n,) rad written as degrees-minutes-seconds, ``12-34-56.7``; nan where blank."""
    text = table.text(column)
    values = np.full(len(text.names), np.nan)
    for code, name in enumerate(text.names):
        if not name:
            continue
        found = _DMS.fullmatch(name)
        rows = text.codes == code
        if found is None:
            example = "write degrees-minutes-seconds, as 12-34-56.7"
            raise table.error(first_row(rows), f"{column}: found {name!r}; {example}")
        sign, degrees, minutes, seconds = found.groups()
        if int(minutes) > 60 or float(seconds) > 60:  # 60 is what rounding makes of 59.99
            raise table.error(first_row(rows), f"{column}: found {name!r}; minutes and seconds go up to 60")
        arcseconds = int(degrees) * 3600 + int(minutes) * 60 + float(seconds)
        values[code] = to_si(-arcseconds if sign == "-" else arcseconds, "arcsec")
    return np.asarray(values[text.codes])


def one_of(table: Table, parts: Mapping[str, FloatArray]) -> FloatArray:
    """The value (n,) of each row from the one of ``parts`` that has it; raises where two have."""
    out = np.full(len(table), np.nan)
    for name, values in parts.items():
        twice = ~np.isnan(values) & ~np.isnan(out)
        if twice.any():
            raise table.error(first_row(twice), f"{name}: the value is given twice; keep one of {', '.join(parts)}")
        out = np.where(np.isnan(values), out, values)
    return out


def needed(table: Table, values: FloatArray, rows: BoolArray, advice: str) -> None:
    """Raise at the first of ``rows`` without a value."""
    missing = rows & np.isnan(values)
    if missing.any():
        raise table.error(first_row(missing), advice)
