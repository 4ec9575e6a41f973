"""The project folder: ``read`` gives a ``Project``, ``write_project`` writes one."""

from survey.files.project import (
    AdjustmentOptions,
    Definition,
    ImagePointsWhere,
    Project,
    Sigmas,
    SpotBlock,
    SpotsRequest,
)
from survey.files.reading import read, read_definition
from survey.files.text import atomic_write

__all__ = [
    "AdjustmentOptions",
    "Definition",
    "ImagePointsWhere",
    "Project",
    "Sigmas",
    "SpotBlock",
    "SpotsRequest",
    "atomic_write",
    "read",
    "read_definition",
]
