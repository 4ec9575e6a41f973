"""The quality of the images just taken, looked at in a thread of its own so that the table need not wait for it.

Every image gives a line of ``capture/quality.jsonl``: for the web page, and for the coverage after a restart. The file
is no record: what a crash takes of it is only not shown.
"""

import json
import math
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Self

import numpy as np

from adjust.model.survey import FloatArray
from capture.devices.camera import Frame
from capture.plan.plan import CapturePlan
from capture.plan.poses import definition_of
from capture.session.quality import image_quality
from survey.project.captured import Coverage, quality_path
from survey.project.captured import Qualities as SeenBefore
from survey.project.targets import PointList

Qualities = Mapping[str, Mapping[str, Any]]
_BEHIND = 4  # epochs that may wait; more, and the session waits for the oldest


class Judge:
    """What is to be said of images as they come. coverage: by camera, of all that were looked at."""

    def __init__(self, plan: CapturePlan, coverage: dict[str, Coverage] | None = None) -> None:
        self.coverage = coverage or {}
        definition = None if plan.survey is None else definition_of(plan.survey)
        self._kinds = {} if definition is None else definition.target_kinds
        self._only = {} if definition is None else definition.target_cameras

    def __call__(self, camera_id: str, frame: Frame) -> tuple[dict[str, Any], dict[str, FloatArray]]:
        """The quality of an image of a camera as plain values, and the points (n, 2) px in it by target."""
        targets = {name: kind for name, kind in self._kinds.items()
                   if not isinstance(kind, PointList) and camera_id in self._only.get(name, (camera_id,))}  # fmt: skip
        found = image_quality(frame, targets)
        height, width = frame.image.shape
        covered = self.coverage.get(camera_id, Coverage((width, height)))
        self.coverage[camera_id] = covered.with_points(np.concatenate([np.zeros((0, 2)), *found.points.values()]))
        return {
            "width": width, "height": height, "brightness": round(found.brightness, 4), "peak": round(found.peak, 4),
            "saturated": round(found.saturated, 6),
            "blur_px": None if math.isnan(found.blur_px) else round(found.blur_px, 3),
            "targets": {name: len(uv) for name, uv in found.points.items()},
            "coverage": round(self.coverage[camera_id].share, 4),
        }, dict(found.points)  # fmt: skip


class QualityWatch:
    """Looks at epochs one after the other; calling it hands over one and tells of the last that is done."""

    def __init__(self, plan: CapturePlan) -> None:
        self._path, before = quality_path(plan.project), SeenBefore(plan.project)
        before.read()
        self._look = Judge(plan, before.coverage)
        self._pool = ThreadPoolExecutor(1, "image quality")
        self._waiting: deque[Future[Qualities]] = deque()
        self._last: Qualities = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
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
        quality, points = self._look(camera_id, frame)
        row = {"epoch_id": epoch_id, "camera_id": camera_id, **quality}
        told = {key: value for key, value in row.items() if key not in ("targets", "coverage")}
        told["points"] = {name: np.round(uv, 1).tolist() for name, uv in points.items()}
        with suppress(OSError), self._path.open("a", encoding="utf-8") as stream:  # a full disk does not matter here
            stream.write(json.dumps(told) + "\n")
        return row


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
