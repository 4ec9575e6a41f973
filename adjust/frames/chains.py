"""Pose chains: the products of links and their derivatives by every link, and the motion of a table; many at once.

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


def table_motion(
    axis1: int, axis2: int, angle1: FloatArray, angle2: FloatArray, tilt: FloatArray, offset: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``table_from_mount`` = R1(angle1) Trans3(offset) R3(tilt) R2(angle2) of n positions of a table.

    Angles, tilt and offset: (n,). Returns R (n, 3, 3), t (n, 3), and D (n, 6, 4), the derivatives by angle1, angle2,
    tilt and offset. ``axis2`` < 0: a one-axis table, of which only R1 remains.
    """
    n = len(angle1)
    R, t, D = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 6, 4))
    if axis2 >= 0:
        axis3 = 3 - axis1 - axis2
        R = _turns(axis2, angle2)
        D[:, axis2, 1] = 1.0
        D[:, :3, 2] = R[:, axis3]
        R = _turns(axis3, tilt) @ R
        D[:, 3:, 3] = R[:, axis3]
        t[:, axis3] = offset
    D[:, :, 0] = adjoint_of_inverse(R, t)[:, :, axis1]
    first = _turns(axis1, angle1)
    return first @ R, (first @ t[:, :, None])[:, :, 0], D


def _turns(axis: int, angle: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) about an axis by angles (n,) rad."""
    out, i, j = np.zeros((len(angle), 3, 3)), (axis + 1) % 3, (axis + 2) % 3
    out[:, axis, axis] = 1.0
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, j, i] = np.sin(angle)
    out[:, i, j] = -out[:, j, i]
    return out
