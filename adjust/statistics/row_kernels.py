"""Compiled: the whitened rows of single image points, which the batches condense and do not keep."""

import numpy as np

from adjust.compiling import njit
from adjust.image_kernels import BlockArrays, LensArrays, PointArrays, local_row
from adjust.lens_kernels import MAX_LENS
from adjust.model import FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def block_rows(
    b: int, blocks: BlockArrays, points: PointArrays, W: FloatArray, lenses: LensArrays, R: FloatArray, t: FloatArray,
    warp: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Whitened rows (2 n, n_lens + 6 + n_warp + 1) of block b over its local unknowns, residual last."""
    c, wb = blocks.camera[b], blocks.warp_id[b]
    nl, nw = lenses.n_free[c], blocks.n_warp[b]
    warp_x, warp_y = (warp[wb, 0], warp[wb, 1]) if wb >= 0 else (0.0, 0.0)
    row = np.zeros((2, MAX_LENS + 3))
    X, uv, shape = points.X, points.uv, points.shape
    first = blocks.ptr[b]
    for p in range(first, blocks.ptr[b + 1]):
        s0, s1 = shape[0, p], shape[1, p]
        at = 2 * (p - first)
        local_row(
            lenses.kind[c], lenses.values[c], lenses.constants[c], R[b], t[b], X[0, p], X[1, p],
            X[2, p] + warp_x * s0 + warp_y * s1, uv[0, p], uv[1, p], W[0, p], W[1, p], W[2, p], lenses.n_map[c],
            lenses.source[c], lenses.column[c], lenses.factor[c], nl, s0, s1, nw, row, out[at : at + 2],
        )  # fmt: skip
