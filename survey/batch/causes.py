"""Why a folder could not be adjusted, in a few kinds that a person can act on."""

import re

from adjust.model.errors import IndeterminateError, NotConvergedError, SurveyError
from survey.folder.locking import BusyError

CAUSES = {
    "project": "no project",
    "files": "error in the project's files",
    "undetermined": "not determined",
    "convergence": "did not converge",
    "survey": "cannot be adjusted",
    "access": "file or folder not accessible",
    "busy": "another command works on it",
    "memory": "out of memory",
    "process": "its process ended abruptly",
    "cluster": "lost on the cluster",
    "internal": "internal error",
}
"""Kind of failure and how it is called."""

MAY_PASS = frozenset({"access", "busy", "memory", "process"})
"""What a second try may mend: everything else would end the same way again."""

_LINE_OF_FILE = re.compile(r"\.(toml|csv|parquet)(:|\b)")


def cause_of(error: BaseException) -> str:
    """The kind of a failure."""
    if isinstance(error, IndeterminateError):
        return "undetermined"
    if isinstance(error, NotConvergedError):
        return "convergence"
    if isinstance(error, BusyError):
        return "busy"
    if isinstance(error, SurveyError):
        text = str(error)
        if "no such folder" in text or "there is no survey.toml" in text:
            return "project"
        return "files" if _LINE_OF_FILE.search(text.split("; ")[0]) else "survey"
    if isinstance(error, OSError):
        return "access"
    return "memory" if isinstance(error, MemoryError) else "internal"
