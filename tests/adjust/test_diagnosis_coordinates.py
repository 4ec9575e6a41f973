"""Observed coordinates in other axes, as the diagnosis tries them; what is thousands of sigmas off."""

from dataclasses import replace

import numpy as np

from adjust.diagnosis.hypothesis import ChangeColumns
from adjust.diagnosis.names.nearer import nearer
from adjust.diagnosis.units.axes import other_axes
from adjust.diagnosis.units.conventions import LENGTH_RATIOS
from adjust.diagnosis.units.singles import far_off
from adjust.model.observations import Coordinates, Distance, PositionRef
from adjust.model.survey import Datum, Point, PointParameter, Survey
from adjust.statistics.screened_adjustment import adjust_cleaned
from tests.adjust.terrestrial_networks import measured, polar_network


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


def in_other_axes(of: int = 5) -> Survey:
    """A network of set-ups with coordinates of some points whose y and z are exchanged."""
    survey, truth = polar_network(1)
    names = [p.point_id for p in survey.points][-of:]
    wrong = (np.asarray(truth["point", n])[[0, 2, 1]][None] for n in names)
    known = tuple(Coordinates((PositionRef(n),), x, 1e-8 * np.eye(3)) for n, x in zip(names, wrong, strict=True))
    free = tuple(replace(p, x_in_world=PointParameter()) for p in survey.points)
    return replace(measured(survey, truth, 7), points=free, coordinates=known, datum=Datum())


def test_only_axes_in_which_coordinates_lie_nearer_to_where_readings_have_them_get_a_start_of_their_own() -> None:
    """Which way north is readings do not tell: four of all ways differ by that alone."""
    survey = in_other_axes()
    left = nearer(survey, every := [*other_axes(survey)])
    matrices = [edit.matrix for h in left for edit in h.edits if isinstance(edit, ChangeColumns)]
    turns = [M @ np.eye(3)[[0, 2, 1]] for M in matrices]
    assert "have y and z exchanged" in left[0].cause
    assert sum(turn[2, 2] == 1.0 and np.linalg.det(turn) > 0.0 for turn in turns) == 4
    assert len(left) < len(every) / 5


def test_all_axes_get_one_where_readings_do_not_tell() -> None:
    survey = in_other_axes()
    tilted = replace(survey, setups=tuple(replace(s, levelled=False) for s in survey.setups))
    for unknown in (tilted, in_other_axes(2)):
        assert len(nearer(unknown, every := [*other_axes(unknown)])) == len(every)


def test_a_distance_that_was_left_out_thousands_of_sigmas_off_is_told_once_and_not_if_people_left_it_out() -> None:
    """Nothing was said of it; two of them may have one cause."""
    x = np.random.default_rng(1).uniform(-3.0, 3.0, (6, 3))
    known = tuple(Coordinates((PositionRef(f"P{i}"),), x[i][None], 1e-8 * np.eye(3)) for i in range(6))
    points = tuple(Point(f"P{i}") for i in range(6))

    def told(off: dict[int, float], used: bool = True) -> list[tuple[str, tuple[str, ...]]]:
        lengths = (float(np.linalg.norm(x[i] - x[i + 1])) for i in range(5))
        distances = tuple(
            Distance(f"D{i}", PositionRef(f"P{i}"), PositionRef(f"P{i + 1}"), s, 1e-4, used=used or i > 0)
            for i, s in enumerate(length + off.get(i, 0.0) for i, length in enumerate(lengths))
        )
        survey = Survey(points=points, coordinates=known, distances=distances)
        found = far_off(survey, adjust_cleaned(survey))
        return [(c.hypothesis.name, c.hypothesis.place.ids) for c in found]

    assert told({2: 2.0}) == [("gross error", ("D2",))]
    assert told({2: 0.05}) == told({2: 2.0, 4: -1.0}) == told({}) == []
    assert told({0: 2.0}, used=False) == []
