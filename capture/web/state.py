"""What the page shows: from the files of a project while a session works on it, or live from cameras and table."""

import threading
import time
from contextlib import suppress
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from adjust.model.errors import SurveyError
from capture.devices.turntables.moving import MovingTable
from capture.plan.plan import CapturePlan
from capture.plan.table import make_table
from capture.session.cameras import PlannedCameras
from capture.session.folder import session_lock
from capture.session.quality_thread import Judge
from capture.session.resume import last_readback
from capture.session.table_jobs import jog_target, table_status
from survey.workbench.pages.capturing import FolderView, Shown, coverage_dict

_LIVE_S = 0.3


class View(Protocol):
    """What the server asks for."""

    def status(self) -> dict[str, Any]:
        """Progress, quality and coverage as plain values; ``shown``: of every camera's last image size and points."""
        ...

    def shown(self, camera_id: str) -> Shown | None:
        """The last image of a camera; None where there is none yet."""
        ...

    def jog(self, words: list[str]) -> None:
        """Turn the table, as ``labcapture table --jog``."""
        ...

    def stop(self) -> None:
        """Stop the table."""
        ...

    def close(self) -> None:
        """Let go of everything."""
        ...


class SessionView(FolderView):
    """Read-only: all from the files that a session writes."""

    def __init__(self, plan: CapturePlan) -> None:
        super().__init__(plan.project, [camera.camera_id for camera in plan.cameras], len(plan.shots))

    def jog(self, words: list[str]) -> None:
        """See ``View``."""
        raise SurveyError("the page shows a project only; start it with --live --allow-move to turn the table")

    def stop(self) -> None:
        """See ``View``."""
        raise SurveyError("the page only shows a project; stop its session with Ctrl-C or labcapture table PLAN --stop")

    def close(self) -> None:
        """See ``View``."""


class LiveView:
    """Cameras, and the table where moving is allowed, held by this process; the project's lock keeps sessions away."""

    def __init__(self, plan: CapturePlan, with_table: bool) -> None:
        self._plan, self._judge = plan, Judge(plan)
        self._shown: dict[str, Shown] = {}
        self._quality: dict[str, Any] = {}
        self._message, self._ending = "", threading.Event()
        self._lock = session_lock(plan.project)
        self._lock.acquire()
        self._table: MovingTable | None = None
        trigger = "free" if plan.options.trigger == "hardware" else plan.options.trigger
        self._cameras = PlannedCameras(plan.cameras, trigger)
        try:
            if with_table and plan.table is not None:
                self._table = make_table(plan.table, last_readback(plan.project))
                self._table.open()
            self._cameras.open()
        except BaseException:
            self.close()
            raise
        self._worker = threading.Thread(target=self._look, name="live images", daemon=True)
        self._worker.start()

    def _look(self) -> None:
        while not self._ending.wait(_LIVE_S):
            try:
                for camera_id, frame in self._cameras.take(self._plan.options.fetch_timeout_s).items():
                    self._quality[camera_id], points = self._judge(camera_id, frame)
                    self._shown[camera_id] = Shown(frame.image, np.concatenate([np.zeros((0, 2)), *points.values()]))
                self._message = ""
            except SurveyError as error:
                self._message = str(error)
                with suppress(SurveyError):
                    self._cameras.recover(reopen=True)
                self._ending.wait(1.0)

    def status(self) -> dict[str, Any]:
        """See ``View``."""
        table: dict[str, Any] | None = None
        if self._table is not None:
            try:
                table = table_status(self._table, self._plan)
            except SurveyError as error:
                self._message = str(error)
        return {
            "state": "live",
            "message": self._message,
            "live": True,
            "cameras": [camera.camera_id for camera in self._plan.cameras],
            "quality": dict(self._quality),
            "coverage": coverage_dict(dict(self._judge.coverage)),
            "table": table,
            "time": time.monotonic(),
            "shown": {name: shown.as_dict() for name, shown in dict(self._shown).items()},
        }

    def shown(self, camera_id: str) -> Shown | None:
        """See ``View``."""
        return self._shown.get(camera_id)

    def jog(self, words: list[str]) -> None:
        """See ``View``; returns when the move has begun."""
        if self._table is None:
            raise SurveyError("no table is held; start the page with --live --allow-move and a plan that has one")
        self._table.set(jog_target(self._table, words))

    def stop(self) -> None:
        """See ``View``."""
        if self._table is not None:
            self._table.stop()

    def close(self) -> None:
        """See ``View``."""
        self._ending.set()
        if hasattr(self, "_worker"):
            self._worker.join(10.0)
        self._cameras.close()
        if self._table is not None:
            self._table.close()
        self._lock.release()


def png_of(image: npt.NDArray[np.generic], longest_px: int | None) -> bytes:
    """The image in 8 bit, made smaller where it has more than ``longest_px``."""
    deep = image.dtype != np.uint8
    gray = np.clip(image.astype(float) / max(float(np.max(image)), 1.0) * 255.0, 0, 255) if deep else image
    factor = min(1.0, (longest_px or max(image.shape)) / max(image.shape))
    size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
    small = cv2.resize(gray.astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".png", small, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise ValueError("no PNG")
    return data.tobytes()
