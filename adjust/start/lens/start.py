"""A start for the lens of one camera, from the targets it sees: given, remembered or found."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from adjust.lenses.models import FOCAL, LensModel, lens_model
from adjust.model.errors import SurveyError
from adjust.model.survey import Camera, FloatArray
from adjust.start.lens.search import LensSearch, LensStart
from adjust.start.views import Sighting


def start_lens(
    camera: Camera, sightings: Sequence[Sighting], lent: Mapping[str, float] = MappingProxyType({}),
    near: FloatArray | None = None,
) -> LensStart:  # fmt: skip
    """Lens values from the given ones, or from the images of known points; ``lent``: those that another camera tells.

    Planar targets: Zhang's closed form, or the best of a scan of focal lengths, then lens and poses together on at most
    30 well-spread images. Raises SurveyError naming the camera where nothing determines its focal length.
    near: values (n,) whose focal length and centre are taken where no closed form misses little: nothing is scanned.
    """
    model = lens_model(camera.lens.model)
    if camera.lens.values is not None:
        _check_given(camera, model)
        return LensStart(np.array(camera.lens.values, dtype=float), "lens as given", {})
    known = _remembered.get()
    if known is None:
        return LensSearch(camera, model, lent).run(sightings, near)
    key = (camera.camera_id, camera.image_size, camera.lens, tuple(lent.items()),
           tuple((s.x.tobytes(), s.uv.tobytes()) for s in sightings))  # fmt: skip
    if key not in known or (known[key][1] and near is None):
        alone = [s._replace(block_idx=i) for i, s in enumerate(sightings)]
        try:
            start: LensStart | SurveyError = LensSearch(camera, model, lent).run(alone, near)
        except SurveyError as error:
            start = error
        known[key] = start, near is not None and isinstance(start, LensStart) and not start.refined
    found, _ = known[key]
    if isinstance(found, SurveyError):
        raise found
    return replace(found, values=found.values.copy(),
                   excluded={sightings[i].block_idx: why for i, why in found.excluded.items()})  # fmt: skip


@contextmanager
def remembering() -> Iterator[None]:
    """Inside, what the same images of a camera have told of its lens is not searched again: of surveys that are alike.

    Lenses are told apart by identity.
    """
    token = _remembered.set({})
    try:
        yield
    finally:
        _remembered.reset(token)


_Found = tuple[LensStart | SurveyError, bool]
"""What the search gave, and whether it ended at values that were known before, though these led nowhere."""
_remembered: ContextVar[dict[object, _Found] | None] = ContextVar("remembered lenses", default=None)


def _check_given(camera: Camera, model: LensModel) -> None:
    values = np.asarray(camera.lens.values)
    if values.shape != (model.n,):
        raise SurveyError(f"camera {camera.camera_id!r}: {values.size} lens values given, {model.name} has {model.n}")
    for name, value in zip(model.names, values, strict=True):
        if name in FOCAL and not value > 0:
            raise SurveyError(
                f"camera {camera.camera_id!r}: the lens value {name} is {value:g}; give a positive start for it, or no"
                " lens values at all, then they are found from the images"
            )
