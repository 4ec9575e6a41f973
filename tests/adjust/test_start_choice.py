"""Start values that came with a survey: used, found anew where they lead nowhere, and compared with what comes out."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import GivenUpError, NotConvergedError, SurveyError
from adjust.model.observations import Distance, PositionRef
from adjust.model.result import Adjustment
from adjust.model.survey import Datum, FloatArray, Point, PointParameter, PoseParameter, Survey
from adjust.start.choice import Begun, adjusted_from_own_start
from adjust.start.given import GivenStarts, given_starts, without_starts
from survey.simulate import beacons, head_on_table
from tests.adjust import helpers as h

SIGMA = 1e-3
FIXED = {"A": (0.0, 0.0, 0.0), "B": (10.0, 0.0, 0.3), "C": (9.0, 8.0, -0.2), "D": (-1.0, 7.0, 0.0)}


def trilateration(x: dict[str, FloatArray], start: dict[str, FloatArray], seed: int = 1) -> Survey:
    """Points above four held ones that lie almost in a plane, each by its distances from these."""
    rng = np.random.default_rng(seed)
    points = [Point(n, PointParameter(np.array(v), "held")) for n, v in FIXED.items()]
    points += [Point(n, PointParameter(start.get(n))) for n in x]
    distances = [
        Distance(f"{a}-{n}", PositionRef(a), PositionRef(n), float(np.linalg.norm(place - b)) + SIGMA * rng.normal(),
                 SIGMA)
        for n, place in x.items() for a, b in ((a, np.array(b)) for a, b in FIXED.items())
    ]  # fmt: skip
    return Survey(points=tuple(points), distances=tuple(distances))


def flat(survey: Survey) -> Survey:
    """The same with the held points exactly in a plane, so that above and below fit the same."""
    moved = [
        replace(p, x_in_world=replace(p.x_in_world, value=np.asarray(p.x_in_world.value) * (1.0, 1.0, 0.0)))
        if p.x_in_world.treatment == "held" else p
        for p in survey.points
    ]  # fmt: skip
    place = {p.point_id: np.asarray(p.x_in_world.value) for p in moved if p.x_in_world.treatment == "held"}
    distances = tuple(
        replace(d, value=float(np.linalg.norm(TOPS[str(d.b.point_id)] - place[str(d.a.point_id)])))
        for d in survey.distances
    )
    return replace(survey, points=tuple(moved), distances=distances)


TOPS = {"P": np.array([3.0, 4.0, 2.5]), "Q": np.array([6.0, 2.0, 3.0]), "R": np.array([5.0, 6.0, 1.5])}


def begun_at(places: dict[str, FloatArray], survey: Survey) -> Adjustment:
    """As ``adjust``, but its search for start values ends at these places."""
    return adjusted_from_own_start(
        survey,
        lambda trial, _given: Begun(trial, StartValues({}, {}, places)),
        lambda begun: adjust(begun.survey, begun.start),
    )


def test_of_two_mirror_images_the_one_near_the_start_values_is_kept() -> None:
    survey = flat(trilateration(TOPS, {n: x + 0.2 for n, x in TOPS.items()}))
    below = {n: x * (1.0, 1.0, -1.0) for n, x in TOPS.items()}
    assert adjust(survey, StartValues({}, {}, below)).estimates["point", "P"].value[2] < 0.0
    result = begun_at(below, survey)
    for n, x in TOPS.items():
        np.testing.assert_allclose(np.asarray(result.estimates["point", n].value), x, atol=1e-6)
    assert any("two mirror images equally well" in w for w in result.warnings)


def test_an_image_that_does_not_fit_is_not_taken() -> None:
    """The held points tell above from below: the result stays, and that it is far from the start values is told."""
    survey = trilateration(TOPS, {n: x * (1.0, 1.0, -1.0) for n, x in TOPS.items()})
    result = begun_at(dict(TOPS), survey)
    assert result.estimates["point", "P"].value[2] > 0.0
    said = [w for w in result.warnings if "lie far from the start values" in w]
    assert len(said) == 1
    assert "3 of 3 points" in said[0]
    assert "P (5" in said[0]
    assert "mirrored" in said[0]


def test_a_whole_network_keeps_its_handedness() -> None:
    """Nothing is held, only distances: the inner constraints hang on the start values, and so does left and right."""
    rng = np.random.default_rng(4)
    x = {f"P{i}": v for i, v in enumerate(rng.uniform(-10, 10, (6, 3)))}
    names = list(x)
    survey = Survey(
        points=tuple(Point(n, PointParameter(v + rng.normal(0, 0.1, 3))) for n, v in x.items()),
        distances=tuple(
            Distance(f"{a}{b}", PositionRef(a), PositionRef(b), float(np.linalg.norm(x[a] - x[b])), SIGMA)
            for i, a in enumerate(names) for b in names[:i]
        ),
        datum=Datum("inner"),
    )  # fmt: skip
    result = begun_at({n: v * (1.0, 1.0, -1.0) for n, v in x.items()}, survey)
    found = np.array([result.estimates["point", n].value for n in names])
    there = np.array(list(x.values()))
    sides = [np.linalg.det((p - p[0])[1:4]) for p in (found, there)]
    assert sides[0] * sides[1] > 0.0
    assert any("mirror images" in w for w in result.warnings)


def test_start_values_that_are_good_are_not_mentioned() -> None:
    result = adjust(trilateration(TOPS, {n: x + 0.1 for n, x in TOPS.items()}))
    assert not any("start values" in w for w in result.warnings)


@pytest.mark.slow
def test_wrong_poses_are_found_anew_and_told() -> None:
    """Boards given on the other side of the room, upside down: without what was given the images tell."""
    survey, _ = head_on_table(1, n_cameras=2, n_table_epochs=6, n_free_epochs=3)
    wrong = PoseParameter(Pose3(Rot3.Rx(np.pi), np.array([7.0, -9.0, 4.0])))

    def spoilt(parameter: PoseParameter) -> PoseParameter:
        return wrong if parameter.treatment == "free" else parameter

    stations = tuple(replace(s, mount_from_station=spoilt(s.mount_from_station)) for s in survey.stations)
    cameras = tuple(replace(c, station_from_camera=spoilt(c.station_from_camera)) for c in survey.cameras)
    tables = tuple(replace(t, world_from_table=spoilt(t.world_from_table)) for t in survey.tables)
    given = replace(survey, cameras=cameras, stations=stations, tables=tables)
    assert given_starts(given).poses
    result = adjust(given)
    best = adjust(survey)
    assert result.omega == pytest.approx(best.omega, rel=1e-6)
    assert any("start values: those given for poses" in w and "found anew" in w for w in result.warnings)


@pytest.mark.slow
def test_rough_coordinates_of_beacons_leave_the_boards_alone() -> None:
    """Beacons given to 30 mm at a few metres, boards exact: the same minimum as from good ones, without a word."""
    survey, truth = beacons(seed=4, n_table_epochs=5, n_free_epochs=4)
    rng = np.random.default_rng(1)
    free = [p.point_id for p in survey.points if p.x_in_world.treatment == "free"]
    points = tuple(
        replace(p, x_in_world=replace(p.x_in_world, value=truth["point", p.point_id] + rng.normal(0.0, 0.03, 3)))
        if p.point_id in free else p
        for p in survey.points
    )  # fmt: skip
    assert free
    result = adjust(replace(survey, points=points))
    assert result.omega == pytest.approx(adjust(survey).omega, rel=1e-6)
    assert not any("start values" in w for w in result.warnings)


def test_the_first_failure_is_the_one_that_is_raised() -> None:
    survey = trilateration(TOPS, {n: x + 0.2 for n, x in TOPS.items()})
    tried: list[int] = []

    def find(trial: Survey, _given: GivenStarts) -> Begun:
        tried.append(sum(p.x_in_world.value is None for p in trial.points))
        return Begun(trial, StartValues({}, {}, {}))

    def run(_begun: Begun) -> Adjustment:
        raise NotConvergedError(f"failure {len(tried)}")

    with pytest.raises(SurveyError, match="failure 1"):
        adjusted_from_own_start(survey, find, run)
    assert tried == [0, 3]


@pytest.mark.parametrize(("kinds", "raised"), [
    ((NotConvergedError, GivenUpError), 1), ((GivenUpError, GivenUpError), 0), ((SurveyError, GivenUpError), 0),
])  # fmt: skip
def test_a_start_that_was_given_up_is_told_before_one_that_did_not_converge(
    kinds: tuple[type[SurveyError], ...], raised: int
) -> None:
    """Who gives up early has to know, and to go on; what fails for another reason fails anyway."""
    survey = trilateration(TOPS, {n: x + 0.2 for n, x in TOPS.items()})
    errors = [kind(f"failure {i}") for i, kind in enumerate(kinds)]
    left = iter(errors)

    def run(_begun: Begun) -> Adjustment:
        raise next(left)

    with pytest.raises(SurveyError) as caught:
        adjusted_from_own_start(survey, lambda trial, _: Begun(trial, StartValues({}, {}, {})), run)
    assert caught.value is errors[raised]


def test_held_and_known_values_are_no_start_values() -> None:
    pose, cov = Pose3(), np.eye(6)
    survey, _ = h.network(1)
    points = (
        Point("a", PointParameter(np.ones(3))), Point("b", PointParameter(np.ones(3), "held")),
        Point("c", PointParameter(np.ones(3), "prior", np.eye(3))), Point("d", PointParameter(np.ones(3), held=("z",))),
    )  # fmt: skip
    station = replace(
        survey.stations[0], world_from_station=PoseParameter(pose, "held"),
        epochs={"e0": PoseParameter(pose), "e1": PoseParameter(pose, "prior", cov)},
    )  # fmt: skip
    survey = replace(survey, points=points, stations=(station,))
    found = given_starts(survey)
    assert set(found.points) == {"a"}
    assert ("world_from_station", station.station_id, "e0") in found.poses
    assert ("world_from_station", station.station_id, "e1") not in found.poses
    bare = without_starts(survey, points=True, poses=True)
    assert not given_starts(bare)
    assert [p.x_in_world.value is None for p in bare.points] == [True, False, False, False]
