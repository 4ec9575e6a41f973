"""The images of a project folder, ``images/<camera_id>/<epoch_id>.png``, and what detection looks for in them."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import field, fields, is_dataclass
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from survey.folder.text import id_problem, suggestion
from survey.project.detected import ImageKey
from survey.project.project import Definition
from survey.project.targets import DetectableTarget, PointList

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


def find_images(folder: Path, camera_ids: Iterable[str]) -> dict[tuple[str, str], Path]:
    """Images below ``folder`` by (camera_id, epoch_id), in natural order; hidden files are passed over."""
    camera_ids = tuple(camera_ids)
    images: dict[tuple[str, str], Path] = {}
    for entry in visible(folder):
        if not entry.is_dir():
            raise SurveyError(f"{entry}: a file among the cameras' folders; move it to {folder}/<camera_id>/ or out")
        if entry.name not in camera_ids:
            near = suggestion(entry.name, camera_ids)
            raise SurveyError(f"{entry}: images of the unknown camera {entry.name!r}; {near}")
        for path in visible(entry):
            key = (entry.name, _epoch_id(path))
            if key in images:
                raise SurveyError(f"{path}: epoch {key[1]!r} has an image already, {images[key].name}; remove one")
            images[key] = path
    return images


def visible(folder: Path) -> list[Path]:
    """What lies in a folder, in natural order, without hidden files; nothing where there is none."""
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


@frozen
class Sought:
    """Targets by id, and the smallest and largest diameter (px) of spots where these are looked for."""

    targets: Mapping[str, DetectableTarget] = field(default_factory=dict)
    spots_px: tuple[float, float] | None = None

    def digest(self) -> str:
        """A hash by which a change in survey.toml shows."""
        return hashlib.sha256(repr((_plain(dict(self.targets)), self.spots_px)).encode()).hexdigest()


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if is_dataclass(value):
        return [type(value).__name__, *((f.name, _plain(getattr(value, f.name))) for f in fields(value))]
    if isinstance(value, dict):
        return sorted((k, _plain(v)) for k, v in value.items())
    return value


def sought_in(definition: Definition) -> dict[ImageKey, Sought]:
    """Every image with what may be in it: all targets, except on images that are reserved for spots."""
    request = definition.spots_request
    targets: dict[str, DetectableTarget] = {
        target_id: kind for target_id, kind in definition.target_kinds.items() if not isinstance(kind, PointList)
    }
    found = {}
    for camera_id, epoch_id in definition.images:
        wanted = request is not None and camera_id in request.cameras
        reserved = wanted and request is not None and request.epochs is not None and epoch_id in request.epochs
        spots = None
        if wanted and request is not None and (reserved or (request.epochs is None and not targets)):
            spots = request.diameter_px
        only = definition.target_cameras
        here = {} if reserved else {t: k for t, k in targets.items() if camera_id in only.get(t, (camera_id,))}
        if here or spots:
            found[camera_id, epoch_id] = Sought(here, spots)
    return found
