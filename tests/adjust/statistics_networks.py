"""A hall measured with a total station, a tape and levelled differences, in a few plain lines; four groups."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.model.observations import Distance, PositionRef, Reading
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Point, PointParameter, Setup, Survey

SIGMAS = {"direction": 5e-6, "zenith": 8e-6, "slope_distance": 3e-4, "tape": 2e-4}


def coordinates(seed: int, n_points: int, n_stations: int) -> dict[str, FloatArray]:
    rng = np.random.default_rng(seed)
    x = {f"S{i + 1}": np.array([10.0 * (i % 3) + 2.0, 9.0 * (i // 3) + 1.5 * (i % 2), 1.6]) for i in range(n_stations)}
    return x | {f"P{i + 1}": rng.uniform((-8.0, -8.0, 0.0), (30.0, 22.0, 6.0)) for i in range(n_points)}


def exact(kind: str, a: FloatArray, b: FloatArray, orientation: float = 0.0) -> float:
    """Readings counted clockwise from y, instruments upright along z."""
    d = b - a
    if kind == "direction":
        return float(np.arctan2(d[0], d[1]) - orientation)
    if kind == "zenith":
        return float(np.arctan2(np.hypot(d[0], d[1]), d[2]))
    return float(np.linalg.norm(d))


def hall(
    seed: int = 1, n_points: int = 12, n_stations: int = 3, n_tapes: int = 12,
    factors: Mapping[str, float] | None = None, noise: bool = True, kept: float = 1.0,
    places: Mapping[str, FloatArray] | None = None, sample: int = 0,
) -> tuple[Survey, StartValues]:  # fmt: skip
    """The first station and the bearing of the second are held.

    factors: true variance factors of the groups, on top of ``SIGMAS``. kept: share of the sights.
    places: coordinates, instead of drawn ones. sample: of the noise.
    """
    x, rng = places or coordinates(seed, n_points, n_stations), np.random.default_rng([1000 + seed, sample])
    factors = factors or {}
    readings, tapes = [], []

    def error(group: str) -> float:
        return float(rng.normal() * SIGMAS[group] * np.sqrt(factors.get(group, 1.0)) * noise)

    stations = [n for n in x if n.startswith("S")]
    for i, s in enumerate(stations):
        for p in x:
            if p == s or rng.uniform() > kept:
                continue
            for kind in ("direction", "zenith", "slope_distance"):
                value = exact(kind, x[s], x[p], 0.3 * i) + error(kind)
                readings.append(Reading(f"{kind} {s} {p}", kind, PositionRef(s), PositionRef(p), value, SIGMAS[kind],
                                        setup_id=f"setup {s}", group=kind))  # fmt: skip
    names = [n for n in x if n.startswith("P")]
    for i in range(n_tapes):
        a, b = rng.choice(names, 2, replace=False)
        tapes.append(Distance(f"tape {i}", PositionRef(str(a)), PositionRef(str(b)),
                              exact("slope_distance", x[a], x[b]) + error("tape"), SIGMAS["tape"], "tape"))  # fmt: skip
    points = tuple(Point(n, PointParameter(v, "held" if n == "S1" else "free", held=("y",) if n == "S2" else ()))
                   for n, v in x.items())  # fmt: skip
    survey = Survey(points=points, setups=tuple(Setup(f"setup {s}") for s in stations), readings=tuple(readings),
                    distances=tuple(tapes))  # fmt: skip
    return survey, StartValues({}, {}, dict(x))


def adjusted(survey: Survey, start: StartValues) -> Adjustment:
    return adjust(survey, start)


def with_reading(survey: Survey, index: int, **changes: object) -> Survey:
    readings = list(survey.readings)
    readings[index] = replace(readings[index], **changes)
    return replace(survey, readings=tuple(readings))
