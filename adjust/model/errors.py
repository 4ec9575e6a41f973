"""What a user can cause and mend, everything else is a bug and keeps its traceback; names in what is said of it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from adjust.model.stopped import Stopped  # for types alone: it loads GTSAM


class SurveyError(Exception):
    """Something in the survey that its owner can put right; the message says where, what was found and what to do."""


class IndeterminateError(SurveyError):
    """The observations and the datum leave some unknowns undetermined.

    ``parameters`` names them, strongest share first.
    """

    def __init__(self, message: str, parameters: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.parameters = parameters


class NotConvergedError(SurveyError):
    """The adjustment did not reach a minimum; the message says what kept moving.

    stopped: where that was, None where it is not known.
    """

    def __init__(self, message: str, stopped: "Stopped | None" = None) -> None:
        super().__init__(message)
        self.stopped = stopped


class GivenUpError(NotConvergedError):
    """After many steps the observations still miss by more than was worth going on for: see ``SolveOptions``."""


class Explanation(Protocol):
    """What explains that a survey does not fit: see :class:`adjust.diagnosis.diagnosis.Diagnosis`."""

    @property
    def lines(self) -> tuple[str, ...]:
        """For people: one for each cause, the likeliest first."""
        ...

    @property
    def spoils(self) -> bool:
        """Whether the adjustment fits only because it left out what showed the first cause."""
        ...

    def told(self) -> list[dict[str, str | float | bool | list[str]]]:
        """The causes for machines."""
        ...


class DiagnosedError(SurveyError):
    """An adjustment that failed, with what explains it."""

    def __init__(self, message: str, diagnosis: Explanation) -> None:
        super().__init__(message)
        self.diagnosis = diagnosis


def listed(names: Sequence[str], most: int, between: str = ", ") -> str:
    """The first names of a message, and how many more there are."""
    return between.join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
