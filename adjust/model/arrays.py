"""The arrays that values are made of."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def largest(values: FloatArray, most: int) -> IntArray:
    """Positions of the largest values (n,), which are numbers, at most so many: largest first, equal ones in order."""
    if len(values) > most > 0:  # sorting a million to show a few takes longer than all else
        among = np.flatnonzero(values >= np.partition(values, len(values) - most)[len(values) - most])
        return np.asarray(among[np.argsort(-values[among], kind="stable")][:most])
    return np.argsort(-values, kind="stable")[: max(most, 0)]
