"""GigE Vision over loopback: Aravis' camera in another process, and the client's own fakes."""

import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
from viva_genicam.testing import FakeGigeCamera, FakeU3vCamera

from adjust.model.errors import SurveyError
from capture.devices.camera import Camera, DisconnectedError, FetchTimeoutError, IncompleteFrameError, InUseError
from capture.devices.cameras import discover
from capture.devices.cameras.u3v import U3vCamera
from capture.session.trigger_set import TriggerSet
from tests.capture.camera_helpers import GIGE, gige_port, number_in, open_camera, set_up
from tests.capture.gige_server import GigeServer

pytestmark = [pytest.mark.hardware, pytest.mark.slow]


@pytest.fixture
def port() -> Iterator[None]:
    with gige_port():
        yield


@pytest.fixture
def server(port: None) -> Iterator[GigeServer]:
    with GigeServer("gradient", serial="S-4711") as running:
        yield running


def test_discovery_tells_serial_number_and_whether_it_is_held(server: GigeServer) -> None:
    (info,) = discover("gige")
    assert (info.address, info.vendor, info.serial, info.in_use) == (GIGE, "Aravis", "S-4711", False)
    with open_camera("gige:S-4711") as camera:
        assert camera.serial == "S-4711"
        assert discover("gige")[0].in_use


def test_pixels_are_those_that_were_sent_of_the_region_that_was_set(server: GigeServer) -> None:
    with open_camera(GIGE) as camera:
        set_up(camera, 96, 40)
        camera.set("OffsetX", 16)
        camera.set("OffsetY", 8)
        camera.arm()
        camera.trigger()
        rows, columns = np.arange(8, 48) // 8, np.arange(16, 112) // 8
        np.testing.assert_array_equal(camera.fetch(2.0).image, rows[:, None] + columns[None, :])
        camera.disarm()
        camera.set("PixelFormat", "Mono16")
        camera.arm()
        camera.trigger()
        frame = camera.fetch(2.0)
        assert frame.bits == 16
        np.testing.assert_array_equal(frame.image, rows[:, None] + columns[None, :])


def test_its_clock_is_told_in_nanoseconds(server: GigeServer) -> None:
    """The best of several pauses, because other work on the machine may hold up one image on its way."""
    with open_camera(GIGE) as camera:
        set_up(camera)
        camera.arm()
        device, host = [], []
        for pause in (0.0, 0.2, 0.2, 0.2):
            time.sleep(pause)
            camera.trigger()
            frame = camera.fetch(10.0)
            assert frame.device_time_ns is not None
            device.append(frame.device_time_ns)
            host.append(frame.host_monotonic_ns)
    assert np.abs(np.diff(device) - np.diff(host)).min() * 1e-9 < 0.05


def test_block_ids_of_16_bit_begin_anew_at_1(port: None) -> None:
    """Aravis starts at 65400, for this very test."""
    with GigeServer("gradient"), open_camera(GIGE) as camera:
        set_up(camera)
        cameras = TriggerSet({"X": camera})
        cameras.arm()
        frames = [cameras.take(2.0)["X"] for _ in range(144)]
        assert camera.last_block_id == 65535
    ids = [f.block_id for f in frames]
    assert 1 in ids
    assert 65535 in ids
    assert 0 not in ids
    numbers = np.array([number_in(f.image) for f in frames])
    assert (np.diff(numbers) == 1).all()


def test_lost_packets_make_incomplete_images(port: None) -> None:
    lost, good = 0, 0
    with GigeServer("gradient", lost_ratio=0.05), open_camera(GIGE) as camera:
        set_up(camera, 256, 128)  # some 25 packets
        camera.arm()
        for _ in range(20):
            camera.trigger()
            try:
                image = camera.fetch(1.0).image
            except (IncompleteFrameError, FetchTimeoutError):  # the latter where nothing of it came
                lost += 1
            else:
                np.testing.assert_array_equal(image[1], np.arange(256) // 8)
                good += 1
    assert lost >= 3  # of 20 images at 72 % each; 3 or fewer by chance: 1e-7
    assert lost + good == 20


def test_a_camera_whose_plug_is_pulled(port: None) -> None:
    with GigeServer("gradient") as server, open_camera(GIGE) as camera:
        set_up(camera)
        camera.arm()
        camera.trigger()
        camera.fetch(2.0)
        server.kill()
        with pytest.raises(DisconnectedError, match=r"does not answer any more; .*open it anew"):
            camera.trigger()
        begin = time.monotonic()
        with pytest.raises(DisconnectedError):
            camera.fetch(0.1)
        assert time.monotonic() - begin < 5.0


HOLDER = """
import sys
from capture.devices.cameras import open_camera
camera = open_camera("gige:127.0.0.1")
print("held", flush=True)
sys.stdin.read()
"""


def test_after_a_crash_the_camera_opens_again(server: GigeServer) -> None:
    """The camera holds to the dead program for 3 s; a session that resumes at once need not know."""
    with subprocess.Popen([sys.executable, "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline().strip() == b"held"
        holder.kill()
        holder.wait()
        assert discover("gige")[0].in_use
        with open_camera(GIGE) as camera:
            camera.set("Width", 64)


def test_two_servers_on_one_address(server: GigeServer) -> None:
    with pytest.raises(SurveyError, match="did not start"), GigeServer("gradient"):
        pass


def use_for(seconds: float, camera: Camera) -> None:
    """The loss is noticed with the next heartbeat."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        camera.set("ExposureTime", 1000.0)
        time.sleep(0.05)


def test_control_taken_by_another(port: None) -> None:
    with FakeGigeCamera(width=64, height=48) as fake, open_camera(GIGE) as camera:
        assert camera.serial == "VIVA-FAKE-001"
        with pytest.raises(InUseError):
            open_camera(GIGE)
        fake._native.revoke_control()
        with pytest.raises(DisconnectedError, match="open it anew"):
            use_for(5.0, camera)


def test_resent_packets_complete_an_image(port: None) -> None:
    for resend, expected in ((True, [1, 2, 3]), (False, [1, "lost", 3])):
        fake = FakeGigeCamera(width=64, height=48, fps=50, drop_packets=[(2, 1)], packet_resend=resend)
        with fake, open_camera(GIGE) as camera:
            camera.arm()
            seen: list[int | str] = []
            for _ in range(3):
                try:
                    seen.append(camera.fetch(2.0).block_id)
                except IncompleteFrameError:
                    seen.append("lost")
        assert seen == expected


def test_usb3_vision() -> None:
    fake = FakeU3vCamera(width=64, height=48)
    with U3vCamera("FAKE", fake.connect) as camera:
        camera.open()
        assert camera.last_block_id is None
        camera.arm()
        assert fake.acquiring()
        frames = [camera.fetch(2.0) for _ in range(3)]
        camera.disarm()
        assert not fake.acquiring()
    assert [f.block_id for f in frames] == [0, 1, 2]
    assert frames[0].image.shape == (48, 64)
    stamps = [f.device_time_ns or 0 for f in frames]
    assert 0 < stamps[0] < stamps[1] < stamps[2]
