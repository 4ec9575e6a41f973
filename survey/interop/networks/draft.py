"""A network while its file is being read: points axis by axis, readings, and what of them makes a survey."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from adjust.model.errors import listed
from adjust.model.observations import (
    CoordinateDifferences,
    Coordinates,
    PositionRef,
    Reading,
    ReadingCovariance,
    ReadingKind,
)
from adjust.model.survey import Bearings, Datum, FloatArray, Point, PointParameter, Setup, Survey
from survey.folder.text import suggestion
from survey.interop.networks.foreign import Where, check_cov
from survey.interop.networks.values import ends_of

AXES = "xyz"
_NEEDS: Mapping[ReadingKind, str] = {
    "direction": "xy",
    "angle": "xy",
    "azimuth": "xy",
    "horizontal_distance": "xy",
    "height_difference": "z",
    "zenith": "xyz",
    "slope_distance": "xyz",
}
_PREFIX: Mapping[ReadingKind, str] = {
    "direction": "d",
    "angle": "a",
    "azimuth": "az",
    "horizontal_distance": "h",
    "height_difference": "dh",
    "zenith": "z",
    "slope_distance": "s",
}


@dataclass
class DraftPoint:
    """A point as far as it is known. start: m by axis. status: fixed, free or constrained (datum) by axis."""

    point_id: str
    where: Where
    start: dict[str, float] = field(default_factory=dict)
    status: dict[str, str] = field(default_factory=dict)

    def parameter(self) -> PointParameter:
        """As the survey takes it: nan for an axis without start; one that is no unknown is held, at zero by default."""
        held = tuple(a for a in AXES if self.status.get(a, "fixed") == "fixed")
        missing = [a for a in AXES if a in self.status and a not in self.start]
        value = np.array([self.start.get(a, np.nan if a in missing else 0.0) for a in AXES])
        if len(held) == 3:
            return PointParameter(value, "held")
        if not held and len(missing) == 3:
            return PointParameter()
        return PointParameter(value, "free", held=held)


@dataclass
class Vectors:
    """Baselines or coordinates with one covariance (3n, 3n) m^2, inf on the diagonal of what was not observed."""

    where: Where
    at: list[str]
    to: list[str]
    values: FloatArray
    cov: FloatArray


class NetworkDraft:
    """Collects what a file says; ``survey`` makes frozen values of it."""

    def __init__(self) -> None:
        self.points: dict[str, DraftPoint] = {}
        self.readings: list[Reading] = []
        self.covariances: list[ReadingCovariance] = []
        self.setups: list[Setup] = []
        self.differences: list[Vectors] = []
        self.coordinates: list[Vectors] = []
        self.notes: list[str] = []
        self._ids: dict[str, None] = {}
        self._counts: dict[str, int] = {}
        self._setup_of: dict[str, str] = {}

    def add_point(
        self, name: str, where: Where, start: dict[str, float] | None = None, status: dict[str, str] | None = None
    ) -> None:
        """A new point; raises SurveyError where it is there already."""
        if name in self.points:
            raise where.error(f"point {name!r} is there already; remove one")
        self.points[name] = DraftPoint(name, where, start or {}, status or {})

    def require_points(self, names: Iterable[str], where: Where) -> None:
        """Raise SurveyError for a point that is not there."""
        for name in names:
            if name not in self.points:
                raise where.error(f"unknown point {name!r}; {suggestion(name, self.points)}")

    def own_setup(self, key: str) -> str:
        """The one setup of this key, which is a point or names one."""
        if key not in self._setup_of:
            self._setup_of[key] = self.setup(key)
        return self._setup_of[key]

    def setup(self, at: str) -> str:
        """A new setup of an instrument at a point."""
        names = {s.setup_id for s in self.setups}
        name, count = at, 2
        while name in names:
            name, count = f"{at}-{count}", count + 1
        self.setups.append(Setup(name))
        return name

    def reading(
        self,
        kind: ReadingKind,
        at: str,
        to: str,
        value: float,
        sigma: float,
        *,
        setup_id: str = "",
        second: str | None = None,
        heights: tuple[float, float, float] = (0.0, 0.0, 0.0),
        name: str = "",
    ) -> str:
        """Add a reading; its id, which is ``name`` where that is still free."""
        prefix = _PREFIX[kind]
        while not name or name in self._ids:
            self._counts[prefix] = self._counts.get(prefix, 0) + 1
            name = f"{prefix}{self._counts[prefix]}"
        self._ids[name] = None
        right = PositionRef(second) if second is not None else None
        self.readings.append(
            Reading(
                name, kind, PositionRef(at), PositionRef(to), value, sigma, setup_id, right, *heights, group=kind
            )
        )  # fmt: skip
        return name

    def correlate(self, names: list[str], cov: FloatArray) -> None:
        """Give readings a joint covariance (n, n), which replaces their sigmas."""
        sigma = dict(zip(names, np.sqrt(np.diagonal(cov)).tolist(), strict=True))
        self.readings = [replace(r, sigma=sigma.get(r.reading_id, r.sigma)) for r in self.readings]
        if np.count_nonzero(cov) > len(cov):
            self.covariances.append(ReadingCovariance(tuple(names), cov))

    def survey(self, bearings: Bearings) -> Survey:
        """The survey. What touches points without coordinates or status is left out, and said.

        So are coordinates that are to be adjusted though nothing observes them.
        """
        points = {p.point_id: p for p in self.points.values() if p.status}
        readings = tuple(
            r for r in self.readings
            if all(p in points and set(_NEEDS[r.kind]) <= points[p].status.keys() for p in _ends(r))
        )  # fmt: skip
        points = self._observed(points, readings)
        self._note("readings", len(self.readings) - len(readings))
        kept = {r.reading_id for r in readings}
        used = {r.setup_id for r in readings}
        differences = [d for v in self.differences for d in _split(v, points)]
        observed = [c for v in self.coordinates for c in _split(v, points)]
        self._note("baselines", sum(len(v.to) for v in self.differences) - sum(len(d[1]) for d in differences))
        self._note("coordinates", sum(len(v.to) for v in self.coordinates) - sum(len(c[1]) for c in observed))
        return Survey(
            points=tuple(Point(p.point_id, p.parameter()) for p in points.values()),
            datum=self._datum(points, bool(observed)),
            bearings=bearings,
            setups=tuple(s for s in self.setups if s.setup_id in used),
            readings=readings,
            reading_covariances=tuple(c.of(kept) for c in self.covariances if kept.intersection(c.reading_ids)),
            coordinate_differences=tuple(CoordinateDifferences(_refs(a), _refs(t), v, c) for a, t, v, c in differences),
            coordinates=tuple(Coordinates(_refs(t), v, c) for _, t, v, c in observed),
        )

    def _observed(self, points: Mapping[str, DraftPoint], readings: Iterable[Reading]) -> dict[str, DraftPoint]:
        """The points without the unknown axes that no reading, baseline or coordinate touches."""
        touched = {(p, a) for r in readings for p in _ends(r) for a in _NEEDS[r.kind]}
        for v in (*self.differences, *self.coordinates):
            seen = np.isfinite(np.diagonal(v.cov)).reshape(-1, 3)
            rows = [(p, seen[k]) for ids in (v.at, v.to) for k, p in enumerate(ids)]
            touched |= {(p, AXES[i]) for p, row in rows for i in np.flatnonzero(row)}
        out, gone = {}, []
        for name, point in points.items():
            kept = {a: s for a, s in point.status.items() if s == "fixed" or (name, a) in touched}
            gone += [f"{''.join(a for a in point.status if a not in kept)} of {name}"] if kept != point.status else []
            if kept:
                out[name] = replace(point, status=kept)
        if gone:
            self.notes.append(f"left out, coordinates that nothing observes: {listed(gone, 6)}")
        return out

    def _note(self, what: str, count: int) -> None:
        if count:
            why = "a point of theirs has no coordinates and is not to be adjusted"
            self.notes.append(f"left out, {what}: {count}, because {why}")

    def _datum(self, points: Mapping[str, DraftPoint], observed: bool) -> Datum:
        """Inner constraints over the constrained points, over all where nothing at all is fixed or observed."""
        chosen = []
        for point in points.values():
            constrained = [a for a, s in point.status.items() if s == "constrained"]
            if constrained and "free" in point.status.values():
                raise point.where.error(
                    f"point {point.point_id!r}: {', '.join(constrained)} define the datum, its other coordinates do "
                    "not; constrain all that are adjusted, or none"
                )
            chosen += [point.point_id] if constrained else []
        if chosen:
            return Datum("inner", tuple(chosen))
        fixed = any(s == "fixed" for p in points.values() for s in p.status.values())
        return Datum() if fixed or observed else Datum("inner")


def _ends(reading: Reading) -> list[str]:
    return [e.point_id or "" for e in ends_of(reading)]


def _refs(ids: Sequence[str]) -> tuple[PositionRef, ...]:
    return tuple(PositionRef(i) for i in ids)


def _split(
    vectors: Vectors, points: Mapping[str, DraftPoint]
) -> list[tuple[list[str], list[str], FloatArray, FloatArray]]:
    """What is correlated stays one observation, the rest is on its own; those of unknown points are left out."""
    good = [
        k
        for k in range(len(vectors.to))
        if all(
            a in points[p].status if p in points else False
            for i, a in enumerate(AXES)
            for p in ([vectors.at[k]] if vectors.at else []) + [vectors.to[k]]
            if np.isfinite(vectors.cov[3 * k + i, 3 * k + i])
        )
    ]
    known = np.isfinite(vectors.cov) & (vectors.cov != 0.0)
    joined = known.reshape(len(vectors.to), 3, len(vectors.to), 3).any(axis=(1, 3))[np.ix_(good, good)]
    n, label = connected_components(coo_array(joined), directed=False) if good else (0, np.zeros(0, int))
    out = []
    for part in range(n):
        rows = [good[k] for k in np.flatnonzero(label == part)]
        idx = [3 * k + i for k in rows for i in range(3)]
        cov = vectors.cov[np.ix_(idx, idx)]
        seen = np.isfinite(np.diagonal(cov))
        check_cov(cov[np.ix_(seen, seen)], "covariance matrix", vectors.where)
        at = [vectors.at[k] for k in rows] if vectors.at else []
        out.append((at, [vectors.to[k] for k in rows], vectors.values[rows], cov))
    return out
