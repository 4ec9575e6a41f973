"""Tables of angles and distances."""

import numpy as np

from adjust.model.names import natural_key
from adjust.model.observations import Distance, TableReading
from adjust.model.survey import FloatArray
from survey.folder.text import suggestion
from survey.folder.units import to_si
from survey.project.project import Sigmas
from survey.project.tables.covariance import covariance_from_sigmas, table_correlations
from survey.project.tables.reading import FLAGS, Layout, Table, first_row, group_names
from survey.project.tables.references import Names, read_ends

ANGLES = Layout(
    "table_angles",
    ("epoch_id", "table_id"),
    ("axis1_deg",),
    FLAGS[:1],
    ("axis2_deg", "sigma_arcsec", "sigma_axis1_arcsec", "sigma_axis2_arcsec", "rho_12"),
)
DISTANCES = Layout("distances", ("distance_id", "from_id", "to_id"), (), FLAGS, ("value_mm", "value_m", "sigma_mm"))


def read_angles(table: Table, names: Names, sigmas: Sigmas) -> tuple[TableReading, ...]:
    """Readings sorted by table and epoch."""
    axes = {t.table_id: len(t.axes) for t in names.survey.tables}
    epochs, tables = table.ids("epoch_id").values(), table.text("table_id").values()
    angles = np.stack([table.numbers("axis1_deg"), table.numbers("axis2_deg")], axis=1)
    groups = group_names(table, "table")
    lines: dict[tuple[str, str], int] = {}
    for row, (epoch_id, table_id) in enumerate(zip(epochs, tables, strict=True)):
        if table_id not in axes:
            raise table.error(row, f"table_id: unknown table {table_id!r}; {suggestion(table_id, axes)}")
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
        scaled = cov * sigmas.scale.get(groups[row], 1.0) ** 2
        readings.append(TableReading(table_id, epoch_id, to_si(angles[row, :k], "deg"), scaled, groups[row]))
    return tuple(sorted(readings, key=lambda r: (natural_key(r.table_id), natural_key(r.epoch_id))))


def _angle_sigmas(table: Table, row_axes: list[int], sigmas: Sigmas) -> FloatArray:
    """Sigmas (n, 2) rad of the readings, from the row or else from survey.toml; nan beside a table's one axis."""
    both = table.positive("sigma_arcsec")
    each = np.stack([table.positive("sigma_axis1_arcsec"), table.positive("sigma_axis2_arcsec")], axis=1)
    twice = ~np.isnan(both) & ~np.isnan(each).all(axis=1)
    if twice.any():
        raise table.error(first_row(twice), "sigma_arcsec and sigma_axis1_arcsec are both given; keep one of the two")
    result = to_si(np.where(np.isnan(each), both[:, None], each), "arcsec")
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
    groups, used = group_names(table, "distance"), table.flags("used").tolist()
    ends = list(zip(table.text("from_id").values(), table.text("to_id").values(), strict=True))
    distances = []
    for row, (from_text, to_text) in enumerate(ends):
        a, b = read_ends(table, row, (from_text, to_text), names, "distance")
        sigma = float(to_si(sigma_mm[row], "mm")) * sigmas.scale.get(groups[row], 1.0)
        distances.append(Distance(distance_ids[row], a, b, values[row], sigma, groups[row], used[row]))
    return tuple(sorted(distances, key=lambda distance: natural_key(distance.distance_id)))
