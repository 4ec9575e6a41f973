"""Least squares of many complete networks of rotations in the core; the formulas are in ``trials.h``."""

import numpy as np

from adjust.model import FloatArray, IntArray
from adjust.native.library import Function

_adjust_trials = Function(
    "adjust_trials",
    "which[*] measured[T,E,3,3] information[T,E,3,3] n limit most adjusted[T,E,3,3] omega[T] iterations[T] work[*]",
)


def adjust_trials(
    which: IntArray, measured: FloatArray, information: FloatArray, n: int, limit: float, most: int,
    adjusted: FloatArray, omega: FloatArray, iterations: IntArray,
) -> None:  # fmt: skip
    """Adjusted ``b_from_a`` (T, E, 3, 3), v'Pv (T,) and iterations (T,) of the listed trials.

    measured, information: (T, E, 3, 3), pairs of n stations in the order (0, 1), (0, 2), ..., (1, 2), ... limit: of the
    last step, rad. ``most`` + 1 iterations are told where a trial did not settle.
    """
    work = np.empty(9 * n + 9 * (n - 1) ** 2 + 3 * (n - 1))
    _adjust_trials(which, measured, information, n, limit, most, adjusted, omega, iterations, work)
