"""Keys of ``survey.toml`` that let a lens be another one from some epoch on, or its images cropped."""

from collections.abc import Sequence

from adjust.diagnosis.hypothesis import Edit, SetKey
from adjust.lenses.models import MODELS
from adjust.model.survey import FloatArray, Survey


def block_keys(survey: Survey, camera_id: str, names: Sequence[str], begins: Sequence[str]) -> tuple[Edit, ...]:
    """``lens.drift``: parameters in blocks that begin at these epochs; none where it is there, or none is free."""
    lens = survey.cameras_by_id[camera_id].lens
    changing = tuple(x for x in names if x in lens.free)
    if lens.drift is not None or not changing:
        return ()
    path = ("cameras", camera_id, "lens", "drift")
    return SetKey((*path, "parameters"), changing), SetKey((*path, "begins"), tuple(begins))


def crop_keys(
    survey: Survey, camera_id: str, epoch_id: str, scale: float = 1.0, shift: Sequence[float] | FloatArray = (0.0, 0.0)
) -> tuple[Edit, ...]:
    """``lens.crops``: from this epoch on images of another size, or whose points moved by ``shift`` px.

    None where images are cropped already, or the lens is in mm.
    """
    camera = survey.cameras_by_id[camera_id]
    if camera.lens.crops or MODELS[camera.lens.model].in_mm:
        return ()
    path = ("cameras", camera_id, "lens", "crops", epoch_id)
    resized = scale != 1.0
    values = {"scale": scale} if resized else {"left_px": -float(shift[0]), "top_px": -float(shift[1])}
    return (
        SetKey((*path, "free"), ("scale",) if resized else ("left", "top")),
        *(SetKey((*path, key), float(f"{value:.6g}")) for key, value in values.items()),
        SetKey((*path, "size_px"), tuple(round(scale * n) for n in camera.image_size)),
    )


def key_text(keys: Sequence[Edit]) -> str:
    """The table of ``survey.toml`` that the first of these keys stands in."""
    return next(".".join(key.path[:-1]) for key in keys if isinstance(key, SetKey))
