"""What every section of a report is made from, and the choice of what it shows."""

from typing import Any

import numpy as np

from adjust.model.arrays import largest
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import BoolArray, FloatArray, IntArray
from survey.solution.dictionary import RunInfo
from survey.solution.quantities import Scale
from survey.solution.residual_tables import ImageRows
from survey.solution.statistics import Statistics


@frozen(eq=False)
class Listed:
    """The rows of the table of all observations, of ``total``, without what statistics say of them.

    values: (12, n), as :mod:`survey.report.sections.every_observation` has them. columns: each as JSON, by its heading.
    rest: JSON of what the table has beside its columns.
    """

    total: int
    values: FloatArray
    columns: dict[str, str]
    rest: str


@frozen(eq=False)
class Context:
    """The adjustment, its solution as plain values, and the image points row by row; ``suspect`` (N,).

    statistics: None where only the adjustment itself is to be reported. listed: once it is made.
    """

    adjustment: Adjustment
    run: RunInfo
    solution: dict[str, Any]
    scale: Scale
    rows: ImageRows
    suspect: BoolArray
    statistics: Statistics | None = None
    listed: Listed | None = None

    @property
    def found(self) -> Statistics:
        """The statistics, for sections that are about nothing else; raises ValueError where there are none."""
        if self.statistics is None:
            raise ValueError("only the adjustment itself is reported")
        return self.statistics


def worst(values: FloatArray, most: int) -> IntArray:
    """Positions of the largest absolute values, largest first, equal ones in their order; NaN comes last."""
    return largest(np.fmax(np.abs(values), -1.0), most)


def other_components(adjustment: Adjustment) -> tuple[IntArray, IntArray, FloatArray]:
    """Of everything but image points, row by row: position of the observation, component, standardized residual."""
    others = adjustment.other_arrays
    first = np.cumsum(others.n_components) - others.n_components
    component = np.arange(len(others.observation)) - first[others.observation]
    return others.observation, component, others.standardized
