"""Targets as planes of grey cells in front of a camera.

The square of a checkerboard between r0c0, r0c1, r1c1 and r1c0 is dark, as is the outer one at r0c0; boards have one row
of squares outside the inner corners and a bright margin. Targets show a plain back.
"""

from dataclasses import field

import numpy as np
from gtsam import Pose3

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.project.dictionaries import charuco_board, marker_cells
from survey.project.targets import Charuco, Checkerboard, DetectableTarget, MarkerBlock, MarkerGrid


@frozen(eq=False)
class PlacedTarget:
    """A target in front of the camera, with the grey values of its ink and its paper."""

    target: DetectableTarget
    camera_from_target: Pose3
    dark_gray: float = 30.0
    bright_gray: float = 220.0


@frozen(eq=False)
class Facet:
    """A plane of grey cells: ``camera_from_facet`` columns are x, y axes and origin; z = x cross y is its back."""

    camera_from_facet: FloatArray
    x_edges: FloatArray
    y_edges: FloatArray
    cells: FloatArray

    def bounds(self) -> FloatArray:
        """Bounding box (4,) of the facet in x/z, y/z: x from, x to, y from, y to."""
        a, b = self.x_edges[[0, -1, 0, -1]], self.y_edges[[0, 0, -1, -1]]
        x = self.camera_from_facet @ np.stack([a, b, np.ones(4)])
        if x[2].max() <= 0.0:
            return np.array([np.inf, -np.inf, np.inf, -np.inf])
        if x[2].min() <= 0.0:
            return np.array([-np.inf, np.inf, -np.inf, np.inf])
        p = x[:2] / x[2]
        return np.array([p[0].min(), p[0].max(), p[1].min(), p[1].max()])

    def hides(self, x_in_camera: FloatArray) -> bool:
        """Whether the facet lies between the camera and the point."""
        q = np.linalg.solve(self.camera_from_facet, x_in_camera)
        if q[2] <= 1.0:  # q[2] is the depth of the point over that of the facet
            return False
        a, b = q[0] / q[2], q[1] / q[2]
        return bool(self.x_edges[0] <= a <= self.x_edges[-1] and self.y_edges[0] <= b <= self.y_edges[-1])


@frozen(eq=False)
class _Patch:
    """Cells (rows, columns), 0 dark and 1 bright, over a rectangle of a plane: origin and width of one cell, in m."""

    x0: float
    y0: float
    x_step: float
    y_step: float
    cells: FloatArray = field(default_factory=lambda: np.ones((1, 1)))

    def x_edges(self) -> FloatArray:
        return self.x0 + self.x_step * np.arange(self.cells.shape[1] + 1)

    def y_edges(self) -> FloatArray:
        return self.y0 + self.y_step * np.arange(self.cells.shape[0] + 1)


def facets_of(placed: PlacedTarget) -> list[Facet]:
    """The planes that a target shows."""
    pose, target = placed.camera_from_target, placed.target
    if not isinstance(target, MarkerBlock):
        axes = np.column_stack([pose.rotation().matrix()[:, :2], pose.translation()])
        return [_facet(placed, axes, _board_patches(target))]
    facets = []
    for marker, corners in sorted(target.corners.items()):
        cells = marker_cells(target.dictionary, marker)
        n = len(cells)
        c = pose.transformFrom(np.ascontiguousarray(np.asarray(corners, float).T)).T
        axes = np.column_stack([c[1] - c[0], c[3] - c[0], c[0]])
        quiet = _Patch(-1.0 / n, -1.0 / n, 1.0 + 2.0 / n, 1.0 + 2.0 / n)
        facets.append(_facet(placed, axes, [quiet, _Patch(0.0, 0.0, 1.0 / n, 1.0 / n, cells)]))
    return facets


def _facet(placed: PlacedTarget, axes: FloatArray, patches: list[_Patch]) -> Facet:
    """One plane of cells from patches, the later ones on top; its back is plain."""
    x_edges, y_edges = _union([p.x_edges() for p in patches]), _union([p.y_edges() for p in patches])
    x, y = (x_edges[1:] + x_edges[:-1]) / 2, (y_edges[1:] + y_edges[:-1]) / 2
    cells = np.ones((len(y), len(x)))
    for p in patches:
        i, j = np.searchsorted(p.x_edges(), x) - 1, np.searchsorted(p.y_edges(), y) - 1
        inside_x, inside_y = (i >= 0) & (i < p.cells.shape[1]), (j >= 0) & (j < p.cells.shape[0])
        cells[np.ix_(inside_y, inside_x)] = p.cells[np.ix_(j[inside_y], i[inside_x])]
    if np.linalg.det(axes) < 0.0:
        cells[:] = 0.5
    gray = placed.dark_gray + (placed.bright_gray - placed.dark_gray) * cells
    return Facet(axes, x_edges, y_edges, gray)


def _union(edges: list[FloatArray]) -> FloatArray:
    """All edges in order; those that differ by rounding alone are one."""
    merged = np.sort(np.concatenate(edges))
    keep = np.concatenate([[True], np.diff(merged) > 1e-9 * (merged[-1] - merged[0])])
    return np.asarray(merged[keep], float)


def _board_patches(target: Checkerboard | Charuco | MarkerGrid) -> list[_Patch]:
    if isinstance(target, Checkerboard):
        s = target.square_m
        j, i = np.mgrid[-1 : target.rows, -1 : target.columns]
        margin = _Patch(-2.0 * s, -2.0 * s, (target.columns + 3) * s, (target.rows + 3) * s)
        return [margin, _Patch(-s, -s, s, s, ((i + j) % 2).astype(float))]
    if isinstance(target, Charuco):
        return _charuco_patches(target)
    step, m = target.marker_m + target.gap_m, target.marker_m
    edge = max(target.gap_m, m / 4.0)
    more = 2 * edge - target.gap_m
    patches = [_Patch(-edge, -edge, target.columns * step + more, target.rows * step + more)]
    for k in range(target.rows * target.columns):
        cells = marker_cells(target.dictionary, target.first_id + k)
        row, column = divmod(k, target.columns)
        patches.append(_Patch(column * step, row * step, m / len(cells), m / len(cells), cells))
    return patches


def _charuco_patches(target: Charuco) -> list[_Patch]:
    """The board as OpenCV lays it out; a square that holds a marker is bright."""
    board, s = charuco_board(target), target.square_m
    squares = np.zeros((target.squares_y, target.squares_x))
    markers = []
    for marker, corners in zip(np.ravel(board.getIds()), board.getObjPoints(), strict=True):
        x, y = np.asarray(corners, float).reshape(4, 3)[0, :2]
        squares[int(y / s), int(x / s)] = 1.0
        cells = marker_cells(target.dictionary, int(marker))
        step = target.marker_m / len(cells)
        markers.append(_Patch(x - s, y - s, step, step, cells))
    margin = _Patch(-1.5 * s, -1.5 * s, (target.squares_x + 1.0) * s, (target.squares_y + 1.0) * s)
    return [margin, _Patch(-s, -s, s, s, squares), *markers]
