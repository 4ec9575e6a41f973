"""Every derivative of the core against differences of residuals, away from zero error."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.lenses.models import MODELS
from adjust.model.observations import Coordinates, Distance, FrameRef, Pair, PositionRef
from adjust.model.survey import FloatArray, Point, PointParameter, PoseParameter, Survey, Tie, VectorPrior
from tests.adjust import helpers as h

# of differences in the rational terms k4..k6: a step is too long for some blocks or too short for others
TOLERANCE = 1e-6
LENSES = ("brown", "fisheye", "brown_backward", "brown_backward_dbat", "aicon")


def image_factors(graph: AdjustmentGraph) -> list[gtsam.NonlinearFactor]:
    first = sum(item.used for item in graph.others)
    return [graph.graph.at(first + b) for b in range(len(graph.images.blocks))]


def plain_rows(graph: AdjustmentGraph, start: StartValues, values: gtsam.Values, b: int, keys: list[int]):
    """Whitened rows [A | e] of block b from OpenCV and differences."""
    plain = h.Plain(graph, dict(start.lenses))
    block = graph.survey.image_blocks[b]
    used = block.used if block.used is not None else np.ones(len(block.uv), bool)
    W = [h.root(c) for c in block.cov[used]]

    found, by_key = plain.parameters(values), graph.unknowns.by_key

    def by(key: int) -> FloatArray:
        def residual(at: gtsam.Values) -> FloatArray:
            return plain.image(block, plain.displaced(found, by_key[key].name, at))[used].ravel()

        return h.differences(residual, values, key, h.steps_of(by_key[key], values))

    return h.whiten(W, np.hstack([by(k) for k in keys])), h.whiten(W, plain.image(block, found)[used].ravel())


def check_images(survey: Survey, start: StartValues, expected_links: set[str]) -> None:
    graph = h.build(survey, start)
    values = h.disturbed(graph.start, graph, 6)
    graph.prepare(values, jacobians=True)
    links = set()
    for b, factor in enumerate(image_factors(graph)):
        linear = factor.linearize(values)
        A, rhs = linear.jacobian()
        keys = list(linear.keys())
        links |= {graph.unknowns.by_key[k].name[0] for k in keys}
        rows, e = plain_rows(graph, start, values, b, keys)
        scale = np.linalg.norm(rows, axis=0)
        assert np.all(scale > 0), "a derivative by an unknown that does not move the image"
        np.testing.assert_allclose(
            A.T @ A / np.outer(scale, scale), rows.T @ rows / np.outer(scale, scale), atol=TOLERANCE
        )
        length = np.linalg.norm(e)
        np.testing.assert_allclose(A.T @ rhs / scale / length, -rows.T @ e / scale / length, atol=TOLERANCE)
        assert rhs @ rhs == pytest.approx(length**2, rel=1e-10)
        assert 2.0 * factor.error(values) == pytest.approx(length**2, rel=1e-10)
    assert links == expected_links


ALL_LINKS = {
    "lens", "station_from_camera", "mount_from_station", "world_from_table", "table_geometry", "table_angles",
    "world_from_station", "carrier_from_target", "warp",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("model", LENSES)
def test_condensed_blocks_hold_the_normal_equations_of_plain_residuals(model: str) -> None:
    """All lens models; all links of a chain; full covariances; unused points."""
    survey, start = h.everything(1, model)
    check_images(survey, start, ALL_LINKS)


@pytest.mark.slow
@pytest.mark.parametrize("axes", [("x", "z"), ("z", "x"), ("y", "x"), ("y", "z"), ("z",), ("x",)])
def test_condensed_blocks_on_tables_of_all_kinds(axes: tuple[str, ...]) -> None:
    survey, start = h.everything(2, axes=axes)
    check_images(survey, start, ALL_LINKS)


@pytest.mark.slow
def test_condensed_blocks_with_tied_and_held_lens_parameters() -> None:
    ties = (Tie("fy", "fx", 1.0125), Tie("k4", "k1", -0.3))
    survey, start = h.everything(3, ties=ties)
    free = tuple(n for n in MODELS["brown"].names if n not in ("skew", "k3", "fy", "k4"))
    cameras = (replace(survey.cameras[0], lens=replace(survey.cameras[0].lens, free=free)), survey.cameras[1])
    check_images(replace(survey, cameras=cameras), start, ALL_LINKS)


@pytest.mark.slow
def test_condensed_blocks_with_held_links_and_part_of_the_table_geometry() -> None:
    survey, start = h.everything(4)
    held = {name: PoseParameter(p, "held") for name, p in start.poses.items()}
    geometry = replace(survey.tables[0].geometry, free=("axis_offset", "zero_2"))
    survey = replace(
        survey,
        tables=(replace(survey.tables[0], geometry=geometry),),
        stations=(
            replace(survey.stations[0], mount_from_station=held["mount_from_station", "head"]),
            replace(survey.stations[1], world_from_station=held["world_from_station", "tripod"]),
        ),
    )
    check_images(survey, start, ALL_LINKS - {"mount_from_station"})


def others(survey: Survey, start: StartValues) -> tuple[Survey, StartValues]:
    """``everything`` with every kind of observation that is not an image point, all off by some amount."""
    rng = np.random.default_rng(7)
    t1, h1 = FrameRef("station", "head", "t1"), FrameRef("station", "head", "h1")
    tripod, board, table = FrameRef("station", "tripod"), FrameRef("target", "board"), FrameRef("table", "table")
    block, wand, camera = (
        FrameRef("target", "block", "t2"), FrameRef("target", "wand", "h1"), FrameRef("camera", "X", "t1"),
    )  # fmt: skip
    world = FrameRef("world")
    a, b, held = PositionRef("A"), PositionRef("B"), PositionRef("H")
    on_block, on_board = PositionRef("c3", block), PositionRef("c9", board)
    cov6, cov3 = (lambda: h.random_cov(rng, [1e-3] * 6)), (lambda: h.random_cov(rng, [1e-3] * 3))
    far = h.pose(rng, 0.4, (0.1, 0.2, 0.3))
    frames = [(tripod, board), (board, tripod), (t1, h1), (camera, wand), (world, t1), (t1, world), (table, block),
              (t1, FrameRef("station", "head", "t2")), (block, t1)]  # fmt: skip
    pairs = [Pair(f"pose {i}", x, y, far, cov6()) for i, (x, y) in enumerate(frames)]
    pairs += [Pair(f"rotation {i}", x, y, far.rotation(), cov3()) for i, (x, y) in enumerate(frames)]
    ends = [(a, b), (a, held), (a, on_block), (on_block, on_board), (PositionRef(frame=camera), a),
            (PositionRef(frame=t1), PositionRef(frame=tripod)), (on_block, PositionRef("c20", block)),
            (PositionRef(frame=t1), PositionRef(frame=h1))]  # fmt: skip
    distances = tuple(Distance(f"d{i}", x, y, 0.3, 1e-3) for i, (x, y) in enumerate(ends))
    coordinates = (
        Coordinates((a,), rng.normal(size=(1, 3)), h.random_cov(rng, [1e-3] * 3)),
        Coordinates((a, b, on_block, PositionRef(frame=h1), held), rng.normal(size=(5, 3)),
                    h.random_cov(rng, [1e-3] * 15)),
    )  # fmt: skip
    unknown = np.array([np.inf, 1.0, np.inf, 1.0, 1.0, np.inf])
    part = h.random_cov(rng, [1e-2] * 6) + np.diag(np.where(np.isinf(unknown), np.inf, 0.0))
    stations = (
        replace(survey.stations[0], mount_from_station=PoseParameter(far, "prior", part),
                epochs={"h1": PoseParameter(far, "prior", cov6())}),
        survey.stations[1],
    )  # fmt: skip
    names = ("v0", "k1", "fx")
    prior = VectorPrior(names, np.array([700.0, 0.3, 600.0]), h.random_cov(rng, [5.0, 0.01, 3.0]))
    cameras = (replace(survey.cameras[0], lens=replace(survey.cameras[0].lens, prior=prior)), survey.cameras[1])
    of_table = VectorPrior(("zero_1", "axis_offset"), np.array([0.3, 0.1]), h.random_cov(rng, [1e-3, 1e-4]))
    table_ = replace(survey.tables[0], geometry=replace(survey.tables[0].geometry, prior=of_table))
    of_warp = VectorPrior(("warp_y",), np.array([0.01]), np.array([[1e-6]]))
    warp = survey.targets[0].warp
    assert warp is not None
    points = (
        Point("A"),
        Point("B", PointParameter(np.array([0.3, 0.2, 0.1]), "prior", h.random_cov(rng, [1e-3] * 3))),
        Point("H", PointParameter(np.array([1.0, 2.0, 3.0]), "held")),
    )
    survey = replace(
        survey, pairs=tuple(pairs), distances=distances, coordinates=coordinates, stations=stations, cameras=cameras,
        tables=(table_,), targets=(replace(survey.targets[0], warp=replace(warp, prior=of_warp)), *survey.targets[1:]),
        points=points,
    )  # fmt: skip
    return survey, replace(start, points={"A": np.array([0.5, 0.1, 0.9]), "B": np.array([-0.4, 0.3, 0.7])})


@pytest.mark.slow
@pytest.mark.parametrize("axes", [("x", "z"), ("z",)])
def test_every_other_factor(axes: tuple[str, ...]) -> None:
    """Residual against plain lines, Jacobian against differences, whitening against the covariance."""
    survey, start = h.everything(5, axes=axes)
    survey, start = others(survey, start)
    if len(axes) == 1:
        prior = VectorPrior(("zero_1",), np.array([0.3]), np.array([[1e-6]]))
        survey = replace(
            survey, tables=(replace(survey.tables[0], geometry=replace(survey.tables[0].geometry, prior=prior)),)
        )
    graph = h.build(survey, start)
    values = h.disturbed(graph.start, graph, 6)
    found = h.Plain(graph, dict(start.lenses)).parameters(values)
    kinds = set()
    for item in graph.others:
        r, cov = h.Plain(graph, dict(start.lenses)).other(item, found)
        np.testing.assert_allclose(h.whitened_residual(item.factor, values), h.root(cov) @ r, rtol=1e-9, atol=1e-9,
                                   err_msg=f"{item.kind} {item.ids}")  # fmt: skip
        assert h.jacobian_mismatch(item.factor, graph, values) < 2e-9, (item.kind, item.ids)
        kinds.add((item.kind, item.ids[0] if item.kind == "prior" else ""))
    assert kinds == {
        ("table", ""), ("pair", ""), ("distance", ""), ("coordinates", ""), ("prior", "mount_from_station"),
        ("prior", "world_from_station"), ("prior", "point"), ("prior", "lens"), ("prior", "table_geometry"),
        ("prior", "warp"),
    }  # fmt: skip


def test_a_pose_pair_between_fixed_bodies_is_gtsams_own_factor() -> None:
    """Two keys, and GTSAM's order: Between(b, a) measures b_from_a."""
    survey, start = others(*h.everything(5))
    graph = h.build(survey, start)
    native = [i for i in graph.others if isinstance(i.factor, gtsam.BetweenFactorPose3)]
    assert {i.ids[0] for i in native} == {"pose 0", "pose 1"}


@pytest.mark.parametrize("what", ["distance", "rotation"])
def test_the_helper_sees_a_wrong_derivative(what: str) -> None:
    """Five per cent too much in one column is found, in a factor made by hand."""
    survey, start = others(*h.everything(5))
    graph = h.build(survey, start)
    key = graph.unknowns.by_name["carrier_from_target", "board"].key

    def residual(_f, values, jacobians):
        pose: Pose3 = values.atPose3(key)
        t, R = pose.translation(), pose.rotation()
        if what == "distance":
            if jacobians is not None:
                jacobians[0] = np.hstack([np.zeros((1, 3)), 1.05 * (t / np.linalg.norm(t))[None] @ R.matrix()])
            return np.array([np.linalg.norm(t) - 0.1])
        if jacobians is not None:  # the derivative at zero error, which is wrong away from it
            jacobians[0] = np.hstack([np.eye(3), np.zeros((3, 3))])
        return Rot3.Logmap(Rot3.Rx(0.5).between(R))

    n = 1 if what == "distance" else 3
    factor = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(n), [key], residual)
    assert h.jacobian_mismatch(factor, graph, graph.start) > 0.02
