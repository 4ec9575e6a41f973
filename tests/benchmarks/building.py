"""A building of rooms in a grid, each with stations and points of its own; doors are seen from both their rooms."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from tests.benchmarks.bundle import Bundle
from tests.benchmarks.data import SIZE, matrix, pixels

ROOM = np.array([6.0, 6.0, 3.0])
"""m."""
LENS = np.array([700.0, 699.0, 636.0, 515.0, -0.03, 0.01, -4e-4, 2e-4])
"""Wide: 85 by 72 degrees."""
SIGMA_PX = 0.1
_DOOR = 10


@dataclass(frozen=True)
class Plan:
    """Rooms along x and y, stations (one image each) and points of a room, points of a door."""

    along_x: int
    along_y: int
    stations: int = 100
    points: int = 560
    door: int = _DOOR

    @property
    def rooms(self) -> list[tuple[int, int]]:
        return list(product(range(self.along_x), range(self.along_y)))

    def doors(self) -> list[tuple[tuple[int, int], tuple[int, int]]]:
        """Neighbouring rooms, each pair once."""
        right = [((i, j), (i + 1, j)) for i, j in self.rooms if i + 1 < self.along_x]
        return right + [((i, j), (i, j + 1)) for i, j in self.rooms if j + 1 < self.along_y]


@dataclass(frozen=True, eq=False)
class Building:
    """A plan with its bundle. room: (I,) of each image, in the order of ``plan.rooms``.

    of_point: (P,) the room that alone sees a point, or -1 for the point of a door. truth: (P, 3) m.
    """

    plan: Plan
    bundle: Bundle
    room: IntArray
    of_point: IntArray
    truth: FloatArray


def build(plan: Plan, seed: int = 1) -> Building:
    """Points on the walls, floors and ceilings, images from the middle of the rooms into all directions."""
    rng = np.random.default_rng(seed)
    points, of_point, seen_in = _points(plan, rng)
    poses, rows, room = [], [], []
    for r, (i, j) in enumerate(plan.rooms):
        for _ in range(plan.stations):
            pose, at = _pose(np.array([i, j, 0]) * ROOM, rng), seen_in[r]
            q = (points[at] - pose[:3, 3]) @ pose[:3, :3]
            uv = pixels(q, LENS)
            visible = np.flatnonzero((q[:, 2] > 0.3) & np.all((uv > 0) & (uv < np.array(SIZE)), axis=1))
            rows += [np.column_stack([np.full(len(visible), len(poses)), at[visible], uv[visible]])]
            poses.append(pose)
            room.append(r)
    table = np.concatenate(rows)
    table = table[np.bincount(table[:, 1].astype(int), minlength=len(points))[table[:, 1].astype(int)] >= 4]
    used, point = np.unique(table[:, 1].astype(int), return_inverse=True)
    uv = table[:, 2:] + rng.normal(size=(len(table), 2)) * SIGMA_PX
    start = np.array([p @ matrix(rng.normal(size=3) * 2e-3, rng.normal(size=3) * 3e-3) for p in poses])
    lens = LENS * [1.002, 1.002, 1, 1, 0.9, 0.9, 0, 0] + [0, 0, 2, 2, 0, 0, 0, 0]
    bundle = Bundle(
        uv, table[:, 0].astype(int), point, np.full(uv.shape, SIGMA_PX), lens, start,
        points[used] + rng.normal(size=(len(used), 3)) * 2e-3, used, np.zeros(0), np.array(False), np.array(0.0),
    )  # fmt: skip
    return Building(plan, bundle, np.array(room), of_point[used], points[used])


def _points(plan: Plan, rng: np.random.Generator) -> tuple[FloatArray, IntArray, list[IntArray]]:
    """Points (P, 3) m, the room of each (P,) or -1, and which ones can be seen from each room."""
    points, of_point, seen = [], [], []
    for r, (i, j) in enumerate(plan.rooms):
        x = rng.uniform(0.02, 0.98, (plan.points, 3))
        side = rng.integers(0, 3, plan.points)
        x[np.arange(plan.points), side] = rng.integers(0, 2, plan.points) * 0.98 + 0.01
        points.append((x + [i, j, 0]) * ROOM)
        of_point += [r] * plan.points
        seen.append([np.arange(r * plan.points, (r + 1) * plan.points)])
    number = {room: r for r, room in enumerate(plan.rooms)}
    for a, b in plan.doors():
        middle = (np.array([*a, 0]) + np.array([*b, 0]) + 1) / 2 * ROOM
        spread = np.where(np.array(a) == np.array(b), 0.6, 0.02)  # along the wall, not through it
        first = len(of_point)
        points.append(middle + rng.uniform(-1, 1, (plan.door, 3)) * [*spread, 1.0])
        of_point += [-1] * plan.door
        for room in (a, b):
            seen[number[room]].append(np.arange(first, first + plan.door))
    return np.concatenate(points), np.array(of_point), [np.concatenate(s) for s in seen]


def _pose(corner: FloatArray, rng: np.random.Generator) -> FloatArray:
    """world_from_camera (4, 4) of a station in the middle third of a room, looking about level."""
    place = corner + ROOM * rng.uniform(0.33, 0.67, 3)
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.normal() * 0.35
    z = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, np.cross(z, x), z, place])
    return pose @ matrix(np.array([0, 0, rng.choice([0, np.pi / 2])]), np.zeros(3))
