"""Instruments and targets beside their points, without a sigma for it: named, with its size, and told from others."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.weights.centring import missing_centring
from adjust.diagnosis.weights.sigmas import wrong_factors
from adjust.model.observations import PositionRef, Reading
from adjust.model.survey import Survey
from adjust.statistics.group_sums import scaled_survey
from tests.adjust.planted import case_of, diagnosed
from tests.adjust.terrestrial_networks import plain_reading, polar_network, positions_of

FAMILIES = (wrong_factors, missing_centring)
SIZE = 1e-3


def network(seed: int, targets: float = 0.0, instruments: float = 0.0) -> Survey:
    """Six set-ups and fourteen points in a hall of 60 m; plumbed with these sigmas (m), of which nothing is said."""
    survey, truth = polar_network(seed, n=14, stations=6)
    x, rng = positions_of(survey, truth), np.random.default_rng(seed)
    off = defaultdict(lambda: np.append(instruments * rng.standard_normal(2), 0.0))

    def value(r: Reading) -> float:
        seen = [p for p in (r.to, r.second) if p is not None]
        moved = {p: x[p] + np.append(targets * rng.standard_normal(2), 0.0) for p in seen}
        return plain_reading(survey, r, truth, x | moved | {r.at: x[r.at] + off[r.setup_id]})

    noise = (r.sigma * rng.standard_normal() for r in survey.readings)
    readings = (replace(r, group=r.kind, value=value(r) + e) for r, e in zip(survey.readings, noise, strict=True))
    return replace(survey, readings=tuple(readings))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("what", ["targets", "instruments"])
def test_a_sigma_that_is_missing_is_named_with_its_size(what: str, seed: int) -> None:
    wrong = network(seed, **{what: SIZE})
    (first, *_) = diagnosed(wrong, *FAMILIES).candidates
    assert first.hypothesis.cause.startswith(f"the {what} do not stand over their points")
    changed = first.hypothesis.changed()
    sizes = [r.target_centring_sigma for r in changed.readings] if what == "targets" else [
        s.centring_sigma for s in changed.setups]  # fmt: skip
    assert max(sizes) == pytest.approx(SIZE, rel=0.5)
    assert adjust(changed).sigma0 == pytest.approx(1.0, abs=0.15)


def test_of_both_the_one_that_explains_more_comes_first() -> None:
    found = diagnosed(network(1, SIZE, SIZE), *FAMILIES).candidates
    assert found[0].hypothesis.name == "centring"
    assert found[0].sigma0 < 1.3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("group", ["direction", "slope_distance"])
def test_sigmas_of_a_kind_that_are_too_small_stay_what_they_are(group: str, seed: int) -> None:
    wrong = scaled_survey(network(seed), {group: 1.0 / 16.0})
    (first, *_) = diagnosed(wrong, *FAMILIES).candidates
    assert (first.hypothesis.name, first.hypothesis.place.ids) == ("sigmas of a group", (group,))


@pytest.mark.parametrize("seed", range(3))
def test_what_stands_over_its_points_or_says_so_is_not_blamed(seed: int) -> None:
    assert not list(missing_centring(case_of(network(seed))))
    said = network(seed, targets=SIZE)
    said = replace(said, readings=tuple(replace(r, target_centring_sigma=SIZE) for r in said.readings))
    assert not list(missing_centring(case_of(said)))


def test_a_free_set_up_has_no_centring() -> None:
    """Its point is known by its own readings alone and moves with the instrument."""
    survey = network(0, instruments=SIZE)
    free = {PositionRef(f"P{i}"): PositionRef(f"free{i}") for i in range(6)}
    points = (*survey.points, *(replace(p, point_id=f"free{i}", x_in_world=replace(p.x_in_world, treatment="free"))
                                for i, p in enumerate(survey.points[:6])))  # fmt: skip
    readings = tuple(replace(r, at=free[r.at]) for r in survey.readings if r.setup_id and r.kind != "angle")
    survey = replace(survey, points=points, readings=readings)
    assert not list(missing_centring(Case(survey, adjust(survey))))
