"""Sigmas that no instrument has and another unit makes usual: told by the values alone, whatever the residuals say.

No theodolite is known to a hundredth of an arcsecond, and no length in air to a tenth of a millionth, for the air's
refractive index is not.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import ChangeColumns, ChangeReadings, Edit, Hypothesis, Place, ScaleKey
from adjust.diagnosis.units.conventions import ANGLES, UNKNOWN, Written
from adjust.diagnosis.weights.sigmas import id_of, kind_of
from adjust.model.errors import listed
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.observations import Distance, Reading
from adjust.model.rewriting import with_rows
from adjust.model.survey import Survey
from adjust.observations.pair_arrays import pair_arrays

SURE = 1e6
"""Evidence: these values cannot be right, so that what they should be is tried before all else."""
_ARCSEC = float(np.radians(1.0 / 3600.0))
_ANGLE, _LENGTH, _PART = 0.01 * _ARCSEC, 1e-7, 1e-7
"""What every sigma is larger than: of an angle (rad), of a length (m), and of a length as a part of it."""
_SETUP = 1e-6
"""m: the same of a length that a total station or a level reads."""
_USUAL = 0.05 * _ARCSEC, 120.0 * _ARCSEC
_SIZES = {"degrees": np.pi / 180.0, "gon": np.pi / 200.0, "radians": 1.0, "arcseconds": _ARCSEC,
          "milligon": np.pi / 2e5, "cc": np.pi / 2e6}  # fmt: skip
"""rad: of the units in which sigmas of angles are meant, the first three, and read."""
_TYPICAL = (("degrees", "arcseconds"), ("gon", "milligon"), ("gon", "cc"), ("radians", "arcseconds"))
"""What is meant and read where nobody knows how it is written."""
_ALIKE = 1.2
"""Ratio below which two units are not told from each other by what sigmas they make."""
_OF_LENGTHS = {1000.0: "are metres, read as millimetres"}
_TABLES = {"readings": "terrestrial", "distances": "distances", "pairs": "pairs"}


@frozen(eq=False)
class Sigmas:
    """Sigmas of observations of one kind and group.

    rows: in the list ``field`` of a survey. part: of a pair's motion, "rotation" or "translation". whole: whether that
    is all of the group. largest: of these sigmas (rad or m).
    """

    field: str
    what: str
    group: str
    rows: tuple[int, ...]
    ids: tuple[str, ...]
    largest: float
    whole: bool
    part: str = ""

    @property
    def count(self) -> int:
        """Of observed components."""
        return len(self.rows) * {"pairs": 3, "table_readings": 2}.get(self.field, 1)

    @property
    def is_length(self) -> bool:
        """Else they are angles."""
        return self.part != "rotation" and self.what not in ANGLES


def impossible_sigmas(case: Case) -> Iterator[Hypothesis]:
    """All angles that cannot be right in the units that were probably meant, and all lengths."""
    odd = _odd(case.survey)
    for some in ([o for o in odd if o.is_length], [o for o in odd if not o.is_length]):
        yield from _hypotheses(case.survey, some, case.written)


def doubtful_sigmas(survey: Survey, written: Written = UNKNOWN) -> Iterator[Hypothesis]:
    """The same kind by kind, each only in the likeliest unit."""
    for odd in _odd(survey):
        yield from _hypotheses(survey, [odd], written)[:1]


def _odd(survey: Survey) -> list[Sigmas]:
    return [*_of_values(survey), *_of_pairs(survey), *_of_tables(survey)]


def _hypotheses(survey: Survey, some: Sequence[Sigmas], written: Written) -> list[Hypothesis]:
    """By unit. What larger variances take of the misfit is paid for only among these: smaller ones are impossible."""
    if not some:
        return []
    largest = max(o.largest for o in some)
    units = _OF_LENGTHS if some[0].is_length else units_of_angles(some, written)
    size = f"{1e3 * largest:.2g} mm" if some[0].is_length else f"{largest / _ARCSEC:.2g} arcsec"
    return [replace(with_sigmas(survey, some, factor, f"no instrument has a sigma of {size}: these sigmas {unit}",
                                factor / min(units)), evidence=SURE, looked_at=len(units))
            for factor, unit in units.items()]  # fmt: skip


def units_of_angles(some: Sequence[Sigmas], written: Written, only_usual: bool = False) -> dict[float, str]:
    """By factor how sigmas were written and read, so that they become usual ones; else all where none is."""
    tables = {_TABLES.get(o.field, "") for o in some}
    read = frozenset[str]().union(*(written.words(f"{t}.sigma") for t in tables))
    values = frozenset[str]().union(*(written.words(f"{t}.value") for t in tables))
    meant = sorted(("degrees", "gon", "radians"), key=lambda unit: unit not in values)
    ways = [(m, r) for m in meant for r in _SIZES if (r in read if read else (m, r) in _TYPICAL)]
    by = {(m, r): _SIZES[m] / _SIZES[r] for m, r in ways if _SIZES[m] > _ALIKE * _SIZES[r]}
    largest = max(o.largest for o in some)
    usual = {w: f for w, f in by.items() if _USUAL[0] <= f * largest <= _USUAL[1]}
    usual = usual or ({} if only_usual else by)
    out = dict[float, str]()
    for (m, r), factor in usual.items():
        near = next((f for f in out if 1.0 / _ALIKE < f / factor < _ALIKE), None)
        if near is None:
            out[factor] = f"are {m}, read as {r}"
        elif read and out[near].endswith(r):
            out[near] += f" (or {m}, which is nearly the same)"
    return out


def with_sigmas(survey: Survey, some: Sequence[Sigmas], factor: float, said: str, dearer: float) -> Hypothesis:
    """These sigmas in another unit. dearer: by what factor they are larger than those they are compared with."""
    named = " and ".join(f"{o.what} {listed(o.ids, 5)}" for o in some)
    place = Place("group", tuple(o.group for o in some), "sigma") if all(o.whole for o in some) else Place(
        "pair" if some[0].field == "pairs" else "reading", tuple(i for o in some for i in o.ids), "sigma")  # fmt: skip
    changed = survey
    for one in some:
        changed = _with_sigmas(changed, one, factor)
    return Hypothesis(
        "unit of sigmas", f"{named}: {said}", f"multiply these sigmas by {factor:.6g}, or name their column or key by "
        "their unit", place, changed, tuple(e for one in some for e in _edits(one, factor)), parameters=0,
        penalty=2.0 * sum(o.count for o in some) * float(np.log(dearer)), of_variances=True,
    )  # fmt: skip


def _of_values(survey: Survey) -> Iterator[Sigmas]:
    """Of readings by kind, and of distances."""
    every: tuple[tuple[str, tuple[Reading | Distance, ...]], ...] = (
        ("readings", survey.readings), ("distances", survey.distances))  # fmt: skip
    for field, observed in every:
        number = grouped((o.group, i) for i, o in enumerate(observed) if o.used)
        odd = grouped(((kind_of(o), o.group), i) for i, o in enumerate(observed) if o.used and o.sigma < _least(o))
        for (kind, group), rows in odd.items():
            ids = tuple(id_of(observed[i]) for i in rows)
            largest = max(observed[i].sigma for i in rows)
            yield Sigmas(field, kind, group, tuple(rows), ids, largest, len(rows) == len(number[group]))


def _of_pairs(survey: Survey) -> Iterator[Sigmas]:
    """Of the rotations and of the shifts of pairs, where all sigmas of one are too small."""
    if not survey.pairs:
        return
    measured = pair_arrays(survey.pairs)
    sigmas = np.sqrt(np.diagonal(measured.cov, axis1=1, axis2=2))
    least = np.maximum(_LENGTH, _PART * np.linalg.norm(measured.shifts, axis=1))
    turn, shift = sigmas[:, :3].max(axis=1), sigmas[:, 3:].max(axis=1)
    parts = (("rotation", "the rotation of pairs", turn, turn < _ANGLE),
             ("translation", "the translation of pairs", shift, measured.is_pose & (shift < least)))  # fmt: skip
    for group, rows in grouped((p.group, i) for i, p in enumerate(survey.pairs) if p.used).items():
        for part, what, largest, small in parts:
            odd = np.array(rows)[small[rows]].tolist()
            if odd:
                ids, size = tuple(survey.pairs[i].pair_id for i in odd), float(largest[odd].max())
                yield Sigmas("pairs", what, group, tuple(odd), ids, size, False, part)


def _of_tables(survey: Survey) -> Iterator[Sigmas]:
    """Of the angles that are read off a table's axes."""
    odd = ((i, r, float(np.sqrt(np.diagonal(r.cov).max()))) for i, r in enumerate(survey.table_readings))
    small = ((r.table_id, (i, r, sigma)) for i, r, sigma in odd if r.used and sigma < _ANGLE)
    for table_id, found in grouped(small).items():
        rows, ids = tuple(i for i, _, _ in found), tuple(r.epoch_id for _, r, _ in found)
        yield Sigmas("table_readings", f"the angles of table {table_id} at", found[0][1].group, rows, ids,
                   max(sigma for _, _, sigma in found), False, "rotation")  # fmt: skip


def _least(o: Reading | Distance) -> float:
    if isinstance(o, Distance):
        return max(_LENGTH, _PART * o.value)
    return _ANGLE if o.kind in ANGLES else _SETUP


def _with_sigmas(survey: Survey, odd: Sigmas, factor: float) -> Survey:
    every = getattr(survey, odd.field)
    if not odd.part:
        return with_rows(survey, odd.field, {i: replace(every[i], sigma=factor * every[i].sigma) for i in odd.rows})
    return with_part(survey, odd.field, odd.rows, odd.part, factor)


def with_part(survey: Survey, field: str, rows: Iterable[int], part: str, factor: float) -> Survey:
    """The survey with the sigmas of the rotations, or of the shifts, of some pairs or table readings times a factor."""
    by, every = np.repeat([factor, 1.0] if part == "rotation" else [1.0, factor], 3), getattr(survey, field)
    new = {i: replace(p, cov=p.cov * np.outer(by[: len(p.cov)], by[: len(p.cov)]))
           for i in rows for p in (every[i],)}  # fmt: skip
    return with_rows(survey, field, new)


def _edits(odd: Sigmas, factor: float) -> tuple[Edit, ...]:
    """Of a whole group as one number; of others in their rows."""
    if odd.field == "table_readings":
        return ()  # these stand in table_angles.csv or in survey.toml
    if odd.part:
        columns = ("sigma_rotation_arcsec" if odd.part == "rotation" else "sigma_translation_mm",)
        return (ChangeColumns("pairs", columns, factor * np.eye(1), np.zeros(1), {"pair_id": odd.ids}),)
    if odd.whole:
        return (ScaleKey(("sigmas", "scale", odd.group), factor),)
    table = "terrestrial" if odd.field == "readings" else "distances"
    return (ChangeReadings(odd.ids, factor, table=table, field="sigma"),)
