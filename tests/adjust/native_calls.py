"""Calls of the compiled core as surveys, navigation, detection and rendering make them, kept to be made again."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy import sparse

from adjust.adjustment import adjust
from adjust.graph.pair_normals import PairNormals
from adjust.model.survey import PoseParameter
from adjust.native import (
    bundles,
    elimination,
    images,
    lenses,
    loops,
    navigation,
    pairs,
    point_tests,
    reduction,
    text,
    trees,
    views,
    vision,
)
from adjust.native.library import Function
from adjust.navigation import navigate
from adjust.precision.precision import Precision
from adjust.relay.loops import loop_basis
from adjust.relay.network import topology
from adjust.start import find_start
from adjust.statistics.condensed import condensed_system
from survey.detection import SpotOptions, detect_image, detect_spots
from survey.detection.corners import grown
from survey.project.targets import Checkerboard
from survey.simulate import head_on_table
from survey.simulate.rendering import Beacons, BrownCamera, PlacedTarget, render
from tests.adjust import helpers as h
from tests.adjust import pose_networks
from tests.adjust.lenses import IMAGE_SIZE, NAMES, lens, points_in_camera
from tests.adjust.navigation import (
    Sight,
    mfns_head,
    printed_beacons,
    scattered_beacons,
    simulated,
    turned,
    wide_head,
)
from tests.adjust.pose_networks import solve_network
from tests.adjust.terrestrial_networks import measured, polar_network
from tests.adjust.test_image_reduction import near, warped_stereo

_MODULES = (
    lenses, images, trees, reduction, bundles, navigation, views, vision, loops, pairs, elimination, point_tests, text,
)  # fmt: skip
FUNCTIONS = {f.name: f for module in _MODULES for f in vars(module).values() if isinstance(f, Function)}
"""All functions of the core that have a face in Python."""
_KEPT = 2
_LARGEST = 20_000_000  # bytes of arguments


@dataclass(frozen=True)
class Call:
    """A function and what it was given, arrays as they were before."""

    function: Function
    arguments: tuple[Any, ...]

    def again(self, instructions: str | None = None) -> tuple[int, list[np.ndarray]]:
        """Its answer, and the arrays after the call, with these vector instructions."""
        arguments = [a.copy() if isinstance(a, np.ndarray) else a for a in self.arguments]
        answer = self.function.using(instructions)(*arguments)
        return answer, [a for a in arguments if isinstance(a, np.ndarray)]


@contextmanager
def recorded() -> Iterator[list[Call]]:
    """The first calls of every function, while this lasts."""
    calls: list[Call] = []
    counts: dict[str, int] = {}
    plain = Function.__call__

    def kept(self: Function, *arguments: Any) -> int:
        count = counts.get(self.name, 0)
        if count < _KEPT and sum(a.nbytes for a in arguments if isinstance(a, np.ndarray)) < _LARGEST:
            counts[self.name] = count + 1
            calls.append(Call(self, tuple(a.copy() if isinstance(a, np.ndarray) else a for a in arguments)))
        return plain(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Function, "__call__", kept)
        yield calls


@cache
def calls() -> tuple[Call, ...]:
    """Some calls of every function of the core: all that the functions below make."""
    with recorded() as kept:
        _images()
        _bundles()
        _navigation()
        _pictures()
        _lenses()
        _starts()
    return tuple(kept)


def _images() -> None:
    survey, truth = warped_stereo()
    graph, done = h.solved(survey, near(truth))
    precision = Precision(graph, done)
    points, lambda0 = precision.image_points, np.array([17.0, 19.0])
    n, ptr = len(points.v), survey.image_points.ptr
    point_tests.residual_tests(points)
    point_tests.sums_of_blocks(ptr, points)
    point_tests.farthest_points(ptr, points.v, np.zeros((len(ptr) - 1, 2)))
    point_tests.controlled_directions(points, np.zeros(n, dtype=np.int64))
    point_tests.external_reliability(points, lambda0, np.zeros(n))
    point_tests.point_tests(points, lambda0, tuple(np.zeros((n,) if i < 5 else (n, 2)) for i in range(9)))
    eye, ones = point_tests.SparseRows(np.arange(4), np.arange(3), np.ones(3)), np.ones((3, 2))
    B = point_tests.ColumnsOfRows(np.arange(3), 2 * np.arange(3), ones.ravel())
    point_tests.change_squares(np.array([0, 1, 3]), B, 2, eye, ones[:, 0].copy(), eye, np.ones((3, 8)))
    point_tests.UnitVectors(np.eye(20, 64)[[0, 1, 1, 5, 19]]).parallel(0, 5, 5, 0.9)
    words = text.Words.of(["a", "bc", ""])
    text.number_rows(words, np.array([0, 1, 2]), words, np.array([1, 1, 0]), points.v[:3], [3, 0])
    parts = [(text.WORD, 0), (text.NUMBERS, 2), (text.TEXT, 1)]
    text.record_rows(words, np.array([[1], [2], [0]]), points.v[:3], parts)
    names = list(graph.unknowns.by_name)
    precision.joint([names[0], names[-1]])
    batch = graph.images
    batch.rows(np.array([0]))
    condensed_system(precision)
    batch.local_from_keys(np.array([0]))
    solved = solve_network(pose_networks.simulate(3, 2).network)
    solved.pairs  # noqa: B018  # is computed when asked for
    tree = solved.precision.tree
    tree.among(sparse.csr_array(np.eye(tree.n)[:2]))
    trees.clique_covariance(tree.arrays, tree.cliques.n_front, 0)
    graph = solved.minimum.graph
    normals = PairNormals(graph, [])
    normals.by_rows = True
    found = normals.solution(normals.linearized(graph.prepare(graph.start, True)))
    if found is not None:
        normals.bending.bent(graph.start, found[0], graph.start)
    ring = [(chr(65 + i), chr(65 + (i + step) % 12)) for step in (1, 2) for i in range(0, 12, step)]
    loop_basis(topology([(a + b, a, b) for a, b in ring]))  # triangles, then a loop through the stations of one pair
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    graph, done = h.solved(survey, near(truth))  # nothing to reduce: every block is condensed for itself
    graph.prepare(done.values, jacobians=False)


def _starts() -> None:
    survey, _ = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    find_start(survey)
    adjust(measured(*polar_network(4), 1))


def _bundles() -> None:
    for n_cameras in (2, 1):
        survey, truth = h.network(1, n_cameras=n_cameras)
        if n_cameras == 1:
            camera = survey.cameras[0]
            mount = truth["station_from_camera", camera.camera_id]
            assert isinstance(mount, Pose3)
            survey = replace(survey, cameras=(replace(camera, station_from_camera=PoseParameter(mount, "held")),))
        graph, done = h.solved(survey, h.shaken(h.start_at(truth), 1, 0.003, 0.003))
        precision = Precision(graph, done)
        point_tests.residual_tests(precision.image_points)
        precision.datum_products({key: np.ones((1, u.dim)) for key, u in graph.unknowns.by_key.items()})


def _navigation() -> None:
    place = wide_head(), scattered_beacons(20)
    rng = np.random.default_rng(1)
    for named in (True, False):
        navigate(*place, [simulated(*place, Pose3(), rng, Sight(0.2, named=named))[0]])
    known = mfns_head(), printed_beacons()
    navigate(*known, [simulated(*known, turned(0.0), rng, Sight(1e-6, only=("B9", "B10")))[0]])
    pose = Pose3(Rot3.Rodrigues(np.array([0.3, -0.2, 0.5])), np.array([0.1, 0.2, -0.3])).matrix()
    pose = np.ascontiguousarray(pose)
    rays = np.array([[0.1, 0.2, 1.0], [-0.2, 0.1, 1.0], [0.1, -0.3, 1.0]])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    origins = np.zeros((3, 3))
    x = np.ascontiguousarray((origins + rays * np.array([[1.0], [1.2], [0.9]])) @ pose[:3, :3].T + pose[:3, 3])
    navigation.three_point_poses(origins, rays, x, 0.1, 10.0)


def _pictures() -> None:
    board = Checkerboard(8, 5, 0.02)
    camera = BrownCamera((480, 360), 600.0, 600.0, 239.5, 179.5, (-0.2, 0.05, 1e-3, -5e-4))
    turn = Rot3.Rx(0.3) * Rot3.Ry(0.25) * Rot3.Rz(0.2)
    centre = board.points()[1].mean(0)
    view = PlacedTarget(board, Pose3(turn, np.array([0.005, -0.003, 0.35]) - turn.matrix() @ centre))
    image = render(camera, [view], seed=1)
    found = detect_image(image, board)
    assert len(found) == 40
    assert not len(detect_image(np.full_like(image, 128), board))
    gray, grid = image.astype(np.float32), found.uv.reshape(5, 8, 2)
    assert grown(gray, grid[1:-1, 1:-1], float(np.ptp(gray))).shape == grid.shape
    lights = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 4), np.linspace(-0.15, 0.15, 3), [1.0]), -1).reshape(-1, 3)
    assert len(detect_spots(render(camera, beacons=Beacons(lights, 0.006, 200.0, "disc"), seed=1), SpotOptions())) == 12
    xy = np.random.default_rng(1).uniform(-4.0, 4.0, (50, 2))
    for crossing in (True, False):
        vision.corner_rows(xy, np.array([0.2, -0.1, 0.3, 1.7, 20.0, 80.0, -0.2, 0.1, -0.3]), crossing)
    for profile in (vision.GAUSSIAN, vision.DISC):
        vision.spot_rows(xy, np.array([0.2, -0.3, 10.0, 80.0, 0.4, 0.6, -0.1]), profile)


def _lenses() -> None:
    q = points_in_camera(50)
    uv = np.random.default_rng(1).uniform([0, 0], IMAGE_SIZE, (len(q), 2))
    for name in NAMES:
        model, values, constants = lens(name)
        lenses.lens_rows(model.kind, values, constants, q, uv)
        lenses.lens_residuals(model.kind, values, constants, q, uv)
        given, newton = lenses.Lens(model.kind, values, constants), lenses.Newton(50, 1e-8)
        seen = lenses.image_points_of(given, q, newton, 800.0, uv)[0]
        lenses.rays_of(given, seen, newton, 2.0)
    lenses.radii_of(np.array([1.0, -0.2, 0.01]), np.array([1.0, 0.1]), np.inf, np.linspace(0.0, 0.9, 50))
