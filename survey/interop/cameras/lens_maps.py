"""Lenses in the parameters that other programs have: exact where they can be, else the nearest with its difference."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from adjust.lenses.conversion import convert
from adjust.lenses.models import MODELS, camera_constants, lens_constants
from adjust.model.survey import Camera, FloatArray

BROWN_4 = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")
BROWN_5 = (*BROWN_4, "k3")
BROWN_8 = (*BROWN_5, "k4", "k5", "k6")
FISHEYE_4 = ("fx", "fy", "u0", "v0", "k1", "k2", "k3", "k4")
_EXACT_PX = 1e-9


@dataclass(frozen=True, eq=False)
class MappedLens:
    """A lens as another program has it. values: by parameter name. cov: (n, n) in the order of the model, or None.

    exact: whether it is the same lens; else largest_px says how far the two differ anywhere in the image, and note
    says so for people.
    """

    model: str
    values: dict[str, float]
    cov: FloatArray | None
    largest_px: float = 0.0
    note: str | None = None

    @property
    def exact(self) -> bool:
        """Whether nothing was approximated."""
        return self.largest_px == 0.0

    def array(self, *names: str) -> FloatArray:
        """Values of the named parameters."""
        return np.array([self.values[n] for n in names])


def mapped_lens(
    camera: Camera, values: FloatArray, choices: Mapping[str, tuple[str, ...]], cov: FloatArray | None = None
) -> MappedLens:
    """The lens (n,) of a camera in one of the allowed forms, ``choices``: model name to its usable parameters.

    The first exact choice is taken; where none is, the lens is fitted over the whole image by
    ``adjust.lenses.conversion`` in the first model, a fisheye's in a fisheye where that is among the choices. Of a lens
    that changes the note says which one it is. Raises SurveyError where no lens of that form fits.
    """
    model, taken = MODELS[camera.lens.model], _which(camera)
    if model.name in choices:
        usable = choices[model.name]
        if all(v == 0.0 or n in usable for n, v in zip(model.names, values, strict=True)):
            return MappedLens(model.name, dict(zip(model.names, map(float, values), strict=True)), cov, note=taken)
    wanted = MODELS[model.name if model.name in choices else next(iter(choices))]
    usable = choices[wanted.name]
    # three rational terms beside three others cannot be told apart: fit without them
    free = tuple(n for n in usable if wanted.name != "brown" or n not in ("k4", "k5", "k6"))
    found = convert(
        model, values, camera_constants(camera), wanted, lens_constants(wanted, camera.image_size), camera.image_size,
        free=free, cov=cov,
    )  # fmt: skip
    u, v = found.largest_at
    largest = found.largest_difference_px
    note = (
        f"camera {camera.camera_id}: the lens {model.name} is written as {wanted.name} with {', '.join(free)}, which "
        f"differs by up to {largest:.2g} px, at ({u:.0f}, {v:.0f}); the rms is {found.rms_px:.2g} px"
    )
    return MappedLens(
        wanted.name, dict(zip(wanted.names, map(float, found.values), strict=True)), found.cov,
        max(largest, _EXACT_PX), note if taken is None else f"{taken}; {note}",
    )  # fmt: skip


def _which(camera: Camera) -> str | None:
    """Which lens is written of one that changes or whose images are cropped."""
    lens, parts = camera.lens, []
    if lens.drift is not None:
        temperature = lens.drift.reference_temperature
        parts.append("of the first block of epochs" if temperature is None else f"at {temperature:g} degC")
    parts += ["of whole images"] if lens.crops else []
    return f"camera {camera.camera_id}: its lens is written as it is {' and '.join(parts)}" if parts else None
