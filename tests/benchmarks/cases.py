"""Arrays that travel to a worker as one ``.npz`` file."""

from dataclasses import fields
from pathlib import Path
from typing import Self

import numpy as np


class Arrays:
    """A frozen dataclass of arrays with this base can be saved and loaded."""

    def save(self, path: Path) -> None:
        """Write all fields."""
        np.savez(path, **{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read all fields."""
        with np.load(path) as data:
            return cls(**{f.name: data[f.name] for f in fields(cls)})
