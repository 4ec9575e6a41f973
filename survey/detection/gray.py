"""Images as grey values: what is read from a file or a camera, and what the detectors work on.

How large an image says it is, is read before anything is decoded: a few bytes can claim any number of pixels. Sources:
PNG (W3C, 11.2.2 IHDR), TIFF 6.0 (tags 256 and 257), JPEG (ITU T.81, B.2.2 frame header), BMP (BITMAPINFOHEADER).
"""

import struct
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray

Gray8 = npt.NDArray[np.uint8]
Gray32 = npt.NDArray[np.float32]
AnyImage = npt.NDArray[np.generic]
LARGEST_PIXELS = 400_000_000  # the largest sensors have a third of that
_LARGEST_BYTES = 2**32
_HEAD = 2**20  # bytes in which the size is looked for
_SAMPLE = 60_000  # pixels whose percentiles stand for those of the image


def read_image(path: Path) -> AnyImage:
    """The image as stored, (h, w) or (h, w, channels), 8 or 16 bit; its EXIF orientation is not applied.

    Raises SurveyError where the file is missing or is no image.
    """
    if not path.is_file():
        raise SurveyError(f"{path}: there is no such file; correct the name or take it out of the project")
    if not path.stat().st_size <= _LARGEST_BYTES:
        raise SurveyError(f"{path}: {path.stat().st_size / 1e9:.1f} GB are more than an image has; take it out")
    data = np.fromfile(path, np.uint8)
    size = image_size(data[:_HEAD].tobytes())
    if size is not None and size[0] * size[1] > LARGEST_PIXELS:
        raise SurveyError(f"{path}: {size[0]} x {size[1]} px are more than {LARGEST_PIXELS:.0e}; cut the image")
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error:  # its own limits; what it says names its source code, not the user's file
        image = None
    if image is None:
        raise SurveyError(
            f"{path}: not an image that OpenCV can read ({len(data)} bytes); export it again as PNG or TIFF"
        )
    return np.asarray(image)


def gray_values(image: AnyImage) -> Gray32:
    """Grey values (h, w) in the image's own range; colour (B G R, alpha left out): 0.299 R + 0.587 G + 0.114 B."""
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim == 3 and image.shape[2] in (3, 4):
        b, g, r = (image[:, :, k].astype(np.float32) for k in range(3))
        return np.asarray(0.114 * b + 0.587 * g + 0.299 * r, np.float32)
    if image.ndim != 2 or image.size == 0:
        raise SurveyError(f"image of shape {image.shape}: give (h, w) grey or (h, w, 3) colour")
    return np.ascontiguousarray(image, np.float32)


def saturation_level(image: AnyImage) -> float:
    """Grey value of a full pixel: 255, or the end of the smallest of 10, 12, 14, 16 bit that holds the image."""
    if image.dtype == np.uint8:
        return 255.0
    top = float(np.max(image))
    return float(next((2**bits - 1 for bits in (8, 10, 12, 14, 16) if top <= 2**bits - 1), top))


def for_finding(gray: Gray32 | Gray8) -> Gray8:
    """8 bit for OpenCV's finders; deeper images and dim ones are stretched between their 0.1 and 99.9 percentiles."""
    step = max(7, int(np.sqrt(gray.size / _SAMPLE)))
    some = gray[::step, ::step].ravel()
    levels = np.asarray(np.sort(some, kind="stable") if some.dtype == np.uint8 else np.sort(some), np.float64)  # radix
    low, high = np.interp(np.array([0.001, 0.999]) * (len(levels) - 1), np.arange(len(levels)), levels).tolist()
    if low >= 0.0 and high - low >= 60.0 and high <= 255.0:
        if gray.dtype == np.uint8:
            return np.asarray(gray, np.uint8)
        low, high = 0.0, 255.0
    scale = 255.0 / max(high - low, 1.0)
    # one pass over the image that scales, shifts, rounds and clips
    return np.asarray(cv2.addWeighted(gray, scale, gray, 0.0, -low * scale, dtype=cv2.CV_8U), np.uint8)


def halved(gray8: Gray8, longest_px: int) -> tuple[Gray8, FloatArray]:
    """The image halved while its longer side keeps at least so many pixels, and the factor (2,) back.

    ``u = (u_reduced + 0.5) * factor - 0.5``.
    """
    factor = np.ones(2)
    while max(gray8.shape) >= 2 * longest_px:
        w, h = gray8.shape[1] // 2, gray8.shape[0] // 2
        # an odd row or column is cut off: every pixel is the mean of four, and the factor is two
        gray8 = np.asarray(cv2.resize(gray8[: 2 * h, : 2 * w], (w, h), interpolation=cv2.INTER_AREA), np.uint8)
        factor *= 2.0
    return gray8, factor


def reduced(gray8: Gray8, longest_px: int) -> tuple[Gray8, FloatArray]:
    """The image with at most so many pixels along its longer side, itself where it has, and the factor as `halved`.

    Halving is fast, so as much as can be is done by it.
    """
    gray8, factor = halved(gray8, longest_px)
    scale = max(gray8.shape) / longest_px
    if scale <= 1.0:
        return gray8, factor
    size = (round(gray8.shape[1] / scale), round(gray8.shape[0] / scale))
    factor *= [gray8.shape[1] / size[0], gray8.shape[0] / size[1]]
    return np.asarray(cv2.resize(gray8, size, interpolation=cv2.INTER_AREA), np.uint8), factor


_TIFF_TYPES = {1: "B", 3: "H", 4: "I"}


def image_size(head: bytes) -> tuple[int, int] | None:
    """(width, height) by the first bytes of a PNG, TIFF, JPEG or BMP file; None where they do not tell."""
    try:
        if head.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", head, 16)
            return width, height
        if head.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", head, 18)
            return abs(width), abs(height)
        if head[:4] in (b"II*\0", b"MM\0*"):
            return _tiff_size(head, "<" if head[:1] == b"I" else ">")
        if head.startswith(b"\xff\xd8"):
            return _jpeg_size(head)
    except struct.error:  # the header goes on beyond what is there
        pass
    return None


def _tiff_size(head: bytes, order: str) -> tuple[int, int] | None:
    (at,) = struct.unpack_from(order + "I", head, 4)
    (count,) = struct.unpack_from(order + "H", head, at)
    found: dict[int, int] = {}
    for i in range(count):
        tag, kind = struct.unpack_from(order + "HH", head, at + 2 + 12 * i)
        if tag in (256, 257) and kind in _TIFF_TYPES:
            (found[tag],) = struct.unpack_from(order + _TIFF_TYPES[kind], head, at + 10 + 12 * i)
    return (found[256], found[257]) if len(found) == 2 else None


def _jpeg_size(head: bytes) -> tuple[int, int] | None:
    at = 2
    while True:
        mark, kind, length = struct.unpack_from(">BBH", head, at)
        if mark != 0xFF:
            return None
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", head, at + 5)
            return width, height
        at += 1 if kind == 0xFF else 2 + length  # bytes that fill up, then the marker itself
