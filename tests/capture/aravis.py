"""Aravis' fake GigE Vision camera, bound through ctypes: it speaks GVCP and GVSP for real and sends images of ours.

The library comes with the wheel aravis-python; glib and libxml2 are the system's (Debian: libglib2.0-0 libxml2).
"""

import ctypes
import importlib.util
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from capture.devices.camera import GrayImage, ImageSource

_FILL = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)  # buffer, user data, exposure (us), gain, pixel format
_SIZE_REGISTERS = (0x100, 0x104)  # Width and Height, as the XML of the library's camera has them
_PORT = 3956  # of GigE Vision's control channel
_SYSTEM_PACKAGES = "libglib2.0-0 libxml2"


class AravisCamera:
    """A GigE Vision camera on one address of this machine, served by threads of the library while the object lives.

    image_size: (width, height) px of the region that it sends until a client sets another; None: 512 x 512.
    lost_ratio: share of the packets of images that are never sent. failed: is given the error where ``source`` raises,
    since nothing may pass through the library.
    """

    def __init__(
        self,
        source: ImageSource,
        interface: str = "127.0.0.1",
        serial: str = "LAB-1",
        lost_ratio: float = 0.0,
        image_size: tuple[int, int] | None = None,
        failed: Callable[[Exception], None] | None = None,
    ) -> None:
        self._source, self._failed = source, failed
        self._library = _load()
        _require_free(interface)
        self._callback = _FILL(self._fill)
        self._camera = self._library.arv_gv_fake_camera_new(interface.encode(), serial.encode())
        if not self._library.arv_gv_fake_camera_is_running(self._camera):
            raise SurveyError(
                f"GigE Vision camera on {interface}: it cannot start; Aravis knows no such interface, use 127.0.0.1"
            )
        if lost_ratio:
            self._lose(lost_ratio)
        inner = self._library.arv_gv_fake_camera_get_fake_camera(self._camera)
        for register, value in zip(_SIZE_REGISTERS, image_size or (), strict=False):
            self._library.arv_fake_camera_write_register(inner, register, value)
        self._library.arv_fake_camera_set_fill_pattern(inner, self._callback, None)

    def _lose(self, ratio: float) -> None:
        camera, end = ctypes.c_void_p(self._camera), ctypes.c_void_p()
        self._library.g_object_set(camera, b"gvsp-lost-ratio", ctypes.c_double(ratio), end)

    def _fill(self, buffer: int, _: int, exposure_us: int, gain: int, pixel_format: int) -> None:
        """Called by the library for every image it is about to send."""
        try:
            image = self._source(float(exposure_us), float(gain))
            self._copy(image, buffer, pixel_format)
        except Exception as error:
            if self._failed is not None:
                self._failed(error)

    def _copy(self, image: GrayImage, buffer: int, pixel_format: int) -> None:
        """The region of the image that the buffer is for; black outside of it."""
        get = self._library
        x, y = get.arv_buffer_get_image_x(buffer), get.arv_buffer_get_image_y(buffer)
        width, height = get.arv_buffer_get_image_width(buffer), get.arv_buffer_get_image_height(buffer)
        kind = np.uint16 if (pixel_format >> 16) & 0xFF == 16 else np.uint8  # PFNC: bits of a pixel
        size = width * height * np.dtype(kind).itemsize
        place = (ctypes.c_ubyte * size).from_address(get.arv_buffer_get_data(buffer, ctypes.c_size_t()))
        sent = np.frombuffer(place, kind).reshape(height, width)
        sent[:] = 0
        part = image[y : y + height, x : x + width]
        sent[: part.shape[0], : part.shape[1]] = part


def _require_free(interface: str) -> None:
    """The library would share the port with another camera, and each would get some of the commands."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((interface, _PORT))
        except OSError as error:
            raise SurveyError(
                f"GigE Vision camera on {interface}: port {_PORT} is taken, or that is no address of this machine"
                f" ({error}); end the other camera, or use 127.0.0.1"
            ) from error


def _load() -> ctypes.CDLL:
    """The library, its functions declared."""
    for wheel, file in (("libusb_package", "libusb-1.0.so"), ("aravis", "lib/libaravis-0.8.so")):
        spec = importlib.util.find_spec(wheel)
        if spec is None or spec.origin is None:
            raise SurveyError(
                "simulated GigE Vision camera: needs the wheels aravis-python and libusb-package; "
                "install them: pip install aravis-python libusb-package"
            )
        try:
            # libusb first and for all: the library of Aravis asks for it by name, and no system may have it
            library = ctypes.CDLL(str(Path(spec.origin).parent / file), mode=ctypes.RTLD_GLOBAL)
        except OSError as error:
            raise SurveyError(
                f"simulated GigE Vision camera: {error}; install Debian's {_SYSTEM_PACKAGES}, or what it names"
            ) from error
    return _declared(library)


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    pointer, text = ctypes.c_void_p, ctypes.c_char_p
    signatures: dict[str, tuple[type | None, list[type]]] = {
        "arv_gv_fake_camera_new": (pointer, [text, text]),
        "arv_gv_fake_camera_is_running": (ctypes.c_int, [pointer]),
        "arv_gv_fake_camera_get_fake_camera": (pointer, [pointer]),
        "arv_fake_camera_set_fill_pattern": (None, [pointer, _FILL, pointer]),
        "arv_fake_camera_write_register": (ctypes.c_int, [pointer, ctypes.c_uint32, ctypes.c_uint32]),
        "arv_buffer_get_data": (pointer, [pointer, ctypes.POINTER(ctypes.c_size_t)]),
    }
    for name in ("x", "y", "width", "height"):
        signatures[f"arv_buffer_get_image_{name}"] = (ctypes.c_int, [pointer])
    for function, (result, arguments) in signatures.items():
        getattr(library, function).restype = result
        getattr(library, function).argtypes = arguments
    library.g_object_set.restype = None
    return library
