"""How the table stands, told to whoever renders: a function, or a small file that another process can follow."""

import json
import os
from collections.abc import Callable
from pathlib import Path

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen

Angles = Callable[[], tuple[float, float]]
"""The true angles (axis1, axis2) of the table at this moment, rad."""


def write_angles(path: Path, axis1_rad: float, axis2_rad: float) -> None:
    """Tell the angles; whoever reads sees the old pair or the new one, never half of each."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps({"axis1_rad": axis1_rad, "axis2_rad": axis2_rad}), encoding="utf-8")
    os.replace(temporary, path)


@frozen
class AnglesFile:
    """Reads what ``write_angles`` wrote: ``AnglesFile(path)()``."""

    path: Path

    def __call__(self) -> tuple[float, float]:
        """(axis1, axis2) rad. Raises SurveyError where the file is missing or holds something else."""
        try:
            told = json.loads(self.path.read_text(encoding="utf-8"))
            return float(told["axis1_rad"]), float(told["axis2_rad"])
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise SurveyError(
                f"{self.path}: does not tell the table's angles ({error}); start the simulated table first"
            ) from error
