"""Tables of angles and distances."""

from collections.abc import Sequence

import numpy as np

from adjust.model.names import natural_key
from adjust.model.observations import Distance, TableReading, position_text
from adjust.model.survey import FloatArray
from survey.folder.units import from_si, to_si
from survey.project.project import Sigmas
from survey.project.tables.covariance import covariance_from_sigmas, sigmas_and_correlations, table_correlations
from survey.project.tables.reading import Columns, Table, both_or_each, first_row, group_columns, marks
from survey.project.tables.references import Names, read_ends


def read_angles(table: Table, names: Names, sigmas: Sigmas) -> tuple[TableReading, ...]:
    """Readings sorted by table and epoch."""
    axes = {t.table_id: len(t.axes) for t in names.survey.tables}
    epochs, tables = table.ids("epoch_id").values(), table.text("table_id").values()
    angles = np.stack([table.numbers("axis1_deg"), table.numbers("axis2_deg")], axis=1)
    groups, _, scale = marks(table, "table", sigmas.scale)
    lines: dict[tuple[str, str], int] = {}
    for row, (epoch_id, table_id) in enumerate(zip(epochs, tables, strict=True)):
        table.require(row, "table_id", "table", table_id, axes)
        key = (table_id, epoch_id)
        if key in lines:
            raise table.error(row, f"epoch {epoch_id!r} of table {table_id!r} stands already in line {lines[key]}")
        lines[key] = int(table.lines[row])
        k = axes[table_id]
        if int((~np.isnan(angles[row])).sum()) != k:
            advice = "fill in axis2_deg" if k == 2 else "leave axis2_deg blank"
            raise table.error(row, f"axis2_deg: table {table_id!r} has {k} axes; {advice}")
    sigma = _angle_sigmas(table, [axes[table_id] for table_id in tables], sigmas)
    rho = table_correlations(table, ("rho_12",))
    readings = []
    for row, (epoch_id, table_id) in enumerate(zip(epochs, tables, strict=True)):
        k = axes[table_id]
        cov = covariance_from_sigmas(sigma[None, row, :k], rho[row : row + 1, : k - 1])[0]
        angle = to_si(angles[row, :k], "deg")
        readings.append(TableReading(table_id, epoch_id, angle, cov * scale[row] ** 2, groups[row]))
    return tuple(sorted(readings, key=lambda r: (natural_key(r.table_id), natural_key(r.epoch_id))))


def _angle_sigmas(table: Table, row_axes: list[int], sigmas: Sigmas) -> FloatArray:
    """Sigmas (n, 2) rad of the readings, from the row or else from survey.toml; nan beside a table's one axis."""
    result = to_si(both_or_each(table, "sigma_arcsec", ("sigma_axis1_arcsec", "sigma_axis2_arcsec")), "arcsec")
    for row, (table_id, k) in enumerate(zip(table.text("table_id").values(), row_axes, strict=True)):
        if np.isnan(result[row]).all() and table_id in sigmas.tables:
            result[row, :k] = sigmas.tables[table_id]
        if np.isnan(result[row, :k]).any():
            raise table.error(row, f"the row has no sigma; add sigma_arcsec here or to [tables.{table_id}]")
    return result


def read_distances(table: Table, names: Names, sigmas: Sigmas) -> tuple[Distance, ...]:
    """Distances sorted by id."""
    distance_ids = table.unique_ids("distance_id")
    in_mm, in_m, sigma_mm = (table.positive(name) for name in ("value_mm", "value_m", "sigma_mm"))
    wrong = np.isnan(in_mm) == np.isnan(in_m)
    if wrong.any():
        raise table.error(first_row(wrong), "value_mm, value_m: fill in one of the two")
    if np.isnan(sigma_mm).any():
        raise table.error(first_row(np.isnan(sigma_mm)), "sigma_mm: is blank; fill it in")
    values = np.where(np.isnan(in_m), to_si(in_mm, "mm"), in_m).tolist()
    groups, used, scale = marks(table, "distance", sigmas.scale)
    sigma, distances = (to_si(sigma_mm, "mm") * scale).tolist(), []
    for row, ends in enumerate(zip(table.text("from_id").values(), table.text("to_id").values(), strict=True)):
        a, b = read_ends(table, row, ends, names, "distance")
        distances.append(Distance(distance_ids[row], a, b, values[row], sigma[row], groups[row], used[row]))
    return tuple(sorted(distances, key=lambda distance: natural_key(distance.distance_id)))


def angle_columns(readings: Sequence[TableReading]) -> Columns:
    """One row per reading; the second axis blank for a table that has one."""
    rows = np.full((len(readings), 5), np.nan)
    for row, reading in zip(rows, readings, strict=True):
        k = len(reading.angles)
        sigma, rho = sigmas_and_correlations(reading.cov[None])
        row[:k] = from_si(reading.angles, "deg")
        row[2 : 2 + k] = from_si(sigma[0], "arcsec")
        row[4] = rho[0, 0] if k == 2 else np.nan
    names = ("axis1_deg", "axis2_deg", "sigma_axis1_arcsec", "sigma_axis2_arcsec", "rho_12")
    return {
        "epoch_id": [reading.epoch_id for reading in readings],
        "table_id": [reading.table_id for reading in readings],
        **dict(zip(names, rows.T, strict=True)),
        **group_columns(readings, "table", used=False),
    }


def distance_columns(distances: Sequence[Distance]) -> Columns:
    """One row per distance."""
    return {
        "distance_id": [distance.distance_id for distance in distances],
        "from_id": [position_text(distance.a) for distance in distances],
        "to_id": [position_text(distance.b) for distance in distances],
        "value_m": np.array([distance.value for distance in distances]),
        "sigma_mm": from_si([distance.sigma for distance in distances], "mm"),
        **group_columns(distances, "distance"),
    }
