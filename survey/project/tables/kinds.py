"""Every table of observations but those of image points: what of a survey it holds, how it is read and written."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from adjust.model.frozen import frozen
from adjust.model.observations import position_text
from adjust.model.survey import Survey
from survey.project.project import Sigmas
from survey.project.tables import coordinates, geometric, layouts, measurements, terrestrial
from survey.project.tables.pairs import pair_columns, read_pairs
from survey.project.tables.reading import Columns, Layout, Table
from survey.project.tables.references import Names


@frozen
class Kind:
    """Observations of one kind: their table, and the field of a survey that holds them.

    called: what reports call them, and their groups where the table names none. id_of: their name in that table.
    positions: columns that may name points of the world. beside: the table of the covariances between rows.
    """

    layout: Layout
    field: str
    called: tuple[str, ...]
    id_of: Callable[[Any], str]
    read: Callable[[Table, Names, Sigmas], tuple[Any, ...]]
    columns: Callable[[Any], Columns | tuple[Columns, Columns]]
    positions: tuple[str, ...] = ()
    beside: Layout | None = None


_ENDS = ("from_id", "to_id")
KINDS = (
    Kind(layouts.TABLE_ANGLES, "table_readings", ("table",), lambda r: f"{r.table_id}/{r.epoch_id}",
         measurements.read_angles, measurements.angle_columns),
    Kind(layouts.PAIRS, "pairs", ("pair",), lambda p: p.pair_id, read_pairs, pair_columns),
    Kind(layouts.DISTANCES, "distances", ("distance",), lambda d: d.distance_id, measurements.read_distances,
         measurements.distance_columns, _ENDS),
    Kind(layouts.COORDINATES, "coordinates", ("coordinates",), lambda c: c.set_id or position_text(c.positions[0]),
         coordinates.read_coordinates, coordinates.coordinate_columns, ("point_id",),
         layouts.COORDINATES_COVARIANCE),
    Kind(layouts.TERRESTRIAL, "readings", terrestrial.READING_KINDS, lambda r: r.reading_id,
         terrestrial.read_readings, terrestrial.reading_columns, (*_ENDS, "second_id"),
         layouts.TERRESTRIAL_COVARIANCE),
    Kind(layouts.DIFFERENCES, "coordinate_differences", ("coordinate_difference",), lambda d: d.set_id,
         coordinates.read_differences, coordinates.difference_columns, _ENDS, layouts.DIFFERENCES_COVARIANCE),
    Kind(layouts.LEVELS, "levels", ("level",), lambda x: x.level_id, geometric.read_levels, geometric.level_columns),
    Kind(layouts.ALIGNMENTS, "alignments", ("alignment",), lambda x: x.alignment_id, geometric.read_alignments,
         geometric.alignment_columns),
    Kind(layouts.LASER_SPOTS, "laser_spots", ("laser",), lambda x: x.spot_id, geometric.read_laser_spots,
         geometric.laser_columns),
    Kind(layouts.ON_SURFACES, "on_surfaces", ("surface",), lambda o: f"{o.surface_id}/{position_text(o.position)}",
         geometric.read_on_surfaces, geometric.surface_columns, ("point_id",)),
)  # fmt: skip
GROUPS = ("image", *(name for kind in KINDS for name in kind.called))


def with_observations(survey: Survey, tables: Mapping[str, Table], sigmas: Sigmas) -> Survey:
    """A survey with all that the tables hold, but image points. Raises SurveyError."""
    for kinds in (KINDS[:1], KINDS[1:]):  # what a laser on a turntable met needs the turntable's readings
        names, found = Names.of(survey), dict[str, Any]()
        for kind in kinds:
            name, table = kind.layout.name, tables.get(kind.layout.name)
            extra = tables.get(kind.beside.name) if kind.beside else None
            if table is not None:
                found[kind.field] = kind.read(replace(table, beside=extra), names, sigmas)
            elif extra is not None:
                raise extra.error(0, f"there is no table of {name} beside it; add {name}.csv or remove this file")
        survey = replace(survey, **found)
    joint = tables.get(layouts.TERRESTRIAL_COVARIANCE.name)
    return survey if joint is None else replace(
        survey, reading_covariances=terrestrial.read_reading_covariances(joint, survey.readings)
    )  # fmt: skip


def observation_tables(survey: Survey) -> dict[str, Columns]:
    """The inverse: the columns of every table, with or without rows."""
    found: dict[str, Columns] = {}
    for kind in KINDS:
        made = kind.columns(getattr(survey, kind.field))
        if isinstance(made, tuple):
            found |= dict(zip((kind.layout.name, kind.beside.name if kind.beside else ""), made, strict=True))
        else:
            found[kind.layout.name] = made
    found[layouts.TERRESTRIAL_COVARIANCE.name] = terrestrial.correlation_columns(survey.reading_covariances)
    return found
