"""The images of a project folder: ``images/<camera_id>/<epoch_id>.png``."""

from collections.abc import Iterable
from pathlib import Path

from adjust.model.errors import SurveyError
from survey.folder.text import id_problem, natural_key, suggestion

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


def find_images(folder: Path, camera_ids: Iterable[str]) -> dict[tuple[str, str], Path]:
    """Images below ``folder`` by (camera_id, epoch_id), in natural order; hidden files are passed over."""
    camera_ids = tuple(camera_ids)
    images: dict[tuple[str, str], Path] = {}
    for entry in _visible(folder):
        if not entry.is_dir():
            raise SurveyError(f"{entry}: a file among the cameras' folders; move it to {folder}/<camera_id>/ or out")
        if entry.name not in camera_ids:
            near = suggestion(entry.name, camera_ids)
            raise SurveyError(f"{entry}: images of the unknown camera {entry.name!r}; {near}")
        for path in _visible(entry):
            key = (entry.name, _epoch_id(path))
            if key in images:
                raise SurveyError(f"{path}: epoch {key[1]!r} has an image already, {images[key].name}; remove one")
            images[key] = path
    return images


def _visible(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted((p for p in folder.iterdir() if not p.name.startswith(".")), key=lambda p: natural_key(p.name))


def _epoch_id(path: Path) -> str:
    if not path.is_file() or path.suffix.lower() not in IMAGE_ENDINGS:
        raise SurveyError(f"{path}: not an image; move it away, or save it as one of {', '.join(IMAGE_ENDINGS)}")
    problem = id_problem(path.stem)
    if problem:
        raise SurveyError(f"{path}: its name is its epoch: {problem}")
    return path.stem
