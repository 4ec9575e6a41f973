"""The lens of images that show a part of the sensor, or in another size.

Pixel u of the whole image is ``scale (u + 1/2 - left) - 1/2`` of such an image, v likewise with the top: the centre of
the first pixel is (0, 0), the edge of the image at -1/2. Focal lengths scale together, the principal point scales and
shifts, and distortion stays what it is in normalised coordinates: coefficients in 1/mm^n go with ``scale^-n``.
"""


import numpy as np

from adjust.lenses.models import LensModel, principal_components
from adjust.model.frozen import frozen
from adjust.model.survey import Camera, FloatArray, ImageCrop

UNITS = ("1", "px", "px")
"""Of ``CROP``."""


@frozen(eq=False)
class CroppedLens:
    """values (n,); by_lens (n,): by those of the whole image, by_crop (n, 3): by ``CROP``."""

    values: FloatArray
    by_lens: FloatArray
    by_crop: FloatArray


def cropped_lens(model: LensModel, values: FloatArray, constants: FloatArray, crop: FloatArray) -> CroppedLens:
    """The lens (n,) of a whole image, with its constants (4,), as it is in images of that crop (3,).

    The constants stay: a balance radius, which would not, is not for images of another scale.
    """
    scale, edges = crop[0], crop[1:]
    power = np.array([_power(unit) for unit in model.units])
    by_lens = scale**power
    new, by_crop = by_lens * values, np.zeros((model.n, 3))
    by_crop[:, 0] = power * by_lens / scale * values
    at, per_px, centre = principal_components(model, constants)
    from_edge = values[at] / per_px + centre + 0.5 - edges  # px of the whole image
    new[at] = per_px * (scale * from_edge - 0.5 - centre)
    by_crop[at, 0] = per_px * from_edge
    by_crop[at, [1, 2]] = -per_px * scale
    return CroppedLens(new, by_lens, by_crop)


def whole_image(uv: FloatArray, crop: FloatArray) -> FloatArray:
    """Pixels (n, 2) of the whole image, from those of a crop (3,)."""
    return np.asarray((uv + 0.5) / crop[0] + crop[1:] - 0.5)


def crop_size(whole: tuple[int, int], crop: ImageCrop) -> tuple[int, int]:
    """Width and height in px of the images of a crop, as it is given, from those of whole images."""
    if crop.size is not None:
        return crop.size
    scale, *edges = np.asarray(crop.parameters.values).tolist()
    width, height = (round(scale * (n - edge)) for n, edge in zip(whole, edges, strict=True))
    return width, height


def possible_sizes(camera: Camera) -> list[tuple[int, int]]:
    """Width and height in px that images of a camera may have."""
    return [camera.image_size, *(crop_size(camera.image_size, crop) for crop in camera.lens.crops.values())]


def _power(unit: str) -> int:
    """The power of the scale with which a parameter of that unit goes."""
    if unit in ("px", "mm"):
        return 1
    return 0 if unit == "1" else -int(unit.removeprefix("1/mm").removeprefix("^") or 1)
