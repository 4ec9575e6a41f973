"""Levels, alignments, laser spots, surfaces, coordinate differences: residuals, derivatives, motions, messages."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.adjustment import adjust
from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import (
    Alignment,
    CoordinateDifferences,
    Coordinates,
    Distance,
    FrameRef,
    LaserSpot,
    Level,
    OnSurface,
    PositionRef,
)
from adjust.model.survey import (
    BEAM,
    SURFACES,
    TILT,
    Beam,
    Datum,
    FloatArray,
    Point,
    PointParameter,
    PoseParameter,
    Station,
    Surface,
    Survey,
    Target,
    VectorParameter,
    VectorPrior,
    Vertical,
    tilt_axes,
)
from adjust.observations.geometry.residuals import line_distance, plane_distance, sphere_distance
from adjust.observations.motions import direction_motions, surface_motions
from adjust.spatial.motions import point_motions
from adjust.spatial.vertical import tilted
from tests.adjust import helpers as h
from tests.sizes import size

UP = np.array([0.1, -0.2, 0.97]) / np.linalg.norm([0.1, -0.2, 0.97])
HEAD = FrameRef("station", "head", "t1")
BOARD, BLOCK = FrameRef("target", "board"), FrameRef("target", "block", "t2")
A, B, ON_BLOCK = PositionRef("A"), PositionRef("B"), PositionRef("c3", BLOCK)


def unit(x) -> FloatArray:
    return np.asarray(x, dtype=float) / np.linalg.norm(x)


def geometric(seed: int) -> tuple[Survey, StartValues]:
    """``everything`` with every geometric observation, all off by some amount."""
    survey, start = h.everything(seed)
    rng = np.random.default_rng(seed)
    part = h.random_cov(rng, [1e-3] * 6)
    part[4, 4] = np.inf
    one = np.diag([1e-6, np.inf])
    axes = [unit(rng.normal(size=3)) for _ in range(4)]
    prior = VectorPrior(("slope_1",), np.array([0.02]), np.array([[1e-6]]))
    R = Rot3(np.asarray(start.poses["carrier_from_target", "board"].rotation().matrix()))
    near = R.matrix() @ axes[1]  # in the world, near an axis of the board
    survey = replace(
        survey,
        points=(Point("A"), Point("B"), Point("H", PointParameter(np.array([1.0, 2.0, 3.0]), "held"))),
        vertical=Vertical(UP, VectorParameter(TILT, np.array([0.01, -0.02]), free=TILT), radius=50.0),
        levels=(
            Level("l1", HEAD, np.array([1.0, 0.0, 0.0]), 0.2, 1e-3),
            Level("l2", BOARD, unit([0.1, 1.0, 0.3]), -0.1, 1e-3),
            Level("l3", FrameRef("mount", "table", "t2"), np.array([0.0, 1.0, 0.0]), 0.1, 1e-3),
        ),
        alignments=(
            Alignment("a1", BOARD, axes[1], FrameRef("world"), unit(near + 0.1), np.array([0.05, 0.02]),
                      h.random_cov(rng, [1e-3] * 2)),
            Alignment("a2", FrameRef("table", "table"), np.array([0.0, 1.0, 0.0]), FrameRef("mount", "table", "t1"),
                      unit([0.2, 1.0, 0.1]), np.array([0.01, 0.3]), one),
        ),
        beams=(
            Beam("b1", "mount", "table", "z", VectorParameter(BEAM, np.array([0.1, 0.2, 0.03, -0.02]), BEAM, prior)),
            Beam("b2", "station", "head", "x", VectorParameter(BEAM, np.array([0.1, 0.2, 0.03, -0.02]), BEAM[1:3])),
            Beam("b3", "mount", "table", "y", VectorParameter(BEAM, np.array([0.1, 0.2, 0.4, -0.3]))),
        ),
        laser_spots=(
            LaserSpot("s1", "b1", "t1", "board", np.array([0.3, 0.1]), h.random_cov(rng, [1e-3] * 2)),
            LaserSpot("s2", "b1", "t2", "board", np.array([0.1, 0.1]), h.random_cov(rng, [1e-3] * 2)),
            LaserSpot("s3", "b2", "h1", "wand", np.array([0.1, 0.4]), h.random_cov(rng, [1e-3] * 2)),
            LaserSpot("s4", "b3", "t1", "board", np.array([0.2, 0.4]), h.random_cov(rng, [1e-3] * 2)),
        ),
        surfaces=(
            Surface("plane", "plane", UP),
            Surface("line", "line", unit([0.3, 1.0, 0.2]), VectorParameter(SURFACES["line"], np.array(
                [0.02, -0.03, 0.4, 0.3]), free=("direction_2", "offset_1"))),
            Surface("rod", "line", unit([1.0, 0.1, 0.2]), VectorParameter(
                SURFACES["line"], np.array([0.02, -0.03, 0.4, 0.3]), SURFACES["line"])),
            Surface("ball", "sphere", None, VectorParameter(SURFACES["sphere"], np.array([0.1, 0.2, 0.3, 0.25]),
                                                            free=SURFACES["sphere"])),
        ),
        on_surfaces=(
            OnSurface("plane", A, 1e-3), OnSurface("plane", B, 1e-3, 0.01), OnSurface("line", A, 1e-3),
            OnSurface("line", ON_BLOCK, 1e-3, 0.02), OnSurface("rod", B, 1e-3), OnSurface("ball", ON_BLOCK, 1e-3, 0.01),
        ),
        coordinate_differences=(
            CoordinateDifferences((A, B), (B, ON_BLOCK), rng.normal(size=(2, 3)), part),
            CoordinateDifferences((PositionRef("H"),), (A,), rng.normal(size=(1, 3)), h.random_cov(rng, [1e-3] * 3)),
        ),
        coordinates=(
            Coordinates((A,), np.array([[0.1, np.nan, 0.3]]), np.diag([1e-6, np.inf, 1e-6])),
            Coordinates((A, B), rng.normal(size=(2, 3)), part),
        ),
    )  # fmt: skip
    return survey, replace(start, points={"A": np.array([0.5, 0.1, 0.9]), "B": np.array([-0.4, 0.3, 0.7])})


class Plainly:
    """The same residuals with scipy's rotations and plain geometry; nothing but the poses is shared."""

    def __init__(self, graph: AdjustmentGraph, start: StartValues, values) -> None:
        self.survey, self.graph, self.values = graph.survey, graph, values
        self.plain = h.Plain(graph, dict(start.lenses))
        self.parameters = self.plain.parameters(values)

    def frame(self, ref: FrameRef) -> FloatArray:
        from adjust.observations.factors import ChainPose  # poses of chains have tests of their own

        chain = self.chains[ref]
        return np.asarray(ChainPose(self.graph.unknowns, self.graph.state, chain)(self.values)[0].matrix())

    def position(self, ref: PositionRef) -> FloatArray:
        if ref.frame is None:
            unknown = self.graph.unknowns.by_name.get(("point", ref.point_id))
            return np.array([1.0, 2.0, 3.0]) if unknown is None else np.asarray(self.values.atPoint3(unknown.key))
        target = next(t for t in self.survey.targets if t.target_id == ref.frame.frame_id)
        x = target.x_in_target[target.point_ids.index(ref.point_id)]
        T = self.frame(ref.frame)
        return T[:3, :3] @ x + T[:3, 3]

    def vector(self, name) -> FloatArray:
        return self.graph.unknowns.vectors[name].full(self.values)

    def __getattr__(self, name):
        if name != "chains":
            raise AttributeError(name)
        from adjust.graph.building import GraphBuilder

        survey = self.survey
        frames = GraphBuilder(survey, {c.camera_id: c.lens.values for c in survey.cameras}).frames
        frames.unknowns = self.graph.unknowns  # the same slots
        refs = [HEAD, BOARD, BLOCK, FrameRef("table", "table"), FrameRef("target", "wand", "h1"),
                FrameRef("station", "head", "h1"), FrameRef("mount", "table", "t1"), FrameRef("mount", "table", "t2"),
                FrameRef("world")]  # fmt: skip
        self.chains = {ref: frames.relative(ref, FrameRef("world")) for ref in refs}
        return self.chains

    def spot(self, spot: LaserSpot) -> FloatArray:
        beam = next(b for b in self.survey.beams if b.beam_id == spot.beam_id)
        o1, o2, m1, m2 = self.vector(("beam", beam.beam_id))
        k = "xyz".index(beam.axis)
        start, along = np.zeros(3), np.zeros(3)
        start[(k + 1) % 3], start[(k + 2) % 3] = o1, o2
        along[(k + 1) % 3], along[(k + 2) % 3], along[k] = m1, m2, 1.0
        carrier = self.frame(FrameRef(beam.carrier_kind, beam.carrier_id, spot.epoch_id))
        moved = spot.target_id == "wand"
        T = np.linalg.inv(self.frame(FrameRef("target", spot.target_id, spot.epoch_id if moved else None))) @ carrier
        p, q = (T @ np.array([*(start + s * along), 1.0]) for s in (0.0, 1.0))
        return (p + (q - p) * p[2] / (p[2] - q[2]))[:2]

    def level(self, level: Level) -> float:
        tilt = self.vector(("vertical",))
        up = Rotation.from_rotvec(tilt @ tilt_axes(UP)).apply(UP)
        T = self.frame(level.frame)
        plumb = unit(T[:3, 3] + 50.0 * up)
        return float(np.arcsin(T[:3, :3] @ level.axis_in_frame @ plumb)) - level.value

    def alignment(self, a: Alignment) -> FloatArray:
        R = np.linalg.inv(self.frame(a.b)) @ self.frame(a.a)
        return (tilt_axes(a.axis_in_b) @ R[:3, :3] @ a.axis_in_a - a.value)[np.isfinite(np.diag(a.cov))]

    def on_surface(self, o: OnSurface) -> FloatArray:
        surface = next(s for s in self.survey.surfaces if s.surface_id == o.surface_id)
        x, p = self.position(o.position), self.vector(("surface", o.surface_id))
        if surface.kind == "sphere":
            return np.array([np.linalg.norm(x - p[:3]) - p[3] - o.offset])
        across = tilt_axes(surface.reference)
        turn = Rotation.from_rotvec(p[:2] @ across)
        n = turn.apply(surface.reference)
        if surface.kind == "plane":
            return np.array([n @ x - p[2] - o.offset])
        y = x - p[2:] @ across
        if o.offset:
            return np.array([np.linalg.norm(np.cross(n, y)) - o.offset])
        return turn.apply(across) @ y


@pytest.mark.slow
def test_residuals_and_derivatives_of_every_kind() -> None:
    survey, start = geometric(3)
    graph = h.build(survey, start)
    values = h.disturbed(graph.start, graph, 4)
    plain = Plainly(graph, start, values)
    expected = {
        "level": [np.array([plain.level(x)]) for x in survey.levels],
        "alignment": [plain.alignment(x) for x in survey.alignments],
        "laser": [plain.spot(x) - x.xy for x in survey.laser_spots],
        "surface": [plain.on_surface(x) for x in survey.on_surfaces],
        "coordinate_difference": [
            np.concatenate([plain.position(b) - plain.position(a) - v for a, b, v in zip(d.at, d.to, d.values,
                                                                                      strict=True)])
            [np.isfinite(np.diag(d.cov))] for d in survey.coordinate_differences
        ],
        "coordinates": [
            np.concatenate([plain.position(p) - v for p, v in zip(c.positions, c.values, strict=True)])
            [np.isfinite(np.diag(c.cov))] for c in survey.coordinates
        ],
    }  # fmt: skip
    found = {kind: [item for item in graph.others if item.kind == kind] for kind in expected}
    for kind, residuals in expected.items():
        assert len(found[kind]) == len(residuals)
        for item, r in zip(found[kind], residuals, strict=True):
            W = np.asarray(item.factor.noiseModel().R())
            np.testing.assert_allclose(h.whitened_residual(item.factor, values), W @ r, rtol=1e-8, atol=1e-8,
                                       err_msg=f"{kind} {item.ids}")  # fmt: skip
            # a beam that meets the board askew is so curved that the steps of the differences show
            limit = 3e-6 if kind == "laser" else 5e-9
            assert h.jacobian_mismatch(item.factor, graph, values) < limit, (kind, item.ids)
            assert len(item.components) == len(item.units) == len(item.observed) == len(r)


def test_what_all_are_served_is_what_each_says_alone() -> None:
    survey, start = geometric(3)
    graph = h.build(survey, start)
    values = h.disturbed(graph.start, graph, 4)
    alone = [item.factor.linearize(values).jacobian() for item in graph.others if item.used]
    graph.prepare(values, jacobians=True)
    with graph.state.serving():
        served = [item.factor.linearize(values).jacobian() for item in graph.others if item.used]
    for one, other in zip(alone, served, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.3, -0.2)])
def test_tilted_direction(tilt: tuple[float, float]) -> None:
    """Against scipy's rotation and differences; of z, the first tilt turns about x and the second about y."""
    t = np.array(tilt)
    n, J = tilted(UP, t)
    np.testing.assert_allclose(n, Rotation.from_rotvec(t @ tilt_axes(UP)).apply(UP), atol=1e-15)
    numeric = [(tilted(UP, t + d)[0] - tilted(UP, t - d)[0]) / 2e-6 for d in 1e-6 * np.eye(2)]
    np.testing.assert_allclose(J, np.array(numeric).T, atol=1e-9)
    np.testing.assert_allclose(tilted(np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.0]))[0],
                               [0.0, -np.sin(0.1), np.cos(0.1)], atol=1e-15)  # fmt: skip


@pytest.mark.parametrize(("kind", "distance"), [("plane", plane_distance), ("line", line_distance),
                                                ("sphere", sphere_distance)])  # fmt: skip
def test_surfaces_move_with_the_survey(kind: str, distance) -> None:
    """A position keeps its distance from a surface that moves along, but for the scale."""
    p = {"plane": [0.2, -0.1, 0.7], "line": [0.2, -0.1, 0.4, 0.3], "sphere": [0.1, 0.2, 0.3, 0.5]}[kind]
    full, x, step = np.array(p), np.array([0.9, -0.4, 0.8]), 1e-6
    surface = Surface("s", kind, None if kind == "sphere" else UP)
    G, M = surface_motions(surface, full), point_motions(x)
    reference = np.zeros(3) if kind == "sphere" else UP
    for i in range(7):
        ends = [distance(x + s * M[:, i], full + s * G[:, i], reference, False)[0][0] for s in (step, -step)]
        change = (ends[0] - ends[1]) / (2.0 * step)
        assert change == pytest.approx(distance(x, full, reference, False)[0][0] if i == 6 else 0.0, abs=1e-8)


def test_direction_turns_with_the_survey() -> None:
    t = np.array([0.2, -0.3])
    n, J = tilted(UP, t)
    G = direction_motions(UP, t)
    np.testing.assert_allclose(J @ G[:, 3:6], np.cross(np.eye(3), n).T, atol=1e-12)
    assert np.all(G[:, [0, 1, 2, 6]] == 0.0)


# -- adjustments -------------------------------------------------------------------------------------------------------


def cloud(kind: str, seed: int, n: int = 12, noise: float = 1e-3) -> FloatArray:
    rng = np.random.default_rng(seed)
    if kind == "sphere":
        x = np.array([0.3, -0.2, 1.0]) + 0.4 * np.array([unit(v) for v in rng.normal(size=(n, 3))])
    elif kind == "plane":
        x = np.array([1.0, 2.0, 0.5]) + rng.uniform(-1, 1, (n, 2)) @ tilt_axes(unit([0.2, -0.3, 0.9]))
    else:
        x = np.array([1.0, 2.0, 0.5]) + rng.uniform(-1, 1, (n, 1)) * unit([0.2, -0.9, 0.4])
    return x + noise * rng.standard_normal(x.shape)


def measured(x: FloatArray, kind: str, **given) -> Survey:
    """Points held as they were measured, all on one surface."""
    points = tuple(Point(f"P{i}", PointParameter(v, "held")) for i, v in enumerate(x))
    on = tuple(OnSurface("s", PositionRef(p.point_id), 1e-3) for p in points)
    return Survey(points=points, surfaces=(Surface("s", kind, **given),), on_surfaces=on)


@pytest.mark.parametrize("kind", ["plane", "line"])
def test_plane_and_line_are_those_of_the_singular_values(kind: str) -> None:
    """Orthogonal regression in closed form: through the centre, along the singular vectors of the points."""
    x = cloud(kind, 5)
    result = adjust(measured(x, kind))
    surface = result.survey.surfaces[0]
    full = np.asarray(result.estimates["surface", "s"].value)
    n = tilted(surface.reference, full[:2])[0]
    _, s, Vt = np.linalg.svd(x - x.mean(axis=0))
    assert abs(n @ Vt[2 if kind == "plane" else 0]) == pytest.approx(1.0, abs=1e-12)
    centre = x.mean(axis=0)
    if kind == "plane":
        assert full[2] == pytest.approx(n @ centre, abs=1e-10)
        assert result.omega == pytest.approx((s[2] / 1e-3) ** 2, rel=1e-9)
    else:
        offset = centre - full[2:] @ tilt_axes(surface.reference)
        assert np.linalg.norm(np.cross(n, offset)) < 1e-9
        assert result.omega == pytest.approx((s[1] ** 2 + s[2] ** 2) / 1e-6, rel=1e-9)
    assert result.redundancy == (12 - 3 if kind == "plane" else 24 - 4)


def test_sphere_and_its_covariance() -> None:
    """Against numpy's Gauss-Newton on |x - c| - r."""
    x = cloud("sphere", 6)
    result = adjust(measured(x, "sphere"))
    p = np.array([0.2, 0.0, 0.8, 0.3])
    for _ in range(30):
        d = x - p[:3]
        length = np.linalg.norm(d, axis=1)
        J = np.hstack([-d / length[:, None], -np.ones((12, 1))])
        p = p - np.linalg.lstsq(J, length - p[3], rcond=None)[0]
    estimate = result.estimates["surface", "s"]
    np.testing.assert_allclose(estimate.value, p, atol=1e-10)
    np.testing.assert_allclose(estimate.cov, np.linalg.inv(J.T @ J) * 1e-6, rtol=1e-6)
    assert estimate.status == ("free",) * 4


def test_sphere_of_known_radius() -> None:
    radius = VectorParameter(SURFACES["sphere"], np.array([np.nan] * 3 + [0.4]), free=("x", "y", "z"))
    result = adjust(measured(cloud("sphere", 7), "sphere", parameters=radius))
    estimate = result.estimates["surface", "s"]
    assert (estimate.value[3], estimate.status[3]) == (0.4, "held")
    np.testing.assert_allclose(estimate.value[:3], [0.3, -0.2, 1.0], atol=3e-3)


def test_point_coordinates_scatter_as_their_covariance_says() -> None:
    """Points tied to a fixed corner by distances, four of them on a plane: d' inv(C) d over re-solved noise."""
    rng = np.random.default_rng(8)
    truth = np.array([[0.0, 0, 1], [2, 0, 1], [0, 2, 1], [2, 2, 1.0], [1, 1, 3], [3, 1, 2]])
    anchors = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 4], [3, 3, 4.0]])
    ids = [f"P{i}" for i in range(6)]
    fixed = tuple(Point(f"F{i}", PointParameter(a, "held")) for i, a in enumerate(anchors))
    chi, n = [], size(120, 15)
    for _ in range(n):
        distances = tuple(
            Distance(f"{p}-{f.point_id}", PositionRef(p), PositionRef(f.point_id),
                     float(np.linalg.norm(x - a)) + 1e-3 * rng.standard_normal(), 1e-3)
            for p, x in zip(ids, truth, strict=True) for f, a in zip(fixed, anchors, strict=True)
        )  # fmt: skip
        on = tuple(OnSurface("floor", PositionRef(p), 5e-4, float(5e-4 * rng.standard_normal())) for p in ids[:4])
        survey = Survey(points=(*fixed, *(Point(p) for p in ids)), distances=distances, on_surfaces=on,
                        surfaces=(Surface("floor", "plane", np.array([0.0, 0.0, 1.0])),))  # fmt: skip
        result = adjust(survey, StartValues({}, {}, dict(zip(ids, truth + 0.01, strict=True))))
        names = [("point", p) for p in ids]
        error = np.concatenate([np.asarray(result.estimates[n].value) - x for n, x in zip(names, truth, strict=True)])
        plane = np.asarray(result.estimates["surface", "floor"].value) - [0.0, 0.0, 1.0]
        error = np.append(error, plane)
        chi.append(error @ np.linalg.solve(result.precision.joint([*names, ("surface", "floor")]), error))
    # n times chi-square with 21 degrees of freedom
    assert abs(sum(chi) - 21.0 * n) < 3.3 * np.sqrt(42.0 * n)


def test_point_prior_that_leaves_a_height_open() -> None:
    """x and y from the prior, z from one distance straight down."""
    prior = PointParameter(np.array([1.0, 2.0, 0.9]), "prior", np.diag([1e-6, 4e-6, np.inf]))
    survey = Survey(points=(Point("P", prior), Point("F", PointParameter(np.array([1.0, 2.0, 0.0]), "held"))),
                    distances=(Distance("d", PositionRef("F"), PositionRef("P"), 1.0, 1e-4),))  # fmt: skip
    result = adjust(survey, StartValues({}, {}, {"P": np.array([1.0, 2.0, 0.9])}))
    np.testing.assert_allclose(result.estimates["point", "P"].value, [1.0, 2.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(result.estimates["point", "P"].cov)), [1e-3, 2e-3, 1e-4], rtol=1e-9)
    assert (result.n_observations, result.redundancy) == (3, 0)


def levelled(value_1: float, value_2: float) -> Survey:
    station = Station("stage", world_from_station=PoseParameter(Pose3(), "free", held=("rz", "tx", "ty", "tz")))
    frame = FrameRef("station", "stage")
    return Survey(stations=(station,), levels=(
        Level("x", frame, np.array([1.0, 0.0, 0.0]), value_1, 1e-5),
        Level("y", frame, np.array([0.0, 1.0, 0.0]), value_2, 2e-5)))  # fmt: skip


def test_two_levels_give_the_tilt_of_a_body() -> None:
    """Inclinations of its axes: the third component of each column of the rotation is their sine."""
    result = adjust(levelled(0.02, -0.03), StartValues({}, {("world_from_station", "stage"): Pose3()}, {}))
    estimate = result.estimates["world_from_station", "stage"]
    R = estimate.value.rotation().matrix()
    np.testing.assert_allclose(np.arcsin(R[2, :2]), [0.02, -0.03], atol=1e-12)
    # near the horizon, rx inclines y and ry inclines x
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.cov))[:2], [2e-5, 1e-5], rtol=2e-3)


def test_trace_of_the_laser_is_the_papers() -> None:
    """The point of incidence of appendix A.3 (its third equation), the board level at height h above the table."""
    m, n, a, b, c, height = 0.02, 0.3, 0.05, 0.03, 0.04, 0.6
    board = Target("board", ("o",), np.zeros((1, 3)), carrier_from_target=PoseParameter(
        Pose3(Rot3(), np.array([0.0, 0.0, height])), "held"))  # fmt: skip
    spots, poses = [], {}
    for i, phi in enumerate(np.linspace(-0.3, 0.3, 7)):
        factor = (height - (-b * np.sin(phi) + c * np.cos(phi))) / (-n * np.sin(phi) + np.cos(phi))
        x = m * factor + a
        y = (n * np.cos(phi) + np.sin(phi)) * factor + b * np.cos(phi) + c * np.sin(phi)
        spots.append(LaserSpot(f"s{i}", "laser", f"e{i}", "board", np.array([x, y]), 1e-8 * np.eye(2)))
        # the paper's matrix takes coordinates to the turned ones
        turned = np.array([[1, 0, 0], [0, np.cos(phi), np.sin(phi)], [0, -np.sin(phi), np.cos(phi)]])
        poses[f"e{i}"] = PoseParameter(Pose3(Rot3(turned), np.zeros(3)), "held")
    survey = Survey(stations=(Station("head", "epoch", epochs=poses),), targets=(board,), laser_spots=tuple(spots),
                    beams=(Beam("laser", "station", "head"),))  # fmt: skip
    result = adjust(survey)
    beam = np.asarray(result.estimates["beam", "laser"].value)
    np.testing.assert_allclose(beam, [a - m * c, b - n * c, m, n], atol=1e-12)
    assert result.omega < 1e-12


# -- what is not determined, and what is wrong -------------------------------------------------------------------------


def test_inner_datum_finds_the_motions_of_a_network_on_a_plane() -> None:
    """Distances alone leave six motions; the plane moves along and takes none of them away."""
    x = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0], [1, 1, 2.0]])
    refs = [PositionRef(f"P{i}") for i in range(5)]
    distances = tuple(Distance(f"{i}{j}", refs[i], refs[j], float(np.linalg.norm(x[i] - x[j])), 1e-3)
                      for i in range(5) for j in range(i))  # fmt: skip
    survey = Survey(points=tuple(Point(f"P{i}") for i in range(5)), distances=distances, datum=Datum("inner"),
                    surfaces=(Surface("floor", "plane"),),
                    on_surfaces=tuple(OnSurface("floor", r, 1e-3) for r in refs[:4]))  # fmt: skip
    start = StartValues({}, {}, {f"P{i}": v for i, v in enumerate(x)})
    result = adjust(survey, start)
    assert (result.datum_defect, result.redundancy) == (6, 10 + 4 - 18 + 6)
    with pytest.raises(IndeterminateError, match=r"position along world x, y, z and the rotation about world x, y, z"):
        adjust(replace(survey, datum=Datum()), start)


def test_beam_that_one_spot_cannot_tell_is_named() -> None:
    station = Station("head", world_from_station=PoseParameter(Pose3(), "held"))
    board = Target("board", ("o",), np.zeros((1, 3)), carrier_from_target=PoseParameter(
        Pose3(Rot3(), np.array([0.0, 0.0, 0.5])), "held"))  # fmt: skip
    spot = LaserSpot("s", "laser", "e", "board", np.array([0.1, 0.2]), 1e-8 * np.eye(2))
    survey = Survey(stations=(station,), targets=(board,), beams=(Beam("laser", "station", "head"),),
                    laser_spots=(spot,))  # fmt: skip
    with pytest.raises(IndeterminateError, match=r"laser beam laser \(offset_1, slope_1\)"):
        adjust(survey)


def test_free_vertical_turns_with_the_survey() -> None:
    """Nothing but levels sees the vertical: two rotations of the whole survey are open, and it turns along."""
    survey = levelled(0.0, 0.0)
    survey = replace(survey, vertical=Vertical(tilt=VectorParameter(TILT, np.zeros(2), free=TILT)))
    with pytest.raises(IndeterminateError, match="rotation about world x, y of the whole survey"):
        adjust(survey, StartValues({}, {("world_from_station", "stage"): Pose3()}, {}))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"levels": (Level("up", FrameRef("station", "stage"), np.array([0.0, 0.0, 1.0]), 0.0, 1e-4),)},
         r"level 'up': the axis of station:stage starts 90 deg .* name the axis along which it was laid"),
        ({"alignments": (Alignment("a", FrameRef("station", "stage"), np.array([1.0, 0, 0]), FrameRef("world"),
                                   np.array([-1.0, 0, 0]), np.zeros(2), np.eye(2)),)},
         r"alignment 'a': the axes of station:stage and world start 180 deg apart; correct an axis"),
        ({"laser_spots": (LaserSpot("s", "gone", "e", "board", np.zeros(2), np.eye(2)),)},
         r"beam 'gone' is observed but not part of the survey"),
        ({"on_surfaces": (OnSurface("gone", PositionRef(frame=FrameRef("station", "stage")), 1e-3),)},
         r"surface 'gone' is observed but not part of the survey"),
    ],
)  # fmt: skip
def test_errors_name_the_observation(change: dict, message: str) -> None:
    survey = replace(levelled(0.0, 0.0), **change)
    with pytest.raises(SurveyError, match=message):
        adjust(survey, StartValues({}, {("world_from_station", "stage"): Pose3()}, {}))


@pytest.mark.parametrize(
    ("kind", "x", "message"),
    [
        ("plane", np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3.0, 0, 0]]), "3 that are apart and not in a row"),
        ("line", np.zeros((3, 3)), "observe 2 that are apart"),
        ("sphere", np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1.0, 1, 0]]), "four that are not in a plane"),
    ],
)
def test_surfaces_that_their_positions_do_not_show(kind: str, x: FloatArray, message: str) -> None:
    with pytest.raises(SurveyError, match=f"surface 's': .*{message}"):
        adjust(measured(x, kind))


def test_offset_from_a_plane_needs_its_side() -> None:
    survey = measured(cloud("plane", 9), "plane")
    on = (replace(survey.on_surfaces[0], offset=0.01), *survey.on_surfaces[1:])
    with pytest.raises(SurveyError, match="on which side is not known; give its normal"):
        adjust(replace(survey, on_surfaces=on))
