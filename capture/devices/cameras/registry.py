"""Which drivers there are, and cameras by address."""

import difflib
import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import cast

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from capture.devices.camera import Camera, CameraInfo, DriverMissingError


@frozen
class DriverDescription:
    """A driver: what it reaches, the form of its addresses, and where its software comes from.

    Its module has ``camera(place, **options) -> Camera`` (not opened) and, where cameras are not only named,
    ``discover() -> tuple[CameraInfo, ...]``. packages: what it imports. extra: the extra of this package that installs
    them; None: always there. room: where its module is.
    """

    name: str
    reaches: str
    address: str
    packages: tuple[str, ...] = ()
    extra: str | None = None
    room: str = "capture.devices.cameras"


DRIVERS = {
    d.name: d
    for d in (
        DriverDescription("gige", "GigE Vision, without an SDK", "gige:IP or gige:SERIAL", ("viva_genicam",), "gige"),
        DriverDescription("u3v", "USB3 Vision, without an SDK", "u3v:SERIAL", ("viva_genicam",), "gige"),
        DriverDescription(
            "gentl",
            "any camera whose maker has a GenTL producer (.cti)",
            "gentl:SERIAL (producers in GENICAM_GENTL64_PATH) or gentl:/path/to/file.cti#SERIAL",
            ("harvesters", "genicam"),
            "gentl",
        ),
        DriverDescription("pylon", "Basler, through pypylon", "pylon:SERIAL", ("pypylon",), "pylon"),
        DriverDescription("opencv", "webcams (V4L2, UVC) and films", "opencv:/dev/video0 or opencv:FILM.avi"),
        DriverDescription("images", "a sequence of image files, played back", "images:FOLDER or images:FOLDER/*.png"),
        DriverDescription("simulated", "a camera in this process that can be told to fail", "simulated:NAME"),
        DriverDescription(
            "lab",
            "a camera of the simulated laboratory, in this process or through pylon's emulator",
            "lab:FOLDER/CAMERA or lab:FOLDER/CAMERA?via=pylon:SERIAL",
            room="capture.simulated",
        ),
    )
}


def describe_driver(name: str) -> DriverDescription:
    """The driver of that name. Raises SurveyError where there is none."""
    if name not in DRIVERS:
        near = difflib.get_close_matches(name, DRIVERS, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(DRIVERS)}"
        raise SurveyError(f"camera driver {name!r}: unknown; {hint}")
    return DRIVERS[name]


def open_camera(address: str, **options: object) -> Camera:
    """The camera at ``driver:place``, opened; to be closed, best by ``with``.

    options: of the driver, named in its module. Raises SurveyError for an address without a known driver,
    DriverMissingError, InUseError, DisconnectedError.
    """
    name, colon, place = address.partition(":")
    if not colon or not place:
        raise SurveyError(f"camera address {address!r}: give driver:place, such as {describe_driver('pylon').address}")
    driver = load_driver(name)
    camera = cast(Callable[..., Camera], driver.camera)(place, **options)
    camera.open()
    return camera


def discover(name: str = "all") -> tuple[CameraInfo, ...]:
    """The cameras that a driver finds; ``all``: those of every driver whose software is installed."""
    if name != "all":
        return tuple(getattr(load_driver(name), "discover", tuple)())
    found: list[CameraInfo] = []
    for each in DRIVERS:
        with suppress(DriverMissingError):
            found += discover(each)
    return tuple(found)


def load_driver(name: str) -> ModuleType:
    """The driver's module. Raises DriverMissingError where the software that it needs is not installed."""
    driver = describe_driver(name)
    with needed_software(driver):
        for package in driver.packages:
            importlib.import_module(package)
    return importlib.import_module(f"{driver.room}.{name}")


@contextmanager
def needed_software(driver: DriverDescription) -> Iterator[None]:
    """Turns an import that fails into a message that names the extra."""
    try:
        yield
    except ImportError as error:
        found = f"its driver needs {' and '.join(driver.packages)} ({error})"
        advice = f"install it: pip install 'labsurvey[{driver.extra}]'"
        raise DriverMissingError(f"{driver.name}:", found, advice) from error
