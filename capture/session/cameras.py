"""The cameras of a plan, opened, set and armed as one trigger set."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Self

from adjust.model.errors import SurveyError
from capture.devices.camera import Camera, CameraError, Frame, UnknownFeatureError
from capture.devices.cameras import open_camera
from capture.plan.plan import CameraPlan
from capture.session.trigger_set import TriggerSet

_DESCRIBED = ("DeviceVendorName", "DeviceModelName", "Width", "Height", "PixelFormat", "ExposureTime", "Gain")


class PlannedCameras:
    """The cameras of a session, taken together.

    trigger: software, hardware (pulses come from outside) or free (no trigger).
    """

    def __init__(self, plans: Sequence[CameraPlan], trigger: str = "software") -> None:
        self._plans, self._trigger = tuple(plans), trigger
        self._cameras: dict[str, Camera] = {}
        self._set: TriggerSet | None = None

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Open and set all cameras, and arm them. Raises CameraError."""
        try:
            for plan in self._plans:
                camera = open_camera(plan.address, **plan.options)
                self._cameras[plan.camera_id] = camera
                self._apply(plan, camera)
            self._set = TriggerSet(self._cameras, _wait_for_pulse if self._trigger == "hardware" else None)
            self._set.arm()
        except BaseException:
            self.close()
            raise

    def _apply(self, plan: CameraPlan, camera: Camera) -> None:
        """The trigger first: some cameras forbid an exposure time before it is known who starts it."""
        settings: dict[str, Any] = {}
        if self._trigger == "free":
            settings["TriggerMode"] = "Off"
        else:
            settings |= {"TriggerSelector": "FrameStart", "TriggerMode": "On"}
            settings["TriggerSource"] = "Software" if self._trigger == "software" else "Line1"
        for name, value in {**settings, **plan.settings}.items():
            try:
                camera.set(name, value)
            except UnknownFeatureError:
                if name in plan.settings or (name == "TriggerMode" and value == "On"):
                    raise

    def close(self) -> None:
        """Disarm and close all."""
        if self._set is not None:
            self._set.disarm()
            self._set = None
        cameras, self._cameras = self._cameras, {}
        for camera in cameras.values():
            camera.close()

    def take(self, timeout_s: float) -> Mapping[str, Frame]:
        """One image of every camera, by camera_id, exposed after this call. Raises CameraError."""
        if self._set is None or not self._set.armed:
            self.recover(reopen=self._set is None)
        if self._set is None:
            raise SurveyError("the cameras are not open; open them first")
        return self._set.take(timeout_s)

    def values(self, camera_id: str, names: Sequence[str]) -> Mapping[str, object]:
        """Features as they are now; those that a camera does not know or tell are left out."""
        found: dict[str, object] = {}
        for name in names:
            with suppress(CameraError):
                found[name] = self._cameras[camera_id].get(name)
        return found

    def recover(self, reopen: bool) -> None:
        """Be armed again without an image from before, with new connections where ``reopen``."""
        if reopen or self._set is None:
            self.close()
            self.open()
        else:
            self._set.arm()

    def describe(self) -> Mapping[str, Mapping[str, object]]:
        """Address, serial number and main features of every camera."""
        return {
            name: {"address": camera.address, "serial": camera.serial, **self.values(name, _DESCRIBED)}
            for name, camera in self._cameras.items()
        }


def _wait_for_pulse() -> None:
    """The pulse comes from outside; the fetch waits for its image."""
