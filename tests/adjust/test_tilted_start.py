"""Start values of stations that are not levelled: scanners and trackers, and theodolites without distances."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.adjustment import adjust
from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.observations import CoordinateDifferences, FrameRef, PositionRef, Reading
from adjust.model.result import Adjustment
from adjust.model.survey import (
    Bearings,
    Camera,
    Datum,
    FloatArray,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Setup,
    Station,
    Survey,
    Target,
)

ANGLE, LENGTH = 2e-5, 1e-4
RAYS = ("direction", "zenith")
POLAR = (*RAYS, "slope_distance")
CONVENTIONS = [Bearings("x", False), Bearings("y", True)]


def reading_of(kind: str, q: FloatArray, sign: float) -> float:
    """What an instrument at the origin reads of a point q (3,) in its own axes."""
    if kind == "direction":
        return float(sign * np.arctan2(q[1], q[0]) % (2 * np.pi))
    if kind == "zenith":
        return float(np.arctan2(np.hypot(q[0], q[1]), q[2]))
    return float(np.linalg.norm(q))


def sights(
    name: str, pose: Pose3, x: dict[str, FloatArray], kinds: Sequence[str], bearings: Bearings, turn: float = 0.0,
    setup: str | None = None,
) -> tuple[Reading, ...]:  # fmt: skip
    """Readings with noise of points x from a station; its instrument is turned about the station's z axis."""
    rng = np.random.default_rng([*name.encode(), *(setup or "").encode()])
    sign = -1.0 if bearings.clockwise else 1.0
    at, out = PositionRef(frame=FrameRef("station", name)), []
    for point, place in x.items():
        q = (pose * Pose3(Rot3.Rz(turn), np.zeros(3))).transformTo(place)
        for kind in kinds:
            sigma = LENGTH if kind == "slope_distance" else ANGLE
            value = reading_of(kind, q, sign) + sigma * rng.normal()
            own = setup or f"set-up {name}"
            out.append(Reading(f"{own} {point} {kind}", kind, at, PositionRef(point), value, sigma, own))
    return tuple(out)


def poses(n: int, seed: int = 1) -> list[Pose3]:
    """Stations anywhere, turned anyhow."""
    rng = np.random.default_rng(seed)
    return [Pose3(Rot3.Expmap(rng.uniform(-1.5, 1.5, 3)), rng.uniform(-3, 3, 3)) for _ in range(n)]


def around(n: int, seed: int = 2) -> dict[str, FloatArray]:
    rng = np.random.default_rng(seed)
    return {f"P{i:02d}": rng.uniform(4, 9) * v / np.linalg.norm(v) for i, v in enumerate(rng.normal(size=(n, 3)))}


def points(x: dict[str, FloatArray], held: int) -> tuple[Point, ...]:
    """The first ones held, the others without any value."""
    return tuple(
        Point(n, PointParameter(place, "held") if i < held else PointParameter())
        for i, (n, place) in enumerate(x.items())
    )


def check(result: Adjustment, x: dict[str, FloatArray], limit: float = 1e-3) -> None:
    assert 0.6 < result.sigma0 < 1.3  # the noise is drawn once: wide enough for any draw
    for name, place in x.items():
        np.testing.assert_allclose(np.asarray(result.estimates["point", name].value), place, atol=limit)


@pytest.mark.parametrize("kinds", [POLAR, RAYS], ids=["polar", "rays"])
@pytest.mark.parametrize("bearings", CONVENTIONS, ids=["x left", "y right"])
def test_tilted_stations_from_known_points(kinds: Sequence[str], bearings: Bearings) -> None:
    """Points all around, so that no view holds them all; those that are not known follow from the stations."""
    x, stations = around(14), poses(3)
    readings = tuple(r for i, pose in enumerate(stations) for r in sights(f"T{i}", pose, x, kinds, bearings))
    survey = Survey(
        points=points(x, 8), stations=tuple(Station(f"T{i}") for i in range(3)), readings=readings, bearings=bearings,
        setups=tuple(Setup(f"set-up T{i}", levelled=False) for i in range(3)),
    )  # fmt: skip
    result = adjust(survey)
    check(result, x)
    for i, pose in enumerate(stations):
        found = result.estimates["world_from_station", f"T{i}"].value
        assert isinstance(found, Pose3)
        assert np.abs(Pose3.Logmap(pose.between(found))).max() < 1e-3


def test_trackers_that_know_nothing_but_each_other() -> None:
    """One tracker is the world; the others hang on it by the points that they share. A second set-up turns freely."""
    x, stations = around(12), [Pose3(), *poses(2)]
    near = dict(list(x.items())[:8])
    far = dict(list(x.items())[4:])
    bearings = Bearings("x", False)
    readings = sights("T0", stations[0], near, POLAR, bearings) + sights("T1", stations[1], x, POLAR, bearings)
    readings += sights("T2", stations[2], far, POLAR, bearings)
    readings += sights("T2", stations[2], far, POLAR, bearings, turn=2.0, setup="again")
    setups = tuple(Setup(n, levelled=False) for n in ("set-up T0", "set-up T1", "set-up T2", "again"))
    first = Station("T0", world_from_station=PoseParameter(Pose3(), "held"))
    survey = Survey(
        points=points(x, 0), stations=(first, Station("T1"), Station("T2")), readings=readings, bearings=bearings,
        setups=setups,
    )  # fmt: skip
    result = adjust(survey)
    check(result, x)
    turns = [result.estimates["orientation", s.setup_id] for s in setups]
    assert [t.status[0] for t in turns] == ["held", "held", "held", "free"]


def test_the_instrument_on_a_held_station_keeps_its_orientation_unknown() -> None:
    """Held in the world by points, a station that is known, and its instrument turned on it."""
    x, pose = around(9), poses(1)[0]
    bearings = Bearings("y", True)
    held = Station("T0", world_from_station=PoseParameter(pose, "held"))
    survey = Survey(
        points=points(x, 4), stations=(held,), readings=sights("T0", pose, x, POLAR, bearings, turn=2.5),
        bearings=bearings, setups=(Setup("set-up T0", levelled=False),),
    )  # fmt: skip
    result = adjust(survey)
    check(result, x)
    turn = float(np.asarray(result.estimates["orientation", "set-up T0"].value)[0])
    assert abs(np.angle(np.exp(1j * (turn - -2.5)))) < 1e-4 or abs(np.angle(np.exp(1j * (turn - 2.5)))) < 1e-4


def test_free_trackers_in_a_free_network() -> None:
    """Nothing is known: one station is set freely, and the inner constraints keep what comes of it."""
    x, stations = around(10), poses(3)
    bearings = Bearings("x", False)
    readings = tuple(r for i, pose in enumerate(stations) for r in sights(f"T{i}", pose, x, POLAR, bearings))
    survey = Survey(
        points=points(x, 0), stations=tuple(Station(f"T{i}") for i in range(3)), readings=readings, bearings=bearings,
        setups=tuple(Setup(f"set-up T{i}", levelled=False) for i in range(3)), datum=Datum("inner"),
    )  # fmt: skip
    result = adjust(survey)
    assert result.datum_defect == 6
    assert 0.6 < result.sigma0 < 1.3
    found = np.array([result.estimates["point", n].value for n in x])
    there = np.array(list(x.values()))
    lengths = (np.linalg.norm(a[:, None] - a[None], axis=2) for a in (found, there))
    np.testing.assert_allclose(*lengths, atol=1e-3)


def test_a_body_tied_to_points_follows_them() -> None:
    """A body whose points are the same as points of the world has no start pose; three of these are enough."""
    x, stations = around(14), poses(3)
    bearings = Bearings("x", False)
    names = list(x)[8:]
    body = poses(1, seed=9)[0]
    local = np.array([body.transformTo(x[n]) for n in names])
    ties = CoordinateDifferences(
        tuple(PositionRef(n, FrameRef("target", "body")) for n in names), tuple(PositionRef(n) for n in names),
        np.zeros((len(names), 3)), 1e-6 * np.eye(3 * len(names)),
    )  # fmt: skip
    readings = tuple(r for i, pose in enumerate(stations) for r in sights(f"T{i}", pose, x, RAYS, bearings))
    survey = Survey(
        points=points(x, 8), stations=tuple(Station(f"T{i}") for i in range(3)), readings=readings, bearings=bearings,
        setups=tuple(Setup(f"set-up T{i}", levelled=False) for i in range(3)),
        targets=(Target("body", tuple(names), local),), coordinate_differences=(ties,),
    )  # fmt: skip
    found = adjust(survey).estimates["carrier_from_target", "body"].value
    assert isinstance(found, Pose3)
    assert np.abs(Pose3.Logmap(body.between(found))).max() < 1e-3


def test_what_stands_on_the_station_tells_the_orientation() -> None:
    """A camera or a target in the station's frame makes the orientation a quantity of its own."""
    from adjust.observations.terrestrial.parameters import repeated_orientations

    x, pose = around(9), poses(1)[0]
    bearings = Bearings("x", False)
    survey = Survey(
        points=points(x, 9), stations=(Station("T0"),), readings=sights("T0", pose, x, POLAR, bearings),
        bearings=bearings, setups=(Setup("set-up T0", levelled=False),),
    )  # fmt: skip
    assert repeated_orientations(survey) == {"set-up T0": ("world_from_station", "T0")}
    lens = LensParameter("brown", (), np.zeros(len(MODELS["brown"].names)))
    assert not repeated_orientations(replace(survey, cameras=(Camera("C", "T0", (100, 100), lens),)))
    assert not repeated_orientations(replace(survey, targets=(Target("t", ("a",), np.zeros((1, 3)), "T0"),)))
    for parameter in (PoseParameter(pose, held=("rz",)), PoseParameter(pose, "held"),
                      PoseParameter(pose, "prior", np.eye(6))):  # fmt: skip
        assert not repeated_orientations(replace(survey, stations=(Station("T0", world_from_station=parameter),)))


def test_too_few_known_points_are_told() -> None:
    x, pose = around(5), poses(1)[0]
    bearings = Bearings("x", False)
    survey = Survey(
        points=points(x, 2), stations=(Station("T0"),), readings=sights("T0", pose, x, RAYS, bearings),
        bearings=bearings, setups=(Setup("set-up T0", levelled=False),),
    )  # fmt: skip
    with pytest.raises(SurveyError, match="'P02' is seen from set-up T0, which is not levelled"):
        adjust(survey)
