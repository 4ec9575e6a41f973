"""How the tables of a project write its observations: the units of their numbers, and angles as they stand there."""

from collections.abc import Iterable, Iterator

import numpy as np

from adjust.diagnosis.units.conventions import UNITS, Written
from survey.folder.units import to_si, unit_in
from survey.jobs.adjusting.places import ProjectFiles
from survey.project.project import Project
from survey.project.tables.layouts import EULER
from survey.project.tables.reading import Table

_TABLES = ("terrestrial", "distances", "pairs")


def written_of(project: Project) -> Written:
    """Of readings, distances and pairs, with what survey.toml says of instruments."""
    files = ProjectFiles(project.files or project.folder)
    units, euler = dict[str, frozenset[str]](), {}
    for name in _TABLES:
        table = files.table(name)
        if table is None:
            continue
        for quantity in ("value", "sigma"):
            units[f"{name}.{quantity}"] = _units(_filled(table), quantity)
        if name == "terrestrial" and not units["terrestrial.sigma"] - {"mm"}:
            units["terrestrial.sigma"] |= _units(_keys(files), "sigma")
        if name == "pairs" and table.has(EULER[0]):
            angles = to_si(np.stack([table.numbers(c) for c in EULER], axis=1), "deg")
            euler = dict(zip(table.text("pair_id").values(), angles, strict=True))
    return Written(units, {i: a for i, a in euler.items() if np.isfinite(a).all()})


def _units(columns: Iterable[str], quantity: str) -> frozenset[str]:
    """In which the numbers of a quantity stand, by the names of columns or keys."""
    mine = (c.replace("_dms", "_deg") for c in columns if c.startswith(f"{quantity}_"))
    return frozenset(unit_in(c) for c in mine) & frozenset(UNITS)


def _filled(table: Table) -> Iterator[str]:
    yield from (name for name, numbers in table.number_columns.items() if not np.isnan(numbers).all())
    yield from table.text_columns


def _keys(files: ProjectFiles) -> Iterator[str]:
    yield from (str(path[-1]) for path in files.keys if path[0] == "instruments")
