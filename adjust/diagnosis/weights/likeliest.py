"""How large errors are which nobody gives: one variance component beside the observations' own."""

from collections.abc import Sequence

import numpy as np

from adjust.model.survey import FloatArray


def likeliest_size(b: FloatArray, M: FloatArray, sizes: Sequence[float]) -> tuple[float, float]:
    """That of some sizes, and minus twice the logarithm of its restricted likelihood over that of none.

    With ``b = B'e`` (k,) and M (k, k), what the unknowns leave of B'B, v'Pv falls by ``b' inv(M + I / s^2) b`` where
    the errors have variances s^2; ``log det (I + s^2 M)`` counts against it (REML; Patterson, Thompson 1971).
    """
    values, axes = np.linalg.eigh(M)
    along, squares = (axes.T @ b) ** 2, np.square(sizes)[:, None]
    left = squares * np.maximum(values, 0.0)
    costs = (np.log1p(left) - squares * along / (1.0 + left)).sum(axis=1)
    best = int(np.argmin(costs))
    return sizes[best], float(costs[best])
