"""Compiled pose chains: the product of links and its derivative by every link, and the motion of a table.

Tangents are GTSAM's (rotation then translation, perturbation on the right). For ``T = A1 ... An`` a perturbation of a
forward link i reaches T through ``Ad((A_{i+1} ... A_n)^-1)``; of an inverted link through ``-Ad((A_i^-1 ... A_n)^-1)``
(Sola, Deray, Atchuthan 2018, "A micro Lie theory", section II.G).
"""

import numpy as np

from adjust.compiling import njit
from adjust.model import BoolArray, FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def adjoint_of_inverse(R: FloatArray, t: FloatArray, out: FloatArray) -> None:
    """Fill ``out`` (6, 6) with Ad(T^-1) of T = (R, t)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = R[j, i]
            out[i, j + 3] = 0.0
            out[i + 3, j + 3] = R[j, i]
    # lower left block: -R' [t]x
    for i in range(3):
        out[i + 3, 0] = -(R[1, i] * t[2] - R[2, i] * t[1])
        out[i + 3, 1] = -(-R[0, i] * t[2] + R[2, i] * t[0])
        out[i + 3, 2] = -(R[0, i] * t[1] - R[1, i] * t[0])


@njit(cache=True, nogil=True, error_model="numpy")
def compose_left(Ra: FloatArray, ta: FloatArray, inverse: bool, R: FloatArray, t: FloatArray) -> None:
    """(R, t) <- A^+-1 (R, t), in place."""
    r = np.empty((3, 3))
    s = np.empty(3)
    if inverse:
        for i in range(3):
            s[i] = Ra[0, i] * (t[0] - ta[0]) + Ra[1, i] * (t[1] - ta[1]) + Ra[2, i] * (t[2] - ta[2])
            for j in range(3):
                r[i, j] = Ra[0, i] * R[0, j] + Ra[1, i] * R[1, j] + Ra[2, i] * R[2, j]
    else:
        for i in range(3):
            s[i] = ta[i] + Ra[i, 0] * t[0] + Ra[i, 1] * t[1] + Ra[i, 2] * t[2]
            for j in range(3):
                r[i, j] = Ra[i, 0] * R[0, j] + Ra[i, 1] * R[1, j] + Ra[i, 2] * R[2, j]
    for i in range(3):
        t[i] = s[i]
        for j in range(3):
            R[i, j] = r[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _nothing(R: FloatArray, t: FloatArray) -> None:
    """(R, t) becomes the motion that moves nothing."""
    for i in range(3):
        t[i] = 0.0
        for j in range(3):
            R[i, j] = 1.0 if i == j else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_chains(
    slot_R: FloatArray, slot_t: FloatArray, link_ptr: IntArray, link_slot: IntArray, link_inverse: BoolArray,
    R: FloatArray, t: FloatArray, C: FloatArray,
) -> None:  # fmt: skip
    """Poses R (B, 3, 3), t (B, 3) of all chains, and C (links, 6, 6), the derivative of each pose by each link."""
    for b in range(link_ptr.size - 1):
        Rb, tb = R[b], t[b]
        _nothing(Rb, tb)
        for k in range(link_ptr[b + 1] - 1, link_ptr[b] - 1, -1):
            a = link_slot[k]
            if link_inverse[k]:
                compose_left(slot_R[a], slot_t[a], True, Rb, tb)
                adjoint_of_inverse(Rb, tb, C[k])
                for i in range(6):
                    for j in range(6):
                        C[k, i, j] = -C[k, i, j]
            else:
                adjoint_of_inverse(Rb, tb, C[k])
                compose_left(slot_R[a], slot_t[a], False, Rb, tb)


@njit(cache=True, nogil=True, error_model="numpy")
def _turn(axis: int, angle: float, R: FloatArray) -> None:
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[axis, axis], R[axis, i], R[axis, j] = 1.0, 0.0, 0.0
    R[i, axis], R[i, i], R[i, j] = 0.0, c, -s
    R[j, axis], R[j, i], R[j, j] = 0.0, s, c


@njit(cache=True, nogil=True, error_model="numpy")
def table_motion(
    axis1: int, axis2: int, angle1: float, angle2: float, tilt: float, offset: float, R: FloatArray, t: FloatArray,
    D: FloatArray,
) -> None:  # fmt: skip
    """``table_from_mount`` = R1(angle1) Trans3(offset) R3(tilt) R2(angle2); D (6, 4) by angle1, angle2, tilt, offset.

    ``axis2`` < 0: a one-axis table, of which only R1 remains.
    """
    r = np.empty((3, 3))
    zero = np.zeros(3)
    ad = np.empty((6, 6))
    _nothing(R, t)
    D[:] = 0.0
    if axis2 >= 0:
        axis3 = 3 - axis1 - axis2
        D[axis2, 1] = 1.0
        _turn(axis2, angle2, r)
        compose_left(r, zero, False, R, t)
        adjoint_of_inverse(R, t, ad)
        for i in range(6):
            D[i, 2] = ad[i, axis3]
        _turn(axis3, tilt, r)
        compose_left(r, zero, False, R, t)
        adjoint_of_inverse(R, t, ad)
        for i in range(6):
            D[i, 3] = ad[i, 3 + axis3]
        t[axis3] += offset
    adjoint_of_inverse(R, t, ad)
    for i in range(6):
        D[i, 0] = ad[i, axis1]
    _turn(axis1, angle1, r)
    compose_left(r, zero, False, R, t)
