"""Sigmas of pairs that are tried in the graph that is there, and those that need not be tried."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import diagnose
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.trial import misfit_of, tried
from adjust.diagnosis.weights.impossible import with_part
from adjust.diagnosis.weights.parts import units_of_parts
from adjust.diagnosis.weights.sigmas import wrong_factors
from adjust.model.survey import Survey
from adjust.statistics.group_sums import scaled_survey
from tests.adjust import pose_networks


def network() -> Survey:
    return pose_networks.simulate(5, 4, 3, extra=12).network.survey


def cautious(survey: Survey, part: str, factor: float) -> Survey:
    """With the sigmas of a part of all its pairs so many times as large as they are."""
    return with_part(survey, "pairs", range(len(survey.pairs)), part, factor)


@pytest.mark.parametrize("part", ["rotation", "translation"])
def test_a_trial_of_other_sigmas_leaves_what_a_whole_adjustment_with_them_does(part: str) -> None:
    survey = cautious(network(), part, 1000.0)
    case = Case(survey, adjust(survey))
    for hypothesis in units_of_parts(case):
        assert hypothesis.pair_sigmas is not None
        trial, whole = (tried(h, case) for h in (hypothesis, replace(hypothesis, pair_sigmas=None)))
        assert trial.result is not None
        assert whole.result is not None
        assert trial.result.omega == pytest.approx(whole.result.omega, rel=1e-9)
        assert trial.result.sigma0 == pytest.approx(whole.result.sigma0, rel=1e-9)
        for name in ("omega", "fitted", "unused", "count", "redundancy", "dropped"):
            assert getattr(trial.misfit, name) == pytest.approx(getattr(whole.misfit, name), rel=1e-9)


def test_a_common_factor_of_all_sigmas_is_tried_without_a_solution() -> None:
    survey = scaled_survey(network(), {"pair": 100.0})
    case = Case(survey, adjust(survey))
    (hypothesis,) = wrong_factors(case)
    before = case.budget.left
    trial = tried(hypothesis, case)
    whole = adjust(hypothesis.survey)
    assert trial.result is not None
    assert case.budget.left == before - 1.5  # of the linear system, which a case has in any case
    assert trial.result.sigma0 == pytest.approx(whole.sigma0, rel=1e-9)
    assert trial.misfit.omega == pytest.approx(misfit_of(whole, survey).omega, rel=1e-9)


def test_of_a_part_of_the_pairs_no_common_factor_is_taken() -> None:
    survey = network()
    pairs = tuple(replace(p, group="north" if i % 2 else "south") for i, p in enumerate(survey.pairs))
    survey = scaled_survey(replace(survey, pairs=pairs), {"north": 100.0})
    case = Case(survey, adjust(survey))
    found = {h.place.ids: h for h in wrong_factors(case)}
    assert found["north",].pair_sigmas is None
    by = np.ones((len(pairs), 6))
    by[1::2] = 0.1
    again, whole = case.reweighted(by), adjust(scaled_survey(survey, {"north": 0.01}))
    assert again is not None
    assert again.omega == pytest.approx(whole.omega, rel=1e-9)


@pytest.mark.slow
def test_what_another_one_leaves_no_room_for_is_not_tried() -> None:
    survey = pose_networks.simulate(20, 15, 3, extra=500, sigma_rad=1e-5, sigma_m=1e-3).network.survey
    pairs = tuple(replace(p, cov=np.diag(np.diagonal(p.cov))) for p in survey.pairs)
    survey = cautious(replace(survey, pairs=pairs), "rotation", 3600.0)
    case, asked = Case(survey, adjust(survey)), list[Hypothesis]()

    def watched(case: Case) -> list[Hypothesis]:
        return [told(h) for h in units_of_parts(case)]

    def told(h: Hypothesis) -> Hypothesis:
        return replace(h, pair_sigmas=None, survey=lambda: asked.append(h) or h.changed())

    found = diagnose(case, [watched])
    assert len(list(units_of_parts(case))) == 2
    assert [h.change for h in asked] == [found.candidates[0].hypothesis.change]
    assert found.candidates[0].hypothesis.cause.endswith("they are arcseconds, read as degrees")
