"""A whole network in one plain table: points, readings, baselines and coordinates, one row each.

Columns are those of ``COLUMNS``; what a row does not need stays blank. Values of angles stand under ``value_gon`` or
``value_deg``, their sigmas under ``sigma_cc`` or ``sigma_arcsec``. Rows of kind ``point`` give start values, ``hold``
names the axes that keep them, ``datum`` is yes for the points of inner constraints; ``coordinates`` and
``coordinate_difference`` use x_m to sigma_z_mm; ``bearings`` has the zero axis as ``from_id`` and clockwise or
counterclockwise as ``to_id``; ``adjusted`` rows are results and not read. Covariances between rows are not held.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import get_args

import numpy as np

from adjust.model.observations import Reading, ReadingKind
from adjust.model.survey import Bearings, FloatArray, Survey
from survey.folder.text import csv_rows, csv_text, suggestion
from survey.interop.networks.draft import AXES, NetworkDraft, Vectors
from survey.interop.networks.foreign import (
    ARCSEC,
    CC,
    DEGREE,
    GON,
    MM,
    ForeignNetwork,
    Where,
    number,
    positive,
    text_of,
)
from survey.interop.networks.values import NetworkValues, point_of, readings_of, triples_of
from survey.project.tables.layouts import HEIGHTS
from survey.project.tables.terrestrial import ANGLES

COLUMNS = (
    "kind", "id", "from_id", "to_id", "second_id", "setup_id", "value_m", "value_gon", "value_deg", "sigma_mm",
    "sigma_cc", "sigma_arcsec", "instrument_height_m", "target_height_m", "second_height_m", "x_m", "y_m", "z_m",
    "sigma_x_mm", "sigma_y_mm", "sigma_z_mm", "hold", "datum",
)  # fmt: skip
READINGS: tuple[ReadingKind, ...] = get_args(ReadingKind)
_KINDS = ("point", "coordinates", "coordinate_difference", "bearings", "adjusted", *READINGS)
_VALUES = {"value_m": 1.0, "value_gon": GON, "value_deg": DEGREE}
_SIGMAS = {"sigma_mm": MM, "sigma_cc": CC, "sigma_arcsec": ARCSEC}


def read_plain_csv(path: Path) -> ForeignNetwork:
    """A network from one table. Raises SurveyError with file and line for what cannot be read."""
    reader = _Reader()
    rows = ((Where(path, line), words) for line, words in csv_rows(path, text_of(path)) if any(map(str.strip, words)))
    first = next(rows, None)
    if first is None:
        raise Where(path, 1).error(f"the table is empty; its first line names the columns, as {', '.join(COLUMNS[:4])}")
    names = _header(first[1], first[0])
    for where, words in rows:
        if len(words) != len(names):
            raise where.error(f"found {len(words)} cells, the header has {len(names)}; correct the row")
        reader.row({k: w.strip() for k, w in zip(names, words, strict=True) if w.strip()}, where)
    survey = reader.draft.survey(reader.bearings)
    return ForeignNetwork(survey, path.stem, reject=True, notes=tuple(reader.draft.notes))


def _header(words: list[str], where: Where) -> list[str]:
    names = [word.strip() for word in words]
    for name in names:
        if name not in COLUMNS:
            raise where.error(f"unknown column {name!r}; {suggestion(name, COLUMNS)}")
    if "kind" not in names or len(set(names)) < len(names):
        raise where.error("the columns must differ, and 'kind' must be one of them")
    return names


class _Reader:
    def __init__(self) -> None:
        self.draft, self.bearings = NetworkDraft(), Bearings()

    def row(self, row: Mapping[str, str], where: Where) -> None:
        kind = row.get("kind", "")
        if kind == "point":
            self._point(row, where)
        elif kind in ("coordinates", "coordinate_difference"):
            self._vector(row, where)
        elif kind == "bearings":
            self._bearings(row, where)
        elif kind in READINGS:
            self._reading(next(k for k in READINGS if k == kind), row, where)
        elif kind != "adjusted":
            raise where.error(f"kind: found {kind!r}; {suggestion(kind, _KINDS)}")

    def _allow(self, row: Mapping[str, str], where: Where, *names: str) -> None:
        for name in row:
            if name not in ("kind", *names):
                raise where.error(f"{name}: a row of kind {row['kind']!r} has no such cell; leave it blank")

    def _need(self, row: Mapping[str, str], where: Where, name: str) -> str:
        if name not in row:
            raise where.error(f"{name}: is blank; fill it in")
        return row[name]

    def _point(self, row: Mapping[str, str], where: Where) -> None:
        self._allow(row, where, "from_id", "x_m", "y_m", "z_m", "hold", "datum")
        name, hold, datum = self._need(row, where, "from_id"), row.get("hold", ""), row.get("datum", "no")
        if set(hold) - set(AXES) or datum not in ("yes", "no"):
            raise where.error(f"hold names axes, as xy, and datum is yes or no; found {hold!r} and {datum!r}")
        start = {a: number(row[f"{a}_m"], f"{a}_m", where) for a in AXES if f"{a}_m" in row}
        missing = [a for a in hold if a not in start]
        if missing and len(hold) == 3:
            raise where.error(f"{missing[0]}_m: is held but blank; fill it in")
        free = "constrained" if datum == "yes" else "free"
        self.draft.add_point(name, where, start, {a: "fixed" if a in hold else free for a in AXES})

    def _bearings(self, row: Mapping[str, str], where: Where) -> None:
        self._allow(row, where, "from_id", "to_id")
        zero, sense = row.get("from_id", ""), row.get("to_id", "")
        if zero not in ("x", "y") or sense not in ("clockwise", "counterclockwise"):
            raise where.error(f"expected x or y, and clockwise or counterclockwise; found {zero!r} and {sense!r}")
        self.bearings = Bearings("x" if zero == "x" else "y", sense == "clockwise")

    def _vector(self, row: Mapping[str, str], where: Where) -> None:
        difference = row["kind"] == "coordinate_difference"
        ends = ("from_id", "to_id") if difference else ("from_id",)
        self._allow(row, where, "id", *ends, *(f"{a}_m" for a in AXES), *(f"sigma_{a}_mm" for a in AXES))
        ids = [self._need(row, where, end) for end in ends]
        values, variances = np.zeros((1, 3)), np.full(3, np.inf)
        for i, axis in enumerate(AXES):
            if difference or f"{axis}_m" in row:
                values[0, i] = number(self._need(row, where, f"{axis}_m"), f"{axis}_m", where)
                text = self._need(row, where, f"sigma_{axis}_mm")
                variances[i] = (positive(text, f"sigma_{axis}_mm", where) * MM) ** 2
        vectors = Vectors(where, ids[:-1], ids[-1:], values, np.diag(variances))
        (self.draft.differences if difference else self.draft.coordinates).append(vectors)

    def _reading(self, kind: ReadingKind, row: Mapping[str, str], where: Where) -> None:
        heights = [f"{name}_m" for name in HEIGHTS]
        second = ("second_id",) if kind == "angle" else ()
        self._allow(row, where, "id", "from_id", "to_id", *second, "setup_id", *_VALUES, *_SIGMAS, *heights)
        ends = [self._need(row, where, end) for end in ("from_id", "to_id", *second)]
        if len(set(ends)) < len(ends):
            raise where.error(f"the points {', '.join(ends)} must differ")
        angular = kind in ANGLES
        value = self._one(row, where, _VALUES, angular, "value_m", number)
        sigma = self._one(row, where, _SIGMAS, angular, "sigma_mm", positive)
        high = [number(row.get(name, "0"), name, where) for name in heights]
        setup = row.get("setup_id", ends[0]) if kind == "direction" else row.get("setup_id", "")
        self.draft.reading(
            kind, ends[0], ends[1], value, sigma, setup_id=self.draft.own_setup(setup) if setup else "",
            second=ends[2] if second else None, heights=(high[0], high[1], high[2]), name=row.get("id", ""),
        )  # fmt: skip

    def _one(
        self,
        row: Mapping[str, str],
        where: Where,
        units: Mapping[str, float],
        angular: bool,
        length: str,
        read: Callable[[str, str, Where], float],
    ) -> float:
        """The one cell among ``units`` that is filled, in SI."""
        allowed = [name for name in units if (name == length) != angular]
        found = [name for name in units if name in row]
        if len(found) != 1 or found[0] not in allowed:
            raise where.error(f"fill in one of {', '.join(allowed)}, found {', '.join(found) or 'none'}")
        return read(row[found[0]], found[0], where) * units[found[0]]


def plain_csv(network: NetworkValues) -> str:
    """The table of a network, with a row of kind ``adjusted`` per point where it was adjusted."""
    survey = network.survey
    zero, clockwise = survey.bearings.zero, survey.bearings.clockwise
    rows = [{"kind": "bearings", "from_id": zero, "to_id": "clockwise" if clockwise else "counterclockwise"}]
    datum = survey.datum
    chosen = set(datum.points) if datum.points else {p.point_id for p in survey.points}
    for point in survey.points:
        held = AXES if point.x_in_world.treatment == "held" else "".join(point.x_in_world.held)
        in_datum = {"datum": "yes"} if datum.kind == "inner" and point.point_id in chosen and held != AXES else {}
        rows.append({"kind": "point", "from_id": point.point_id, **_xyz(network.x.get(point.point_id)),
                     "hold": held, **in_datum})  # fmt: skip
    rows += [*map(_reading_row, readings_of(survey)), *_vector_rows(survey)]
    for name, cov in network.covs.items():
        sigma = dict(zip((f"sigma_{a}_mm" for a in AXES), _texts(np.sqrt(np.diag(cov)) / MM), strict=True))
        rows.append({"kind": "adjusted", "from_id": name, **_xyz(network.x[name]), **sigma})
    used = [c for c in COLUMNS if any(row.get(c) for row in rows)]
    return csv_text([used, *([row.get(c) or "" for c in used] for row in rows)])


def _texts(values: FloatArray) -> list[str]:
    return [repr(float(v)) if np.isfinite(v) else "" for v in values]


def _xyz(x: FloatArray | None) -> dict[str, str]:
    return {} if x is None else dict(zip(("x_m", "y_m", "z_m"), _texts(x), strict=True))


def _reading_row(r: Reading) -> dict[str, str]:
    angular = r.kind in ANGLES
    ends = [point_of(e) or "" if e else "" for e in (r.at, r.to, r.second)]
    out: dict[str, str] = {"kind": r.kind, "id": r.reading_id, "from_id": ends[0], "to_id": ends[1]}
    out |= {"second_id": ends[2], "setup_id": r.setup_id}
    out |= {"value_gon" if angular else "value_m": repr(float(r.value / (GON if angular else 1.0)))}
    out |= {"sigma_cc" if angular else "sigma_mm": repr(float(r.sigma / (CC if angular else MM)))}
    return out | {f"{name}_m": repr(height) for name in HEIGHTS if (height := getattr(r, name))}


def _vector_rows(survey: Survey) -> list[dict[str, str]]:
    rows = []
    baselines, coordinates = triples_of(survey)
    for t in (*baselines, *coordinates):
        sigma = np.sqrt(np.diagonal(t.cov)).reshape(-1, 3)
        for k, to in enumerate(t.to):
            ends = {"from_id": t.at[k], "to_id": to} if t.at else {"from_id": to}
            named = dict(zip((f"sigma_{i}_mm" for i in AXES), _texts(sigma[k] / MM), strict=True))
            x = np.where(np.isfinite(sigma[k]), t.values[k], np.nan)
            kind = "coordinate_difference" if t.at else "coordinates"
            rows.append({"kind": kind, **ends, **_xyz(x), **named})
    return rows


def correlated(network: NetworkValues) -> tuple[str, ...]:
    """What of a network's covariances a plain table cannot hold, for people."""
    survey = network.survey
    n = sum(len(c.reading_ids) for c in survey.reading_covariances)
    covs = [*(d.cov for d in survey.coordinate_differences), *(c.cov for c in survey.coordinates)]
    m = sum(np.count_nonzero(np.where(np.isfinite(c), c, 0.0)) > np.isfinite(np.diagonal(c)).sum() for c in covs)
    priors = sum(p.x_in_world.treatment == "prior" for p in survey.points)
    found = (("correlations of readings", n), ("correlations of coordinates", int(m)), ("priors of points", priors))
    return tuple(f"left out, {what}: {count}" for what, count in found if count)
