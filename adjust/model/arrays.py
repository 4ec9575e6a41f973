"""The arrays that values are made of."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
_MANY, _STEPS = 10_000, 65_536


def largest(values: FloatArray, most: int) -> IntArray:
    """Positions of the largest values (n,), which are numbers, at most so many: largest first, equal ones in order."""
    if len(values) > most > 0:  # sorting a million to show a few takes longer than all else
        k = max(len(values) // (8 * most), 1)
        of_parts = values[: len(values) // k * k].reshape(k, -1).max(axis=0)  # as many values are at least as large
        among = np.flatnonzero(values >= np.partition(of_parts, len(of_parts) - most)[len(of_parts) - most])
        return np.asarray(among[np.argsort(-values[among], kind="stable")][:most])
    return np.argsort(-values, kind="stable")[: max(most, 0)]


def ranked(values: FloatArray, ranks: IntArray) -> FloatArray:
    """Those of the values (n,), all finite, that would stand at these places (k,) in ascending order.

    Of many only what shares one of as many steps between the least and the largest with a value sought is sorted.
    """
    low, high = values.min(initial=np.inf), values.max(initial=-np.inf)
    if len(values) < _MANY or not low < high:
        return np.asarray(np.sort(values)[ranks])
    step = ((values - low) * ((_STEPS - 1) / (high - low))).astype(np.int32)
    ends = np.cumsum(np.bincount(step, minlength=_STEPS))
    wanted = np.zeros(_STEPS, dtype=np.bool_)
    wanted[np.searchsorted(ends, ranks, side="right")] = True
    before = ends - np.cumsum(np.where(wanted, np.diff(ends, prepend=0), 0))  # that are not sorted
    return np.asarray(np.sort(values[wanted[step]])[ranks - before[np.searchsorted(ends, ranks, side="right")]])
