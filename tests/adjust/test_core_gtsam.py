"""GTSAM's own optimiser and marginals on the graph of a survey: the same optimum and covariances as the solver's.

The graph is asked as any graph of GTSAM is, at any values; what the solver reduces is a view of it.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import gtsam
import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.graph.assembly import AdjustmentGraph, StartValues, values_of
from adjust.graph.solver import SolveOptions, solve
from adjust.lenses.conversion import convert
from adjust.lenses.models import MODELS, lens_constants
from adjust.model.observations import Closure, FrameRef, Pair
from adjust.model.survey import INSTRUMENT, LensParameter, Setup, Survey, VectorParameter, VectorPrior, Vertical
from adjust.observations.images import helmert_blocks
from adjust.pose_network.network import survey_of
from adjust.precision.precision import Precision
from adjust.relay.closed import closed
from survey.simulate import resample, stereo
from tests.adjust import helpers as h
from tests.adjust.pose_networks import simulate
from tests.adjust.terrestrial_networks import measured, polar_network, start_near
from tests.adjust.test_core_jacobians import others
from tests.adjust.test_geometry import geometric
from tests.adjust.test_relay_closed import eyes
from tests.adjust.test_terrestrial_joint import laboratory, start_of
from tests.benchmarks import dissection
from tests.benchmarks.building import Plan, build
from tests.benchmarks.bundle import start as bundle_start

pytestmark = pytest.mark.slow

Problem = tuple[Survey, StartValues]


def bundle() -> Problem:
    """Unknown points: most of them, and most epochs, are hidden from the solver's view."""
    survey, truth = h.network(3)
    return survey, h.shaken(h.start_at(truth), 1, 0.002, 0.002)


def reduced_epochs() -> Problem:
    """Boards at enough epochs for the solver to reduce their poses; some image points not used; a pair of cameras."""
    survey, truth = stereo(3, n_pairs=10)
    blocks = tuple(replace(b, used=np.arange(len(b.uv)) % 5 > 0) for b in survey.image_blocks)
    epoch = blocks[0].epoch_id
    ends = FrameRef("camera", "left", epoch), FrameRef("camera", "right", epoch)
    cov = h.random_cov(np.random.default_rng(2), [1e-3] * 6)
    survey = replace(survey, image_blocks=blocks, pairs=(Pair("rig", *ends, gtsam.Pose3(), cov),))
    return resample(survey, truth, 4), h.shaken(h.start_at(truth), 1, 0.003)


def of_lens(model: str) -> Callable[[], Problem]:
    """The same images through lenses of another model, all of its parameters free that boards can tell apart."""

    def make() -> Problem:
        survey, start = reduced_epochs()
        old, new, cameras, lenses = MODELS["brown"], MODELS[model], [], {}
        for camera in survey.cameras:
            size = camera.image_size
            pixels, constants = lens_constants(old, size), lens_constants(new, size, 0.005, 2.0)
            free = [name for name in new.names if name not in ("skew", "k3", "k4", "a3")]
            lens = convert(old, start.lenses[camera.camera_id], pixels, new, constants, size, free=free)
            lenses[camera.camera_id] = lens.values
            given = LensParameter(model, tuple(free), pixel_size_mm=0.005, balance_radius_mm=2.0 * (model == "aicon"))
            cameras.append(replace(camera, lens=given))
        return replace(survey, cameras=tuple(cameras)), replace(start, lenses=lenses)

    return make


def lab() -> Problem:
    """Boards and a table, beacons seen by cameras and total station."""
    survey, truth = laboratory(2)
    return survey, start_of(truth, survey)


def readings() -> Problem:
    """Every kind of reading."""
    survey, truth = polar_network(4)
    return measured(survey, truth, 4), start_near(survey, truth, 2, 1e-3)


def instruments() -> Problem:
    """What instruments do not know of themselves, refraction over round level surfaces, centring and heights."""
    values = np.array([0.0, 0.0, 0.13, 0.0])
    prior = VectorPrior(INSTRUMENT, values, np.diag([1e-6, 1e-8, 25.0, 1e-8]))
    free = VectorParameter(INSTRUMENT, values, free=INSTRUMENT, prior=prior)
    survey, truth = polar_network(
        4, n=6, stations=3, held=3, instrument=free, vertical=Vertical(radius=6.38e6),
        setup=Setup("", "T", centring_sigma=1e-3, height_sigma=5e-4),
    )  # fmt: skip
    return measured(survey, truth, 4), start_near(survey, truth, 2, 1e-3)


def pair_graph() -> Problem:
    """Nothing but pairs and a prior: eliminated in the compiled core."""
    survey = survey_of(simulate(4, 3, seed=2, extra=5).network)
    return survey, h.shaken(values_of(adjust(survey)), 1, 0.002, 0.002)


def closed_loop() -> Problem:
    """Eyes that are no stations, and a mount with play that closes one of their loops."""
    survey = closed(eyes(1), (Closure("mount", ("C1-C2", "C2-M1", "C1-M1"), 1e-3, 1e-3),))
    return survey, h.shaken(values_of(adjust(survey)), 1, 0.002, 0.002)


def cut_bundle() -> AdjustmentGraph:
    """Two rooms seen through a door, each hidden in a Helmert block of its own."""
    plan = build(Plan(2, 1, stations=20, points=200, door=6))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(helmert_blocks, "SMALLEST", 8)
        return h.build(dissection.survey_of(plan), bundle_start(plan.bundle))


def loose(survey: Survey, factor: float) -> Survey:
    """Every observation with sigmas ``factor`` times as large."""

    def one(item: Any) -> Any:
        names = {f.name for f in fields(item)}
        if "cov" in names:
            return replace(item, cov=item.cov * factor**2)
        return replace(item, sigma=item.sigma * factor)

    kinds = ("image_blocks", "table_readings", "pairs", "distances", "coordinates", "coordinate_differences",
             "levels", "alignments", "laser_spots", "on_surfaces")  # fmt: skip
    return replace(survey, **{kind: tuple(one(i) for i in getattr(survey, kind)) for kind in kinds})


def anchored(graph: AdjustmentGraph, sigma: float) -> AdjustmentGraph:
    """Every unknown kept near its start, so that observations of random values have a minimum there."""
    for unknown in graph.unknowns.by_key.values():
        noise = gtsam.noiseModel.Isotropic.Sigma(unknown.dim, sigma)
        if unknown.kind == "pose":
            prior = gtsam.PriorFactorPose3(unknown.key, graph.start.atPose3(unknown.key), noise)
        elif unknown.kind == "point":
            prior = gtsam.PriorFactorPoint3(unknown.key, graph.start.atPoint3(unknown.key), noise)
        else:
            scale = 100.0 if unknown.name[0] == "lens" else 1.0
            noise = gtsam.noiseModel.Isotropic.Sigma(unknown.dim, sigma * scale)
            prior = gtsam.PriorFactorVector(unknown.key, graph.start.atVector(unknown.key), noise)
        graph.others_graph.add(prior)
    return graph


def of_pairs_and_others() -> AdjustmentGraph:
    survey, start = others(*h.everything(5))
    return anchored(h.build(loose(replace(survey, image_blocks=()), 30.0), start), 1e-3)


def of_geometry() -> AdjustmentGraph:
    survey, start = geometric(3)
    beam = survey.beams[0]  # whose start is where its spots are, far from its prior
    prior = VectorPrior(("slope_1",), np.array([0.02]), np.array([[1.0]]))
    beams = (replace(beam, parameters=replace(beam.parameters, prior=prior)), *survey.beams[1:])
    survey = replace(survey, beams=beams)
    return anchored(h.build(loose(replace(survey, image_blocks=()), 30.0), start), 1e-3)


def problem(make: Callable[[], Problem]) -> Callable[[], AdjustmentGraph]:
    return lambda: h.build(*make())


GRAPHS = {
    "bundle": problem(bundle), "reduced epochs": problem(reduced_epochs), "lab": problem(lab),
    "readings": problem(readings), "pairs and others": of_pairs_and_others, "geometry": of_geometry,
    "pairs alone": problem(pair_graph), "closed loop": problem(closed_loop), "Helmert blocks": cut_bundle,
    "instruments": problem(instruments),
    **{f"lens {m}": problem(of_lens(m)) for m in ("fisheye", "brown_backward", "brown_backward_dbat", "aicon")},
}  # fmt: skip


@pytest.mark.parametrize("kind", GRAPHS)
def test_gtsams_own_algorithms_reach_the_same_optimum_and_covariances(kind: str) -> None:
    graph = GRAPHS[kind]()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-13)
    parameters.setAbsoluteErrorTol(1e-10)
    parameters.setDiagonalDamping(True)  # else its bound on lambda means something else for every unit
    theirs = gtsam.LevenbergMarquardtOptimizer(graph.graph, graph.start, parameters).optimize()
    ours = solve(graph, SolveOptions(max_step=1e-10))
    precision = Precision(graph, ours)
    marginals = gtsam.Marginals(graph.graph, gtsam.Values(ours.values))
    assert 2.0 * graph.graph.error(ours.values) == pytest.approx(ours.omega, rel=1e-9)
    assert set(graph.graph.keyVector()) == set(graph.unknowns.by_key)
    for name, unknown in graph.unknowns.by_name.items():
        mine = h.covariance_of(precision, name)
        free = [i for i in range(unknown.dim) if i not in graph.unknowns.held.get(unknown.key, ())]
        step = theirs.localCoordinates(ours.values).at(unknown.key)[free]
        assert np.all(np.abs(step) < 1e-3 * np.sqrt(np.diag(mine))[free]), name
        expected = marginals.marginalCovariance(unknown.key)
        assert h.relative(mine[np.ix_(free, free)], expected[np.ix_(free, free)]) < 2e-6, name


def test_all_kinds_of_observations_are_among_these() -> None:
    seen = dict.fromkeys(("image", "bundle", "hidden points", "reduced poses", "Helmert blocks", "only pairs"), False)
    kinds: set[str] = set()
    for make in GRAPHS.values():
        graph = make()
        kinds |= {item.kind for item in graph.others} | {r.kind for r in graph.survey.readings}
        seen["image"] |= bool(graph.images.blocks)
        seen["bundle"] |= bool(graph.bundles)
        seen["hidden points"] |= any(bundle.reduced for bundle in graph.bundles)
        seen["reduced poses"] |= graph.reduction is not None
        seen["Helmert blocks"] |= len(graph.bundles) > 1
        seen["only pairs"] |= graph.only_pairs
    assert all(seen.values()), seen
    assert kinds == {
        "table", "pair", "distance", "coordinates", "prior", "level", "alignment", "laser", "surface",
        "coordinate_difference", "direction", "angle", "zenith", "azimuth", "slope_distance", "horizontal_distance",
        "height_difference",
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["bundle", "reduced epochs", "lab", "Helmert blocks"])
def test_the_solvers_view_is_of_the_same_chi_square_anywhere(kind: str) -> None:
    """Neither graph needs anything prepared, nor minds what the other was asked in between."""
    graph = GRAPHS[kind]()
    far = h.disturbed(graph.start, graph, 3, 0.1)
    for values in (far, graph.start, far):
        expected = graph.omega(gtsam.Values(values))
        assert 2.0 * graph.view(graph.reduction).error(values) == pytest.approx(expected, rel=1e-10)
        assert 2.0 * graph.graph.error(values) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("kind", ["bundle", "reduced epochs", "lab", "Helmert blocks"])
def test_the_solvers_view_has_the_step_of_the_graph(kind: str) -> None:
    """Also at values that nothing was prepared for."""
    graph = GRAPHS[kind]()
    far = h.disturbed(graph.start, graph, 3, 0.02)
    whole, view = graph.graph.linearize(gtsam.Values(far)), graph.view(graph.reduction).linearize(far)
    expected, found = whole.optimize(), view.optimize()
    for key in graph.view(graph.reduction).keyVector():
        scale = np.abs(expected.at(key)).max()
        np.testing.assert_allclose(found.at(key), expected.at(key), rtol=1e-5, atol=1e-6 * scale)


def test_served_rows_do_not_mix_values() -> None:
    """A factor asked elsewhere in between leaves the prepared rows of the others as they are."""
    for kind in ("reduced epochs", "lab"):
        graph = GRAPHS[kind]()
        far = h.disturbed(graph.start, graph, 3, 0.1)
        plain = graph.view(graph.reduction).linearize(graph.start)
        prepared = graph.prepare(graph.start, jacobians=True)
        for i in range(graph.graph.size()):
            graph.graph.at(i).error(far)
        for bundle in graph.bundles:  # whose rows need the derivatives of the table, which these errors have moved
            assert set(bundle.chains.slot.tolist()) & set(graph.unknowns.table_slots)
        served = graph.linearized(prepared)
        for i in range(plain.size()):
            (A, b), (C, d) = plain.at(i).jacobian(), served.at(i).jacobian()
            np.testing.assert_allclose(A.T @ A, C.T @ C, rtol=1e-9, atol=1e-12 * np.abs(A.T @ A).max())
            np.testing.assert_allclose(np.linalg.norm(b), np.linalg.norm(d), rtol=1e-9)


def test_unused_weights_are_those_of_the_graph() -> None:
    """Weights set after the graph was made are its own."""
    graph = h.build(*bundle())
    before = graph.graph.error(graph.start)
    n = len(graph.used())
    weights = np.where(np.arange(n) % 3 == 0, 0.25, 1.0)
    graph.set_weights(weights)
    assert 2.0 * graph.graph.error(graph.start) == pytest.approx(graph.omega(graph.start), rel=1e-12)
    assert graph.graph.error(graph.start) < before


