"""What detection gives back, as frozen values."""

from dataclasses import field
from pathlib import Path
from typing import Literal

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray


@frozen(eq=False)
class Detection:
    """Points of one target in one image; empty where it was not found, and ``reason`` says why.

    point_idx: (n,) positions in the target's ``points()``. uv: (n, 2) px. cov: (n, 2, 2) px^2.
    blur_px: median standard deviation of the point spread.
    other_size: columns and rows of inner corners of a board that is there instead.
    """

    point_idx: IntArray
    uv: FloatArray
    cov: FloatArray
    blur_px: float = float("nan")
    reason: str = ""
    other_size: tuple[int, int] | None = None

    def __len__(self) -> int:
        return len(self.point_idx)


def nothing_found(reason: str, other_size: tuple[int, int] | None = None) -> Detection:
    """An empty detection."""
    none = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2))
    return Detection(*none, reason=reason, other_size=other_size)


@frozen(eq=False)
class Spots:
    """Luminous spots of one image, brightest first: uv (n, 2) px, cov (n, 2, 2) px^2, full width at half maximum (n,).

    peak: (n,) grey values above the background; saturated: (n,) number of pixels left out for being saturated.
    """

    uv: FloatArray
    cov: FloatArray
    diameter_px: FloatArray
    peak: FloatArray
    saturated: IntArray

    def __len__(self) -> int:
        return len(self.uv)


@frozen
class SpotOptions:
    """Which spots to look for.

    diameter_px: full width at half maximum, from and to. min_contrast: peak above the background, in standard
    deviations of the noise. max_elongation: longest over shortest axis. max_count: the brightest ones are kept.
    """

    diameter_px: tuple[float, float] = (2.0, 12.0)
    min_contrast: float = 10.0
    max_elongation: float = 1.6
    max_count: int = 1000


@frozen(eq=False)
class ImageReport:
    """What became of one image.

    status: ``found`` (something), ``nothing``, or ``failed`` (unreadable); message says more.
    detections: by target id, empty ones with their reason included. spots: None where none were asked for.
    """

    path: Path
    camera_id: str
    epoch_id: str
    status: Literal["found", "nothing", "failed"]
    message: str = ""
    detections: dict[str, Detection] = field(default_factory=dict)
    spots: Spots | None = None
    image_size: tuple[int, int] | None = None
