"""Unknown points: the reduced bundle against one dense matrix with every unknown in it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import SolveOptions, solve
from adjust.model.errors import IndeterminateError
from adjust.model.observations import Coordinates, Distance, PositionRef
from adjust.model.survey import Datum, PoseParameter, Survey
from adjust.observations.images.bundle_hidden import BundleHidden
from adjust.precision.precision import Precision
from survey.simulate import beacons
from survey.simulate.scene import Truth
from tests.adjust import helpers as h


def near(truth: Truth) -> StartValues:
    return h.shaken(h.start_at(truth), 1, 0.003, 0.003)


def graph_at(survey: Survey, start: StartValues) -> AdjustmentGraph:
    return GraphBuilder(survey, start.lenses).build(start)


def calibrated(survey: Survey, truth: Truth) -> Survey:
    """All cameras known."""
    cameras = []
    for c in survey.cameras:
        pose = truth["station_from_camera", c.camera_id]
        assert isinstance(pose, gtsam.Pose3)
        cameras.append(replace(c, lens=replace(c.lens, free=()), station_from_camera=PoseParameter(pose, "held")))
    return replace(survey, cameras=tuple(cameras))


def held_epochs(survey: Survey, truth: Truth) -> Survey:
    epochs = {
        name[2]: PoseParameter(pose, "held")
        for name, pose in truth.items()
        if name[0] == "world_from_station" and isinstance(pose, gtsam.Pose3)
    }
    return replace(survey, stations=(replace(survey.stations[0], epochs=epochs),))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "reduced", "tied"),
    [
        ({}, 6, 4),
        ({"distances": 0}, 10, 0),
        ({"unused": 0.2}, 6, 4),
        ({"held": 0, "coordinates": 5}, 9, 5),
        ({"free_lens": ()}, 6, 4),
        ({"n_cameras": 1}, 6, 4),
        ({"n_cameras": 3, "distances": 3}, 4, 6),
    ],
)
def test_bundle_equals_the_dense_adjustment(options: dict[str, object], reduced: int, tied: int) -> None:
    """Values, covariances of lenses, hidden poses, reduced, tied and held points, all redundancy numbers and tests."""
    survey, truth = h.network(1, **options)
    precision, _ = h.check_against_dense(survey, near(truth))
    (bundle,) = precision.graph.bundles
    assert (len(bundle.reduced), len(bundle.tied)) == (reduced, tied)
    assert len(bundle.hidden_poses) == 4


@pytest.mark.slow
@pytest.mark.parametrize(("n_cameras", "alone"), [(1, True), (2, False)])
def test_cameras_fixed_to_their_stations(n_cameras: int, alone: bool) -> None:
    """A hidden pose behind one image alone takes the short way, one behind several images the general one."""
    survey, truth = h.network(1, n_cameras=n_cameras)
    cameras = []
    for c in survey.cameras:
        pose = truth["station_from_camera", c.camera_id]
        assert isinstance(pose, gtsam.Pose3)
        cameras.append(replace(c, station_from_camera=PoseParameter(pose, "held")))
    precision, _ = h.check_against_dense(replace(survey, cameras=tuple(cameras)), near(truth))
    (bundle,) = precision.graph.bundles
    assert bundle.hidden_poses
    assert bundle.alone == alone


def test_points_between_known_cameras() -> None:
    """Intersection alone: nothing but points is unknown."""
    survey, truth = h.network(1, distances=0)
    precision, _ = h.check_against_dense(held_epochs(calibrated(survey, truth), truth), near(truth))
    assert {n[0] for n in precision.graph.unknowns.by_name} == {"point"}


def test_intersection_goes_on_until_every_point_stands_still() -> None:
    """The steps of points that are reduced count, though the rest of the graph does not see them."""
    survey, truth = h.network(1, distances=0)
    survey = held_epochs(calibrated(survey, truth), truth)
    graph, best = h.solved(survey, h.start_at(truth))
    far = h.start_at(truth)
    points = {k: np.asarray(best.values.atPoint3(graph.unknowns.by_name["point", k].key)) for k in far.points
              if ("point", k) in graph.unknowns.by_name}  # fmt: skip
    visible = set(graph.view(graph.reduction).keyVector())
    seen_by_gtsam = {n for n, u in graph.unknowns.by_name.items() if u.key in visible}
    hidden = next(k for k in points if ("point", k) not in seen_by_gtsam)
    points[hidden] = points[hidden] + (0.3, -0.2, 0.2)
    again = h.build(survey, replace(far, points={**far.points, **points}))
    done = solve(again, SolveOptions())
    np.testing.assert_allclose(done.omega, best.omega, rtol=1e-10)
    x = done.values.atPoint3(again.unknowns.by_name["point", hidden].key)
    y = best.values.atPoint3(graph.unknowns.by_name["point", hidden].key)
    np.testing.assert_allclose(x, y, atol=1e-9)


@pytest.mark.slow
def test_bundle_beside_boards_and_a_table() -> None:
    """Beacons without coordinates, seen from the table: nine kinds of unknowns on the interface."""
    survey, truth = beacons(1, n_table_epochs=3, n_free_epochs=2, n_night_epochs=5)
    boards = [b for b in survey.image_blocks if b.target_id is not None]
    thin = [replace(b, point_idx=b.point_idx[::5], uv=b.uv[::5], cov=b.cov[::5]) for b in boards]
    nights = [b for b in survey.image_blocks if b.target_id is None]
    survey = replace(survey, image_blocks=(*thin, *nights), coordinates=(), distances=survey.distances[:1])
    precision, _ = h.check_against_dense(survey, near(truth))
    (bundle,) = precision.graph.bundles
    assert len(bundle.tied) == 2


def test_points_on_the_interface_or_reduced_give_the_same() -> None:
    """Three ways to the same numbers: reduced, tied by observations without weight, tied by unused ones."""
    survey, truth = h.network(2, distances=0)
    free = [p.point_id for p in survey.points if p.x_in_world.treatment != "held"]
    nothing = tuple(
        Coordinates((PositionRef(p),), np.asarray(truth["point", p])[None], 1e12 * np.eye(3)) for p in free[::2]
    )
    aside = tuple(Distance(f"u{p}", PositionRef(p), PositionRef("P0"), 0.5, 1e-3, used=False) for p in free[::2])
    results = []
    for extra in ({}, {"coordinates": nothing}, {"distances": aside}):
        graph, done = h.solved(replace(survey, **extra), near(truth))
        results.append((graph, done, Precision(graph, done)))
    first, _, p0 = results[0]
    assert [len(b.tied) for g, _, _ in results for b in g.bundles] == [0, 5, 5]
    for graph, done, precision in results[1:]:
        assert done.omega == pytest.approx(results[0][1].omega, rel=1e-9)
        for name in first.unknowns.by_name:
            assert h.relative(h.covariance_of(precision, name), h.covariance_of(p0, name)) < 1e-8
        unused = [o for o in h.other_residuals(precision) if not o.used]
        assert len(unused) == (5 if graph.survey.distances else 0)


def test_back_substitution_gives_the_dense_step() -> None:
    """One step away from the minimum, hidden poses and points included."""
    survey, truth = h.network(3)
    start = near(truth)
    graph = h.build(survey, start)
    graph.prepare(graph.start, jacobians=True)
    delta = graph.view(graph.reduction).linearize(graph.start).optimize()
    for bundle in graph.bundles:
        bundle.complete(delta)
    full = h.dense(graph, dict(start.lenses), graph.start)
    A, e = full.A[full.used], full.e[full.used]
    expected = -np.linalg.lstsq(A / np.linalg.norm(A, axis=0), e, rcond=None)[0] / np.linalg.norm(A, axis=0)
    for name, place in full.place.items():
        mine = delta.at(graph.unknowns.by_name[name].key)
        np.testing.assert_allclose(mine, expected[place], rtol=1e-6, atol=1e-8, err_msg=str(name))


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"distances": 2}, {"distances": 0}, {"distances": 2, "n_cameras": 1}])
@pytest.mark.parametrize(
    "datum",
    [Datum("inner"), Datum("inner", points=("P1", "P2", "P5", "P7", "P9")), Datum("inner", stations=("head",))],
)
def test_free_network_equals_the_dense_one(options: dict[str, int], datum: Datum) -> None:
    """Inner constraints over all points, some points, the stations; six defects with a distance, seven without."""
    survey, truth = h.network(5, held=0, **options)
    precision, _ = h.check_against_dense(replace(survey, datum=datum), near(truth))
    assert precision.solved.datum is not None
    assert precision.solved.datum.defect == (6 if options["distances"] else 7)


@pytest.mark.slow
@pytest.mark.parametrize("pivot", [1e-11, 1e-15])
def test_the_defects_of_a_larger_free_network_are_all_found(pivot: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Condensed to a few unknowns, the seven motions drown in rounding unless they are taken out exactly.

    Whatever pivots are then left out as rounding.
    """
    monkeypatch.setattr("adjust.observations.images.bundles.ROUNDING_PIVOT", pivot)
    survey, truth = h.network(3, n_epochs=40, n_points=200, held=0, distances=0)
    survey = replace(survey, datum=Datum("inner", points=tuple(f"P{i}" for i in range(5))))
    _, done = h.solved(survey, h.shaken(h.start_at(truth), 1, 0.002, 0.002), tight=False)
    assert done.datum is not None
    assert done.datum.defect == 7
    free = replace(survey, datum=Datum("inner"))
    _, other = h.solved(free, h.shaken(h.start_at(truth), 1, 0.002, 0.002), tight=False)
    assert done.omega == pytest.approx(other.omega, rel=1e-9)


def test_a_network_without_datum_is_named_as_such() -> None:
    survey, truth = h.network(3, held=0, distances=0)
    with pytest.raises(IndeterminateError, match=r"datum.*position.*rotation.*scale"):
        h.solved(survey, near(truth))
    survey, truth = h.network(3, held=0, distances=2)
    with pytest.raises(IndeterminateError, match=r"datum.*position.*rotation") as caught:
        h.solved(survey, near(truth))
    assert "scale" not in str(caught.value)


def test_a_point_seen_once_is_named() -> None:
    survey, truth = h.network(1, distances=0)
    blocks = []
    for i, b in enumerate(survey.image_blocks):
        keep = b.point_idx != 9 if i else np.ones(len(b.uv), bool)
        blocks.append(replace(b, point_idx=b.point_idx[keep], uv=b.uv[keep], cov=b.cov[keep], used=None))
    with pytest.raises(IndeterminateError, match=r"point 'P9' is not determined.*C1 at e0") as caught:
        h.solved(replace(survey, image_blocks=tuple(blocks)), near(truth))
    assert caught.value.parameters == ("point P9",)


@pytest.mark.parametrize("which", [slice(0, 2), slice(-2, None)])
def test_an_epoch_with_too_few_points_is_named(which: slice) -> None:
    """Two known points, or two unknown ones."""
    survey, truth = h.network(1, n_cameras=1, distances=0)
    blocks = list(survey.image_blocks)
    b = blocks[2]
    blocks[2] = replace(b, point_idx=b.point_idx[which], uv=b.uv[which], cov=b.cov[which], used=None)
    with pytest.raises(IndeterminateError, match=r"head.* e2"):
        h.solved(replace(survey, image_blocks=tuple(blocks)), near(truth))


@pytest.mark.slow
def test_beacons_that_only_a_turning_head_sees_with_free_lenses() -> None:
    """The table moves with all beacons it sees: reduced, nothing but rounding is left of it, and that is no weight."""
    survey, truth = beacons(4, n_table_epochs=4, n_free_epochs=3, n_night_epochs=6)
    survey = replace(survey, coordinates=(), distances=())
    solved = solve(graph_at(survey, h.shaken(h.start_at(truth), 1, 0.001, 0.001)), SolveOptions(max_iterations=12))
    assert solved.iterations < 9
    n = sum(2 * len(b.uv) for b in survey.image_blocks) + 2 * len(survey.table_readings)
    assert 0.8 * n < solved.omega < n


def test_image_rows_along_a_direction_are_the_root_of_the_condensed_normal_equations() -> None:
    survey, truth = h.network(1)
    graph = graph_at(survey, near(truth))
    graph.prepare(graph.start, jacobians=True)
    (bundle,) = graph.bundles
    V = np.random.default_rng(3).normal(size=(sum(graph.unknowns.by_key[k].dim for k in bundle.interface), 4))
    R = np.concatenate(bundle.views, axis=1)
    rows = BundleHidden(bundle).rows_along(V)
    np.testing.assert_allclose(rows.T @ rows, (R @ V).T @ (R @ V), rtol=1e-7)
