"""Points that are left without rays once gross errors are out: dropped with a note instead of stopping everything."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from adjust.model.errors import IndeterminateError
from adjust.model.result import Adjustment
from adjust.model.subsets import with_points
from adjust.model.survey import Survey

_PREFIX = "point "
_MOST = 50


def without_lost_points(survey: Survey, run: Callable[[Survey], Adjustment]) -> Adjustment:
    """``run(survey)``; a point that it leaves undetermined is taken out with its image points, and it is run again.

    A spot that two cameras saw and one of them mistook leaves nothing of its point. Such points are named in the
    warnings. Raises what ``run`` raises for other reasons, and when nothing but lost points is found.
    """
    lost: list[str] = []
    while True:
        try:
            result = run(survey)
        except IndeterminateError as error:
            names = [p.removeprefix(_PREFIX) for p in error.parameters if p.startswith(_PREFIX)]
            if not names or len(names) != len(error.parameters) or len(lost) >= _MOST or not _spare(survey, set(names)):
                raise
            lost += names
            survey = without_named_points(survey, set(names))
            continue
        if not lost:
            return result
        note = f"left out, because gross errors leave no intersection: point{'s' * (len(lost) > 1)} {', '.join(lost)}"
        return replace(result, warnings=(*result.warnings, note))


def _spare(survey: Survey, names: set[str]) -> bool:
    """Whether these are points seen by two images or more (else they never had an intersection), and not all."""
    blocks = [b.point_idx for b in survey.image_blocks if b.target_id is None]
    counts = np.bincount(np.concatenate([*blocks, np.zeros(0, dtype=np.int64)]), minlength=len(survey.points))
    mine = [i for i, p in enumerate(survey.points) if p.point_id in names]
    return len(mine) == len(names) and bool(np.all(counts[mine] >= 2)) and len(survey.points) > 10 * len(names)


def without_named_points(survey: Survey, names: set[str]) -> Survey:
    """The survey without these world points, and all that was observed of them."""
    return with_points(survey, [i for i, p in enumerate(survey.points) if p.point_id not in names])
