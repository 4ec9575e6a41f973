"""Things called by each other's names, and epochs out of order: points, cameras, epochs, the same epoch twice."""

from collections.abc import Iterator

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.names.epochs import misplaced_epochs
from adjust.diagnosis.names.given import wrong_given
from adjust.diagnosis.names.images import misnamed_images
from adjust.diagnosis.names.points import exchanged_points
from adjust.diagnosis.names.rays import exchanged_in_images
from adjust.diagnosis.names.setups import rows_of_another_setup
from adjust.diagnosis.names.stations import exchanged_stations


def hypotheses(case: Case) -> Iterator[Hypothesis]:
    """Of readings, given coordinates, images, the poses of hands, pairs."""
    yield from exchanged_points(case)
    yield from wrong_given(case)
    yield from misplaced_epochs(case)
    yield from misnamed_images(case)
    yield from exchanged_in_images(case)
    yield from rows_of_another_setup(case)
    yield from exchanged_stations(case)
