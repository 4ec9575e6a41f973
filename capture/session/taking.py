"""A capture session: turn the table, take the images of every camera as one set, put them on disk, write it down.

Nothing is lost and nothing is twice: an epoch counts when its journal line is on disk, which comes after its images;
whatever else a crash leaves behind is removed at the next start, and the epoch is taken again.
"""

import errno
import platform
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import field
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from capture.devices.camera import CameraError, DisconnectedError, Frame
from capture.devices.turntable import (
    LimitError,
    StoppedError,
    TableDisconnectedError,
    TurntableError,
    location_dict,
)
from capture.devices.turntables.moving import MovingTable
from capture.plan.plan import CapturePlan, Shot, check_plan_limits
from capture.session.cameras import PlannedCameras
from capture.session.control import AbortedError, Control
from capture.session.folder import journal_path, prepare, remove_unrecorded, write_image, write_table_angles
from capture.session.journal import Journal, Record, clocks
from capture.session.placing import DriftError, Placing
from capture.session.resume import verified_sets

JOURNAL_FORMAT = 1


class SessionStoppedError(SurveyError):
    """The session gave up, or was told to; table stopped, everything recorded so far is on disk."""

    def __init__(self, message: str, interrupted: bool = False) -> None:
        super().__init__(message)
        self.interrupted = interrupted


@frozen
class Taken:
    """An epoch that was just taken, for whoever shows the progress; frames by camera_id."""

    record: Record
    frames: Mapping[str, Frame]
    done: int
    total: int


@frozen
class Outcome:
    """What a session did: epochs planned, taken before and now, retries by kind of fault."""

    folder: Path
    planned: int
    before: int
    taken: int
    retries: Mapping[str, int] = field(default_factory=dict)
    seconds: float = 0.0

    def summary(self) -> dict[str, object]:
        """As plain values."""
        return {
            "folder": str(self.folder), "epochs_planned": self.planned, "epochs_before": self.before,
            "epochs_taken": self.taken, "retries": dict(self.retries), "seconds": round(self.seconds, 3),
        }  # fmt: skip


class Session:
    """One run of a plan. ``listener`` is told of every epoch, ``note`` of everything else worth a line."""

    _journal: Journal  # open while it runs

    def __init__(
        self,
        plan: CapturePlan,
        table: MovingTable | None,
        cameras: PlannedCameras,
        control: Control | None = None,
        listener: Callable[[Taken], None] = lambda taken: None,
        note: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.control = control or Control()
        self._plan, self._placing, self._cameras = plan, Placing(plan, table, self.control), cameras
        self.control.on_stop = self._placing.stop_at_once
        self._listener, self._note = listener, note
        self._retries: dict[str, int] = {}

    def run(self) -> Outcome:
        """Take all epochs that are missing. Raises SessionStoppedError; the table is stopped before."""
        begin = time.monotonic()
        plan, folder = self._plan, self._plan.project
        check_plan_limits(plan)
        self._journal = Journal(journal_path(folder))
        try:
            missing, n_before = self._resume()
            if missing:
                self._placing.home(self._note)
            for shot in missing:
                self._pause(shot)
                self._take_with_retries(shot)
            self._finish()
        except BaseException as error:
            safe = self._made_safe(error)
            if safe is error:
                raise
            raise safe from error
        finally:
            with suppress(OSError):  # a full disk: the next start writes it from the journal
                self._write_angles()
            self._journal.close()
        return Outcome(folder, len(plan.shots), n_before, len(missing), dict(self._retries), time.monotonic() - begin)

    def _resume(self) -> tuple[list[Shot], int]:
        plan, journal = self._plan, self._journal
        prepare(plan.project, plan.survey)
        valid = verified_sets(plan, journal, self._note)
        wanted = {shot.epoch_id for shot in plan.shots}
        removed = remove_unrecorded(plan.project, [c.camera_id for c in plan.cameras], wanted - set(valid))
        for path in removed:
            self._note(f"removed {path}: it was never acknowledged")
        journal.append("session", **self._session_record(), removed=removed, torn=journal.torn)
        self._write_angles()
        missing = [shot for shot in plan.shots if shot.epoch_id not in valid]
        if valid and missing:
            self._note(f"{len(valid)} epochs are there and whole, {len(missing)} to go")
        return missing, len(wanted & set(valid))

    def _session_record(self) -> dict[str, object]:
        plan = self._plan
        return {
            "format": JOURNAL_FORMAT,
            "plan": plan.file.name,
            "plan_sha256": plan.digest,
            "host": socket.gethostname(),
            "python": platform.python_version(),
            "table": self._placing.description(),
            "cameras": {name: dict(values) for name, values in self._cameras.describe().items()},
            **clocks(),
        }

    def _pause(self, shot: Shot) -> None:
        if self.control.paused:
            self._event("paused", f"before {shot.epoch_id}")
            self._note(f"paused before {shot.epoch_id}")
            self.control.wait_while_paused()
            self._event("resumed", shot.epoch_id)
        self.control.checkpoint()

    def _take_with_retries(self, shot: Shot) -> None:
        for attempt in range(self._plan.options.retries + 1):
            self.control.checkpoint()
            try:
                return self._take(shot, attempt)
            except (AbortedError, LimitError, StoppedError):
                raise
            except (CameraError, TurntableError, DriftError) as error:
                self._placing.give_up_pose()
                if attempt == self._plan.options.retries:
                    raise
                self._before_retry(shot, attempt + 1, error)
        return None

    def _before_retry(self, shot: Shot, number: int, error: SurveyError) -> None:
        """Write the fault down, wait, and bring back what was lost; where that fails the next try says so."""
        options, kind = self._plan.options, type(error).__name__.removesuffix("Error")
        self._retries[kind] = self._retries.get(kind, 0) + 1
        self._event("retry", f"{shot.epoch_id}: {error}")
        self._note(f"{shot.epoch_id}: {error}\n  trying again ({number} of {options.retries})")
        self.control.sleep(options.retry_pause_s)
        with suppress(CameraError, TurntableError):
            if isinstance(error, TableDisconnectedError):
                self._placing.reopen()
            self._cameras.recover(reopen=isinstance(error, DisconnectedError))

    def _take(self, shot: Shot, attempt: int) -> None:
        plan = self._plan
        self._placing.go_to(shot)
        before = self._placing.locate()
        frames = self._cameras.take(plan.options.fetch_timeout_s)
        after = self._placing.locate()
        self._placing.require_rest(before, after)
        self._require_sizes(frames)
        self.control.checkpoint()
        images = {camera_id: self._write(camera_id, shot, frame) for camera_id, frame in frames.items()}
        record = self._journal.append(
            "set", epoch_id=shot.epoch_id, pose_id=shot.pose_id, repeat=shot.repeat, attempt=attempt,
            planned_deg=np.degrees(shot.angles).tolist(), before=location_dict(before), after=location_dict(after),
            images=images, **clocks(),
        )  # fmt: skip
        done = len(set(self._journal.taken()) & {s.epoch_id for s in plan.shots})
        self._listener(Taken(record, frames, done, len(plan.shots)))

    def _require_sizes(self, frames: Mapping[str, Frame]) -> None:
        """An image that the survey cannot use is no image: better to hear of it at the first than after the last."""
        for camera_id, frame in frames.items():
            height, width = frame.image.shape
            wanted = self._plan.image_sizes.get(camera_id, (width, height))
            if (width, height) != wanted:
                raise SurveyError(
                    f"camera {camera_id!r} sends {width} x {height} px, but {self._plan.survey} says {wanted[0]} x "
                    f"{wanted[1]}; set Width and Height (and OffsetX, OffsetY) in the plan, or correct image_size_px"
                )

    def _write(self, camera_id: str, shot: Shot, frame: Frame) -> dict[str, object]:
        values = self._cameras.values(camera_id, ("ExposureTime", "Gain", "PixelFormat"))
        return {
            **write_image(self._plan.project, camera_id, shot.epoch_id, frame.image),
            "bits": frame.bits,
            "serial": frame.serial,
            "block_id": frame.block_id,
            "device_time_ns": frame.device_time_ns,
            "host_time_ns": frame.host_time_ns,
            "host_monotonic_ns": frame.host_monotonic_ns,
            "features": dict(values),
        }

    def _event(self, what: str, message: str) -> None:
        self._journal.append("event", what=what, message=message, **clocks())

    def _finish(self) -> None:
        wanted = {shot.epoch_id for shot in self._plan.shots}
        lost = wanted - set(self._journal.taken())
        if lost:
            raise ValueError(f"epochs without a record: {sorted(lost)}")
        self._event("finished", f"{len(wanted)} epochs")

    def _write_angles(self) -> None:
        table, sets = self._plan.table, self._journal.taken()
        if table is not None and sets:
            write_table_angles(self._plan.project, table.table_id, sets, table.sigma)

    def _made_safe(self, error: BaseException) -> BaseException:
        """Stop the table, write down why, and say what to do next."""
        safe = self._placing.stopped_text()
        with suppress(OSError):
            self._event("stopped", str(error))
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            reason = f"{error.filename or self._plan.project}: the disk is full; make room"
        elif isinstance(error, SurveyError):
            reason = f"stopped: {self.control.reason}" if self.control.stopping else str(error)
        else:
            return error
        again = f"the same command goes on with the rest: labcapture run {self._plan.file}"
        return SessionStoppedError(f"{reason}\n  {safe}all recorded images are on disk; {again}", self.control.stopping)
