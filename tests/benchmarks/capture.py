"""Soak test of the cameras: many images through a driver, the memory that stays, and what the driver costs.

Run by hand: ``PYLON_CAMEMU=1 python -m tests.benchmarks.capture [--frames 10000] [--drivers simulated,pylon,gige]``.
Memory is the resident set of this process, after the first tenth and at the end, with its slope by a straight line;
a leak of one image in a hundred shows at once. The bare time is the maker's own calls in the same order, in blocks that
take turns with those of the driver, so that a busy machine slows both.
"""

import argparse
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from capture.devices.camera import Camera
from capture.devices.cameras import open_camera
from capture.devices.cameras.simulated import SimulatedCamera
from capture.session.trigger_set import TriggerSet
from tests.capture.camera_helpers import gige_port
from tests.capture.gige_server import GigeServer

WIDTH, HEIGHT = 640, 512
BLOCK = 250  # images between two looks at the memory
TIMEOUT_S = 5.0
Take = Callable[[], Any]


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--drivers", default="simulated,pylon,gige")
    options = parser.parse_args()
    os.environ.setdefault("PYLON_CAMEMU", "1")
    print(f"{WIDTH} x {HEIGHT} px, 8 bit; {options.frames} images each; times are medians of one image")
    print(
        f"{'driver':<12}{'images/s':>9}{'driver ms':>11}{'bare ms':>9}{'cost us':>9}{'of it cpu us':>13}"
        f"{'RSS MB from':>13}{'to':>8}{'B/image':>9}{'files':>7}{'threads':>9}"
    )
    for name in options.drivers.split(","):
        with STACKS[name]() as (take, bare):
            print(row(name, take, bare, options.frames))
            sys.stdout.flush()


def row(name: str, take: Take, bare: Take, n_frames: int) -> str:
    n_blocks = n_frames // BLOCK
    # what the measurement itself needs is there, and written to, before it begins
    driver_times, bare_times = np.ones((n_blocks, BLOCK, 2)), np.ones((n_blocks, BLOCK // 5, 2))
    memory = np.ones(n_blocks)
    run(take, np.ones((BLOCK, 2)))
    before = counts()
    for k in range(n_blocks):
        run(take, driver_times[k])
        run(bare, bare_times[k])
        gc.collect()
        memory[k] = resident_bytes()
    settled = memory[n_blocks // 10 :]
    slope = np.polyfit(np.arange(len(settled)) * BLOCK, settled, 1)[0] if len(settled) > 1 else 0.0
    rate = 1.0 / driver_times[:, :, 0].mean()
    driver_s, driver_cpu_s = np.median(driver_times, axis=(0, 1))
    bare_s, bare_cpu_s = np.median(bare_times, axis=(0, 1))
    cpu_s = driver_cpu_s - bare_cpu_s
    files, threads = (b - a for a, b in zip(before, counts(), strict=True))
    return (
        f"{name:<12}{rate:9.0f}{1e3 * driver_s:11.3f}{1e3 * bare_s:9.3f}{1e6 * (driver_s - bare_s):9.0f}"
        f"{1e6 * cpu_s:13.0f}{settled[0] / 1e6:13.1f}{settled[-1] / 1e6:8.1f}{slope:9.1f}{files:+7d}{threads:+9d}"
    )


def run(take: Take, times: np.ndarray) -> None:
    """Fills times (n, 2) s: by the clock, and of this thread's processor."""
    for row_of_times in times:
        begin, begin_cpu = time.perf_counter(), time.thread_time()
        take()
        row_of_times[:] = time.perf_counter() - begin, time.thread_time() - begin_cpu


def counts() -> tuple[int, int]:
    """Open files and threads of this process."""
    return len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))


def prepared(camera: Camera, **settings: float | str) -> Camera:
    for name, value in {"Width": WIDTH, "Height": HEIGHT, "TriggerMode": "On", "TriggerSource": "Software"}.items():
        camera.set(name, value)
    for name, value in settings.items():
        camera.set(name, value)
    return camera


@contextmanager
def simulated() -> Iterator[tuple[Take, Take]]:
    """Bare: the copy of an image that is there."""
    image = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    with SimulatedCamera("soak", lambda exposure_us, gain_db: image) as camera:
        camera.open()
        cameras = TriggerSet({"soak": prepared(camera)})
        cameras.arm()
        yield lambda: cameras.take(TIMEOUT_S), image.copy


@contextmanager
def pylon() -> Iterator[tuple[Take, Take]]:
    with ExitStack() as stack:
        camera = stack.enter_context(open_camera("pylon:0815-0000"))
        prepared(camera, ExposureTime=100.0, AcquisitionFrameRate=1000.0)
        cameras = TriggerSet({"soak": camera})
        cameras.arm()
        inner, bare_number = camera._camera, [0]
        from pypylon import pylon as sdk

        def bare() -> np.ndarray:
            inner.WaitForFrameTriggerReady(2000, sdk.TimeoutHandling_ThrowException)
            inner.ExecuteSoftwareTrigger()
            result = inner.RetrieveResult(5000, sdk.TimeoutHandling_ThrowException)
            image = result.Array
            bare_number[0] = cameras._last["soak"] = result.BlockID  # its images are no error of the set
            result.Release()
            return image

        yield lambda: cameras.take(TIMEOUT_S), bare


@contextmanager
def gige() -> Iterator[tuple[Take, Take]]:
    """Free running, since Aravis' camera looks for triggers 25 times a second only; fetch alone."""
    with gige_port(), GigeServer("gradient"), open_camera("gige:127.0.0.1") as camera:
        prepared(camera, TriggerMode="Off", AcquisitionFrameRate=200.0)
        camera.arm()
        stream = camera._stream
        yield lambda: camera.fetch(TIMEOUT_S), lambda: stream.next_frame(5000).to_numpy()


STACKS: dict[str, Callable[[], Any]] = {"simulated": simulated, "pylon": pylon, "gige": gige}

if __name__ == "__main__":
    main()
