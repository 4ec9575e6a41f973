"""Synchronised sets: no image is ever taken for that of another trigger."""

from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from capture.devices.camera import Camera, DisconnectedError, FetchTimeoutError, IncompleteFrameError
from capture.devices.cameras.simulated import Fault, FaultKind, SimulatedCamera
from capture.session.trigger_set import FrameOrderError, TriggerSet
from tests.capture.camera_helpers import PYLON, number_in, open_camera, set_up

TIMEOUT_S = 0.02


class World:
    """What both cameras look at: a number that the test changes before every trigger, as the table would its pose."""

    def __init__(self) -> None:
        self.pose = 0

    def __call__(self, exposure_us: float, gain_db: float) -> np.ndarray:
        return np.full((48, 64), self.pose % 256, np.uint8)


@pytest.fixture
def world() -> World:
    return World()


def two_cameras(stack: ExitStack, world: World, faults: tuple[Fault, ...]) -> dict[str, Camera]:
    cameras: dict[str, Camera] = {}
    for name, its_faults in (("A", faults), ("B", ())):
        camera = SimulatedCamera(name, world, its_faults)
        stack.enter_context(camera)
        camera.open()
        set_up(camera)
        cameras[name] = camera
    return cameras


EXPECTED: dict[FaultKind, type[SurveyError]] = {
    "timeout": FetchTimeoutError,
    "incomplete": IncompleteFrameError,
    "disconnect": DisconnectedError,
    "wrong_id": FrameOrderError,
    "duplicate": FrameOrderError,
    "swap": FetchTimeoutError,
    "extra": FrameOrderError,
    "lost": FetchTimeoutError,
}


@pytest.mark.parametrize("kind", EXPECTED)
@pytest.mark.parametrize("at", [2, 5])
def test_every_fault_is_told_and_every_image_that_is_given_is_of_its_pose(
    world: World, kind: FaultKind, at: int
) -> None:
    with ExitStack() as stack:
        cameras = two_cameras(stack, world, (Fault(kind, at),))
        cameras_set = TriggerSet(cameras)
        cameras_set.arm()
        errors: list[SurveyError] = []
        for pose in range(1, 11):
            world.pose = pose
            while True:
                try:
                    frames = cameras_set.take(TIMEOUT_S)
                    break
                except SurveyError as error:
                    errors.append(error)
                    assert not cameras_set.armed
                    if isinstance(error, DisconnectedError):
                        cameras["A"].close()
                        cameras["A"].open()
                    cameras_set.arm()
            assert {name: int(f.image[0, 0]) for name, f in frames.items()} == {"A": pose, "B": pose}
    assert [type(e) for e in errors] == [EXPECTED[kind]]
    assert "camera simulated:A: " in str(errors[0])


def test_a_late_image_is_not_taken_for_the_next_one(world: World) -> None:
    """The image of trigger 3 comes after the time, when the set has been armed again for a new pose."""
    with ExitStack() as stack:
        cameras = two_cameras(stack, world, (Fault("swap", 3),))
        camera = cameras["A"]
        trigger_set = TriggerSet(cameras)
        trigger_set.arm()
        for _ in range(2):
            trigger_set.take(TIMEOUT_S)
        with pytest.raises(FetchTimeoutError):
            trigger_set.take(TIMEOUT_S)
        world.pose = 77
        trigger_set.arm()
        assert camera.triggered
        assert int(trigger_set.take(TIMEOUT_S)["A"].image[0, 0]) == 77


def test_a_hardware_trigger_fires_all(world: World) -> None:
    with ExitStack() as stack:
        cameras = two_cameras(stack, world, ())
        for camera in cameras.values():
            camera.set("TriggerSource", "Line1")

        def pulse() -> None:
            for camera in cameras.values():
                assert isinstance(camera, SimulatedCamera)
                camera.pulse()

        hardware = TriggerSet(cameras, pulse)
        hardware.arm()
        ids = [[frame.block_id for frame in hardware.take(TIMEOUT_S).values()] for _ in range(3)]
        assert np.diff(ids, axis=0).tolist() == [[1, 1], [1, 1]]
        pulse()  # a pulse that nobody asked for
        with pytest.raises(FrameOrderError, match=r"simulated:A: image 4 came without a trigger.*arm the"):
            hardware.take(TIMEOUT_S)


def test_after_an_error_it_has_to_be_armed(world: World) -> None:
    with ExitStack() as stack:
        cameras_set = TriggerSet(two_cameras(stack, world, (Fault("timeout", 1),)))
        with pytest.raises(SurveyError, match="not armed; arm it first"):
            cameras_set.take(TIMEOUT_S)
        cameras_set.arm()
        with pytest.raises(FetchTimeoutError):
            cameras_set.take(TIMEOUT_S)
        with pytest.raises(SurveyError, match="not armed"):
            cameras_set.take(TIMEOUT_S)


def test_one_camera_that_cannot_be_armed_leaves_none_armed(world: World) -> None:
    with ExitStack() as stack:
        cameras = two_cameras(stack, world, ())
        cameras["B"].close()
        with pytest.raises(SurveyError, match=r"simulated:B: it is not open"):
            TriggerSet(cameras).arm()
        with pytest.raises(SurveyError, match="not armed"):
            cameras["A"].trigger()


def test_block_ids_of_16_bit(world: World) -> None:
    class Gige1(SimulatedCamera):
        last_block_id = 65535

    for after, accepted in ((1, True), (65536, True), (0, False), (2, False)):
        with Gige1("W", world) as camera:
            camera.open()
            set_up(camera)
            cameras_set = TriggerSet({"W": camera})
            cameras_set.arm()
            camera._block_id = 65534
            cameras_set.take(TIMEOUT_S)
            camera._block_id = after - 1
            if accepted:
                assert cameras_set.take(TIMEOUT_S)["W"].block_id == after
            else:
                with pytest.raises(FrameOrderError, match=f"image {after} came after image 65535"):
                    cameras_set.take(TIMEOUT_S)


@pytest.fixture
def mixed() -> Iterator[dict[str, Camera]]:
    with open_camera(PYLON) as pylon, open_camera("simulated:M?faults=lost@3") as simulated:
        for camera in (pylon, simulated):
            set_up(camera)
        yield {"P": pylon, "S": simulated}


def test_different_makers_in_one_set(mixed: dict[str, Camera]) -> None:
    cameras_set = TriggerSet(mixed)
    cameras_set.arm()
    numbers = [number_in(cameras_set.take(1.0)["S"].image) for _ in range(2)]
    with pytest.raises(FetchTimeoutError, match="simulated:M"):
        cameras_set.take(0.1)
    cameras_set.arm()  # pylon's image of the failed trigger is gone
    frames = cameras_set.take(1.0)
    assert [*numbers, number_in(frames["S"].image)] == [1, 2, 4]
    assert frames["P"].block_id == 0


@pytest.mark.parametrize("text", ["timeout", "timeout@", "melted@3", "timeout@-1"])
def test_faults_that_mean_nothing(text: str) -> None:
    with pytest.raises(SurveyError, match=r"give kind@number"):
        open_camera(f"simulated:F?faults={text}")


@pytest.mark.parametrize(("pixel_format", "scale"), [("Mono8", 1), ("Mono12", 16), ("Mono16", 256)])
def test_depths_of_the_simulated_camera(world: World, pixel_format: str, scale: int) -> None:
    world.pose = 200
    with SimulatedCamera("D", world) as camera:
        camera.open()
        set_up(camera)
        camera.set("PixelFormat", pixel_format)
        camera.arm()
        camera.trigger()
        frame = camera.fetch(TIMEOUT_S)
    assert frame.image.max() == 200 * scale < 2**frame.bits
