"""Cameras that are not simultaneous, forgotten motion, sigmas that are wrong."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.sequences import Link, links, shifts
from adjust.diagnosis.time.forgotten_motion import forgotten_motion
from adjust.diagnosis.time.synchronisation import time_offset, unsynchronised
from adjust.diagnosis.weights import correlated
from adjust.diagnosis.weights.sigmas import odd_sigmas, wrong_factors
from adjust.statistics.group_sums import scaled_survey
from survey.project import read
from survey.simulate import head_on_table, stereo
from tests.adjust.planted import case_of, hall
from tests.data import data_folder


def moving(offset: float, n: int = 20) -> Link:
    """A board on a smooth path before two cameras; the second sees it ``offset`` intervals later."""
    def pose(t: float) -> np.ndarray:
        out = np.eye(4)
        out[:3, 3] = 0.2 * np.sin(0.9 * t), 0.1 * np.cos(0.7 * t), 1.0 + 0.05 * np.sin(0.4 * t)
        return out

    rng = np.random.default_rng(3)
    first, second = (np.array([pose(t + d) for t in range(n)]) for d in (0.0, offset))
    first[:, :3, 3] += rng.normal(0.0, 1e-4, (n, 3))
    return Link("rig", ("a", "b"), tuple(f"e{i}" for i in range(n)), first, second, "board", 1e-4)


@pytest.mark.parametrize("offset", [-0.3, 0.05, 0.2])
def test_the_offset_of_a_camera_is_estimated_from_the_motion(offset: float) -> None:
    found = time_offset(moving(offset))
    assert found is not None
    assert found.intervals == pytest.approx(offset, abs=0.15 * abs(offset) + 4.0 * found.sigma)
    assert abs(found.intervals) > 4.0 * found.sigma


def test_epochs_are_shifted_only_where_that_joins_what_belongs_together() -> None:
    """What one of two cameras shows in places of its own is not that of another epoch."""
    link = moving(0.0)
    late = replace(link, second=np.roll(link.second, 1, axis=0))
    assert shifts(late)[0].by == 1
    assert shifts(late)[0].evidence > 10.0
    rng = np.random.default_rng(5)
    spoilt = link.second.copy()
    spoilt[:, :3, 3] += rng.normal(0.0, 0.3, (len(spoilt), 3))
    assert not shifts(replace(link, second=spoilt))


def test_simultaneous_cameras_have_no_offset() -> None:
    found = time_offset(moving(0.0))
    assert found is not None
    assert abs(found.intervals) < 4.0 * found.sigma


def test_a_real_session_of_free_running_cameras() -> None:
    """cam1 is 116 +- 9 ms before cam0 by an independent computation; six frames a second."""
    case = Case(read(data_folder("calibration", "unsynchronised")).survey)
    found, apart = unsynchronised(case)
    assert found.name == apart.name == "cameras not simultaneous"
    assert found.edits
    assert not apart.edits
    assert found.place.ids == ("cam1",)
    offset = next(o for link in links(case) if link.names == ("cam0", "cam1") if (o := time_offset(link)))
    assert 1e3 * offset.intervals / 6.0 == pytest.approx(-116.0, abs=3 * 9.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_simultaneous_rig_is_not_blamed(seed: int) -> None:
    assert list(unsynchronised(Case(stereo(seed)[0]))) == []


def test_motion_that_was_forgotten() -> None:
    good = stereo(2)[0]
    wrong = replace(good, targets=tuple(replace(t, motion="fixed") for t in good.targets))
    first = next(forgotten_motion(Case(wrong)))
    assert first.name == "motion forgotten"
    assert first.place.ids == ("board",)
    assert adjust(first.changed()).sigma0 == pytest.approx(adjust(good).sigma0, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("made", [stereo, partial(head_on_table, n_table_epochs=4, n_free_epochs=3)])
def test_what_stands_still_is_not_blamed(made) -> None:
    assert list(forgotten_motion(Case(made(2)[0]))) == []


@pytest.mark.parametrize("k", [1 / 10, 1 / 3, 3.0, 10.0])
def test_sigmas_of_a_group_wrong_by_a_factor(k: float) -> None:
    wrong = scaled_survey(hall(), {"reading": k**2})
    (found,) = wrong_factors(case_of(wrong))
    assert found.name == "sigmas of a group"
    assert found.place.ids == ("reading",)
    assert ("small" if k < 1 else "large") in found.cause
    assert case_of(found.changed()).result.sigma0 == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_right_sigmas_are_not_blamed(seed: int) -> None:
    assert [*wrong_factors(case_of(hall(seed))), *odd_sigmas(case_of(hall(seed)))] == []


@pytest.mark.parametrize("size", [3.0, 10.0])
def test_the_size_of_a_common_error_is_the_likeliest_one(size: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Found without adjusting: adjusted with other sizes v'Pv and the logarithms of the variances are larger."""
    common = dict(zip(("S0", "S1", "S2", "S3"), (1.1, -0.8, 0.5, -1.3), strict=True))
    survey = hall()
    wrong = replace(survey, readings=tuple(
        replace(r, value=r.value + size * r.sigma * common.get(r.setup_id, 0.0) * (r.kind == "slope_distance"))
        for r in survey.readings))  # fmt: skip
    case, costs = case_of(wrong), []
    for sizes in (correlated._SIZES, (0.2,), (1.0,), (60.0,)):
        monkeypatch.setattr(correlated, "_SIZES", sizes)
        found = next(h for h in correlated.correlated_readings(case) if h.place.ids == ("slope_distance",))
        costs.append(adjust(found.changed()).omega + found.penalty)
    assert costs[0] < min(costs[1:]) + 1e-6


def test_a_gross_error_is_no_wrong_sigma() -> None:
    good = hall()
    readings = tuple(replace(r, value=r.value + 0.05) if i == 5 else r for i, r in enumerate(good.readings))
    assert list(wrong_factors(case_of(replace(good, readings=readings)))) == []


@pytest.mark.parametrize("sigma", [1e-12, 1.0])
def test_a_sigma_of_zero_or_of_a_metre(sigma: float) -> None:
    good = hall()
    at = next(i for i, r in enumerate(good.readings) if r.kind == "slope_distance")
    readings = tuple(replace(r, sigma=sigma) if i == at else r for i, r in enumerate(good.readings))
    (found,) = odd_sigmas(Case(replace(good, readings=readings)))
    assert found.place.ids == (good.readings[at].reading_id,)
    assert found.changed().readings[at].sigma == pytest.approx(2e-4)
