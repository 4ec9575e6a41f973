"""The adjustment that is diagnosed as a linear system, and what it says that its images show."""

from dataclasses import dataclass
from functools import cached_property

from adjust.diagnosis.prediction import Prediction, adjusted_values
from adjust.statistics.score import LinearScores


@dataclass(frozen=True, eq=False)
class Linear(LinearScores):
    """Scores of changes of things whose images it predicts."""

    @cached_property
    def prediction(self) -> Prediction:
        """What the adjustment says that its images show."""
        return Prediction(self.result.survey, adjusted_values(self.result))
