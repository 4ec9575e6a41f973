"""Cameras of the real stacks for tests: pylon's emulator, Aravis' GigE Vision camera, the GenTL producer of a wheel."""

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import genicam
import numpy as np
import pytest

from capture.devices.camera import Camera, FetchTimeoutError
from capture.devices.cameras import open_camera

os.environ["PYLON_CAMEMU"] = "3"  # read once, when pylon is loaded
GIGE = "gige:127.0.0.1"
PYLON = "pylon:0815-0000"
VIKY = f"gentl:{Path(genicam.__file__).parent / 'viky.cti'}#1"


@contextmanager
def gige_port() -> Iterator[None]:
    """GigE Vision has one port a machine: tests that serve a camera take turns, also those of other processes."""
    with (Path(tempfile.gettempdir()) / "labsurvey-gige-port").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def number_in(image: np.ndarray) -> int:
    """What the gradient pictures of the simulated cameras carry in their first four pixels."""
    return int.from_bytes(image[0, :4].astype(np.uint8).tobytes(), "big")


def set_up(camera: Camera, width: int = 64, height: int = 48) -> None:
    """Small images, one for each software trigger."""
    for name, value in {
        "Width": width,
        "Height": height,
        "TriggerSelector": "FrameStart",
        "TriggerMode": "On",
        "TriggerSource": "Software",
        "ExposureTime": 1000.0,
    }.items():
        camera.set(name, value)


def require_silence(camera: Camera, seconds: float = 0.1) -> None:
    with pytest.raises(FetchTimeoutError):
        camera.fetch(seconds)


__all__ = ["GIGE", "PYLON", "VIKY", "gige_port", "number_in", "open_camera", "require_silence", "set_up"]
