"""Compiled: Jacobians of many measured pairs, and what their residuals' covariances are made of.

The same formulas as :mod:`adjust.relay.motions`, pair by pair without intermediate arrays.
"""

from math import cos, sin, sqrt

import numpy as np

from adjust.closed_forms.small_kernels import product
from adjust.compiling import njit
from adjust.model import BoolArray, FloatArray, IntArray

_SMALL = 0.3  # rad; below it the series are exact to the last digit, above it the closed forms lose none


@njit(cache=True, nogil=True)
def differences(
    a_idx: IntArray, b_idx: IntArray, R: FloatArray, t: FloatArray, measured: FloatArray, shift: FloatArray,
    present: FloatArray, place: FloatArray, turn: FloatArray, arm: FloatArray,
) -> None:  # fmt: skip
    """``b_from_a`` as it is into present (E, 3, 3) and place (E, 3), measured^-1 times it into turn and arm."""
    for e in range(len(a_idx)):
        a, b = a_idx[e], b_idx[e]
        for i in range(3):
            for j in range(3):
                present[e, i, j] = R[b, 0, i] * R[a, 0, j] + R[b, 1, i] * R[a, 1, j] + R[b, 2, i] * R[a, 2, j]
            place[e, i] = 0.0
            for k in range(3):
                place[e, i] += R[b, k, i] * (t[a, k] - t[b, k])
        for i in range(3):
            arm[e, i] = 0.0
            for k in range(3):
                arm[e, i] += measured[e, k, i] * (place[e, k] - shift[e, k])
            for j in range(3):
                turn[e, i, j] = 0.0
                for k in range(3):
                    turn[e, i, j] += measured[e, k, i] * present[e, k, j]


@njit(cache=True, nogil=True)
def _cross_matrix(v: FloatArray, out: FloatArray) -> None:
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]


@njit(cache=True, nogil=True)
def _coefficients(x2: float) -> tuple[float, float, float, float]:
    """Of the inverse Jacobian, and of its coupling block, by the squared angle."""
    if x2 < _SMALL * _SMALL:
        inverse = 1 / 12 + x2 * (1 / 720 + x2 * (1 / 30240 + x2 * (1 / 1209600 + x2 / 47900160)))
        c1 = 1 / 6 - x2 * (1 / 120 - x2 * (1 / 5040 - x2 * (1 / 362880 - x2 / 39916800)))
        c2 = 1 / 24 - x2 * (1 / 720 - x2 * (1 / 40320 - x2 * (1 / 3628800 - x2 / 479001600)))
        c3 = 1 / 120 - x2 * (1 / 2520 - x2 * (1 / 120960 - x2 * (1 / 9979200 - x2 / 1245404160)))
        return inverse, c1, c2, c3
    x = sqrt(x2)
    s, c, half = sin(x), cos(x), 0.5 * x
    inverse = (1.0 - half * cos(half) / sin(half)) / x2
    return inverse, (x - s) / (x2 * x), (x2 + 2.0 * c - 2.0) / (2.0 * x2 * x2), (2.0 * x - 3.0 * s + x * c) / (
        2.0 * x2 * x2 * x
    )


@njit(cache=True, nogil=True)
def derivatives(
    omega: FloatArray, arm: FloatArray, present: FloatArray, place: FloatArray,
    residual: FloatArray, by_a: FloatArray, adjoint: FloatArray, by_b: FloatArray,
) -> None:  # fmt: skip
    """Residuals (E, 6), Jr^-1 of them (E, 6, 6), Ad(b_from_a^-1) and -Jr^-1 Ad, from omega = Log of the turn."""
    K, K2, left, right = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    P, U, PU, UP, PUP, first, second = (
        np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)),
        np.empty((3, 3)),
    )  # fmt: skip
    v, w = np.empty(3), np.empty(3)
    by_a[:] = 0.0
    adjoint[:] = 0.0
    for e in range(len(omega)):
        o = omega[e]
        inverse, c1, c2, c3 = _coefficients(o[0] * o[0] + o[1] * o[1] + o[2] * o[2])
        _cross_matrix(o, K)
        product(K, K, K2)
        for i in range(3):
            for j in range(3):
                one = 1.0 if i == j else 0.0
                left[i, j] = one - 0.5 * K[i, j] + inverse * K2[i, j]
                right[i, j] = one + 0.5 * K[i, j] + inverse * K2[i, j]
        for i in range(3):
            residual[e, i] = o[i]
            v[i] = left[i, 0] * arm[e, 0] + left[i, 1] * arm[e, 1] + left[i, 2] * arm[e, 2]
            residual[e, 3 + i] = v[i]
        for i in range(3):
            v[i], w[i] = -v[i], -o[i]
        _cross_matrix(w, P)
        _cross_matrix(v, U)
        product(P, U, PU)
        product(U, P, UP)
        product(PU, P, PUP)
        product(P, PU, first)
        product(UP, P, second)
        for i in range(3):
            for j in range(3):
                K2[i, j] = 0.5 * U[i, j] + c1 * (PU[i, j] + UP[i, j] + PUP[i, j])
                K2[i, j] += c2 * (first[i, j] + second[i, j] - 3.0 * PUP[i, j])
        product(PUP, P, first)
        product(P, PUP, second)
        for i in range(3):
            for j in range(3):
                K2[i, j] += c3 * (first[i, j] + second[i, j])
        product(right, K2, first)
        product(first, right, second)
        for i in range(3):
            for j in range(3):
                by_a[e, i, j] = by_a[e, 3 + i, 3 + j] = right[i, j]
                by_a[e, 3 + i, j] = -second[i, j]
                adjoint[e, i, j] = adjoint[e, 3 + i, 3 + j] = present[e, j, i]
        for i in range(3):  # the shift of the inverse motion
            w[i] = -(present[e, 0, i] * place[e, 0] + present[e, 1, i] * place[e, 1] + present[e, 2, i] * place[e, 2])
        _cross_matrix(w, K)
        product(K, adjoint[e, :3, :3], first)
        for i in range(3):
            for j in range(3):
                adjoint[e, 3 + i, j] = first[i, j]
        product(by_a[e], adjoint[e], by_b[e])
    by_b *= -1.0


@njit(cache=True, nogil=True)
def covariances(
    by_b: FloatArray, by_a: FloatArray, turn: FloatArray, whitening: FloatArray, Q: FloatArray, used: BoolArray,
    scatter: FloatArray, Qvv: FloatArray, own: FloatArray,
) -> None:  # fmt: skip
    """Of the adjusted residuals B Q B' (E, d, d), of the whitened ones, and of the adjusted ``b_from_a``.

    Q: (E, 2 d, 2 d) of the stations b and a. used: whether the pair took part, else it is predicted. A row of the
    whitening that is zero was not measured.
    """
    d = by_b.shape[1]
    B, J, BQ, JQ, W = np.empty((d, 2 * d)), np.zeros((d, 2 * d)), np.empty((d, 2 * d)), np.empty((d, 2 * d)), np.empty(
        (d, d)
    )
    for i in range(d):
        J[i, d + i] = 1.0
    for e in range(len(by_b)):
        for i in range(d):
            for j in range(d):
                B[i, j], B[i, d + j], J[i, j] = by_b[e, i, j], by_a[e, i, j], -turn[e, i, j]
        product(B, Q[e], BQ)
        product(BQ, B.T, scatter[e])
        product(J, Q[e], JQ)
        product(JQ, J.T, own[e])
        product(whitening[e], scatter[e], W)
        product(W, whitening[e].T, Qvv[e])
        sign = -1.0 if used[e] else 1.0
        for i in range(d):
            measured = 0.0
            for j in range(d):
                Qvv[e, i, j] *= sign
                if whitening[e, i, j] != 0.0:
                    measured = 1.0
            Qvv[e, i, i] += measured
