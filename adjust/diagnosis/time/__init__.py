"""Things that were not there at the same time, or did not stay where the project says."""

from collections.abc import Iterator

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.time.forgotten_motion import forgotten_motion
from adjust.diagnosis.time.synchronisation import unsynchronised


def hypotheses(case: Case) -> Iterator[Hypothesis]:
    """Of cameras that see the same, and of targets and stations that move."""
    yield from forgotten_motion(case)
    yield from unsynchronised(case)
