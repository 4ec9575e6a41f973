"""What detection looks for in which image of a project."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from survey.project.detected import ImageKey
from survey.project.project import Definition
from survey.project.targets import DetectableTarget, PointList


@dataclass(frozen=True)
class Sought:
    """Targets by id, and the smallest and largest diameter (px) of spots where these are looked for."""

    targets: Mapping[str, DetectableTarget] = field(default_factory=dict)
    spots_px: tuple[float, float] | None = None

    def digest(self) -> str:
        """A hash by which a change in survey.toml shows."""
        return hashlib.sha256(repr((_plain(dict(self.targets)), self.spots_px)).encode()).hexdigest()


def _plain(value: Any) -> Any:
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
