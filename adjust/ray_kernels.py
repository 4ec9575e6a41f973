"""Rays of image points: the projection solved for its point, one image point after the other."""

import numpy as np

from adjust.compiling import njit
from adjust.lens_kernels import MAX_LENS, N_COLUMNS, lens_row
from adjust.model import BoolArray, FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def tangents_of(run: IntArray, ptr: IntArray, kind: int, lens: FloatArray, constants: FloatArray, uv: FloatArray,
                iterations: int, step_tolerance: float, pixel_tolerance: float, tangents: FloatArray,
                found: BoolArray) -> None:  # fmt: skip
    """Newton from the tangents (n, 2) = x/z, y/z that are given, in place, for the pixels (n, 2) of a run of parts.

    found: (n,), where the projection agrees to ``pixel_tolerance`` px and its determinant is positive, as it is in the
    middle of the image of every model; where it is not, the image is turned over.
    """
    row = np.zeros((2, N_COLUMNS))
    for i in range(ptr[run[0]], ptr[run[-1] + 1]):
        x, y, moving = tangents[i, 0], tangents[i, 1], True
        for k in range(iterations + 1):
            ru, rv = lens_row(kind, lens, constants, x, y, 1.0, uv[i, 0], uv[i, 1], row)
            a, b, c, d = row[0, MAX_LENS], row[0, MAX_LENS + 1], row[1, MAX_LENS], row[1, MAX_LENS + 1]
            determinant = a * d - b * c
            if not moving or k == iterations:
                break
            dx, dy = (d * ru - b * rv) / determinant, (a * rv - c * ru) / determinant
            x, y = x - dx, y - dy
            limit = step_tolerance * (1.0 + max(abs(x), abs(y)))
            moving = abs(dx) > limit or abs(dy) > limit  # what is not a number does not move any more
        tangents[i, 0], tangents[i, 1] = x, y
        found[i] = abs(ru) < pixel_tolerance and abs(rv) < pixel_tolerance and determinant > 0.0
