"""Unknowns that nothing in use observes go, with what only they would predict; nothing else does."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.adjustment import adjust
from adjust.model.observations import Coordinates, Distance, FrameRef, Pair, PositionRef, Reading
from adjust.model.survey import Point, PointParameter, PoseParameter, Setup, Station, Survey
from adjust.statistics.outliers.supported import lost_notes, supported
from survey.simulate import head_on_table, single_camera


@pytest.fixture(scope="module")
def table():
    return head_on_table(1, n_table_epochs=6, n_free_epochs=4)[0]


def _unused(survey, *blocks):
    off = {i: np.zeros(len(survey.image_blocks[i].uv), dtype=np.bool_) for i in blocks}
    return replace(survey, image_blocks=tuple(replace(b, used=off[i]) if i in off else b
                                              for i, b in enumerate(survey.image_blocks)))  # fmt: skip


@pytest.mark.slow
def test_a_survey_in_use_is_itself(table):
    same, lost = supported(table)
    assert same is table
    assert lost == ()


def test_an_image_whose_pose_others_tell_stays_predicted(table):
    kept, lost = supported(_unused(table, 0))
    assert lost == ()
    assert len(kept.image_blocks) == len(table.image_blocks)


def test_an_epoch_without_reading_and_image_goes(table):
    block = table.image_blocks[0]
    mine = [i for i, b in enumerate(table.image_blocks) if b.epoch_id == block.epoch_id]
    readings = tuple(replace(r, used=r.epoch_id != block.epoch_id) for r in table.table_readings)
    less = replace(_unused(table, *mine), table_readings=readings)
    kept, lost = supported(less)
    assert lost == (("table_angles", table.tables[0].table_id, block.epoch_id),)
    assert len(kept.image_blocks) == len(table.image_blocks) - len(mine)
    blocks = tuple(b for i, b in enumerate(table.image_blocks) if i not in mine)
    others = tuple(r for r in table.table_readings if r.epoch_id != block.epoch_id)
    without = replace(table, image_blocks=blocks, table_readings=others)
    assert adjust(kept).omega == pytest.approx(adjust(without).omega, rel=1e-9)


def test_an_epoch_of_which_two_points_are_left_goes_and_one_of_three_stays():
    survey = single_camera(1, n_images=8)[0]
    block = survey.image_blocks[0]
    for left, names in ((1, {block.epoch_id}), (2, {block.epoch_id}), (3, set())):
        used = np.arange(len(block.uv)) < left
        less = replace(survey, image_blocks=(replace(block, used=used), *survey.image_blocks[1:]))
        kept, lost = supported(less)
        assert {name[2] for name in lost} == names
        assert len(kept.image_blocks) == len(survey.image_blocks) - len(names)
    whole = adjust(replace(survey, image_blocks=survey.image_blocks[1:]))
    used = np.arange(len(block.uv)) < 2
    less = replace(survey, image_blocks=(replace(block, used=used), *survey.image_blocks[1:]))
    assert adjust(supported(less)[0]).omega == pytest.approx(whole.omega, rel=1e-9)


def _ring():
    held = PoseParameter(Pose3(), "held")
    stations = tuple(Station(f"S{i}", world_from_station=held if i == 0 else PoseParameter()) for i in range(4))
    pose = Pose3(Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([1.0, 2.0, 0.5]))
    pairs = tuple(Pair(f"p{i}{j}", FrameRef("station", f"S{i}"), FrameRef("station", f"S{j}"), pose, 1e-8 * np.eye(6),
                       used=j != 3) for i, j in ((0, 1), (1, 2), (2, 3)))  # fmt: skip
    return Survey(stations=stations, pairs=pairs)


def test_a_station_goes_with_its_last_pair_but_not_one_that_was_never_measured():
    kept, lost = supported(_ring())
    assert lost == (("world_from_station", "S3"),)
    assert [s.station_id for s in kept.stations] == ["S0", "S1", "S2"]
    ring = _ring()
    alone = replace(ring, stations=(*ring.stations, Station("S9")))
    assert "S9" in [s.station_id for s in supported(alone)[0].stations]


def test_points_and_what_would_reach_them():
    a, b, c = (PositionRef(n) for n in "ABC")
    points = (Point("A", PointParameter(np.zeros(3), "held")), Point("B"), Point("C"))
    cov = 1e-6 * np.eye(3)
    survey = Survey(points=points, coordinates=(Coordinates((b,), np.ones((1, 3)), cov),
                                                Coordinates((c,), 2 * np.ones((1, 3)), cov, used=False)),
                    distances=(Distance("bc", b, c, 1.7, 1e-3, used=False),
                               Distance("ab", a, b, 1.7, 1e-3)))  # fmt: skip
    kept, lost = supported(survey)
    assert lost == (("point", "C"),)
    assert [p.point_id for p in kept.points] == ["A", "B"]
    assert [d.distance_id for d in kept.distances] == ["ab"]
    assert len(kept.coordinates) == 1
    assert lost_notes(lost) == ("left out, because every observation of it is left out, or too many are: point C",)
    one_ray = replace(survey, distances=(Distance("bc", b, c, 1.7, 1e-3),))
    assert supported(one_ray)[1] == ()  # one distance still observes it, which is not enough, and that is an error


def test_a_setup_goes_with_its_directions():
    points = tuple(Point(n, PointParameter(np.array(x, dtype=float), "held"))
                   for n, x in (("A", (0, 0, 0)), ("B", (5, 0, 0)), ("C", (0, 5, 0))))  # fmt: skip
    readings = tuple(Reading(f"r{i}", "direction", PositionRef("A"), PositionRef(to), 0.5, 1e-5, setup_id=setup,
                             used=setup == "s1")
                     for i, (to, setup) in enumerate((("B", "s1"), ("C", "s1"), ("B", "s2"), ("C", "s2"))))  # fmt: skip
    kept, lost = supported(Survey(points=points, readings=readings, setups=(Setup("s1"), Setup("s2"))))
    assert lost == (("orientation", "s2"),)
    assert [r.setup_id for r in kept.readings] == ["s1", "s1"]
