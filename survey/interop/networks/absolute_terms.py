"""How far readings are from what the coordinates of a file say: the absolute terms of the observation equations.

An angle counts with the length of its sight: the displacement, across it, of the point sighted. The orientation of a
set of directions is the median of what its directions say.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from adjust.model.errors import listed
from adjust.model.observations import Reading, ReadingKind
from adjust.model.survey import Bearings, FloatArray, Survey
from survey.interop.networks.foreign import MM
from survey.interop.networks.values import ends_of
from survey.project.tables.terrestrial import ANGLES

_MOST_NAMED = 6
_PLANE: tuple[ReadingKind, ...] = ("direction", "angle", "azimuth", "horizontal_distance")


def within_tolerance(survey: Survey, tolerance: float, unit_weight: float) -> tuple[Survey, tuple[str, ...]]:
    """The survey with readings beyond ``tolerance`` (m) of its start values marked as not used, and which, in words.

    As GNU Gama does it, an angle (of whatever kind) goes only where its term is also beyond when multiplied with its
    weight, ``unit_weight`` (rad, of an angle with weight 1) over its sigma: Gama finds such terms before it scales its
    equations, and takes them out after that. What is correlated with them stays, without them.
    """
    x = {p.point_id: p.x_in_world.value for p in survey.points if p.x_in_world.value is not None}
    terms = absolute_terms(survey.readings, x, survey.bearings)
    gone = {
        r.reading_id: r
        for r in survey.readings
        if terms.get(r.reading_id, 0.0) * (min(1.0, unit_weight / r.sigma) if r.kind in ANGLES else 1.0) > tolerance
    }
    left = _not_tested(survey, x, tolerance, len(survey.readings) - len(terms))
    if not gone:
        return survey, left
    named = [
        f"{name} ({r.kind.replace('_', ' ')} {r.at.point_id} - {r.to.point_id}) by {terms[name]:.3f} m"
        for name, r in gone.items()
    ]
    limit = f"tol-abs = {tolerance / MM:g} mm"
    note = f"not used (used = false), beyond {limit} from the file's coordinates: {listed(named, _MOST_NAMED)}"
    kept = tuple(replace(r, used=False) if r.reading_id in gone else r for r in survey.readings)
    used = {r.reading_id for r in kept if r.used}
    joint = tuple(c for whole in survey.reading_covariances if len((c := whole.of(used)).reading_ids) > 1)
    return replace(survey, readings=kept, reading_covariances=joint), (note, *left)


def _not_tested(survey: Survey, x: Mapping[str, FloatArray], tolerance: float, n: int) -> tuple[str, ...]:
    """What tol-abs does not decide on here, in words: readings of points without coordinates, baselines and so on."""
    nowhere = np.full(3, np.nan)
    far: list[str] = []
    for d in survey.coordinate_differences:
        ends = [(a.point_id or "", t.point_id or "") for a, t in zip(d.at, d.to, strict=True)]
        steps = np.array([x.get(t, nowhere) - x.get(a, nowhere) for a, t in ends])
        far += [" - ".join(e) for e, off in zip(ends, np.abs(d.values - steps), strict=True) if (off > tolerance).any()]
    for c in survey.coordinates:
        seen = np.isfinite(np.diagonal(c.cov)).reshape(-1, 3)
        for ref, value, known in zip(c.positions, c.values, seen, strict=True):
            off = np.abs(value - x.get(ref.point_id or "", nowhere))[known]
            far += [ref.point_id or ""] if (off > tolerance).any() else []
    notes: tuple[str, ...] = ()
    if n:
        notes = (f"tol-abs was not applied to {n} readings of points that have no coordinates in the file",)
    if far:
        notes += (f"tol-abs was not applied to baselines and coordinates; beyond it are {listed(far, _MOST_NAMED)}",)
    return notes


def absolute_terms(
    readings: Sequence[Reading], x: Mapping[str, FloatArray], bearings: Bearings
) -> Mapping[str, float]:
    """|observed minus computed| in m by id of the reading, of those whose points all have the coordinates needed.

    x: (3,) m by point, nan for a coordinate that is not known.
    """
    found: dict[str, float] = {}
    sets: dict[str, list[tuple[str, float, float]]] = {}
    for r in readings:
        ends = [x.get(e.point_id or "") for e in ends_of(r)]
        if any(e is None for e in ends):
            continue
        at, to, *second = (e for e in ends if e is not None)
        if r.kind == "direction":
            turn = _bearing(to - at, bearings) - r.value
            sets.setdefault(r.setup_id, []).append((r.reading_id, turn, float(np.hypot(*(to - at)[:2]))))
        else:
            found[r.reading_id] = _term(r, at, to, second, bearings)
    for members in sets.values():
        known = [m for m in members if np.isfinite(m[1])]
        if known:
            first = known[0][1]
            zero = first + float(np.median([_turned(turn - first) for _, turn, _ in known]))
            found |= {name: abs(_turned(turn - zero)) * length for name, turn, length in known}
    return {name: term for name, term in found.items() if np.isfinite(term)}


def _bearing(d: FloatArray, bearings: Bearings) -> float:
    east, north = (d[0], d[1]) if bearings.zero == "y" else (-d[1], d[0])
    clockwise = float(np.arctan2(east, north))
    return clockwise if bearings.clockwise else -clockwise


def _turned(angle: float) -> float:
    """Within half a turn."""
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _term(r: Reading, at: FloatArray, to: FloatArray, second: Sequence[FloatArray], bearings: Bearings) -> float:
    d = to - at
    flat = float(np.hypot(d[0], d[1]))
    if r.kind not in _PLANE:
        d = d + np.array([0.0, 0.0, r.target_height - r.instrument_height])
    slope = float(np.linalg.norm(d)) if r.kind not in _PLANE else flat
    match r.kind:
        case "horizontal_distance":
            return abs(r.value - flat)
        case "slope_distance":
            return abs(r.value - slope)
        case "height_difference":
            return float(abs(r.value - d[2]))
        case "zenith":
            return abs(_turned(r.value - float(np.arctan2(flat, d[2])))) * slope
        case "azimuth":
            return abs(_turned(r.value - _bearing(d, bearings))) * flat
        case "angle":
            computed = _bearing(second[0] - at, bearings) - _bearing(d, bearings)
            return abs(_turned(r.value - computed)) * flat
    return float("nan")
