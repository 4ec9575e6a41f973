"""A camera of the simulated laboratory as a GigE Vision camera, in a process of its own.

``python -m tests.capture.gige_server FOLDER/X`` serves camera X of the laboratory in FOLDER on 127.0.0.1; a client
reaches it as ``gige:127.0.0.1``. ``GigeServer`` starts and ends such a process.
"""

import argparse
import logging
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from adjust.model.errors import SurveyError
from capture.devices.camera import GrayImage, ImageSource
from capture.simulated.angles import AnglesFile
from tests.capture.aravis import AravisCamera

_READY = "ready"
_START_S = 60.0  # on a busy machine
_LOOK_S = 0.02
GRADIENT = "gradient"


class GigeServer:
    """The process: ``with GigeServer(folder / "X"): ...``; on entry it waits until the camera answers.

    camera: FOLDER/CAMERA of a laboratory, or ``gradient`` for a test picture with the image's number in its first
    four pixels. Raises SurveyError where it cannot start.
    """

    def __init__(
        self,
        camera: Path | str,
        interface: str = "127.0.0.1",
        serial: str = "LAB-1",
        lost_ratio: float = 0.0,
        angles: Path | None = None,
    ) -> None:
        self._command = [sys.executable, "-m", "tests.capture.gige_server", str(camera)]
        self._command += ["--interface", interface, "--serial", serial, "--lost-ratio", str(lost_ratio)]
        self._command += ["--angles", str(angles)] if angles is not None else []
        self.process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.process = process
        alarm = threading.Timer(_START_S, process.kill)
        alarm.start()
        try:
            line = process.stdout.readline() if process.stdout else ""
        finally:
            alarm.cancel()
        if line.strip() != _READY:
            self.end()
            raise SurveyError(f"simulated camera: {' '.join(self._command)} did not start; run it by hand to see why")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def kill(self) -> None:
        """As if its plug were pulled."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def end(self) -> None:
        """End the process; may be called twice."""
        if self.process is None:
            return
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
        self.process = None


def _lab_source(camera: Path, file: Path | None) -> ImageSource:
    """What the camera sees now; as soon as the table stands still, the image without noise is made and kept."""
    from capture.simulated.folder import ANGLES, read_lab  # the renderer takes its time to load

    lab, angles = read_lab(camera.parent), AnglesFile(file or camera.parent / ANGLES)
    lock = threading.Lock()

    def image(exposure_us: float, gain_db: float) -> GrayImage:
        with lock:
            return lab.image(camera.name, angles(), exposure_us, gain_db)

    lab.warm_up()  # a camera that does not answer for 3 s has lost its client
    threading.Thread(target=_look_ahead, args=(angles, image), daemon=True).start()
    return image


def _look_ahead(angles: AnglesFile, image: ImageSource) -> None:
    before = rendered = None
    while True:
        now = None
        with suppress(SurveyError):
            now = angles()
        if now is not None and now == before != rendered:
            image(1.0, 0.0)
            rendered = now
        before = now
        time.sleep(_LOOK_S)


def _gradient() -> ImageSource:
    numbers = iter(range(1, 2**32))
    rows, columns = np.arange(2048) // 8, np.arange(2048) // 8
    base = np.asarray((rows[:, None] + columns[None, :]) % 256, np.uint8)

    def image(exposure_us: float, gain_db: float) -> GrayImage:
        base[0, :4] = np.frombuffer(next(numbers).to_bytes(4, "big"), np.uint8)
        return base

    return image


def main() -> None:
    """Serve until the standard input ends."""
    parser = argparse.ArgumentParser(description="A camera of the simulated laboratory, by GigE Vision.")
    parser.add_argument("camera", help="FOLDER/CAMERA, or gradient")
    parser.add_argument("--interface", default="127.0.0.1")
    parser.add_argument("--serial", default="LAB-1")
    parser.add_argument("--lost-ratio", type=float, default=0.0)
    parser.add_argument("--angles", type=Path, help="by default FOLDER/angles.json")
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    try:
        source = _gradient() if options.camera == GRADIENT else _lab_source(Path(options.camera), options.angles)
        size = None if options.camera == GRADIENT else source(1.0, 0.0).shape[::-1]
        camera = AravisCamera(source, options.interface, options.serial, options.lost_ratio, size, _complain)
    except SurveyError as error:
        sys.exit(str(error))
    sys.stdout.write(_READY + "\n")
    sys.stdout.flush()
    sys.stdin.read()
    del camera


def _complain(error: Exception) -> None:
    logging.getLogger(__name__).error("no image: %s", error)


if __name__ == "__main__":
    main()
