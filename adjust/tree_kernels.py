"""Compiled recursions over the cliques of a Bayes tree, flattened; see :mod:`adjust.tree_covariance`.

Clique c has the keys ``keys[key_ptr[c]:key_ptr[c + 1]]``, the first ``n_front[c]`` of them frontal, parents before
children. Row-major blocks of nf x n numbers begin at ``at[c]``: in ``data`` first [R S], later [R^-1, -R^-1 S]; in
``cov`` the rows of the covariance that belong to the frontal keys.
"""

from typing import NamedTuple

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray, IntArray

_BY_HAND = 120_000  # products of a matrix product below which a loop over them takes about as long as BLAS


class TreeArrays(NamedTuple):
    """What :func:`fill_block` needs beside the numbers of two keys, in its order."""

    home: IntArray
    key_ptr: IntArray
    keys: IntArray
    dims: IntArray
    front: IntArray
    width: IntArray
    at: IntArray
    cov: FloatArray

    @staticmethod
    def nothing() -> "TreeArrays":
        """A tree without unknowns."""
        none = np.zeros(0, dtype=np.int64)
        return TreeArrays(none, none, none, none, none, none, none, np.zeros(0))


@njit(cache=True, nogil=True)
def invert_cliques(front: IntArray, width: IntArray, at: IntArray, data: FloatArray) -> int:
    """[R S] to [R^-1, -R^-1 S] in place; returns the first singular clique or -1."""
    for c in range(len(front)):
        nf, n = front[c], width[c]
        A = data[at[c] : at[c] + nf * n].reshape(nf, n)
        for i in range(nf):
            if not abs(A[i, i]) > 0.0:
                return c
        row = np.empty(n)
        for i in range(nf - 1, -1, -1):
            for j in range(i, n):
                row[j] = A[i, j] if j >= nf else 0.0
            for k in range(i + 1, nf):
                factor = A[i, k]
                for j in range(k, n):
                    row[j] += factor * A[k, j]
            d = 1.0 / A[i, i]
            A[i, i] = d
            for j in range(i + 1, n):
                A[i, j] = -d * row[j]
    return -1


@njit(cache=True, nogil=True)
def offset_in(clique: int, key: int, key_ptr: IntArray, keys: IntArray, dims: IntArray) -> int:
    """Column at which a key begins in a clique, -1 where it is not in it."""
    o = 0
    for i in range(key_ptr[clique], key_ptr[clique + 1]):
        if keys[i] == key:
            return o
        o += dims[keys[i]]
    return -1


@njit(cache=True, nogil=True)
def fill_block(
    a: int, b: int, home: IntArray, key_ptr: IntArray, keys: IntArray, dims: IntArray, front: IntArray,
    width: IntArray, at: IntArray, cov: FloatArray, out: FloatArray,
) -> bool:  # fmt: skip
    """Covariance of two keys that share a clique into ``out``; whether they do.

    The key whose home lies deeper was eliminated first, so that its clique holds the other one.
    """
    deep, high, flip = a, b, False
    if home[b] > home[a]:
        deep, high, flip = b, a, True
    c = home[deep]
    row = offset_in(c, deep, key_ptr, keys, dims)
    column = offset_in(c, high, key_ptr, keys, dims)
    if column < 0:
        return False
    n = width[c]
    for i in range(dims[deep]):
        start = at[c] + (row + i) * n + column
        for j in range(dims[high]):
            if flip:
                out[j, i] = cov[start + j]
            else:
                out[i, j] = cov[start + j]
    return True


@njit(cache=True, nogil=True)
def _times(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """A B (n, m) into the first columns of out; small ones without BLAS, which is loaded by its first call."""
    n, m, inner = A.shape[0], B.shape[1], A.shape[1]
    if n * m * inner > _BY_HAND:
        X = A @ B
        for i in range(n):
            for j in range(m):
                out[i, j] = X[i, j]
        return
    for i in range(n):
        for j in range(m):
            out[i, j] = 0.0
        for k in range(inner):
            a = A[i, k]
            if a != 0.0:
                for j in range(m):
                    out[i, j] += a * B[k, j]


@njit(cache=True, nogil=True)
def covariance_rows(
    n_front: IntArray, key_ptr: IntArray, keys: IntArray, dims: IntArray, home: IntArray, front: IntArray,
    width: IntArray, at: IntArray, data: FloatArray, cov: FloatArray,
) -> None:  # fmt: skip
    """Q_fs = T Q_ss and Q_ff = R^-1 R^-T + T Q_sf, parents first."""
    for c in range(len(front)):
        nf, n = front[c], width[c]
        ns = n - nf
        A = data[at[c] : at[c] + nf * n].reshape(nf, n)
        C = cov[at[c] : at[c] + nf * n].reshape(nf, n)
        P, turned = np.zeros((nf, nf)), np.zeros((nf, nf))
        for i in range(nf):
            for j in range(i, nf):
                P[i, j] = turned[j, i] = A[i, j]
        _times(P, turned, C)
        if ns == 0:
            continue
        Q = np.empty((ns, ns))
        r = 0
        for i in range(key_ptr[c] + n_front[c], key_ptr[c + 1]):
            s = 0
            for j in range(key_ptr[c] + n_front[c], i + 1):
                di, dj = dims[keys[i]], dims[keys[j]]
                fill_block(
                    keys[i], keys[j], home, key_ptr, keys, dims, front, width, at, cov, Q[r : r + di, s : s + dj]
                )
                for k in range(di):
                    for m in range(dj):
                        Q[s + m, r + k] = Q[r + k, s + m]
                s += dj
            r += dims[keys[i]]
        T, T_turned, Y, X = np.empty((nf, ns)), np.empty((ns, nf)), np.empty((nf, ns)), np.empty((nf, nf))
        for i in range(nf):
            for j in range(ns):
                T[i, j] = T_turned[j, i] = A[i, nf + j]
        _times(T, Q, Y)
        _times(Y, T_turned, X)
        for i in range(nf):
            for j in range(nf):
                C[i, j] += X[i, j]
            for j in range(ns):
                C[i, nf + j] = Y[i, j]


@njit(cache=True, nogil=True)
def joint_blocks(
    first: IntArray, second: IntArray, d: int, home: IntArray, key_ptr: IntArray, keys: IntArray, dims: IntArray,
    front: IntArray, width: IntArray, at: IntArray, cov: FloatArray, out: FloatArray,
) -> int:  # fmt: skip
    """Joint covariances (p, 2 d, 2 d) of pairs of keys of dimension d that share a clique; a key -1 is a constant.

    Returns the first pair that shares none, or -1.
    """
    for p in range(len(first)):
        out[p] = 0.0
        a, b = first[p], second[p]
        if a >= 0:
            fill_block(a, a, home, key_ptr, keys, dims, front, width, at, cov, out[p, :d, :d])
        if b >= 0:
            fill_block(b, b, home, key_ptr, keys, dims, front, width, at, cov, out[p, d:, d:])
        if a >= 0 and b >= 0:
            if not fill_block(a, b, home, key_ptr, keys, dims, front, width, at, cov, out[p, :d, d:]):
                return p
            for i in range(d):
                for j in range(d):
                    out[p, d + j, i] = out[p, i, d + j]
    return -1


@njit(cache=True, nogil=True)
def solve_cliques(
    cliques: IntArray, key_ptr: IntArray, keys: IntArray, dims: IntArray, first: IntArray, front: IntArray,
    width: IntArray, at: IntArray, data: FloatArray, x: FloatArray,
) -> None:  # fmt: skip
    """Q x in place (D, m) over ``cliques`` (parents first), which hold every ancestor of each of them.

    first: row of x at which a key begins. With R'u = x, R y = u: leaves to roots, then back.
    """
    m = x.shape[1]
    for index in range(len(cliques) - 1, -1, -1):
        c = cliques[index]
        nf, n = front[c], width[c]
        A = data[at[c] : at[c] + nf * n].reshape(nf, n)
        rows = clique_rows(c, n, key_ptr, keys, dims, first)
        for j in range(nf, n):
            for i in range(nf):
                if A[i, j] != 0.0:
                    for k in range(m):
                        x[rows[j], k] += A[i, j] * x[rows[i], k]
        for j in range(nf - 1, -1, -1):
            for k in range(m):
                total = 0.0
                for i in range(j + 1):
                    total += A[i, j] * x[rows[i], k]
                x[rows[j], k] = total
    for index in range(len(cliques)):
        c = cliques[index]
        nf, n = front[c], width[c]
        A = data[at[c] : at[c] + nf * n].reshape(nf, n)
        rows = clique_rows(c, n, key_ptr, keys, dims, first)
        for i in range(nf):
            for k in range(m):
                total = 0.0
                for j in range(i, n):
                    total += A[i, j] * x[rows[j], k]
                x[rows[i], k] = total


@njit(cache=True, nogil=True)
def clique_rows(
    c: int, n: int, key_ptr: IntArray, keys: IntArray, dims: IntArray, first: IntArray
) -> IntArray:
    """Rows (n,) of a stacked vector that belong to a clique's columns."""
    rows = np.empty(n, dtype=np.int64)
    o = 0
    for i in range(key_ptr[c], key_ptr[c + 1]):
        for j in range(dims[keys[i]]):
            rows[o] = first[keys[i]] + j
            o += 1
    return rows
