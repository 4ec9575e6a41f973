"""Images of a project for a page: looked up by camera and epoch, never by a path."""

import hashlib
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adjust.model.errors import SurveyError
from survey.project.detected import DetectedImage

if TYPE_CHECKING:  # brings in OpenCV, which a page that shows no picture yet does without
    from survey.detection import ImageReport
    from survey.detection.gray import Gray8, Gray32

_QUALITY = 85
_LARGEST_SIDE = 4096
_MOST_SHOWN = 400


def picture(images: Mapping[tuple[str, str], Path], key: tuple[str, str], size: int | None) -> tuple[bytes, str]:
    """An image as bytes and their media type: a JPEG whose longer side has ``size`` px, None: a PNG of every pixel.

    Grey values are stretched to 8 bit. Raises KeyError for what is no image, SurveyError for what cannot be read.
    """
    import cv2

    from survey.detection.gray import gray_values, read_image

    path = images[key]
    if not is_plain(path):
        raise SurveyError(f"{path}: is a link or no file; put the image itself into the project")
    stored = read_image(path)
    image: Any = stored if stored.dtype == np.uint8 else _in_8_bit(gray_values(stored))
    if size is None:
        return _encoded(path, ".png", image, []), "image/png"
    factor = min(1.0, min(size, _LARGEST_SIDE) / max(image.shape[:2]))
    if factor < 1.0:
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return _encoded(path, ".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]), "image/jpeg"


def is_plain(path: Path) -> bool:
    """Whether an image is a file and neither it nor the folder of its camera a link. Raises OSError."""
    return stat.S_ISREG(os.lstat(path).st_mode) and not path.parent.is_symlink()


def _in_8_bit(image: "Gray32") -> "Gray8":
    low, high = float(image.min()), float(image.max())
    return np.asarray(np.clip((image - low) * (255.0 / max(high - low, 1e-9)), 0, 255), dtype=np.uint8)


def _encoded(path: Path, ending: str, image: Any, how: list[int]) -> bytes:
    import cv2

    done, data = cv2.imencode(ending, image, how)
    if not done:
        raise SurveyError(f"{path}: cannot be shown; export it again as PNG")
    return data.tobytes()


def etag(known: DetectedImage | None, path: Path, size: int | None) -> str:
    """A name for what an image looks like: by the hash that detection made of the file, else by its time and size."""
    status = path.stat()
    same = known is not None and (known.size, known.mtime_ns) == (status.st_size, status.st_mtime_ns)
    text = known.sha256 if same and known is not None else f"{path.name} {status.st_size} {status.st_mtime_ns}"
    return f'"{hashlib.sha256(f"{text} {size}".encode()).hexdigest()[:32]}"'


def found_in(report: "ImageReport") -> dict[str, object]:
    """What detection found in an image, for a page that shows its picture: size, up to ``_MOST_SHOWN`` places (px)."""
    found = [d.uv for d in report.detections.values()] + ([report.spots.uv] if report.spots is not None else [])
    uv = np.concatenate([*found, np.zeros((0, 2))])
    return {"image": f"{report.camera_id}/{report.epoch_id}", "status": report.status, "message": report.message,
            "n": len(uv), "size": report.image_size, "uv": np.round(uv[:_MOST_SHOWN], 1).tolist()}  # fmt: skip
