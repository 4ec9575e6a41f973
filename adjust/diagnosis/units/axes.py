"""Coordinates of a whole table in other axes, or in another unit: northings first, heights down, inches."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, permutations, product

import numpy as np

from adjust.diagnosis.hypothesis import ChangeColumns, Hypothesis, Place
from adjust.diagnosis.units.conventions import LENGTH_RATIOS
from adjust.model.observations import Coordinates, position_text
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey

_COLUMNS = ("x_mm", "y_mm", "z_mm")
NORTH_FIRST = "have x and y exchanged (north first, or left-handed)"


def ways() -> Iterator[tuple[str, str, FloatArray]]:
    """What the coordinates are instead, what mends it, and how (3, 3): right value = matrix @ value as read."""
    known = [np.eye(3)]
    for said, remedy, M in _common():
        known.append(M)
        yield said, remedy, M
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        M = np.diag(signs) @ np.eye(3)[list(order)]
        if not any(np.array_equal(M, other) for other in known):
            read = ", ".join("-" * (sign < 0) + "xyz"[i] for i, sign in zip(order, signs, strict=True))
            yield f"have other axes: ({read}) of them are x, y and z", "write them so", M
    for said, ratio in LENGTH_RATIOS.items():
        yield said, f"multiply all of them by {ratio:g}", ratio * np.eye(3)


def _common() -> Iterator[tuple[str, str, FloatArray]]:
    for i, j in combinations(range(3), 2):
        a, b, M = "xyz"[i], "xyz"[j], np.eye(3)
        M[[i, j]] = M[[j, i]]
        said = NORTH_FIRST if (a, b) == ("x", "y") else f"have {a} and {b} exchanged"
        yield said, f"exchange {a} and {b} of all of them", M
    for i, axis in enumerate("xyz"):
        M = np.diag(np.where(np.arange(3) == i, -1.0, 1.0))
        yield f"have {axis} in the opposite direction", f"change the sign of {axis}", M


def other_axes(survey: Survey) -> Iterator[Hypothesis]:
    """All coordinates that were observed, each way; of none where a table of covariances stands beside them."""
    observed = survey.coordinates
    if not observed or any(len(c.positions) > 1 for c in observed):
        return
    points = tuple(position_text(c.positions[0]) for c in observed)
    for said, remedy, M in ways():
        turned = np.sign(M)
        rows = {i: _changed(c, M) for i, c in enumerate(observed)}
        sigmas = tuple(f"sigma_{name}" for name in _COLUMNS)
        edits = [ChangeColumns("coordinates", _COLUMNS, M, np.zeros(3))]
        if any(np.ptp(np.diag(c.cov)) > 0 for c in observed) and not np.array_equal(abs(turned), np.eye(3)):
            edits.append(ChangeColumns("coordinates", sigmas, abs(turned), np.zeros(3)))
        yield Hypothesis(
            "axes or unit of coordinates", f"the coordinates in coordinates.csv {said}",
            f"{remedy} in coordinates.csv", Place("point", points, "x_mm"), with_rows(survey, "coordinates", rows),
            tuple(edits),
        )  # fmt: skip


def _changed(observed: Coordinates, M: FloatArray) -> Coordinates:
    """Sigmas go with their axes, in the unit in which they stand; what was not observed stays so."""
    turned, known = np.sign(M), np.isfinite(np.diag(observed.cov))
    lost = abs(M) @ ~known > 0
    values = np.where(lost, np.nan, np.where(known, observed.values, 0.0) @ M.T)
    cov = turned @ np.where(known & known[:, None], observed.cov, 0.0) @ turned.T
    return replace(observed, values=values, cov=np.where(np.diag(lost), np.inf, cov))
