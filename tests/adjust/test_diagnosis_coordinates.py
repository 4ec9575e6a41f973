"""Observed coordinates in other axes, as the diagnosis tries them."""

import numpy as np

from adjust.diagnosis.units.axes import other_axes
from adjust.diagnosis.units.conventions import LENGTH_RATIOS
from adjust.model.observations import Coordinates, PositionRef
from adjust.model.survey import Survey


def test_coordinates_go_to_their_axes_with_their_covariances_and_what_was_not_observed_stays_so() -> None:
    cov = np.array([[1.0, 0.5, 0.0], [0.5, 4.0, 0.0], [0.0, 0.0, np.inf]])
    given = Coordinates((PositionRef("A"),), np.array([[1.0, 2.0, np.nan]]), cov)
    survey = Survey(coordinates=(given,))
    ways = {h.cause.partition(".csv ")[2]: h for h in other_axes(survey)}
    assert len(ways) == 6 * 8 - 1 + len(LENGTH_RATIOS)
    (exchanged,), (turned,) = (survey.coordinates for name in (
        "have x and z exchanged", "have other axes: (y, -x, z) of them are x, y and z",
    ) if (survey := ways[name].changed()) is not None)  # fmt: skip
    np.testing.assert_array_equal(exchanged.values, [[np.nan, 2.0, 1.0]])
    np.testing.assert_array_equal(exchanged.cov, [[np.inf, 0.0, 0.0], [0.0, 4.0, 0.5], [0.0, 0.5, 1.0]])
    np.testing.assert_array_equal(turned.values, [[2.0, -1.0, np.nan]])
    np.testing.assert_array_equal(turned.cov, [[4.0, -0.5, 0.0], [-0.5, 1.0, 0.0], [0.0, 0.0, np.inf]])
