"""Terrestrial and geometric observations as the columns of their tables, the inverse of the modules that read them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from adjust.model.observations import (
    Alignment,
    CoordinateDifferences,
    Coordinates,
    LaserSpot,
    Level,
    OnSurface,
    Reading,
    ReadingCovariance,
    frame_text,
    position_text,
)
from adjust.model.survey import FloatArray, Survey
from survey.folder.units import from_si
from survey.project.tables.coordinates import DIFFERENCE, DIFFERENCE_RHO, DIFFERENCE_SIGMAS
from survey.project.tables.covariance import sigmas_and_correlations
from survey.project.tables.geometric import axis_text
from survey.project.tables.reading import Columns
from survey.project.tables.terrestrial import ANGLES, HEIGHTS

_Column = Sequence[str] | FloatArray


def new_tables(survey: Survey) -> dict[str, Columns]:
    """The columns of every table of terrestrial and geometric observations."""
    differences, between = difference_columns(survey.coordinate_differences)
    return {
        "terrestrial": reading_columns(survey.readings),
        "terrestrial_covariance": correlation_columns(survey.reading_covariances),
        "coordinate_differences": differences,
        "coordinate_differences_covariance": between,
        "levels": level_columns(survey.levels),
        "alignments": alignment_columns(survey.alignments),
        "laser_spots": spot_columns(survey.laser_spots),
        "on_surfaces": surface_columns(survey.on_surfaces),
    }


def group_columns(items: Sequence[Any], usual: str = "", used: bool = True) -> dict[str, list[str]]:
    """``group`` and ``used`` of one item a row where they are not as usual: readings have groups by their kind.

    used: whether the table tells it.
    """
    columns = {}
    if any(x.group != (usual or x.kind) for x in items):
        columns["group"] = [x.group for x in items]
    if used and not all(x.used for x in items):
        columns["used"] = ["true" if x.used else "false" for x in items]
    return columns


def _filled(columns: Mapping[str, _Column], always: Sequence[str] = ()) -> dict[str, _Column]:
    """Without the columns that are blank throughout."""
    return {
        name: column
        for name, column in columns.items()
        if name in always or not (np.isnan(column).all() if isinstance(column, np.ndarray) else not any(column))
    }


def reading_columns(readings: Sequence[Reading]) -> Columns:
    """One row per reading: angles in degrees, lengths in metres, sigmas in arcseconds and millimetres."""
    angle = np.array([r.kind in ANGLES for r in readings], dtype=bool)
    value, sigma = (np.array([getattr(r, name) for r in readings], dtype=float) for name in ("value", "sigma"))
    heights = {name: np.array([getattr(r, name) for r in readings]) for name in HEIGHTS}
    centring = np.array([r.target_centring_sigma for r in readings], dtype=float)
    columns: dict[str, _Column] = {
        "setup_id": [r.setup_id for r in readings],
        "second_id": [position_text(r.second) if r.second else "" for r in readings],
        "value_deg": np.where(angle, from_si(value, "deg"), np.nan),
        "value_m": np.where(angle, np.nan, value),
        "sigma_arcsec": np.where(angle, from_si(sigma, "arcsec"), np.nan),
        "sigma_mm": np.where(angle, np.nan, from_si(sigma, "mm")),
        **{f"{name}_mm": np.where(h != 0.0, from_si(h, "mm"), np.nan) for name, h in heights.items()},
        # written even where it is zero, if any is not: a blank means the instrument's own
        "sigma_target_centring_mm": from_si(centring, "mm"),
    }
    return {
        "kind": [r.kind for r in readings],
        "from_id": [position_text(r.at) for r in readings],
        "to_id": [position_text(r.to) for r in readings],
        "reading_id": [r.reading_id for r in readings],
        **_filled(columns),
        **group_columns(readings),
    }


def correlation_columns(covariances: Sequence[ReadingCovariance]) -> Columns:
    """One row per correlation of two readings."""
    rows = []
    for item in covariances:
        sigma = np.sqrt(np.diagonal(item.cov))
        for i, j in zip(*np.nonzero(np.triu(item.cov, 1)), strict=True):
            rows.append((item.reading_ids[i], item.reading_ids[j], float(item.cov[i, j] / (sigma[i] * sigma[j]))))
    return {
        "a_id": [a for a, _, _ in rows],
        "b_id": [b for _, b, _ in rows],
        "rho": np.array([rho for _, _, rho in rows], dtype=float),
    }


def triple_columns(
    names: Sequence[str], items: Sequence[Coordinates] | Sequence[CoordinateDifferences]
) -> dict[str, FloatArray]:
    """Values, sigmas and correlations (9 columns) of three coordinates a row in mm, nan where not observed."""
    rows = [_triple(x, item.cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3])
            for item in items for i, x in enumerate(item.values)]  # fmt: skip
    return dict(zip(names, np.array(rows).reshape(-1, 9).T, strict=True))


def _triple(values: FloatArray, cov: FloatArray) -> FloatArray:
    known = np.isfinite(np.diag(cov))
    sigma, rho = sigmas_and_correlations(np.where(np.isfinite(cov), cov, 1.0)[None])
    pairs = np.triu_indices(3, 1)
    both = known[pairs[0]] & known[pairs[1]]
    row = [np.where(known, from_si(values, "mm"), np.nan), np.where(known, from_si(sigma[0], "mm"), np.nan)]
    return np.concatenate([*row, np.where(both & (rho[0] != 0.0), rho[0], np.nan)])


def between_columns(sets: Iterable[tuple[str, Sequence[str], FloatArray]]) -> dict[str, _Column]:
    """One row per covariance between different rows of a set; sets: id, names of its rows (n,), cov (3n, 3n) m^2."""
    rows, values = [], []
    for set_id, names, cov in sets:
        for i, j in zip(*np.nonzero(np.triu(cov)), strict=True):
            if i // 3 != j // 3:
                rows.append((set_id, names[i // 3], "xyz"[i % 3], names[j // 3], "xyz"[j % 3]))
                values.append(float(from_si(cov[i, j], "mm2")))
    ids = ("set_id", "a_id", "a_axis", "b_id", "b_axis")
    out: dict[str, _Column] = {name: [row[i] for row in rows] for i, name in enumerate(ids)}
    return {**out, "covariance_mm2": np.array(values)}


def difference_columns(items: Sequence[CoordinateDifferences]) -> tuple[Columns, Columns]:
    """One row per difference, and one row per covariance between those of the same observation."""
    names: list[str] = []
    sets = []
    for item in items:
        first = len(names)
        for _ in item.at:
            own = item.set_id if len(item.at) == 1 and item.set_id not in names else ""
            names.append(own or f"d{len(names) + 1}")
        sets.append(("", names[first:], item.cov))
    set_ids = [(x.set_id or f"set{n}") if len(x.at) > 1 else "" for n, x in enumerate(items, 1) for _ in x.at]
    numbers = triple_columns((*DIFFERENCE, *DIFFERENCE_SIGMAS, *DIFFERENCE_RHO), items)
    between = between_columns(sets)
    del between["set_id"]
    return {
        "difference_id": names,
        "from_id": [position_text(ref) for item in items for ref in item.at],
        "to_id": [position_text(ref) for item in items for ref in item.to],
        **_filled({"set_id": set_ids, **numbers}),
        **group_columns([item for item in items for _ in item.at], "coordinate_difference"),
    }, between


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
        **_filled(dict(zip(columns, numbers.T, strict=True))),
        **group_columns(alignments, "alignment"),
    }


def spot_columns(spots: Sequence[LaserSpot]) -> Columns:
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
        **_filled({"rho_xy": np.where(rho[:, 0] != 0.0, rho[:, 0], np.nan)}),
        **group_columns(spots, "laser"),
    }


def surface_columns(items: Sequence[OnSurface]) -> Columns:
    """One row per position on a surface."""
    offset = np.array([item.offset for item in items], dtype=float)
    return {
        "surface_id": [item.surface_id for item in items],
        "point_id": [position_text(item.position) for item in items],
        "sigma_mm": from_si([item.sigma for item in items], "mm"),
        **_filled({"offset_mm": np.where(offset != 0.0, from_si(offset, "mm"), np.nan)}),
        **group_columns(items, "surface"),
    }
