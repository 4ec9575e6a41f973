"""What every section of a report is made from."""

from dataclasses import dataclass
from typing import Any

from adjust.model.result import Adjustment
from adjust.model.survey import BoolArray
from survey.solution.dictionary import RunInfo
from survey.solution.quantities import Scale
from survey.solution.residual_tables import ImageRows
from survey.solution.statistics import Statistics


@dataclass(frozen=True, eq=False)
class Context:
    """The adjustment, its solution as plain values, and the image points row by row; ``suspect`` (N,).

    statistics: None where only the adjustment itself is to be reported.
    """

    adjustment: Adjustment
    run: RunInfo
    solution: dict[str, Any]
    scale: Scale
    rows: ImageRows
    suspect: BoolArray
    statistics: Statistics | None = None
