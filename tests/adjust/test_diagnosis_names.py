"""Points, epochs and cameras under each other's names, epochs shifted; given coordinates of another point."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.families import NAMES, UNITS
from adjust.diagnosis.names.epochs import exchanged_cameras, misplaced_epochs
from adjust.diagnosis.names.stations import exchanged_stations
from adjust.model.survey import Survey
from survey.project import read
from survey.simulate import stereo
from tests.acceptance.planted_surveys import poses
from tests.adjust.planted import diagnosed, hall
from tests.data import data_folder


def called(survey: Survey, a: str, b: str, setup: str | None) -> Survey:
    """The targets a and b called by each other's names."""
    other = {a: b, b: a}
    readings = tuple(
        replace(r, to=replace(r.to, point_id=other.get(r.to.point_id, r.to.point_id)))
        if setup in (None, r.setup_id) and r.at.point_id not in other else r for r in survey.readings
    )  # fmt: skip
    return replace(survey, readings=readings)


@pytest.mark.slow
@pytest.mark.parametrize("plane", [False, True])
@pytest.mark.parametrize("pair", [("P4", "P6"), ("P5", "P7"), ("P4", "P5")])
def test_two_points_exchanged_in_one_set_up(plane: bool, pair: tuple[str, str]) -> None:
    first = diagnosed(called(hall(plane=plane), *pair, "S2"), *NAMES, *UNITS).candidates[0].hypothesis
    assert first.name == "points exchanged"
    assert set(first.place.ids) == set(pair)
    assert "S2" in first.cause


@pytest.mark.slow
@pytest.mark.parametrize("plane", [False, True])
def test_given_points_exchanged(plane: bool) -> None:
    good = hall(plane=plane)
    x = {p.point_id: p.x_in_world.value for p in good.points}
    other = {"P0": x["P1"], "P1": x["P0"]}
    points = tuple(
        replace(p, x_in_world=replace(p.x_in_world, value=other[p.point_id])) if p.point_id in other else p
        for p in good.points
    )
    found = diagnosed(replace(good, points=points), *NAMES, *UNITS).candidates
    assert "given points exchanged" in [c.hypothesis.name for c in found[:3]]


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "factor"), [(0, 0.1), (1, 10.0), (0, 0.01)])
def test_a_slipped_decimal_of_a_given_point(axis: int, factor: float) -> None:
    good = hall(3)
    value = np.array(good.points[1].x_in_world.value)
    value[axis] *= factor
    wrong = (good.points[0], replace(good.points[1], x_in_world=replace(good.points[1].x_in_world, value=value)))
    found = diagnosed(replace(good, points=wrong + good.points[2:]), *NAMES, *UNITS).candidates
    assert found[0].hypothesis.name == "slipped decimal"
    assert (found[0].hypothesis.place.ids, found[0].hypothesis.place.key) == (("P1",), "xyz"[axis])


# -- epochs ----------------------------------------------------------------------------------------------------------


def later(survey: Survey, begin: int, by: int) -> Survey:
    """From epoch number ``begin`` on, the right camera's images are called ``by`` epochs later."""
    epochs = sorted({b.epoch_id for b in survey.image_blocks})
    blocks = []
    for b in survey.image_blocks:
        i = epochs.index(b.epoch_id)
        if b.camera_id != "right" or i < begin:
            blocks.append(b)
        elif i + by < len(epochs):
            blocks.append(replace(b, epoch_id=epochs[i + by]))
    return replace(survey, image_blocks=tuple(blocks))


@pytest.mark.parametrize(("begin", "by"), [(0, 1), (0, 2), (6, 1), (4, 1)])
def test_images_shifted_by_epochs(begin: int, by: int) -> None:
    first = max(misplaced_epochs(Case(later(stereo(1)[0], begin, by))), key=lambda h: h.evidence)
    assert first.name == "epochs shifted"
    assert f"{by} epoch" in first.cause
    assert "late" in first.cause


@pytest.mark.parametrize("epochs", [("e05",), ("e03", "e09"), tuple(f"e{i:02d}" for i in range(7, 13))])
def test_cameras_exchanged_and_mended(epochs: tuple[str, ...]) -> None:
    good = stereo(1)[0]
    first = max(misplaced_epochs(Case(exchanged_cameras(good, "left", "right", epochs))), key=lambda h: h.evidence)
    assert first.name == "cameras exchanged"
    assert first.place.epochs == epochs
    assert adjust(first.changed()).sigma0 == pytest.approx(adjust(good).sigma0, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_an_innocent_rig_is_not_blamed(seed: int) -> None:
    assert list(misplaced_epochs(Case(stereo(seed)[0]))) == []


@pytest.mark.parametrize("shift", [1, -1])
def test_a_robots_poses_shifted_by_one(shift: int) -> None:
    survey = read(data_folder("calibration", "hand_eye_ds1", "every6")).survey
    n, pairs = len(survey.pairs), survey.pairs
    moved = tuple(replace(p, b_from_a=pairs[(i + shift) % n].b_from_a) for i, p in enumerate(pairs))
    first = max(misplaced_epochs(Case(replace(survey, pairs=moved))), key=lambda h: h.evidence)
    assert first.name == "epochs shifted"
    assert "throughout" in first.cause
    assert ("early" if shift > 0 else "late") in first.cause


# -- measured poses --------------------------------------------------------------------------------------------------


def renamed(survey: Survey, rows: set[int], a: str, b: str) -> Survey:
    """Stations a and b called by each other's names in some pairs."""
    other = {a: b, b: a}
    return replace(survey, pairs=tuple(
        replace(p, a=replace(p.a, frame_id=other.get(p.a.frame_id, p.a.frame_id)),
                b=replace(p.b, frame_id=other.get(p.b.frame_id, p.b.frame_id))) if i in rows else p
        for i, p in enumerate(survey.pairs)))  # fmt: skip


@pytest.mark.parametrize("rotations", [False, True])
@pytest.mark.parametrize("which", [slice(6, None), slice(2, 3)])
def test_stations_under_each_others_names_in_pairs(rotations: bool, which: slice) -> None:
    good = poses(4)[0]
    if rotations:
        good = replace(good, pairs=tuple(
            replace(p, b_from_a=p.b_from_a.rotation(), cov=p.cov[:3, :3]) for p in good.pairs))  # fmt: skip
    mine = [i for i, p in enumerate(good.pairs) if len({p.a.frame_id, p.b.frame_id} & {"T3", "T6"}) == 1]
    wrong = set(mine[which])
    first = next(exchanged_stations(Case(renamed(good, wrong, "T3", "T6"))))
    assert set(first.place.ids) == {"T3", "T6"}
    assert [(p.a, p.b) for p in first.changed().pairs] == [(p.a, p.b) for p in good.pairs]
    assert all(set(e.where["pair_id"]) == {good.pairs[i].pair_id for i in wrong} for e in first.edits)


@pytest.mark.parametrize("seed", range(6))
def test_stations_under_their_own_names_are_not_blamed(seed: int) -> None:
    assert list(exchanged_stations(Case(poses(seed)[0]))) == []
