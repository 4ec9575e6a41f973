"""What a diagnosis may still adjust, and adjusting that is paid for from it; all in adjustments of its survey."""

from dataclasses import dataclass

import numpy as np

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues
from adjust.graph.solver import Progress
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey

MOST = 6.5
"""Adjustments that scores, starts and trials of a diagnosis may take; other evidence takes two or three more."""
SCORES, START, REST, STEP = 1.5, 0.5, 0.4, 0.07
"""What all scores, start values, a graph built and judged, and a step of its solution cost."""
_CLOCKS = 2.5
"""How many times more that costs with clocks: what moves is predicted between epochs."""
_BEGUN = 3
"""Steps after which a survey that is right is not as far off any more as where nothing is explained."""
_HOPELESS = 8
"""Steps after which a trial from near values leaves less than the survey as it stands does, or leads nowhere."""


@dataclass
class Budget:
    """What is left; a part of the survey counts as its share of images.

    kept: of that for later. refused: whether something was.
    """

    left: float = MOST
    kept: float = 0.0
    refused: bool = False

    @property
    def lasts(self) -> bool:
        """Whether something is left for now."""
        return self.left > self.kept

    def spend(self, share: float) -> None:
        """SurveyError where nothing is."""
        if not self.lasts:
            self.refused = True
            raise SurveyError("the time of the diagnosis is spent")
        self.left -= share

    def adjusted(
        self, survey: Survey, start: StartValues | None, options: AdjustOptions, first: float, step: float = STEP,
        most: float = np.inf, lost: float = np.inf,
    ) -> Adjustment:  # fmt: skip
        """Adjust, and pay as it goes: see :meth:`paying`."""
        if any(o.clock is not None for of in (survey.cameras, survey.tables, survey.stations) for o in of):
            first, step = _CLOCKS * first, _CLOCKS * step
        return adjust(survey, start, options, self.paying(first, step, most, lost))

    def paying(self, first: float, step: float = STEP, most: float = np.inf, lost: float = np.inf) -> Progress:
        """The progress of an adjustment that pays as it goes: it begins where something is left, and every step costs.

        most: v'Pv that it has to come below in the end; lost: soon after it began.
        """

        def went(iteration: int, omega: float) -> None:
            self.left -= step
            if (iteration >= _HOPELESS and omega > most) or (iteration >= _BEGUN and omega > lost):
                raise SurveyError("it leads away")

        self.spend(first)
        return went
