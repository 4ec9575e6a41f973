"""``covariance.npz`` read as its README says, by plain lines that are not those of the program."""

from pathlib import Path

import numpy as np


def written_covariances(path: Path) -> dict[str, np.ndarray]:
    """The blocks by ``kind/id[/epoch]``, each (n, n), as they were written."""
    with np.load(path) as found:
        names, sizes, block = found["parameters"], np.diff(found["start"]), found["block"]
        parts = np.split(found["covariance"], block[1:-1])
    return {str(n): part.reshape(k, k) for n, k, part in zip(names, sizes, parts, strict=True)}
