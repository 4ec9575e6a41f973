"""The project folder: ``read`` gives a ``Project``, ``write_project`` writes one.

Every name is loaded when it is first used: large tables are read while all that their project needs is still loaded.
"""

from typing import TYPE_CHECKING

from adjust.model.loading import lazily

if TYPE_CHECKING:
    from survey.folder.text import atomic_write
    from survey.project.project import AdjustmentOptions, Definition, Project, Sigmas, SpotBlock, SpotsRequest
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
_PLACES = {
    **dict.fromkeys(__all__, "survey.project.project"),
    "atomic_write": "survey.folder.text",
    "read": "survey.project.reading",
    "read_definition": "survey.project.reading",
    "write_project": "survey.project.writing",
}

__getattr__ = lazily(globals(), _PLACES)
