"""Pose chains: the products of links and their derivatives by every link, many at once.

Tangents are GTSAM's (rotation then translation, perturbation on the right). For ``T = A1 ... An`` a perturbation of a
forward link i reaches T through ``Ad((A_{i+1} ... A_n)^-1)``; of an inverted link through ``-Ad((A_i^-1 ... A_n)^-1)``
(Sola, Deray, Atchuthan 2018, "A micro Lie theory", section II.G).
"""

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.images import fill_chains


def adjoint_of_inverse(R: FloatArray, t: FloatArray) -> FloatArray:
    """Ad(T^-1) (n, 6, 6) of motions T = (R, t), R (n, 3, 3) and t (n, 3)."""
    out = np.zeros((len(R), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = np.swapaxes(R, 1, 2)
    for i in range(3):  # -R' [t]x has the rows t x (column of R)
        j, k = (i + 1) % 3, (i + 2) % 3
        out[:, 3:, i] = t[:, j, None] * R[:, k] - t[:, k, None] * R[:, j]
    return out


def evaluate_chains(
    slot_R: FloatArray, slot_t: FloatArray, link_ptr: IntArray, link_slot: IntArray, link_inverse: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses R (B, 3, 3), t (B, 3) of all chains, and C (links, 6, 6), the derivative of each pose by each link.

    slot_R (S, 3, 3), slot_t (S, 3): poses by slot. Chain b has the links ``link_ptr[b]:link_ptr[b + 1]``.
    """
    n = len(link_ptr) - 1
    R, t, C = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((len(link_slot), 6, 6))
    fill_chains(slot_R, slot_t, link_ptr, link_slot, link_inverse, R, t, C)
    return R, t, C
