"""Designs of readings and geometric observations: against plain geometry, adjustments of simulated observations."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.design import Candidate, components_of, exact, expect, run_trials, select, with_candidates
from adjust.design.candidates import design_matrix
from adjust.design.prediction import Predictor
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.observations import CoordinateDifferences, OnSurface, PositionRef, Reading, ReadingCovariance
from adjust.model.survey import INSTRUMENT, Datum, Setup, Surface, Survey, VectorParameter, VectorPrior
from tests.adjust.terrestrial_networks import P, Truth, measured, polar_network, start_near, wrapped
from tests.adjust.test_geometry import geometric
from tests.sizes import size


def hall(seed: int = 4) -> tuple[Survey, Truth, StartValues]:
    """Centring of instruments and targets, a prior on the scale, readings with a joint covariance."""
    prior = VectorPrior(("distance_scale",), np.array([2e-6]), np.array([[9e-12]]))
    scale = VectorParameter(INSTRUMENT, np.array([0.0, 2e-6, 0.0, 0.0]), free=("distance_scale",), prior=prior)
    setup = Setup("", "T", centring_sigma=0.001, height_sigma=0.0005)
    survey, truth = polar_network(seed, n=6, stations=3, held=3, instrument=scale, setup=setup)
    truth["instrument", "T"] = np.array([0.0, 2e-6, 0.0, 0.0])
    first = survey.readings[:6]
    sigmas = np.array([r.sigma for r in first])
    cov = np.outer(sigmas, sigmas) * (0.6 + 0.4 * np.eye(6))
    readings = tuple(r if i < 6 else replace(r, target_centring_sigma=0.0005) for i, r in enumerate(survey.readings))
    joint = (ReadingCovariance(tuple(r.reading_id for r in first), cov),)
    survey = replace(survey, readings=readings, reading_covariances=joint)
    return survey, truth, start_near(survey, truth, 0)


def test_nothing_is_left_of_any_kind() -> None:
    survey, start = geometric(2)
    with pytest.raises(SurveyError, match=r"to lie on line 'line', but its coordinates are .* mm off"):
        exact(survey, start)
    on = tuple(o for o in survey.on_surfaces if not (o.surface_id in ("line", "rod") and o.offset == 0.0))
    ideal = exact(replace(survey, on_surfaces=on), start)
    p = Predictor(ideal, start)
    kinds = set()
    for item in p.graph.others:
        kinds.add(item.kind)
        assert np.abs(item.factor.linearize(p.values).jacobian()[1]).max() < 1e-6, item.ids
    assert kinds >= {"level", "alignment", "laser", "surface", "coordinate_difference", "prior"}


def test_readings_are_those_of_plain_geometry() -> None:
    """Directions but for one orientation per set-up."""
    survey, truth, start = hall()
    ideal, plain = exact(survey, start), measured(survey, truth, None)
    turns: dict[str, list[float]] = {}
    for a, b in zip(ideal.readings, plain.readings, strict=True):
        if a.kind == "direction":
            turns.setdefault(a.setup_id, []).append(a.value - b.value)
        else:
            assert wrapped(np.array([a.value - b.value]))[0] == pytest.approx(0.0, abs=1e-11)
    for differences in turns.values():
        assert np.abs(wrapped(np.array(differences) - differences[0])).max() < 1e-11
    assert adjust(ideal, start).omega < 1e-12


def test_expectation_is_the_covariance_of_an_adjustment_of_simulated_readings() -> None:
    survey, truth, start = hall()
    planned, solved = expect(survey, start), adjust(measured(survey, truth, 3), start)
    assert planned.omega == 0.0
    assert planned.redundancy == solved.redundancy
    dense = design_matrix(exact(survey, start), start)
    Q = np.linalg.inv((dense.A.T @ dense.A).toarray())
    for name, estimate in planned.estimates.items():
        s = np.sqrt(np.diag(estimate.cov))
        free = np.flatnonzero(s > 0.0)
        if not len(free):
            continue
        scale = np.outer(s, s)[np.ix_(free, free)]
        C, D = (e.cov[np.ix_(free, free)] / scale for e in (estimate, solved.estimates[name]))
        np.testing.assert_allclose(C, D, atol=5e-3)  # the readings are off by their noise, and so are the places
        at = dense.columns.at[name]
        np.testing.assert_allclose(Q[np.ix_(at, at)] / scale, C, atol=1e-5)


@pytest.mark.slow
def test_scatter_of_simulated_readings_is_the_predicted_covariance() -> None:
    survey, _, start = hall()
    planned, ideal = expect(survey, start), exact(survey, start)
    n = size(40, 8)
    found = run_trials(ideal, start, planned, n, seed=2, n_workers=1)
    assert not found.failed
    assert not [n for n in found.names if n[0] == "centring"]
    assert found.passed, (found.mean_square, found.band)
    assert np.mean(found.omega) == pytest.approx(planned.redundancy, abs=4 * np.sqrt(2 * planned.redundancy / n))
    # readings that are worse than planned are noticed
    loud = replace(ideal, readings=tuple(replace(r, sigma=1.6 * r.sigma) for r in ideal.readings))
    assert not run_trials(loud, start, planned, size(30, 6), seed=2, n_workers=1).passed


def test_sights_are_chosen_by_what_measuring_them_brings() -> None:
    """A new set-up brings its orientation along; the gains are those of new adjustments."""
    survey, truth = polar_network(7, n=6, stations=2, held=2, extra=False)
    start = start_near(survey, truth, 0)
    survey = replace(survey, setups=(*survey.setups, Setup("new", "T")), datum=Datum())
    sights = [
        Candidate(
            f"P4 to P{t}", "sight",
            readings=tuple(Reading(f"{kind}{t}", kind, P("P4"), P(f"P{t}"), 1.0, sigma)
                           for kind, sigma in (("zenith", 2e-5), ("slope_distance", 2e-4))),
        ) for t in (2, 3, 5)
    ]  # fmt: skip
    turn = Candidate("directions from P5", "sight", readings=tuple(
        Reading(f"d{t}", "direction", P("P5"), P(f"P{t}"), 0.0, 1e-5, "new") for t in (0, 1, 2, 3)))  # fmt: skip
    base = Candidate("baseline", "difference", coordinate_differences=(
        CoordinateDifferences((P("P2"),), (P("P3"),), np.zeros((1, 3)), 1e-8 * np.eye(3)),))  # fmt: skip
    candidates = (*sights, turn, base)
    expected = expect(survey, start)
    wanted = components_of(expected, [("point", "P3"), ("point", "P4")])
    chosen = select(survey, start, candidates, wanted, 2, "D", expected)
    for gain in chosen.first:
        more = expect(with_candidates(survey, [candidates[gain.candidate_idx]]), start)
        direct = np.concatenate([np.sqrt(np.diag(more.estimates[n].cov)) for n in (("point", "P3"), ("point", "P4"))])
        np.testing.assert_allclose(gain.sigmas, direct, rtol=1e-6)
    both = expect(with_candidates(survey, [candidates[g.candidate_idx] for g in chosen.steps]), start)
    np.testing.assert_allclose(chosen.after[:3], np.sqrt(np.diag(both.estimates["point", "P3"].cov)), rtol=1e-6)


def test_a_plane_through_planned_points() -> None:
    survey, truth = polar_network(9, n=7, stations=2, held=2, extra=False)
    on = tuple(OnSurface("floor", PositionRef(f"P{i}"), 5e-4) for i in range(2, 7))
    survey = replace(survey, surfaces=(Surface("floor", "plane", np.array([0.0, 0.0, 1.0])),), on_surfaces=on)
    start = start_near(survey, truth, 0)
    planned = expect(survey, start)
    assert adjust(exact(survey, start), start).omega < 1e-10
    assert planned.redundancy == expect(replace(survey, surfaces=(), on_surfaces=()), start).redundancy + 2
