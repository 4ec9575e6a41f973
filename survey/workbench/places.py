"""Where in the world the ends of observations are, adjusted or planned."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.observations import FrameRef, PositionRef
from adjust.model.survey import FloatArray, Point
from survey.solution.frames import AdjustedFrames


def refs_of(item: object) -> list[FrameRef | PositionRef]:
    """The frames and positions that a reading is about."""
    values = (getattr(item, name, None) for name in ("positions", "at", "to", "a", "b", "second", "position", "frame"))
    return [one for value in values for one in (value if isinstance(value, tuple) else (value,)) if one is not None]


def _lines(item: Any) -> list[tuple[FrameRef | PositionRef, ...]]:
    """Between what a reading was taken: differences of coordinates in pairs, others from the first to all others."""
    if isinstance(getattr(item, "at", None), tuple):
        return list(zip(item.at, item.to, strict=True))
    refs = refs_of(item)
    if len(refs) < 2 or hasattr(item, "positions"):
        return [(ref,) for ref in refs]
    return [(refs[0], ref) for ref in refs[1:]]


class Places:
    """Where in the world (m) a reference of a reading is; None where the solution does not tell."""

    def __init__(self, frames: AdjustedFrames, points: Iterable[Point]) -> None:
        self.frames = frames
        self.points = {p.point_id: p for p in points}

    def lines(self, item: Any) -> list[list[FloatArray]]:
        """Between what an observation was taken, those with all ends: two each, one where it is of a single place."""
        ends = [[self.of(ref) for ref in line] for line in _lines(item)]
        return [[x for x in line if x is not None] for line in ends if all(x is not None for x in line)]

    def point(self, point_id: str) -> FloatArray | None:
        """An adjusted point, or the value at which it is held."""
        found = self.frames.estimates.get(("point", point_id))
        value = found.value if found is not None else \
            self.points[point_id].x_in_world.value if point_id in self.points else None  # fmt: skip
        return None if value is None or isinstance(value, Pose3) else np.asarray(value, dtype=float)

    def of(self, ref: FrameRef | PositionRef) -> FloatArray | None:
        """Of the origin of a frame, of a point, or of a point of a target."""
        frame = ref if isinstance(ref, FrameRef) else ref.frame
        point_id = None if isinstance(ref, FrameRef) else ref.point_id
        if frame is None:
            return self.point(point_id or "")
        pose = self.frames.world_from(frame)
        target = self.frames.targets.get(frame.frame_id) if frame.kind == "target" else None
        if pose is None or (point_id is not None and (target is None or point_id not in target.point_ids)):
            return None
        if target is not None and point_id is not None:
            return np.asarray(pose.transformFrom(target.x_in_target[target.point_ids.index(point_id)]))
        return np.asarray(pose.translation())
