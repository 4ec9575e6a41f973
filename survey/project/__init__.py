"""The project folder: ``read`` gives a ``Project``, ``write_project`` writes one."""

from survey.folder.text import atomic_write
from survey.project.project import (
    AdjustmentOptions,
    Definition,
    Project,
    Sigmas,
    SpotBlock,
    SpotsRequest,
)
from survey.project.reading import read, read_definition
from survey.project.writing import write_project

__all__ = [
    "AdjustmentOptions",
    "Definition",
    "Project",
    "Sigmas",
    "SpotBlock",
    "SpotsRequest",
    "atomic_write",
    "read",
    "read_definition",
    "write_project",
]
