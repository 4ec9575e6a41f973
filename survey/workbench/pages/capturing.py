"""A capture session by the files that it writes, for a page that watches it."""

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.folder.locking import SESSION_LOCK, holder_of
from survey.project.captured import Coverage, Qualities, is_id, points_of, session_status
from survey.project.project import IMAGES_FOLDER
from survey.report.language import message
from survey.workbench.pictures import is_plain, picture

if TYPE_CHECKING:
    from survey.detection.gray import AnyImage


def coverage_dict(found: Mapping[str, Coverage]) -> dict[str, Any]:
    """As a page draws it."""
    return {
        name: {"cells": list(c.cells), "hit": sorted(map(list, c.hit)), "share": round(c.share, 4)}
        for name, c in found.items()
    }


@frozen(eq=False)
class Shown:
    """An image and the target points (n, 2) px in it."""

    image: "AnyImage"
    points: FloatArray

    def as_dict(self) -> dict[str, Any]:
        """Size (px) and points for the page, which draws them over the image."""
        return {"size": [self.image.shape[1], self.image.shape[0]], "points": np.round(self.points, 2).tolist()}


class FolderView:
    """A session by the files that it writes; may be asked from any thread. Nothing is written.

    cameras: those that take images, none: those that have. total: how many epochs are planned, where the session has
    not said so yet.
    """

    def __init__(self, folder: Path, cameras: Sequence[str] = (), total: int = 0) -> None:
        self._folder, self._cameras, self._total = folder, list(cameras), total
        self._qualities, self._reading = Qualities(folder), threading.Lock()
        self._last: dict[str, tuple[tuple[str, int], AnyImage]] = {}  # by camera, of which epoch and file

    def status(self) -> dict[str, Any]:
        """Progress, quality and coverage as plain values; ``shown``: of every camera's last image size and points."""
        told = session_status(self._folder)
        running = holder_of(self._folder / SESSION_LOCK)
        if running is None and told.get("state") in ("running", "paused"):
            ended = message("the session's process has ended; start it again to go on")
            told |= {"state": "broken off", "message": ended}
        with self._reading:
            self._qualities.read()
            cameras = self._cameras or list(dict.fromkeys([*told.get("images", ()), *self._qualities.coverage]))
            coverage = coverage_dict(self._qualities.coverage)
        shown = {name: s.as_dict() for name in cameras if (s := self._shown(name, told.get("epoch_id"))) is not None}
        return {"state": "not started", "total": self._total, "done": 0, **told, "live": False, "cameras": cameras,
                "coverage": coverage, "shown": shown}  # fmt: skip

    def shown(self, camera_id: str) -> Shown | None:
        """The last image of a camera; None where there is none yet."""
        with self._reading:
            self._qualities.read()
        return self._shown(camera_id, session_status(self._folder).get("epoch_id"))

    def picture(self, camera_id: str, size: int | None) -> tuple[bytes, str]:
        """The last image of a camera as :func:`survey.workbench.pictures.picture`. Raises SurveyError."""
        epoch_id = session_status(self._folder).get("epoch_id")
        path = self._path(camera_id, epoch_id)
        if path is None or not path.is_file():
            raise SurveyError(f"camera {camera_id}: no image yet")
        return picture({(camera_id, str(epoch_id)): path}, (camera_id, str(epoch_id)), size)

    def _path(self, camera_id: str, epoch_id: object) -> Path | None:
        known = not self._cameras or camera_id in self._cameras
        if epoch_id is None or not known or not is_id(camera_id):
            return None
        return self._folder / IMAGES_FOLDER / camera_id / f"{epoch_id}.png"

    def _shown(self, camera_id: str, epoch_id: object) -> Shown | None:
        """An image is read once; what is seen in it may be known later."""
        from survey.detection.gray import read_image

        path = self._path(camera_id, epoch_id)
        try:
            if path is None or not is_plain(path):
                return None
            key = str(epoch_id), path.stat().st_mtime_ns
            known = self._last.get(camera_id)
            image = known[1] if known is not None and known[0] == key else read_image(path)
        except (SurveyError, OSError):
            return None
        if image.ndim != 2:
            return None
        self._last[camera_id] = key, image
        row = self._qualities.rows.get((camera_id, str(epoch_id)))
        return Shown(image, np.zeros((0, 2)) if row is None else points_of(row))
