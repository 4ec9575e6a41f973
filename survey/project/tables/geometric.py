"""Tables of levels, alignments, laser spots and positions on surfaces."""

from collections.abc import Callable, Sequence

import numpy as np

from adjust.model.names import natural_key
from adjust.model.observations import Alignment, LaserSpot, Level, OnSurface, frame_text, position_text
from adjust.model.survey import FloatArray
from survey.folder.text import LARGEST_NUMBER
from survey.folder.units import from_si, to_si
from survey.project.project import Sigmas
from survey.project.tables.covariance import covariance_from_sigmas, sigmas_and_correlations, table_correlations
from survey.project.tables.layouts import TILT_UNITS
from survey.project.tables.reading import (
    Columns,
    Table,
    both_or_each,
    filled,
    first_row,
    group_columns,
    marks,
    needed,
    one_of,
    quantity,
)
from survey.project.tables.references import Names, timed_frame, timed_position


def read_axis(table: Table, row: int, column: str, text: str) -> FloatArray:
    """A unit vector: ``x``, ``-y`` or three numbers with blanks between them."""
    name, sign = (text[1:], -1.0) if text.startswith("-") else (text, 1.0)
    if name in ("x", "y", "z"):
        return np.asarray(sign * np.eye(3)["xyz".index(name)])
    try:
        axis = np.array([float(part) for part in text.split()])
    except ValueError:
        axis = np.zeros(0)
    fits = axis.shape == (3,) and bool((np.abs(axis) <= LARGEST_NUMBER).all())
    length = float(np.linalg.norm(axis)) if fits else 0.0
    if not length > 0:
        raise table.error(row, f"{column}: found {text!r}; write x, y, z, -x, -y, -z or three numbers with blanks")
    return axis if abs(length - 1.0) < 1e-12 else axis / length


def axis_text(axis: FloatArray) -> str:
    """What ``read_axis`` reads."""
    for sign, prefix in ((1.0, ""), (-1.0, "-")):
        for i, name in enumerate("xyz"):
            if np.array_equal(axis, sign * np.eye(3)[i]):
                return prefix + name
    return " ".join(repr(float(part)) for part in axis)


def read_levels(table: Table, names: Names, sigmas: Sigmas) -> tuple[Level, ...]:
    """Levels sorted by id; an accelerometer gives the component of gravity along its axis, in g, upwards positive."""
    ids, axes = table.unique_ids("level_id"), table.text("axis").values()
    force, force_sigma = table.numbers("value_g"), table.positive("sigma_g")
    wrong = np.abs(force) >= 1
    if wrong.any():
        row = first_row(wrong)
        raise table.error(row, f"value_g: found {force[row]:g}; along a level axis it lies between -1 and 1")
    angle = np.arcsin(force)
    values = one_of(table, {"value": quantity(table, "value", TILT_UNITS), "value_g": angle})
    with np.errstate(invalid="ignore"):
        # of asin(f / g): sigma / cos
        by_force = force_sigma / np.cos(np.nan_to_num(values))
        own = {"sigma": quantity(table, "sigma", TILT_UNITS, True), "sigma_g": by_force}
    sigma = one_of(table, own)
    every = np.ones(len(table), dtype=bool)
    needed(table, values, every, "value: is blank; fill in value_arcsec, value_mm_per_m, value_g or the like")
    needed(table, sigma, every, "sigma: is blank; fill in sigma_arcsec, sigma_mm_per_m, sigma_g or the like")
    groups, used, scale = marks(table, "level", sigmas.scale)
    scaled, levels = (sigma * scale).tolist(), []
    for row, text in enumerate(table.text("frame_id").values()):
        frame = timed_frame(text, names, table.fail(row, "frame_id"))
        axis = read_axis(table, row, "axis", axes[row])
        levels.append(Level(ids[row], frame, axis, float(values[row]), scaled[row], groups[row], used[row]))
    return tuple(sorted(levels, key=lambda level: natural_key(level.level_id)))


def read_alignments(table: Table, names: Names, sigmas: Sigmas) -> tuple[Alignment, ...]:
    """Alignments sorted by id; a component without sigma was not observed, one without value is zero."""
    ids = table.unique_ids("alignment_id")
    units = ("arcsec", "deg")
    values = np.stack([quantity(table, f"value_{i}", units) for i in (1, 2)], axis=1)
    sigma = np.stack([quantity(table, f"sigma_{i}", units, True) for i in (1, 2)], axis=1)
    idle = np.isnan(sigma).all(axis=1)
    if idle.any():
        raise table.error(first_row(idle), "sigma: the row has none; give sigma_1_arcsec, sigma_2_arcsec or both")
    lost = np.isnan(sigma) & ~np.isnan(values)
    if lost.any():
        row, i = (int(x[0]) for x in np.nonzero(lost))
        raise table.error(row, f"value_{i + 1}: has no sigma_{i + 1}; add it, or remove the value")
    rho = table_correlations(table, ("rho_12",))
    groups, used, scale = marks(table, "alignment", sigmas.scale)
    ends, axes = ([table.text(f"{what}{x}").values() for x in suffixes]
                  for what, suffixes in (("", ("a_id", "b_id")), ("axis_", ("a", "b"))))  # fmt: skip
    result = []
    for row, alignment_id in enumerate(ids):
        a, b = (timed_frame(ends[k][row], names, table.fail(row, column)) for k, column in enumerate(("a_id", "b_id")))
        if a == b:
            raise table.error(row, f"a_id, b_id: both are {ends[0][row]!r}; an alignment joins two different frames")
        known = ~np.isnan(sigma[row])
        cov = np.diag(np.where(known, 1.0, np.inf))
        if known.all():
            cov = covariance_from_sigmas(sigma[row][None], rho[row : row + 1])[0]
        else:
            cov[known, known] = sigma[row][known] ** 2
        cov[np.isfinite(cov)] *= scale[row] ** 2
        axis_a, axis_b = (read_axis(table, row, f"axis_{x}", axes[k][row]) for k, x in enumerate("ab"))
        result.append(Alignment(alignment_id, a, axis_a, b, axis_b, np.nan_to_num(values[row]), cov, groups[row],
                                used[row]))  # fmt: skip
    return tuple(sorted(result, key=lambda alignment: natural_key(alignment.alignment_id)))


def read_laser_spots(table: Table, names: Names, sigmas: Sigmas) -> tuple[LaserSpot, ...]:
    """Laser spots sorted by id."""
    ids, epochs = table.unique_ids("spot_id"), table.ids("epoch_id").values()
    beams, targets = table.text("beam_id").values(), table.text("target_id").values()
    sigma = to_si(both_or_each(table, "sigma_mm", ("sigma_x_mm", "sigma_y_mm")), "mm")
    needed(table, sigma.sum(axis=1), np.ones(len(table), dtype=bool), "sigma: is blank; fill in sigma_mm")
    cov = covariance_from_sigmas(sigma, table_correlations(table, ("rho_xy",)))
    xy = to_si(np.stack([table.numbers("x_mm"), table.numbers("y_mm")], axis=1), "mm")
    groups, used, scale = marks(table, "laser", sigmas.scale)
    known = {beam.beam_id: beam for beam in names.survey.beams}
    on_table = {(r.table_id, r.epoch_id) for r in names.survey.table_readings}
    spots = []
    for row, spot_id in enumerate(ids):
        table.require(row, "beam_id", "beam", beams[row], known)
        table.require(row, "target_id", "target", targets[row], names.target_points)
        beam = known[beams[row]]
        if beam.carrier_kind == "mount" and (beam.carrier_id, epochs[row]) not in on_table:
            found = f"table {beam.carrier_id!r} has no reading at epoch {epochs[row]!r}"
            raise table.error(row, f"epoch_id: {found}; add it to table_angles, or correct the epoch")
        scaled = cov[row] * scale[row] ** 2
        spots.append(LaserSpot(spot_id, beams[row], epochs[row], targets[row], xy[row], scaled, groups[row], used[row]))
    return tuple(sorted(spots, key=lambda spot: natural_key(spot.spot_id)))


def read_on_surfaces(table: Table, names: Names, sigmas: Sigmas) -> tuple[OnSurface, ...]:
    """Positions on surfaces, sorted by surface and position."""
    surfaces, texts = table.text("surface_id").values(), table.text("point_id").values()
    offset = to_si(np.nan_to_num(table.numbers("offset_mm")), "mm")
    groups, used, scale = marks(table, "surface", sigmas.scale)
    sigma = (to_si(table.positive("sigma_mm"), "mm") * scale).tolist()
    known = {surface.surface_id for surface in names.survey.surfaces}
    result = []
    for row, (surface_id, text) in enumerate(zip(surfaces, texts, strict=True)):
        table.require(row, "surface_id", "surface", surface_id, known)
        position = timed_position(text, names, table.fail(row, "point_id"))
        item = OnSurface(surface_id, position, sigma[row], float(offset[row]), groups[row], used[row])
        result.append(((natural_key(surface_id), natural_key(text)), item))
    return tuple(item for _, item in sorted(result, key=lambda pair: pair[0]))


def level_columns(levels: Sequence[Level]) -> Columns:
    """One row per level."""
    return {
        "level_id": [level.level_id for level in levels],
        "frame_id": [frame_text(level.frame) for level in levels],
        "axis": [axis_text(level.axis_in_frame) for level in levels],
        "value_arcsec": from_si([level.value for level in levels], "arcsec"),
        "sigma_arcsec": from_si([level.sigma for level in levels], "arcsec"),
        **group_columns(levels, "level"),
    }


def alignment_columns(alignments: Sequence[Alignment]) -> Columns:
    """One row per alignment."""
    numbers = np.full((len(alignments), 5), np.nan)
    for row, a in zip(numbers, alignments, strict=True):
        known = np.isfinite(np.diag(a.cov))
        sigma, rho = sigmas_and_correlations(np.where(np.isfinite(a.cov), a.cov, 1.0)[None])
        row[:2] = np.where(known, from_si(a.value, "arcsec"), np.nan)
        row[2:4] = np.where(known, from_si(sigma[0], "arcsec"), np.nan)
        row[4] = rho[0, 0] if known.all() and rho[0, 0] != 0.0 else np.nan
    columns = ("value_1_arcsec", "value_2_arcsec", "sigma_1_arcsec", "sigma_2_arcsec", "rho_12")
    text: dict[str, Callable[[Alignment], str]] = {
        "alignment_id": lambda a: a.alignment_id,
        "a_id": lambda a: frame_text(a.a),
        "axis_a": lambda a: axis_text(a.axis_in_a),
        "b_id": lambda a: frame_text(a.b),
        "axis_b": lambda a: axis_text(a.axis_in_b),
    }
    return {
        **{name: [get(a) for a in alignments] for name, get in text.items()},
        **filled(dict(zip(columns, numbers.T, strict=True))),
        **group_columns(alignments, "alignment"),
    }


def laser_columns(spots: Sequence[LaserSpot]) -> Columns:
    """One row per laser spot."""
    xy = from_si(np.array([spot.xy for spot in spots]).reshape(-1, 2), "mm")
    sigma, rho = sigmas_and_correlations(np.array([spot.cov for spot in spots]).reshape(-1, 2, 2))
    sigma = from_si(sigma, "mm")
    return {
        **{name: [getattr(s, name) for s in spots] for name in ("spot_id", "beam_id", "epoch_id", "target_id")},
        "x_mm": xy[:, 0],
        "y_mm": xy[:, 1],
        "sigma_x_mm": sigma[:, 0],
        "sigma_y_mm": sigma[:, 1],
        **filled({"rho_xy": np.where(rho[:, 0] != 0.0, rho[:, 0], np.nan)}),
        **group_columns(spots, "laser"),
    }


def surface_columns(items: Sequence[OnSurface]) -> Columns:
    """One row per position on a surface."""
    offset = np.array([item.offset for item in items], dtype=float)
    return {
        "surface_id": [item.surface_id for item in items],
        "point_id": [position_text(item.position) for item in items],
        "sigma_mm": from_si([item.sigma for item in items], "mm"),
        **filled({"offset_mm": np.where(offset != 0.0, from_si(offset, "mm"), np.nan)}),
        **group_columns(items, "surface"),
    }
