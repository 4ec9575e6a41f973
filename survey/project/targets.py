"""Targets that a program can find in an image, and the coordinates of their points.

Every kind gives ``point_ids`` and ``x_in_target`` (n, 3) m, in the order of ``adjust.model.survey.Target``.
Ids: ``r2c5`` (row, column) for corners of boards, ``m17.3`` (marker id, corner) for marker corners; corner 0 is the
upper left one of the upright marker, clockwise, as in OpenCV.
"""

from functools import lru_cache

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray


@lru_cache
def _places(columns: int, rows: int, spacing_m: float) -> tuple[tuple[str, ...], FloatArray]:
    ids = tuple(f"r{row}c{column}" for row in range(rows) for column in range(columns))
    x = np.array([(column * spacing_m, row * spacing_m, 0.0) for row in range(rows) for column in range(columns)])
    return ids, x


def _grid(columns: int, rows: int, spacing_m: float) -> tuple[tuple[str, ...], FloatArray]:
    ids, x = _places(columns, rows, spacing_m)
    return ids, x.copy()


@frozen
class Checkerboard:
    """``columns`` x ``rows`` inner corners, ``square_m`` apart; corner r0c0 is the origin, x along the columns."""

    columns: int
    rows: int
    square_m: float

    def points(self) -> tuple[tuple[str, ...], FloatArray]:
        """Ids and coordinates of the inner corners, row by row."""
        return _grid(self.columns, self.rows, self.square_m)

    def turns(self) -> tuple[IntArray, ...]:
        """Turns after which the board looks the same, colours included: where each point (n,) comes to lie; often none.

        Half a turn takes the colours of the squares to themselves where the numbers of inner corners are both even or
        both odd, a quarter turn where they are equal and even.
        """
        place = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        if (self.columns + self.rows) % 2:
            return ()
        steps = (2, 1, 3) if self.columns == self.rows and self.rows % 2 == 0 else (2,)
        return tuple(np.rot90(place, step).ravel() for step in steps)


@frozen
class Charuco:
    """OpenCV's ChArUco board of ``squares_x`` x ``squares_y`` squares; r0c0 is its inner corner 0.

    The target's origin is that corner 0, x along its row: the inner corners are (columns - 1) x (rows - 1).
    """

    squares_x: int
    squares_y: int
    square_m: float
    marker_m: float
    dictionary: str
    legacy: bool = False

    def points(self) -> tuple[tuple[str, ...], FloatArray]:
        """Ids and coordinates of the inner corners, row by row."""
        return _grid(self.squares_x - 1, self.squares_y - 1, self.square_m)


@frozen
class MarkerGrid:
    """ArUco or AprilTag markers in ``columns`` x ``rows``, ids row by row from ``first_id``, as OpenCV's GridBoard."""

    columns: int
    rows: int
    marker_m: float
    gap_m: float
    dictionary: str
    first_id: int = 0

    def points(self) -> tuple[tuple[str, ...], FloatArray]:
        """Ids and coordinates of all marker corners; the origin is corner 0 of the first marker."""
        ids, xs = [], []
        step = self.marker_m + self.gap_m
        for row in range(self.rows):
            for column in range(self.columns):
                marker = self.first_id + row * self.columns + column
                for corner, (dx, dy) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
                    ids.append(f"m{marker}.{corner}")
                    xs.append((column * step + dx * self.marker_m, row * step + dy * self.marker_m, 0.0))
        return tuple(ids), np.array(xs)


@frozen(eq=False)
class MarkerBlock:
    """Markers anywhere on a rigid body: ``corners`` gives each marker's four corners, (4, 3) m."""

    corners: dict[int, FloatArray]
    dictionary: str

    def points(self) -> tuple[tuple[str, ...], FloatArray]:
        """Ids and coordinates of all marker corners, in ascending marker id."""
        markers = sorted(self.corners)
        ids = tuple(f"m{marker}.{corner}" for marker in markers for corner in range(4))
        return ids, np.concatenate([self.corners[marker] for marker in markers])


@frozen(eq=False)
class PointList:
    """Points that no program finds by itself; their image points come from a file."""

    point_ids: tuple[str, ...]
    x_in_target: FloatArray

    def points(self) -> tuple[tuple[str, ...], FloatArray]:
        """Ids and coordinates as given."""
        return self.point_ids, self.x_in_target


Board = Checkerboard | Charuco | MarkerGrid
BOARDS: dict[str, type[Board]] = {"checkerboard": Checkerboard, "charuco": Charuco, "marker_grid": MarkerGrid}
DetectableTarget = Board | MarkerBlock
TargetKind = DetectableTarget | PointList
