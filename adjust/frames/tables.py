"""The motion of a table at many positions at once, with its derivatives: turns and shifts, one after the other."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, Survey, Table
from adjust.model.tables import Harmonic, harmonic

_IDENTITY = np.eye(3)
_COVERED = 2.0 / 3.0
"""Share of its longest period that the angles of an axis must cover for its harmonics."""


@frozen(eq=False)
class _Step:
    """A turn (rad) about or a shift (m) along an axis by q (n,); by: derivatives (n,) of q by parameters."""

    turn: bool
    axis: int
    q: FloatArray
    by: Sequence[tuple[int, FloatArray]]


def table_motions(
    axes: Sequence[str], geometry: Mapping[str, float], angles: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``table_from_mount`` of :class:`adjust.model.survey.Table` with :mod:`adjust.model.tables` at angles (n, k).

    Returns R (n, 3, 3), t (n, 3) and D (n, 6, k + len(geometry)), the derivatives by the angles and by what is in
    ``geometry``, in its order; what is not there is zero. Raises SurveyError where the angles are not k.
    """
    D = np.zeros((len(angles), 6, angles.shape[1] + len(geometry)))
    return *_moved(axes, geometry, angles, D), D


def table_poses(
    axes: Sequence[str], geometry: Mapping[str, float], angles: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The same without derivatives: R (n, 3, 3), t (n, 3)."""
    return _moved(axes, geometry, angles, None)


def _moved(
    axes: Sequence[str], geometry: Mapping[str, float], angles: FloatArray, D: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    n, k = angles.shape
    if k != len(axes):
        raise SurveyError(f"a table of {len(axes)} axes has readings of {k} angles")
    R, t = np.zeros((n, 3, 3)) + _IDENTITY, np.zeros((n, 3))
    for step in reversed(_steps(["xyz".index(a) for a in axes], geometry, angles)):
        if D is not None and step.by:
            moved = _by_step(R, t, step)
            for parameter, derivative in step.by:
                D[:, :, parameter] += derivative[:, None] * moved
        if step.turn:
            turned = turns(step.axis, step.q)
            R, t = turned @ R, (turned @ t[:, :, None])[:, :, 0]
        else:
            t = t + step.q[:, None] * _IDENTITY[step.axis]
    return R, t


def _by_step(R: FloatArray, t: FloatArray, step: _Step) -> FloatArray:
    """(n, 6): what a step by one before the motions (R, t) moves, a column of Ad(T^-1), tangents on the right."""
    if not step.turn:
        return np.concatenate([np.zeros_like(t), R[:, step.axis]], axis=1)
    j, k = (step.axis + 1) % 3, (step.axis + 2) % 3
    return np.concatenate([R[:, step.axis], t[:, j, None] * R[:, k] - t[:, k, None] * R[:, j]], axis=1)


def _steps(axes: Sequence[int], geometry: Mapping[str, float], angles: FloatArray) -> list[_Step]:
    """The steps from the base to the mount."""
    place = {name: angles.shape[1] + i for i, name in enumerate(geometry)}
    one, steps = np.ones(len(angles)), []

    def simple(turn: bool, axis: int, name: str) -> _Step:
        return _Step(turn, axis, geometry.get(name, 0.0) * one, [(place[name], one)] if name in place else [])

    for i, axis in enumerate(axes):
        series = {name: h for name in geometry if (h := harmonic(name)) is not None and h.axis == i}
        waves = _waves(axis, i, geometry, place, angles[:, i], list(series)) if series else {}
        steps += [step for key, step in waves.items() if key != "angle"]
        zero = simple(True, axis, f"zero_{i + 1}")
        by = [(i, one), *zero.by]
        if (more := waves.get("angle")) is not None:
            own, rest = more.by[0][1], more.by[1:]
            zero, by = _Step(True, axis, zero.q + more.q, ()), [(i, one + own), *zero.by, *rest]
        steps.append(_Step(True, axis, angles[:, i] + zero.q, by))
        if i == 0 and len(axes) == 2:
            third = 3 - axes[0] - axes[1]
            steps += [simple(False, third, "axis_offset"), simple(True, third, "non_orthogonality")]
    return steps


def _waves(
    axis: int, i: int, geometry: Mapping[str, float], place: Mapping[str, int], a: FloatArray, names: Sequence[str]
) -> dict[str, _Step]:
    """What the harmonics of an axis make of its angle a (n,), in the order of the motion; by: first by the angle."""
    x, y = (axis + 1) % 3, (axis + 2) % 3
    kinds = {"radial_x": (False, x), "radial_y": (False, y), "axial": (False, axis), "tilt_x": (True, x),
             "tilt_y": (True, y), "angle": (True, axis)}  # fmt: skip
    q = {kind: np.zeros(len(a)) for kind in kinds}
    by_a = {kind: np.zeros(len(a)) for kind in kinds}
    by: dict[str, list[tuple[int, FloatArray]]] = {kind: [] for kind in kinds}
    for name in names:
        h = harmonic(name)
        if h is None:
            continue
        cos, sin, k = np.cos(h.order * a), np.sin(h.order * a), h.order
        real = (sin, k * cos) if h.second else (cos, -k * sin)
        if h.kind in ("angle", "axial"):
            parts = {h.kind: real}
        elif h.second:
            parts = {f"{h.kind}_x": (-sin, -k * cos), f"{h.kind}_y": (cos, -k * sin)}
        else:
            parts = {f"{h.kind}_x": (cos, -k * sin), f"{h.kind}_y": (sin, k * cos)}
        for kind, (value, slope) in parts.items():
            q[kind] += geometry[name] * value
            by_a[kind] += geometry[name] * slope
            by[kind].append((place[name], value))
    return {kind: _Step(turn, about, q[kind], [(i, by_a[kind]), *by[kind]]) for kind, (turn, about) in kinds.items()
            if by[kind]}  # fmt: skip


def turns(axis: int, angle: FloatArray) -> FloatArray:
    """Right-handed rotations (..., 3, 3) about a coordinate axis by angles (...,) rad."""
    out, i, j = np.zeros((*np.shape(angle), 3, 3)), (axis + 1) % 3, (axis + 2) % 3
    out[..., axis, axis] = 1.0
    out[..., i, i] = out[..., j, j] = np.cos(angle)
    out[..., j, i] = np.sin(angle)
    out[..., i, j] = -out[..., j, i]
    return out


def check_harmonics(survey: Survey) -> None:
    """Raises SurveyError where the angles of an axis are too few, or too close together, for its free harmonics.

    Over a small part of its period a harmonic is a badly conditioned polynomial. With a prior it may be anything.
    """
    for table in survey.tables:
        known = table.geometry.prior.names if table.geometry.prior is not None else ()
        free = [h for n in table.geometry.free if n not in known and (h := harmonic(n)) is not None]
        angles = [r.angles for r in survey.table_readings if r.table_id == table.table_id]
        for axis in sorted({h.axis for h in free}) if angles else ():
            if axis >= len(table.axes):
                raise SurveyError(f"table {table.table_id!r} has no axis {axis + 1} whose harmonics could be unknown")
            _check_axis(table, axis, np.array(angles)[:, axis], [h for h in free if h.axis == axis])


def _check_axis(table: Table, axis: int, angles: FloatArray, free: Sequence[Harmonic]) -> None:
    stops = np.unique(np.round(np.mod(angles, 2.0 * np.pi), 6))
    covered = 2.0 * np.pi - np.diff(np.append(stops, stops[:1] + 2.0 * np.pi)).max()
    wanted = _COVERED * 2.0 * np.pi / min(abs(h.order) for h in free)
    most = max(Counter(h.kind for h in free).values())
    if covered < wanted or len(stops) <= most:
        raise SurveyError(
            f"table {table.table_id!r}: axis {axis + 1} was read at {len(stops)} angles over {np.degrees(covered):.0f} "
            f"deg; its harmonics take more than {most} angles over {np.degrees(wanted):.0f} deg: measure there, or "
            "take them out of harmonics"
        )


def adjoint_of_inverse(R: FloatArray, t: FloatArray) -> FloatArray:
    """Ad(T^-1) (n, 6, 6) of motions T = (R, t), R (n, 3, 3) and t (n, 3)."""
    out = np.zeros((len(R), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = np.swapaxes(R, 1, 2)
    for i in range(3):  # -R' [t]x has the rows t x (column of R)
        j, k = (i + 1) % 3, (i + 2) % 3
        out[:, 3:, i] = t[:, j, None] * R[:, k] - t[:, k, None] * R[:, j]
    return out
