"""What drivers share of GenICam's names: older ones, those locked while images are sent, and pixel formats."""

import numpy as np

from capture.devices.camera import GrayImage
from survey.detection.gray import AnyImage, gray_values

# names of SFNC's first edition, which many cameras still use, in the same units. Not Gain: GainRaw has none
OLDER_NAMES = {
    "ExposureTime": "ExposureTimeAbs",
    "Gain": "GainAbs",
    "DeviceSerialNumber": "DeviceID",
    "AcquisitionFrameRate": "AcquisitionFrameRateAbs",
}
# SFNC locks the region while images are sent; not every camera does. What starts an image is asked for once, when the
# camera is armed
LOCKED_WHILE_ARMED = (
    *("Width", "Height", "OffsetX", "OffsetY", "PixelFormat"),
    *("TriggerSelector", "TriggerMode", "TriggerSource"),
)


def gray_copy(image: AnyImage) -> GrayImage:
    """A copy of its own, (h, w) uint8 or uint16; colour (B G R) becomes grey of the same depth."""
    gray = np.rint(gray_values(image)) if image.ndim == 3 else image
    return np.array(gray, np.uint8) if image.dtype == np.uint8 else np.array(gray, np.uint16)


def bits_of(pixel_format: str) -> int:
    """Depth of a format of GenICam's PFNC: 12 for Mono12, Mono12p, Mono12Packed; 8 where the name holds no depth."""
    digits = "".join(c if c.isdigit() else " " for c in pixel_format).split()
    return int(digits[0]) if digits else 8


def is_mosaic_or_gray(pixel_format: str) -> bool:
    """Whether one value a pixel is sent: grey, or a colour mosaic, which is kept as it is."""
    return pixel_format.startswith(("Mono", "Bayer"))
