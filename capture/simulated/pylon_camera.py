"""A simulated scene through pylon's emulator: every trigger finds the image files of that moment.

The emulator plays a folder's images in turn and reads each file anew when it is triggered. A single file it would read
once, so the folder holds two, and both get the image before each trigger.
"""

import os
import tempfile
from pathlib import Path

import cv2

from adjust.model.errors import SurveyError
from capture.devices.camera import ImageSource
from capture.devices.cameras.pylon import PylonCamera

_FILES, _NEW = ("a.bmp", "b.bmp"), "new.bmp"


class LabPylonCamera(PylonCamera):
    """An emulated camera of pylon that sees what ``source`` shows at the trigger."""

    def __init__(self, place: str, source: ImageSource) -> None:
        super().__init__(place)
        self._source = source
        self._files: tempfile.TemporaryDirectory[str] | None = None

    def open(self) -> None:
        """See ``Camera``."""
        super().open()
        self._files = tempfile.TemporaryDirectory(prefix="labsurvey-pylon-")
        image = self._show()
        self.set("TestImageSelector", "Off")
        self.set("ImageFileMode", "On")
        self.set("ImageFilename", self._files.name)
        self.set("Width", image[1])
        self.set("Height", image[0])

    def close(self) -> None:
        """See ``Camera``."""
        super().close()
        if self._files is not None:
            self._files.cleanup()
            self._files = None

    def _execute_trigger(self) -> None:
        self._show()
        super()._execute_trigger()

    def _show(self) -> tuple[int, int]:
        """Writes what is seen now; its height and width."""
        exposure_us, gain_db = float(self.get("ExposureTime")), float(self.get("Gain"))
        image = self._source(exposure_us, gain_db)
        folder = Path(self._files.name if self._files else ".")
        for name in _FILES:
            if not cv2.imwrite(str(folder / _NEW), image):
                raise SurveyError(f"{folder / _NEW}: cannot be written; is the disk full?")
            os.replace(folder / _NEW, folder / name)
        return int(image.shape[0]), int(image.shape[1])
