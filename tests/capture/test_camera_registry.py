import subprocess
import sys

import pytest

from adjust.model.errors import SurveyError
from capture.devices.camera import DriverMissingError
from capture.devices.cameras import DRIVERS, discover, open_camera
from tests.capture.camera_helpers import PYLON
from tests.capture.camera_helpers import open_camera as opened


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("pylno:1", "did you mean 'pylon'"),
        ("zebra:1", "choose one of .*gige.*pylon"),
        ("pylon", "give driver:place"),
        ("pylon:", "give driver:place"),
    ],
)
def test_addresses_that_mean_nothing(address: str, message: str) -> None:
    with pytest.raises(SurveyError, match=message):
        open_camera(address)


@pytest.mark.parametrize("name", [name for name, driver in DRIVERS.items() if driver.packages])
def test_software_that_is_not_installed_is_named_with_its_extra(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, DRIVERS[name].packages[0], None)
    with pytest.raises(DriverMissingError, match=rf"pip install 'labsurvey\[{DRIVERS[name].extra}\]'"):
        open_camera(f"{name}:1")


def test_all_passes_over_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viva_genicam", None)
    monkeypatch.setitem(sys.modules, "harvesters", None)
    assert {"pylon:0815-0000", "pylon:0815-0001", "pylon:0815-0002"} <= {info.address for info in discover()}


def test_all_drivers_are_asked() -> None:
    assert "pylon:0815-0002" in {info.address for info in discover()}


def test_an_address_that_was_discovered_opens() -> None:
    info = next(i for i in discover("pylon") if i.address == PYLON)
    with opened(info.address) as camera:
        assert camera.serial == info.serial


@pytest.mark.slow
def test_no_software_is_loaded_before_its_driver_is_named() -> None:
    code = (
        "import sys, capture.devices.cameras as c, capture.session.trigger_set; c.discover('opencv');"
        "print([m for m in ('pypylon', 'viva_genicam', 'harvesters', 'genicam') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
