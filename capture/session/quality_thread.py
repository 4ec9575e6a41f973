"""The quality of the images just taken, looked at in a thread of its own so that the table need not wait for it.

Every image gives a line of ``capture/quality.jsonl``: for the web page, and for the coverage after a restart. The file
is no record: what a crash takes of it is only not shown.
"""

import json
import math
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

import numpy as np

from capture.devices.camera import Frame
from capture.plan.plan import CapturePlan
from capture.plan.poses import definition_of
from capture.session.quality import image_quality
from survey.project.captured import Coverage, quality_path
from survey.project.captured import Qualities as SeenBefore
from survey.project.targets import DetectableTarget, PointList

Qualities = Mapping[str, Mapping[str, Any]]


_BEHIND = 4  # epochs that may wait; more, and the session waits for the oldest


def targets_by_camera(plan: CapturePlan) -> Callable[[str], Mapping[str, DetectableTarget]]:
    """What may be seen in a camera's images, by the plan's survey; nothing without one."""
    if plan.survey is None:
        return lambda camera_id: {}
    definition = definition_of(plan.survey)
    kinds = {name: kind for name, kind in definition.target_kinds.items() if not isinstance(kind, PointList)}
    only = definition.target_cameras

    def targets(camera_id: str) -> Mapping[str, DetectableTarget]:
        return {name: kind for name, kind in kinds.items() if camera_id in only.get(name, (camera_id,))}

    return targets


class QualityWatch:
    """Looks at epochs one after the other; calling it hands over one and tells of the last that is done."""

    def __init__(self, plan: CapturePlan) -> None:
        self._path = quality_path(plan.project)
        self._targets = targets_by_camera(plan)
        before = SeenBefore(plan.project)
        before.read()
        self._coverage = before.coverage
        self._pool = ThreadPoolExecutor(1, "image quality")
        self._waiting: deque[Future[Qualities]] = deque()
        self._last: Qualities = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown()

    def __call__(self, epoch_id: str, frames: Mapping[str, Frame]) -> Qualities:
        """Hand over the frames of an epoch; the qualities of the last one that is done."""
        self._waiting.append(self._pool.submit(self._judge, epoch_id, dict(frames)))
        while self._waiting and (self._waiting[0].done() or len(self._waiting) > _BEHIND):
            self._last = self._waiting.popleft().result()
        return self._last

    def finish(self) -> Qualities:
        """Wait for all; the qualities of the last epoch."""
        while self._waiting:
            self._last = self._waiting.popleft().result()
        return self._last

    def _judge(self, epoch_id: str, frames: Mapping[str, Frame]) -> Qualities:
        return {camera_id: self._judge_one(epoch_id, camera_id, frame) for camera_id, frame in frames.items()}

    def _judge_one(self, epoch_id: str, camera_id: str, frame: Frame) -> dict[str, Any]:
        found = image_quality(frame, self._targets(camera_id))
        height, width = frame.image.shape
        row = {
            "epoch_id": epoch_id,
            "camera_id": camera_id,
            "width": width,
            "height": height,
            "brightness": round(found.brightness, 4),
            "peak": round(found.peak, 4),
            "saturated": round(found.saturated, 6),
            "blur_px": None if math.isnan(found.blur_px) else round(found.blur_px, 3),
        }
        points = {name: np.round(uv, 1).tolist() for name, uv in found.points.items()}
        covered = self._coverage.get(camera_id, Coverage((width, height)))
        for uv in found.points.values():
            covered = covered.with_points(uv)
        self._coverage[camera_id] = covered
        with suppress(OSError), self._path.open("a", encoding="utf-8") as stream:  # a full disk does not matter here
            stream.write(json.dumps({**row, "points": points}) + "\n")
        counts = {name: len(uv) for name, uv in found.points.items()}
        return {**row, "targets": counts, "coverage": round(covered.share, 4)}


def quality_text(qualities: Qualities) -> str:
    """``t07 X blur 0.8 px, board, 62 % covered; Y ...``."""
    parts = []
    for camera_id, row in qualities.items():
        words = [f"blur {row['blur_px']:.1f} px"] if row["blur_px"] is not None else ["no edges"]
        words += [f"{100 * row['saturated']:.1f} % SATURATED"] if row["saturated"] > 0.001 else []
        if row["targets"]:
            words += [" ".join(name for name, n in row["targets"].items() if n) or "NO TARGET"]
            words += [f"{100 * row['coverage']:.0f} % covered"]
        parts.append(f"{camera_id} {', '.join(words)}")
    first = next(iter(qualities.values()), None)
    return f"{first['epoch_id']} {'; '.join(parts)}" if first else ""
