"""Surveys less some positions: what concerns them goes, what is correlated keeps what is left."""

from dataclasses import replace

import numpy as np

from adjust.model.observations import Distance, FrameRef, ImageBlock, PositionRef, Reading, ReadingCovariance
from adjust.model.subsets import only_between, points_read, with_points
from adjust.model.survey import TILT, Point, Setup, Survey, VectorParameter, Vertical
from adjust.statistics.outliers.supported import without_named_points

A, B, C = PositionRef("A"), PositionRef("B"), PositionRef("C")


def survey() -> Survey:
    cov = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 2.0], [0.5, 2.0, 16.0]]) * 1e-6
    return Survey(
        distances=(Distance("ab", A, B, 1.0, 1e-3), Distance("bc", B, C, 1.0, 1e-3)),
        setups=(Setup("S"),),
        readings=(
            Reading("1", "slope_distance", A, B, 1.0, 2e-3, "S"),
            Reading("2", "slope_distance", A, C, 1.0, 3e-3, "S", used=False),
            Reading("3", "angle", A, B, 1.0, 3e-3, second=C),
            Reading("4", "slope_distance", B, A, 1.0, 4e-3, "S"),
        ),
        reading_covariances=(ReadingCovariance(("1", "2", "4"), cov),),
        vertical=Vertical(tilt=VectorParameter(TILT, np.zeros(2), TILT)),
    )


def test_what_concerns_a_point_goes() -> None:
    less = only_between(survey(), lambda ref: ref != C)
    assert [d.distance_id for d in less.distances] == ["ab"]
    assert [r.reading_id for r in less.readings] == ["1", "4"]
    assert less.reading_covariances[0].reading_ids == ("1", "4")
    np.testing.assert_array_equal(less.reading_covariances[0].cov, np.array([[4.0, 0.5], [0.5, 16.0]]) * 1e-6)
    assert less.vertical.tilt.free == TILT


def test_without_readings_the_vertical_is_held() -> None:
    less = only_between(survey(), lambda ref: False)
    assert (less.readings, less.distances, less.vertical.tilt.free) == ((), (), ())


def test_points_that_readings_reach() -> None:
    assert points_read(survey()) == {"A", "B", "C"}
    assert points_read(only_between(survey(), lambda ref: ref != C)) == {"A", "B"}


def test_without_a_point_observations_of_other_frames_points_of_its_name_stay() -> None:
    board = FrameRef("target", "board")
    images = (
        ImageBlock("X", "e", None, np.array([2, 0, 1]), np.eye(3, 2), np.tile(np.eye(2), (3, 1, 1))),
        ImageBlock("X", "e", "board", np.array([2]), np.eye(1, 2), np.eye(2)[None]),
        ImageBlock("Y", "e", None, np.array([2]), np.eye(1, 2), np.eye(2)[None]),
    )
    whole = replace(
        survey(),
        points=tuple(Point(name) for name in "ABC"),
        image_blocks=images,
        distances=(*survey().distances, Distance("bc on a board", B, PositionRef("C", board), 1.0, 1e-3)),
        readings=(*survey().readings, Reading("5", "slope_distance", A, PositionRef("C", board), 1.0, 2e-3, "S")),
    )
    for less in (with_points(whole, [0, 1]), without_named_points(whole, {"C"})):
        assert [p.point_id for p in less.points] == ["A", "B"]
        assert [d.distance_id for d in less.distances] == ["ab", "bc on a board"]
        assert [r.reading_id for r in less.readings] == ["1", "4", "5"]
        assert [(b.camera_id, b.target_id, b.point_idx.tolist()) for b in less.image_blocks] == [
            ("X", None, [0, 1]),
            ("X", "board", [2]),
        ]
        np.testing.assert_array_equal(less.image_blocks[0].uv, np.eye(3, 2)[1:])
