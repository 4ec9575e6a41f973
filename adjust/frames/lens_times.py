"""When a lens changes and images are cropped, and what either is at an epoch."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np

from adjust.lenses.crops import crop_size, cropped_lens, whole_image
from adjust.lenses.models import MODELS, camera_constants
from adjust.model.errors import SurveyError
from adjust.model.names import natural_key
from adjust.model.result import ParameterName
from adjust.model.survey import Camera, FloatArray, ImageCrop, Survey


def block_starts(survey: Survey, camera: Camera) -> dict[str, str | None]:
    """By epoch of a camera's images, in their order: the epoch at which its lens last changed, None in the first block.

    Raises SurveyError for a change at which the camera has no image.
    """
    return _starts(survey, camera, () if camera.lens.drift is None else camera.lens.drift.begins, "drift.begins")


def crop_starts(survey: Survey, camera: Camera) -> dict[str, str | None]:
    """Likewise: the epoch from which on its images are cropped as they are, None where they are whole."""
    return _starts(survey, camera, camera.lens.crops, "crops")


def _starts(survey: Survey, camera: Camera, begins: Iterable[str], key: str) -> dict[str, str | None]:
    epochs = dict.fromkeys(b.epoch_id for b in survey.image_blocks if b.camera_id == camera.camera_id)
    if missing := [e for e in begins if epochs and e not in epochs]:
        raise SurveyError(f"camera {camera.camera_id!r}: its lens is to change at epoch {missing[0]!r}, at which it "
                          f"has no image; correct {key}")  # fmt: skip
    out: dict[str, str | None] = {}
    start: str | None = None
    for epoch in epochs:
        start = epoch if epoch in begins else start
        out[epoch] = start
    return out


def changed(camera: Camera, lens: FloatArray, by: Mapping[str, float]) -> FloatArray:
    """A lens (n,) of the camera with so much added to some of its parameters, and its share to what is tied to them."""
    out, names = lens.copy(), MODELS[camera.lens.model].names
    by = {**by, **{tie.name: tie.factor * by[tie.to] for tie in camera.lens.ties if tie.to in by}}
    out[[names.index(x) for x in by]] += list(by.values())
    return out


class LensTimes:
    """Which lens the images of a survey have.

    Of an epoch without image: what the last one before it has, in the order of names; of no epoch (None): the last one.
    """

    def __init__(self, survey: Survey) -> None:
        self.survey = survey
        self._blocks = {c.camera_id: block_starts(survey, c) for c in survey.cameras if c.lens.drift is not None}
        self._crops = {c.camera_id: crop_starts(survey, c) for c in survey.cameras if c.lens.crops}

    def crop(self, camera: Camera, epoch_id: str | None) -> tuple[str, ImageCrop] | None:
        """Since when and how a camera's image is cropped."""
        start = _at(self._crops.get(camera.camera_id, {}), epoch_id)
        return None if start is None else (start, camera.lens.crops[start])

    def size(self, camera: Camera, epoch_id: str | None) -> tuple[int, int]:
        """Width and height in px of a camera's image."""
        crop = self.crop(camera, epoch_id)
        return camera.image_size if crop is None else crop_size(camera.image_size, crop[1])

    def lens(
        self, camera: Camera, epoch_id: str | None, value: Callable[[ParameterName], FloatArray | None]
    ) -> FloatArray:
        """A lens (n,) from the values of ``lens``, ``lens_drift`` and ``lens_crop``.

        Of an epoch without temperature: at the reference temperature. Raises SurveyError where the lens has no value.
        """
        own, model = value(("lens", camera.camera_id)), MODELS[camera.lens.model]
        if own is None:
            raise SurveyError(f"camera {camera.camera_id!r}: its lens has no values yet; adjust the project first")
        out, change = own, self.change(camera, epoch_id)
        if camera.lens.drift is not None and change is not None and (found := value(change[0])) is not None:
            by = (change[1] * found).tolist()
            out = changed(camera, out, dict(zip(camera.lens.drift.parameters, by, strict=True)))
        if (crop := self.crop(camera, epoch_id)) is None:
            return out.copy()
        cropped = value(("lens_crop", camera.camera_id, crop[0]))
        given = np.asarray(crop[1].parameters.values, dtype=float)
        return cropped_lens(model, out, camera_constants(camera), given if cropped is None else cropped).values

    def change(self, camera: Camera, epoch_id: str | None) -> tuple[ParameterName, float] | None:
        """The parameters that are added to a camera's lens, and what they are multiplied with."""
        drift, starts = camera.lens.drift, self._blocks.get(camera.camera_id, {})
        if drift is None:
            return None
        if (reference := drift.reference_temperature) is not None:
            now = self.survey.temperatures.get(next(reversed(starts), "") if epoch_id is None else epoch_id, reference)
            return ("lens_drift", camera.camera_id), now - reference
        start = _at(starts, epoch_id)
        return None if start is None else (("lens_drift", camera.camera_id, start), 1.0)


def _at(starts: Mapping[str, str | None], epoch_id: str | None) -> str | None:
    if epoch_id is not None and epoch_id in starts:
        return starts[epoch_id]
    before = [e for e in starts if epoch_id is None or natural_key(e) <= natural_key(epoch_id)]
    return starts[before[-1]] if before else next(iter(starts.values()), None)


def whole_images(survey: Survey) -> Survey:
    """The survey with its image points in pixels of whole images, by the crops as they are given."""
    cameras = {c.camera_id: (crop_starts(survey, c), c.lens.crops) for c in survey.cameras if c.lens.crops}
    if not cameras:
        return survey
    blocks = []
    for block in survey.image_blocks:
        starts, crops = cameras.get(block.camera_id, ({}, {}))
        if (start := starts.get(block.epoch_id)) is not None:
            crop = np.asarray(crops[start].parameters.values)
            block = replace(block, uv=whole_image(block.uv, crop), cov=block.cov / crop[0] ** 2)
        blocks.append(block)
    lenses = [replace(c.lens, crops={}) for c in survey.cameras]
    return replace(survey, image_blocks=tuple(blocks),
                   cameras=tuple(replace(c, lens=x) for c, x in zip(survey.cameras, lenses, strict=True)))  # fmt: skip
