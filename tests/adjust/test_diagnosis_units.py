"""Units, senses, zeros, constants and conventions of pairs: planted in networks, and in the poses of a real robot."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.diagnosis.case import Case
from adjust.diagnosis.families import NAMES, UNITS, VALUES, WEIGHTS
from adjust.diagnosis.units.heights import wrong_heights
from adjust.diagnosis.units.pairs import misread_pairs
from adjust.diagnosis.units.readings import misread_readings
from adjust.model.survey import Survey
from survey.project import read
from tests.acceptance.planted_surveys import survey_of
from tests.adjust.planted import case_of, diagnosed, hall, reread
from tests.adjust.terrestrial_networks import measured, polar_network
from tests.data import data_folder

GON = 0.9


def distance(plane: bool) -> str:
    return "horizontal_distance" if plane else "slope_distance"


@pytest.mark.slow
@pytest.mark.parametrize("plane", [False, True])
@pytest.mark.parametrize(("factor", "said"), [(1000.0, "millimetres, read as metres"), (1 / 25.4, "are inches"),
                                              (1 / 0.3048, "feet, read as metres")])  # fmt: skip
def test_distances_of_one_set_up_in_another_unit(plane: bool, factor: float, said: str) -> None:
    wrong = reread(hall(plane=plane), lambda r: r.setup_id == "S1" and r.kind == distance(plane), lambda v: factor * v)
    first = diagnosed(wrong, *UNITS, *NAMES).candidates[0].hypothesis
    assert first.name == "unit of lengths"
    assert first.place.ids == ("S1",)
    assert said in first.cause


@pytest.mark.slow
@pytest.mark.parametrize("plane", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("setup", ["S2", None])
@pytest.mark.parametrize(
    ("wrong", "name"), [(lambda v: v / GON, "unit of angles"), (lambda v: -v, "sense of rotation")]
)
def test_directions_in_gon_or_counter_clockwise(plane: bool, setup: str | None, wrong, name: str) -> None:
    survey = reread(hall(plane=plane), lambda r: r.kind == "direction" and setup in (None, r.setup_id), wrong)
    first = next(misread_readings(case_of(survey)))
    assert first.name == name
    assert first.place.ids == ((setup,) if setup else ("direction",))


@pytest.mark.slow
@pytest.mark.parametrize("mend", [lambda v: np.pi / 2 - v, lambda v: np.pi - v, lambda v: 2 * np.pi - v])
def test_zenith_angles_from_another_zero(mend) -> None:
    wrong = reread(hall(), lambda r: r.kind == "zenith" and r.setup_id == "S1", mend)
    first = diagnosed(wrong, *UNITS, *NAMES).candidates[0].hypothesis
    assert first.name == "angles from another zero"
    assert first.place.ids == ("S1",)
    assert _same(first.changed(), hall())


def _same(a: Survey, b: Survey) -> bool:
    return bool(np.allclose([r.value for r in a.readings], [r.value for r in b.readings], atol=1e-12))


@pytest.mark.parametrize("metres", [0.003, 0.03, 0.3])
def test_height_of_an_instrument(metres: float) -> None:
    good = hall()
    readings = tuple(
        replace(r, instrument_height=r.instrument_height + metres) if r.setup_id == "S2" else r for r in good.readings
    )
    found = {(h.name, h.place.ids): h for h in wrong_heights(case_of(replace(good, readings=readings)))}
    best = max(found.values(), key=lambda h: h.evidence)
    mine = found["instrument height", ("S2",)]
    # where nothing else is known of P2's height, targets on P2 that are lower explain it exactly as well
    assert mine is best or found["target height", ("P2",)] is best
    heights = [
        next(r.instrument_height for r in s.readings if (r.setup_id, r.kind) == ("S2", "zenith"))
        for s in (mine.changed(), good)
    ]
    assert heights[0] == pytest.approx(heights[1], rel=0, abs=0.1 * metres + 1e-3)


@pytest.mark.parametrize("both", [False, True])
def test_heights_in_metres_read_as_millimetres(both: bool) -> None:
    """Of targets alone, or of instruments as well: the unit, and not twenty heights that are each wrong."""
    survey, truth = polar_network(3)
    tall = tuple(replace(r, target_height=1.3 + 0.1 * (i % 3)) for i, r in enumerate(survey.readings))
    good = measured(replace(survey, readings=tall), truth, 103)
    readings = tuple(replace(r, target_height=1e-3 * r.target_height,
                             instrument_height=(1e-3 if both else 1.0) * r.instrument_height)
                     for r in good.readings)  # fmt: skip
    (first, *_) = diagnosed(replace(good, readings=readings), *VALUES, *UNITS, *NAMES).candidates
    assert first.hypothesis.name == "unit of heights"
    assert first.hypothesis.place.key == ("instrument_height" if both else "target_height")
    mended = first.hypothesis.changed().readings
    for field in ("target_height", "instrument_height"):
        assert [getattr(r, field) for r in mended] == pytest.approx([getattr(r, field) for r in good.readings])


@pytest.mark.parametrize("axis", range(3))
def test_one_component_of_all_shifts_in_metres(axis: int) -> None:
    survey, _ = survey_of("poses", 3)
    by = np.where(np.arange(3) == axis, 1e-3, 1.0)
    pairs = tuple(replace(p, b_from_a=Pose3(p.b_from_a.rotation(), by * p.b_from_a.translation()))
                  for p in survey.pairs)  # fmt: skip
    (first, *_) = diagnosed(replace(survey, pairs=pairs), *UNITS, *WEIGHTS).candidates
    assert (first.hypothesis.name, first.hypothesis.place.ids) == ("unit of shifts", ("all",))
    assert f"have t{'xyz'[axis]}_mm in metres" in first.hypothesis.cause


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_innocent_networks_are_not_blamed(seed: int) -> None:
    assert diagnosed(hall(seed), *UNITS, *NAMES, *WEIGHTS).candidates == ()


# -- the poses of a real robot ---------------------------------------------------------------------------------------


@cache
def robots_survey() -> Survey:
    return read(data_folder("calibration", "hand_eye_ds1", "every6")).survey


def robot(change) -> Case:
    survey = robots_survey()
    return Case(replace(survey, pairs=tuple(change(i, p) for i, p in enumerate(survey.pairs))))


def _quaternion_last_first(m: Pose3) -> Pose3:
    q = m.rotation().toQuaternion()
    return Pose3(Rot3.Quaternion(q.x(), q.y(), q.z(), q.w()), m.translation())


@pytest.mark.parametrize(
    ("change", "name", "ids"),
    [
        (lambda i, p: replace(p, b_from_a=p.b_from_a.inverse()), "pairs inverted", ("all",)),
        (lambda i, p: replace(p, b_from_a=p.b_from_a.inverse()) if i == 4 else p, "pairs inverted", ("robot24",)),
        (lambda i, p: replace(p, b_from_a=Pose3(p.b_from_a.rotation(), 1e-3 * p.b_from_a.translation())),
         "unit of shifts", ("all",)),
        (lambda i, p: replace(p, b_from_a=Pose3(p.b_from_a.rotation(), 1e3 * p.b_from_a.translation())),
         "unit of shifts", ("all",)),
        (lambda i, p: replace(p, b_from_a=_quaternion_last_first(p.b_from_a)), "order of quaternions", ("all",)),
        (lambda i, p: replace(p, b_from_a=Pose3(p.b_from_a.rotation().inverse(), p.b_from_a.translation())),
         "rotations inverted", ("all",)),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_a_robots_poses_in_another_convention(change, name: str, ids: tuple[str, ...]) -> None:
    first = next(misread_pairs(robot(change)))
    assert (first.name, first.place.ids) == (name, ids)
    assert "m from the hand" in first.cause  # what no residual shows: both sides inverted


@pytest.mark.slow
def test_a_robots_poses_as_they_are() -> None:
    assert list(misread_pairs(robot(lambda i, p: p))) == []
