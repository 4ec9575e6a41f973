"""Rotations or shifts of pairs in another unit than their sigmas: one part misses by the ratio of two units.

Where the sigmas are too large nothing is contradicted, and the part that is right hides the other in the group's sums.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.weights.impossible import with_part
from adjust.model.names import numbered
from adjust.model.result import Adjustment
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.observations.pair_arrays import pair_arrays
from adjust.precision.precision import precision_of

_TURNS = {1.0 / 3600.0: "are arcseconds, read as degrees", 9e-4: "are milligon, read as degrees"}
_SHIFTS = {1e-3: "are micrometres, read as millimetres"}
_FAR, _NEAR = 0.3, 1.5
"""Factor below which it is looked into, and by how much it may be below the ratio of two units.

It is above that by far where the other part tells what this one, so weak, no longer does.
"""
_FEWEST = 8.0
"""Redundancy of a part from which its factor says anything."""
_SHORT = 100.0
"""Sigmas that the shifts of a network are longer than."""
_COARSE = 0.01
"""m: sigma of a shift that is none of a laboratory's."""
_EVIDENCE = 2.0
UNIT_OF_SHIFTS = "unit of shifts"


def units_of_parts(case: Case) -> Iterator[Hypothesis]:
    """Of every group of pairs the part that misses by far less than its sigmas say."""
    survey = case.survey
    if case.result is None or not any(p.used for p in survey.pairs):
        return
    sums, used = _sums(case.result), np.flatnonzero(pair_arrays(survey.pairs).used)
    groups, number = numbered(survey.pairs[i].group for i in used.tolist())
    for k, group in enumerate(groups):
        rows = used[number == k].tolist()
        for part, units in (("rotation", _TURNS), ("translation", _SHIFTS)):
            square, redundancy = sums.get((group, part), (0.0, 0.0))
            if redundancy < _FEWEST or square <= 0.0:
                continue
            factor = float(np.sqrt(square / redundancy))
            for unit, said in units.items() if factor < _FAR else ():
                if unit < _NEAR * factor:
                    yield _hypothesis(survey, rows, group, part, unit, said)


def _sums(result: Adjustment) -> dict[tuple[str, str], tuple[float, float]]:
    """Squares over sigmas and redundancy of rotations and shifts, by group; of the pairs between fixed stations."""
    precision = precision_of(result)
    batch, out = precision.graph.pairs, dict[tuple[str, str], tuple[float, float]]()
    if batch is None:
        return out
    found, pairs = precision.pairs, precision.graph.survey.pairs
    groups, number = numbered(pairs[row].group for row in batch.rows.tolist())
    used = pair_arrays(pairs).used[batch.rows]
    for part, columns in (("rotation", slice(0, 3)), ("translation", slice(3, 6))):
        square, redundancy = ((found.whitened[:, columns] ** 2).sum(axis=1), found.redundancy[:, columns].sum(axis=1))
        for k, group in enumerate(groups):
            mine = np.isfinite(square) & used & (number == k)
            if mine.any():
                out[group, part] = float(square[mine].sum()), float(redundancy[mine].sum())
    return out


def _hypothesis(survey: Survey, rows: list[int], group: str, part: str, unit: float, said: str) -> Hypothesis:
    measured = pair_arrays(survey.pairs)
    of = np.array(rows)[measured.is_pose[rows]] if part == "translation" else np.array(rows)
    penalty = 6.0 * len(of) * float(np.log(unit))
    if part == "translation" and _short(measured.shifts[of], np.sqrt(measured.cov[of, 3, 3])):
        moved = {i: m for i in rows if isinstance(m := survey.pairs[i].b_from_a, Pose3)}
        new = {i: replace(survey.pairs[i], b_from_a=Pose3(m.rotation(), m.translation() / unit))
               for i, m in moved.items()}  # fmt: skip
        return Hypothesis(
            UNIT_OF_SHIFTS, f"the shifts of the pairs of group {group} are hardly longer than their sigmas, and miss "
            "by a thousandth of these: they are metres, read as millimetres",
            "in pairs.csv multiply tx_mm, ty_mm, tz_mm by 1000", Place("group", (group,)),
            with_rows(survey, "pairs", new), (), _EVIDENCE, 0, penalty=penalty,
        )  # fmt: skip
    times, by = f"{1.0 / unit:.0f} times too large", np.ones((len(survey.pairs), 6))
    by[rows, slice(0, 3) if part == "rotation" else slice(3, 6)] = unit
    return Hypothesis(
        "unit of sigmas",
        f"the sigmas of the {part} of the pairs of group {group} are about {times}: they {said}",
        f"multiply these sigmas by {unit:.4g}, or name their column by their unit",
        Place("group", (group,), "sigma"), lambda: with_part(survey, "pairs", rows, part, unit), (), _EVIDENCE, 0,
        penalty=penalty, of_variances=True, pair_sigmas=by,
    )  # fmt: skip


def _short(shifts: FloatArray, sigmas: FloatArray) -> bool:
    """Whether most shifts (n, 3) are hardly longer than their sigmas, which are none of another unit by their size."""
    lengths = np.linalg.norm(shifts, axis=1)
    return bool(len(sigmas) and np.median(lengths / sigmas) < _SHORT and np.median(sigmas) < _COARSE)
