"""What a user can cause and mend; everything else is a bug and keeps its traceback."""

from collections.abc import Sequence


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

    stopped: where that was (``adjust.graph.divergence.Stopped``), None where it is not known.
    """

    def __init__(self, message: str, stopped: object = None) -> None:
        super().__init__(message)
        self.stopped = stopped


class DiagnosedError(SurveyError):
    """An adjustment that failed, with what explains it (``adjust.diagnosis.diagnosis.Diagnosis``)."""

    def __init__(self, message: str, diagnosis: object) -> None:
        super().__init__(message)
        self.diagnosis = diagnosis


def listed(names: Sequence[str], most: int, between: str = ", ") -> str:
    """The first names of a message, and how many more there are."""
    return between.join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
