"""What takes no part in an adjustment, and whose decision that was: of people, of a table, or of this run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adjust.model.result import Adjustment
from survey.project.observed import Hits, Observed, name_of_residual
from survey.project.project import LeftOut


def left_out_dict(adjustment: Adjustment, left_out: Sequence[LeftOut], by_people: int, in_files: int) -> dict[str, Any]:
    """``exclusions`` row by row, and ``left_out``: three counts of observations that never overlap.

    by_people: excluded by ``exclusions.csv``. in_files: only marked ``used = false`` in a table. in_this_run: in use
    until this adjustment left them out. An image point and a reading count one each.
    """
    return {
        "exclusions": _entries(adjustment, left_out),
        "left_out": {"by_people": by_people, "in_files": in_files, "in_this_run": adjustment.n_screened},
    }


def _entries(adjustment: Adjustment, left_out: Sequence[LeftOut]) -> list[dict[str, Any]]:
    if not left_out:
        return []
    observed = Observed(adjustment.survey, ())
    others = {name_of_residual(o): o for o in adjustment.other_residuals}
    return [_entry(adjustment, one, observed.hits(one.exclusion.name, one.exclusion.at), observed, others)
            for one in left_out]  # fmt: skip


def _entry(
    adjustment: Adjustment, one: LeftOut, hit: Hits, observed: Observed, others: Mapping[str, Any]
) -> dict[str, Any]:
    said, ptr, images = one.exclusion, adjustment.image_residuals.block_ptr, adjustment.image_residuals
    sizes = [np.abs(images.standardized[ptr[i] : ptr[i + 1]][mask]).ravel() for i, mask in hit.images.items()]
    sizes += [np.abs(others[name].standardized).ravel() for name in observed.names(hit) if name in others]
    known = np.concatenate([*sizes, np.zeros(0)])
    known = known[np.isfinite(known)]
    largest = {"largest_standardized_residual": float(known.max()) if len(known) else None}
    return said.as_dict() | {"line": said.line} | one.counts() | largest
