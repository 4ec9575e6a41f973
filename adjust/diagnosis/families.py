"""Which causes are looked for, and when. Every family forms its hypotheses by what cheap evidence makes worth a try."""

from collections.abc import Callable, Iterable

from adjust.diagnosis import effects
from adjust.diagnosis.bodies import changed_bodies, lost_cameras
from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.images import mirrored_images, turned_alone
from adjust.diagnosis.names.epochs import misplaced_epochs
from adjust.diagnosis.names.given import wrong_given
from adjust.diagnosis.names.images import misnamed_images
from adjust.diagnosis.names.points import exchanged_points
from adjust.diagnosis.names.rays import exchanged_in_images
from adjust.diagnosis.names.setups import rows_of_another_setup
from adjust.diagnosis.names.stations import exchanged_stations
from adjust.diagnosis.names.throughout import exchanged_throughout
from adjust.diagnosis.table.misread import misread_tables
from adjust.diagnosis.targets.layout import other_layouts
from adjust.diagnosis.targets.size import wrong_sizes
from adjust.diagnosis.time.forgotten_motion import forgotten_motion
from adjust.diagnosis.time.synchronisation import unsynchronised
from adjust.diagnosis.units.faces import other_kinds, second_faces, turned_circles
from adjust.diagnosis.units.heights import misread_heights, wrong_heights
from adjust.diagnosis.units.lengths import misread_lengths
from adjust.diagnosis.units.pairs import misread_pairs
from adjust.diagnosis.units.readings import misread_readings
from adjust.diagnosis.weights.centring import missing_centring
from adjust.diagnosis.weights.correlated import correlated_readings
from adjust.diagnosis.weights.impossible import impossible_sigmas
from adjust.diagnosis.weights.sigmas import odd_sigmas, wrong_factors
from adjust.diagnosis.weights.small import small_sigmas

Family = Callable[[Case], Iterable[Hypothesis]]
SCORES: tuple[Family, ...] = (effects.hypotheses,)
IMAGES: tuple[Family, ...] = (mirrored_images, other_layouts, turned_alone)
NAMES: tuple[Family, ...] = (
    exchanged_points, exchanged_throughout, wrong_given, misplaced_epochs, misnamed_images, exchanged_in_images,
    rows_of_another_setup, exchanged_stations,
)  # fmt: skip
VALUES: tuple[Family, ...] = (misread_heights, impossible_sigmas)
"""Told by the values alone: the first ones that are tried."""
UNITS: tuple[Family, ...] = (
    misread_readings, misread_lengths, second_faces, turned_circles, other_kinds, wrong_heights, misread_pairs,
)  # fmt: skip
IN_COMMON = (*VALUES, exchanged_points, exchanged_throughout, *UNITS, effects.of_tables, small_sigmas)
"""What several observations that were left out, with all others fitting, may have in common."""
TIME: tuple[Family, ...] = (forgotten_motion, unsynchronised)
WEIGHTS: tuple[Family, ...] = (odd_sigmas, wrong_factors, small_sigmas, correlated_readings, missing_centring)
CHEAP = (*VALUES, misread_tables, *IMAGES, *NAMES, *UNITS, *TIME, *WEIGHTS, lost_cameras)
LATER: tuple[tuple[Family, ...], ...] = ((wrong_sizes,), (changed_bodies,))
"""These adjust to find theirs: they are asked where what the first ones found does not explain everything."""


def families(case: Case) -> list[tuple[Family, ...]]:
    """By stage; scores come last where the values at which they are taken would have to be looked for first."""
    if case.result is None and not case.survey.image_blocks:
        return [CHEAP, *LATER, SCORES]
    return [(*SCORES, *CHEAP), *LATER]
