"""Bundles cut into Helmert's blocks: where, and the same numbers as uncut."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.graph.assembly import AdjustmentGraph, values_of
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import solve
from adjust.model.observations import Distance, PositionRef
from adjust.model.survey import Datum, FloatArray, IntArray, Survey
from adjust.observations.images import helmert_blocks as blocks
from adjust.observations.images.helmert_blocks import helmert_blocks
from adjust.precision.precision import Precision
from survey.simulate.labs import LabSize, full_lab
from tests.benchmarks import bundle
from tests.benchmarks.building import Building, Plan, build
from tests.benchmarks.dissection import survey_of

ROOMS = Plan(2, 2, stations=40, points=200, door=6)


def seen_in(building: Building) -> Sequence[IntArray]:
    case = building.bundle
    return np.split(case.point, np.searchsorted(case.image, np.arange(1, len(building.room))))


def test_a_building_is_cut_at_its_doors() -> None:
    building = build(Plan(3, 2, stations=60, points=300))
    n = len(building.room)
    found = helmert_blocks(np.arange(n), seen_in(building), np.full(n, 6.0))
    assert len(np.unique(found)) == 3  # two rooms are below the size that is worth a cut
    assert all(len(np.unique(found[building.room == room])) == 1 for room in range(6))


def test_a_hall_seen_from_all_sides_is_not_cut() -> None:
    case = bundle.simulated(200, 400, 30)
    seen = np.split(case.point, np.searchsorted(case.image, np.arange(1, 200)))
    assert np.all(helmert_blocks(np.arange(200), seen, np.full(200, 6.0)) == 0)


def test_what_nothing_connects_is_cut_for_nothing() -> None:
    seen = [np.arange(90) + 90 * (i % 2) for i in range(200)]
    found = helmert_blocks(np.arange(200), seen, np.full(200, 6.0))
    assert {tuple(np.unique(found[i::2])) for i in (0, 1)} == {(0,), (1,)}


def test_poses_that_others_touch_are_no_reason_to_cut() -> None:
    building = build(Plan(2, 1, stations=100))
    n = len(building.room)
    assert np.all(helmert_blocks(np.arange(n), seen_in(building), np.zeros(n)) == 0)


def adjusted(survey: Survey, building: Building) -> tuple[AdjustmentGraph, Precision]:
    start = bundle.start(building.bundle)
    graph = GraphBuilder(survey, start.lenses).build(start)
    return graph, Precision(graph, solve(graph))


@pytest.mark.parametrize("inner", [False, True])
@pytest.mark.slow
def test_cut_and_whole_give_the_same(monkeypatch: pytest.MonkeyPatch, inner: bool) -> None:
    """Solution, every covariance, of unknowns of different blocks too, residuals, redundancy numbers, tests."""
    building = build(ROOMS)
    survey = survey_of(building)
    if inner:
        survey = replace(survey, datum=Datum("inner"), coordinates=(), distances=bars(building))
    monkeypatch.setattr(blocks, "SMALLEST", 1000)
    whole, before = adjusted(survey, building)
    monkeypatch.setattr(blocks, "SMALLEST", 50)
    cut, after = adjusted(survey, building)
    assert (len(whole.bundles), len(cut.bundles)) == (1, 4)
    assert all(len(b.tied) >= 6 for b in cut.bundles)
    scale = np.sqrt(np.diag(before.joint([("lens", "camera")])))
    difference = lens(after, cut) - lens(before, whole)
    assert np.abs(difference / scale).max() < 1e-6
    for name in whole.unknowns.by_name:
        assert relative(before.joint([name]), after.joint([name])) < 1e-6
    poses = [("world_from_station", "body", f"i{i}") for i in (3, 50, 90, 130)]  # of four rooms
    names = [*poses, ("point", str(building.bundle.names[0])), ("lens", "camera")]
    assert relative(before.joint(names), after.joint(names)) < 1e-6
    a, b = before.image_residuals, after.image_residuals
    for field in ("residuals", "redundancy", "standardized", "test"):
        np.testing.assert_allclose(getattr(b, field), getattr(a, field), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(a.used, b.used)


@pytest.mark.slow
def test_runs_of_epochs_and_one_matrix_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of beacons that other instruments measure too, seen from a table: steps, covariances, residuals, redundancy."""
    survey = full_lab(1, size=LabSize(n_night_epochs=30))[0]
    start = values_of(adjust(survey))
    found = []
    monkeypatch.setattr(blocks, "_GAIN", 100.0)
    for epochs in (1000, 5):
        monkeypatch.setattr(blocks, "_EPOCHS", epochs)
        graph = GraphBuilder(survey, start.lenses).build(start)
        solved = solve(graph)
        found.append((graph, solved, Precision(graph, solved)))
    (whole, before, a), (cut, after, b) = found
    assert [x.by_rows for x in whole.bundles] == [False]
    assert len(cut.bundles) > 2
    assert all(x.by_rows for x in cut.bundles)
    assert after.iterations <= before.iterations
    for name in whole.unknowns.by_name:
        assert relative(a.joint([name]), b.joint([name])) < 1e-6
    sigmas = np.sqrt(np.diag(a.joint([("lens", "X")])))
    difference = before.values.atVector(whole.unknowns.by_name["lens", "X"].key)
    difference = difference - after.values.atVector(cut.unknowns.by_name["lens", "X"].key)
    assert np.abs(difference / sigmas).max() < 1e-5
    one, other = a.image_residuals, b.image_residuals
    for field in ("residuals", "redundancy", "standardized", "test"):
        np.testing.assert_allclose(getattr(other, field), getattr(one, field), rtol=1e-5, atol=1e-6)


def bars(building: Building) -> tuple[Distance, ...]:
    """Lengths across the rooms, in the datum's place."""
    ids, x = building.bundle.names, building.truth
    ends = [(0, len(x) - 1), (5, len(x) // 2)]
    return tuple(
        Distance(f"d{a}", PositionRef(str(ids[a])), PositionRef(str(ids[b])), float(np.linalg.norm(x[a] - x[b])), 1e-4)
        for a, b in ends
    )


def lens(precision: Precision, graph: AdjustmentGraph) -> FloatArray:
    return np.asarray(precision.solved.values.atVector(graph.unknowns.by_name["lens", "camera"].key))


def relative(a: FloatArray, b: FloatArray) -> float:
    d = np.sqrt(np.maximum(np.diag(a), 1e-300))
    return float(np.abs((a - b) / d[:, None] / d).max())
