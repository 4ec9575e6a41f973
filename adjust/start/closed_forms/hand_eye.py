"""AX = XB and AX = ZB: what is rigidly fixed to something that moves by known motions.

Beside OpenCV's calibrateHandEye and calibrateRobotWorldHandEye: wrong poses weigh little, several things are found at
once, and what one axis leaves open is named or chosen.
"""

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.rigid import inverse, nearest_rotation, rigid, rotation_log, rotation_to

_SMALLEST_TURN = np.deg2rad(1.0)
_PARALLEL = 0.02  # second against first singular value of the rotation vectors: about one degree between the axes
_ONE_NULL_VECTOR = 30.0  # second against first eigenvalue, from which the first alone is a solution
_SMALLEST_GAP = 1e-4  # the least second eigenvalue of the scaled system
_ROUNDS = 8
_FRAMES = "the frame in which the motions A are given"


def degenerate_direction(turns: FloatArray) -> FloatArray | None:
    """The one direction (3,) about which all rotation vectors (n, 3) rad turn, or None where there are two or more.

    Raises SurveyError where all turns are below one degree.
    """
    largest = float(np.max(np.linalg.norm(turns, axis=1), initial=0.0))
    if largest < _SMALLEST_TURN:
        raise SurveyError(
            f"the largest of {len(turns)} turns is {np.rad2deg(largest):.3f} deg: rotation and translation are"
            " undetermined in all directions; turn by 30 deg or more about two axes"
        )
    _, s, vt = np.linalg.svd(turns, full_matrices=False)
    second = s[1] if len(s) > 1 else 0.0
    return np.asarray(vt[0]) if second < _PARALLEL * s[0] else None


def solve_ax_xb(a: FloatArray, b: FloatArray, minimum_norm: bool = False) -> tuple[FloatArray, FloatArray]:
    """``x`` (4, 4) with a x = x b for motions a, b (n, 4, 4), and weights (n,) from 0 (a bad pair) to 1.

    Source: Park and Martin, IEEE Trans. Robotics and Automation 10(5), 1994: log(a) = R_x log(b) by Procrustes, then
    (R_a - I) t_x = R_x t_b - t_a by least squares. Reweighted; pairs whose turns or shifts along the axis differ
    (Chen 1991, screw congruence) weigh little from the start.
    Raises SurveyError naming the undetermined direction where all axes are parallel or the turns too small; with
    ``minimum_norm`` the smallest consistent solution is given instead for parallel axes.
    """
    alpha, beta = rotation_log(a[:, :3, :3]), rotation_log(b[:, :3, :3])
    axis = degenerate_direction(alpha)
    if axis is not None and not minimum_norm:
        raise SurveyError(_undetermined(axis, len(a)))
    # a motion of half a turn has two logarithms of opposite sign: it cannot serve
    clear = np.linalg.norm(alpha, axis=1) < np.deg2rad(178.0)
    gap = np.abs(np.linalg.norm(alpha, axis=1) - np.linalg.norm(beta, axis=1))
    weights = clear * _weights(gap, floor=1e-3)
    for _ in range(10):
        r = _turn_onto(alpha, beta, weights, axis)
        miss = np.linalg.norm(alpha - beta @ r.T, axis=1)
        weights = clear * _weights(miss, floor=1e-9)
    factor = a[:, :3, :3] - np.eye(3)
    right = b[:, :3, 3] @ r.T - a[:, :3, 3]
    t, shift_weights = _robust_least_squares(factor, right, weights)
    return rigid(r, t), weights * shift_weights


def _turn_onto(alpha: FloatArray, beta: FloatArray, weights: FloatArray, axis: FloatArray | None) -> FloatArray:
    m = (weights[:, None] * alpha).T @ beta
    if axis is None:
        return nearest_rotation(m)
    u, _, vt = np.linalg.svd(m)
    return rotation_to(vt[0], u[:, 0])


def solve_ax_zb(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``x``, ``z`` (4, 4) with a x = z b for poses a, b (n, 4, 4), and weights (n,) from 0 (a bad pair) to 1.

    Source: Shah, J. Mechanisms and Robotics 5(3), 2013, which is :func:`solve_views` of one thing from one. Raises
    SurveyError for fewer than three poses, and naming the undetermined direction where all turns between the poses are
    about one axis or too small.
    """
    if len(a) < 3:
        raise SurveyError(f"{len(a)} pose(s) cannot determine both transforms of AX = ZB: at least three are needed")
    axis = degenerate_direction(rotation_log(np.swapaxes(a[:1, :3, :3], -1, -2) @ a[1:, :3, :3]))
    if axis is not None:
        raise SurveyError(_undetermined(axis, len(a)))
    one = np.zeros(len(a), dtype=np.int64)
    x, z, weights, _ = _solved(a, inverse(b), one, one, _consensus(a, b))
    return x[0], z[0], weights


def solve_views(
    a: FloatArray, b: FloatArray, first: IntArray, second: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``x`` (m, 4, 4), ``z`` (k, 4, 4) with a_n x[first_n] b_n = z[second_n] for poses a, b (n, 4, 4); weights (n,).

    Several things on what moves before several in the world, each pair seen perhaps only once. Source: the Kronecker
    form of :func:`solve_ax_zb` for all at once: vec(R_z) = (R_b' kron R_a) vec(R_x), a homogeneous system whose one
    null vector holds every rotation; translations jointly by least squares. Reweighted. ``first`` and ``second`` number
    all of 0 ... m - 1 and 0 ... k - 1. Raises SurveyError where the null vector is not the only one: too few views, or
    all turns about one axis.
    """
    x, z, weights, (least, second_least) = _solved(a, b, first, second, np.ones(len(a)))
    if not second_least > max(_ONE_NULL_VECTOR * max(least, 0.0), _SMALLEST_GAP):
        raise SurveyError("the views leave rotations undetermined: more, or turns about a second axis, are needed")
    return x, z, weights


def _solved(
    a: FloatArray, b: FloatArray, first: IntArray, second: IntArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """:func:`solve_views` from first weights (n,), and the two least eigenvalues of its last system."""
    m, k = int(first.max()) + 1, int(second.max()) + 1
    blocks = np.einsum("nkl,nij->nkilj", np.swapaxes(b[:, :3, :3], 1, 2), a[:, :3, :3]).reshape(-1, 9, 9)
    for _ in range(_ROUNDS):
        r_x, r_z, smallest = _all_rotations(blocks, first, second, weights, m, k)
        turned = a[:, :3, :3] @ r_x[first] @ b[:, :3, :3]
        miss = np.linalg.norm(rotation_log(np.swapaxes(r_z[second], -1, -2) @ turned), axis=1)
        weights = _weights(miss, floor=1e-9)
    n = len(a)
    factor = np.zeros((n, 3, 3 * (m + k)))
    for c in range(3):
        factor[np.arange(n), :, 3 * first + c] = a[:, :3, c]
        factor[np.arange(n), c, 3 * (m + second) + c] = -1.0
    # R_z inv(R_b) instead of R_a R_x: one rotation from all views instead of each one's own
    right = -a[:, :3, 3] + np.einsum("nij,nj->ni", r_z[second], inverse(b)[:, :3, 3])
    t, shift_weights = _robust_least_squares(factor, right, weights)
    shifts = t.reshape(-1, 3)
    return rigid(r_x, shifts[:m]), rigid(r_z, shifts[m:]), weights * shift_weights, smallest


def _all_rotations(
    blocks: FloatArray, first: IntArray, second: IntArray, weights: FloatArray, m: int, k: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotations (m, 3, 3), (k, 3, 3) from the null vector of blocks (n, 9, 9) vec(x) - vec(z) = 0, vec by columns.

    And the two least eigenvalues of the scaled system.
    """
    N, own = np.zeros((m + k, m + k, 9, 9)), np.arange(m + k)
    both = np.append(np.bincount(first, weights, m), np.bincount(second, weights, k))
    N[own, own] = both[:, None, None] * np.eye(9)  # the blocks are orthogonal
    place = 81 * (m * second + first)[:, None] + np.arange(81)
    cross = np.bincount(place.ravel(), (-weights[:, None, None] * blocks).ravel(), 81 * m * k).reshape(k, m, 9, 9)
    N[m:, :m], N[:m, m:] = cross, cross.transpose(1, 0, 3, 2)
    seen = np.sqrt(np.maximum(np.einsum("iijj->i", N) / 9.0, 1e-12))
    N = (N / seen[:, None, None, None] / seen[None, :, None, None]).swapaxes(1, 2).reshape(9 * (m + k), -1)
    w, v = np.linalg.eigh(N)
    found = (v[:, 0].reshape(m + k, 9) / seen[:, None]).reshape(m + k, 3, 3).swapaxes(1, 2)
    if np.linalg.det(found / np.linalg.norm(found, axis=(1, 2), keepdims=True)).sum() < 0.0:
        found = -found
    r = nearest_rotation(found)
    return r[:m], r[m:], w[:2]


def _consensus(a: FloatArray, b: FloatArray) -> FloatArray:
    """First weights: a pose is good when its turns against the others are the same in a and in b."""
    n = len(a)
    step = max(1, n // 60)
    between_a = np.einsum("nji,mjk->nmik", a[:, :3, :3], a[::step, :3, :3])
    between_b = np.einsum("nji,mjk->nmik", b[:, :3, :3], b[::step, :3, :3])
    cosines = [np.clip((np.trace(r, axis1=2, axis2=3) - 1.0) / 2.0, -1.0, 1.0) for r in (between_a, between_b)]
    gap = np.median(np.abs(np.arccos(cosines[0]) - np.arccos(cosines[1])), axis=1)
    return _weights(gap, floor=1e-3)


def _weights(miss: FloatArray, floor: float) -> FloatArray:
    """Geman-McClure weights (n,) at three times the median, never all zero."""
    ordered, n = np.sort(miss), len(miss)  # of few, np.median takes ten times as long
    scale = max(1.5 * float(ordered[(n - 1) // 2] + ordered[n // 2]), floor)
    return np.asarray(1.0 / (1.0 + (miss / scale) ** 2) ** 2)


def _robust_least_squares(factor: FloatArray, right: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Reweighted minimum-norm solution of factor (n, 3, k) t = right (n, 3)."""
    k = factor.shape[2]
    shift = np.ones(len(factor))
    for _ in range(10):
        root = np.sqrt(weights * shift)[:, None]
        t = np.linalg.lstsq((root[..., None] * factor).reshape(-1, k), (root * right).ravel(), rcond=_PARALLEL * 0.5)[0]
        miss = np.linalg.norm(factor @ t - right, axis=1)
        shift = _weights(miss, floor=1e-12 + 1e-9 * float(np.max(np.abs(right), initial=0.0)))
    return np.asarray(t), shift


def _undetermined(axis: FloatArray, n: int) -> str:
    text = ", ".join(f"{v:+.3f}" for v in axis)
    return (
        f"all {n} motions turn about the one direction ({text}) of {_FRAMES}: the rotation about it and the translation"
        " along it are undetermined; add motions about another axis, or hold that transform"
    )


def relative_motions(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motions between poses a, b (n, 4, 4) of ``a_i x = z b_i`` for :func:`solve_ax_xb`: a_j^-1 a_i and b_j^-1 b_i.

    Of every pose with the four others nearest to a turn of 100 degrees, where the rotation axis is sharp and
    the logarithm still unambiguous.
    """
    pairs: set[tuple[int, int]] = set()
    for i in range(len(a)):
        turns = np.linalg.norm(rotation_log(np.swapaxes(a[i, :3, :3], -1, -2) @ a[:, :3, :3]), axis=1)
        order = np.argsort(np.abs(turns - np.deg2rad(100.0)), kind="stable")
        pairs |= {(min(i, j), max(i, j)) for j in order[order != i][:4].tolist()}
    first, second = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2).T
    return inverse(a[second]) @ a[first], inverse(b[second]) @ b[first]
