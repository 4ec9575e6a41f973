"""Covariances in another datum, S Q S' with ``S = I - G (R G)^-1 R`` (Baarda 1973; Koch 1999 section 3.3.6)."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray

Products = Callable[[Mapping[int, FloatArray]], dict[int, FloatArray]]
"""From rows (k, dim) of some keys, R, to Q R' (dim, k) of every key."""


@frozen(eq=False)
class STransformation:
    """What the covariances of a solution lack to be in a datum: per key G (dim, k) and Q R' (R G)^-T (dim, k).

    core: (k, k), (R G)^-1 R Q R' (R G)^-T.
    """

    motions: Mapping[int, FloatArray]
    spread: Mapping[int, FloatArray]
    core: FloatArray

    def apply(self, keys: Sequence[int], Q: FloatArray) -> FloatArray:
        """The joint covariance of ``keys`` in the datum, from Q (n, n) in that of the solution."""
        G = np.concatenate([self.motions[k] for k in keys])
        W = np.concatenate([self.spread[k] for k in keys])
        return moved(Q, G, W, self.core)


def moved(Q: FloatArray, G: FloatArray, W: FloatArray, core: FloatArray) -> FloatArray:
    """Blocks (.., n, n) of a covariance, of unknowns with G, W (.., n, k), in the datum of this core (k, k)."""
    back = np.swapaxes(G, -1, -2)
    across = G @ np.swapaxes(W, -1, -2)
    return np.asarray(Q + (G @ core @ back - across - np.swapaxes(across, -1, -2)))


def s_transformation(
    rows: Mapping[int, FloatArray], motions: Mapping[int, FloatArray], products: Products
) -> STransformation:
    """The transformation to the datum ``rows`` (k, dim per key), of a solution with these ``motions`` (dim, k)."""
    seen = np.sum([row @ motions[key] for key, row in rows.items()], axis=0)
    inverse = np.linalg.inv(seen)
    found = products(rows)
    spread = {key: H @ inverse.T for key, H in found.items()}
    core = inverse @ np.sum([row @ spread[key] for key, row in rows.items()], axis=0)
    return STransformation(motions, spread, 0.5 * (core + core.T))


def transformed(
    d: FloatArray, Q: FloatArray, motions: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``S d`` and ``S Q S'`` with ``S = I - G (G'EG)^-1 G'E``, from motions G (n, k) to the datum of weights E (n,).

    Raises numpy's LinAlgError where the weighted components do not carry the motions.
    """
    EG = weights[:, None] * motions
    B = np.linalg.solve(motions.T @ EG, EG.T)
    half = Q - motions @ (B @ Q)
    return d - motions @ (B @ d), half - (half @ B.T) @ motions.T


def without_datum_rows(
    product: FloatArray, motions: FloatArray, seen: FloatArray, right: FloatArray | None = None
) -> FloatArray:  # fmt: skip
    """Covariance in the datum of rows R, times ``right`` (n, m), from the inverse of a normal matrix with R'R times it.

    product: (n, m); of the identity where ``right`` is not given. motions: G (n, k). seen: R G (k, k). What the rows
    add to the inverse is ``G (G'R'RG)^-1 G'``.
    """
    by_motion = motions.T if right is None else motions.T @ right
    return np.asarray(product - motions @ np.linalg.solve(seen.T @ seen, by_motion))
