"""Several cameras at one moment: armed together, triggered together, one image of each.

Block ids must advance by exactly one with every trigger, for every camera; an image that is late, lost, doubled or not
asked for is found by that, and can never be taken for the image of another pose.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress

from adjust.model.errors import SurveyError
from capture.devices.camera import Camera, CameraError, FetchTimeoutError, Frame, IncompleteFrameError


class FrameOrderError(CameraError):
    """An image came that does not belong to the last trigger, or one is missing; arm the set again."""


class TriggerSet:
    """Cameras that take their images together.

    fire: sends the hardware trigger; None: every camera is triggered by software, one after the other. After an error
    the set is disarmed; ``arm`` starts it again, and no image from before is left.
    """

    def __init__(self, cameras: Mapping[str, Camera], fire: Callable[[], None] | None = None) -> None:
        if not cameras:
            raise SurveyError("trigger set: it has no camera; name at least one")
        self._cameras = dict(cameras)
        self._fire = fire
        self._last: dict[str, int] = {}
        self.armed = False

    def arm(self) -> None:
        """Arm all cameras, after disarming those that are. Raises as ``Camera.arm`` does."""
        self.disarm()
        self._last = {}
        try:
            for camera in self._cameras.values():
                camera.arm()
        except SurveyError:
            self.disarm()
            raise
        self.armed = True

    def disarm(self) -> None:
        """Disarm all cameras, those too that answer with an error."""
        self.armed = False
        for camera in self._cameras.values():
            with suppress(CameraError):
                camera.disarm()

    def take(self, timeout_s: float) -> dict[str, Frame]:
        """Trigger, and the image of each camera, by its id.

        Raises FrameOrderError where an image cannot belong to this trigger; FetchTimeoutError, IncompleteFrameError and
        DisconnectedError of the camera that failed. After any of them the set is disarmed.
        """
        if not self.armed:
            raise SurveyError("trigger set: it is not armed; arm it first, also after an error")
        try:
            self._require_quiet()
            self._trigger()
            frames = {name: self._fetched(name, camera, timeout_s) for name, camera in self._cameras.items()}
            self._require_quiet()
        except BaseException:
            self.disarm()
            raise
        return frames

    def _trigger(self) -> None:
        if self._fire is not None:
            self._fire()
            return
        for camera in self._cameras.values():
            camera.trigger()

    def _require_quiet(self) -> None:
        """No image waits that no trigger asked for. Cameras that run freely always have one."""
        for camera in self._cameras.values():
            if not camera.triggered:
                continue
            try:
                found = f"image {camera.fetch(0.0).block_id}"
            except FetchTimeoutError:
                continue
            except IncompleteFrameError:
                found = "an incomplete image"
            raise _out_of_order(camera, f"{found} came without a trigger, or after its time")

    def _fetched(self, name: str, camera: Camera, timeout_s: float) -> Frame:
        frame = camera.fetch(timeout_s)
        last = self._last.get(name)
        self._last[name] = frame.block_id
        if last is None:
            return frame
        if camera.triggered and not _follows(last, frame.block_id, camera.last_block_id):
            raise _out_of_order(camera, f"image {frame.block_id} came after image {last}, one trigger later")
        if frame.block_id == last:
            raise _out_of_order(camera, f"image {last} came twice")
        return frame


def _follows(before: int, after: int, last_block_id: int | None) -> bool:
    """Whether ``after`` is the next block id; at the end of 16 bits also where the camera counts on or begins anew."""
    return after == before + 1 or (before == last_block_id and after == 1)


def _out_of_order(camera: Camera, found: str) -> FrameOrderError:
    return FrameOrderError(camera.address, found, "all images of this trigger are discarded; arm the cameras again")
