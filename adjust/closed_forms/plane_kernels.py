"""Views of planes, compiled: the homography, both poses that it allows, and how far an image is from one."""

import numpy as np

from adjust.closed_forms.small_kernels import eigen_in_place, median_in_place, product, solve_in_place
from adjust.closed_forms.view_kernels import error_of_view
from adjust.compiling import njit
from adjust.model import BoolArray, FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def plane_to_image(xy: FloatArray, uv: FloatArray, first: int, refinements: int, h: FloatArray) -> float:
    """Homography h (3, 3) of points (n, 2) to uv first ... first + n, and the rms of its residuals in the unit of uv.

    Negative where it is singular.

    Hartley and Zisserman, Multiple View Geometry, algorithm 4.2, then Gauss-Newton steps on the distance in the image.
    """
    n = len(xy)
    x, u, tx, tu = np.empty((n, 2)), np.empty((n, 2)), np.empty(3), np.empty(3)
    _normalise(xy, 0, x, tx)
    _normalise(uv, first, u, tu)
    N, g, trial, best_h = np.empty((9, 9)), np.empty(9), np.empty((3, 3)), np.empty((3, 3))
    if not _linear(x, u, N, best_h):
        return -1.0
    best = _map_rms(best_h, x, u)
    for _ in range(refinements):
        _map_step(best_h, x, u, N, g)
        if not solve_in_place(N, g):
            break
        for a in range(9):
            trial[a // 3, a % 3] = best_h[a // 3, a % 3] + g[a]
        error = _map_rms(trial, x, u)
        if not error < best:
            break
        best = error
        for a in range(9):
            best_h[a // 3, a % 3] = trial[a // 3, a % 3]
    _undo_normalising(best_h, tx, tu, h)
    return float(best / tu[0])


@njit(cache=True, nogil=True, error_model="numpy")
def plane_poses(x: FloatArray, rays: FloatArray, first: int, last: int, thickness: float, widest: float, view: int,
                poses: FloatArray) -> bool:  # fmt: skip
    """Both poses[view] (2, 4, 4) of the points first ... last of a plane, m, on their rays; False where it is no case.

    Source: Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 109, 2014: the rotations from the first
    derivatives of the homography at the centroid; the translations by linear least squares. No case are points off a
    plane, on a line, and rays further from their mean than the cosine ``widest``.
    """
    n = last - first
    mean, centre = np.empty(3), np.empty(3)
    F, axes, H = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    xy, local = np.empty((n, 2)), np.empty((n, 2))
    _mean(rays, first, last, mean)
    if not mean[2] > -0.5 * np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2):
        return False
    _turn_to_front(mean, F)
    for i in range(n):
        r0, r1, r2 = rays[first + i, 0], rays[first + i, 1], rays[first + i, 2]
        z = F[2, 0] * r0 + F[2, 1] * r1 + F[2, 2] * r2
        if not z > widest:
            return False
        for k in range(2):
            xy[i, k] = (F[k, 0] * r0 + F[k, 1] * r1 + F[k, 2] * r2) / z
    scale = _on_plane(x, first, thickness, centre, axes, local)
    if not scale > 0.0 or plane_to_image(local, xy, 0, 0, H) < 0 or H[2, 2] == 0.0:
        return False
    size = H[2, 2]
    for i in range(3):
        for j in range(3):
            H[i, j] /= size
    turns, t, out = np.empty((2, 3, 3)), np.empty(3), np.empty((3, 3))
    if not _infinitesimal(H, turns):
        return False
    finite = True
    for k in range(2):
        if not _shift(turns[k], local, xy, t):
            return False
        # R = F' turn axes, F' scale t - R centre
        for i in range(3):
            for j in range(3):
                out[i, j] = F[0, i] * turns[k, 0, j] + F[1, i] * turns[k, 1, j] + F[2, i] * turns[k, 2, j]
        product(out, axes, H)
        for i in range(3):
            along = scale * (F[0, i] * t[0] + F[1, i] * t[1] + F[2, i] * t[2])
            for j in range(3):
                poses[view, k, i, j] = H[i, j]
                along -= H[i, j] * centre[j]
            poses[view, k, i, 3], poses[view, k, 3, i] = along, 0.0
            finite = finite and np.isfinite(along + H[i, 0] + H[i, 1] + H[i, 2])
        poses[view, k, 3, 3] = 1.0
    return finite


@njit(cache=True, nogil=True, error_model="numpy")
def first_poses(run: IntArray, x: FloatArray, rays: FloatArray, ptr: IntArray, thickness: float, widest: float,
                poses: FloatArray, rms: FloatArray, in_front: BoolArray, found: BoolArray) -> None:  # fmt: skip
    """Both poses (B, 2, 4, 4) of the plane in the views of a run, as :func:`plane_poses` finds them, and how good.

    rms, in_front: (B, 2) as of ``errors_of_views``. found: (B,), False where there is no plane.
    """
    for view in run:
        a, b = ptr[view], ptr[view + 1]
        found[view] = b - a > 3 and plane_poses(x, rays, a, b, thickness, widest, view, poses)
        if found[view]:
            for k in range(2):
                error_of_view(poses[view, k], x, rays, a, b, k, rms[view], in_front[view])


@njit(cache=True, nogil=True, error_model="numpy")
def plane_misfits(x: FloatArray, uv: FloatArray, ptr: IntArray, out: FloatArray) -> None:
    """Per view the median distance (B,) from the image of the points' best plane, relative to their extent there.

    Infinite where the points lie on one line or are fewer than four.
    """
    h, centre, axes = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for view in range(len(ptr) - 1):
        a, n = ptr[view], ptr[view + 1] - ptr[view]
        out[view] = np.inf
        xy, miss = np.empty((n, 2)), np.empty(n)
        if n < 4 or not _on_plane(x, a, np.inf, centre, axes, xy) > 0.0 or plane_to_image(xy, uv, a, 0, h) < 0:
            continue
        low0, low1, high0, high1 = np.inf, np.inf, -np.inf, -np.inf
        for i in range(n):
            u, v = uv[a + i, 0], uv[a + i, 1]
            w = h[2, 0] * xy[i, 0] + h[2, 1] * xy[i, 1] + h[2, 2]
            du = (h[0, 0] * xy[i, 0] + h[0, 1] * xy[i, 1] + h[0, 2]) / w - u
            dv = (h[1, 0] * xy[i, 0] + h[1, 1] * xy[i, 1] + h[1, 2]) / w - v
            miss[i] = np.sqrt(du * du + dv * dv)
            low0, low1, high0, high1 = min(low0, u), min(low1, v), max(high0, u), max(high1, v)
        extent = np.sqrt((high0 - low0) ** 2 + (high1 - low1) ** 2)
        out[view] = median_in_place(miss, n) / max(extent, 1e-9)


@njit(cache=True, nogil=True, error_model="numpy")
def _mean(x: FloatArray, first: int, last: int, out: FloatArray) -> None:
    for a in range(3):
        total = 0.0
        for i in range(first, last):
            total += x[i, a]
        out[a] = total / (last - first)


@njit(cache=True, nogil=True, error_model="numpy")
def _on_plane(x: FloatArray, first: int, thickness: float, centre: FloatArray, axes: FloatArray,
              local: FloatArray) -> float:  # fmt: skip
    """Coordinates local (n, 2) of points on the plane through them, of unit size, and what to multiply them with.

    axes: rows, right-handed, the normal last. Negative where the points are a line or thicker than ``thickness``.
    """
    n = len(local)
    _mean(x, first, first + n, centre)
    N, V = np.zeros((3, 3)), np.empty((3, 3))
    largest = 0.0
    for i in range(first, first + n):
        d0, d1, d2 = x[i, 0] - centre[0], x[i, 1] - centre[1], x[i, 2] - centre[2]
        N[0, 0] += d0 * d0
        N[1, 1] += d1 * d1
        N[2, 2] += d2 * d2
        N[0, 1] += d0 * d1
        N[0, 2] += d0 * d2
        N[1, 2] += d1 * d2
        largest = max(largest, d0 * d0 + d1 * d1 + d2 * d2)
    N[1, 0], N[2, 0], N[2, 1] = N[0, 1], N[0, 2], N[1, 2]
    eigen_in_place(N, V)
    thin, middle, long = np.sqrt(max(N[0, 0], 0.0)), np.sqrt(max(N[1, 1], 0.0)), np.sqrt(max(N[2, 2], 0.0))
    if not middle > 1e-6 * long or thin >= thickness * long:
        return -1.0
    for a in range(3):
        axes[0, a], axes[1, a] = V[a, 2], V[a, 1]
    _cross_rows(axes)
    scale = np.sqrt(largest)
    for i in range(n):
        for k in range(2):
            local[i, k] = 0.0
            for a in range(3):
                local[i, k] += axes[k, a] * (x[first + i, a] - centre[a])
            local[i, k] /= scale
    return float(scale)


@njit(cache=True, nogil=True, error_model="numpy")
def _cross_rows(A: FloatArray) -> None:
    """The third row (3,) across the first two."""
    A[2, 0] = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    A[2, 1] = A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]
    A[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _normalise(xy: FloatArray, first: int, out: FloatArray, t: FloatArray) -> None:
    """Points (n, 2) moved to mean zero and mean distance sqrt(2): t[0] (xy - t[1:]) (Hartley, PAMI 19(6), 1997)."""
    n = len(out)
    t[1] = t[2] = 0.0
    for i in range(n):
        t[1] += xy[first + i, 0] / n
        t[2] += xy[first + i, 1] / n
    size = 0.0
    for i in range(n):
        out[i, 0], out[i, 1] = xy[first + i, 0] - t[1], xy[first + i, 1] - t[2]
        size += np.sqrt(out[i, 0] ** 2 + out[i, 1] ** 2) / n
    t[0] = np.sqrt(2.0) / size if size > 0 else 1.0
    for i in range(n):
        out[i, 0] *= t[0]
        out[i, 1] *= t[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _undo_normalising(inner: FloatArray, tx: FloatArray, tu: FloatArray, h: FloatArray) -> None:
    """``h = Tu^-1 inner Tx`` with the two of :func:`_normalise`."""
    for a in range(3):
        at_0, at_1 = tx[0] * inner[a, 0], tx[0] * inner[a, 1]
        h[a, 0], h[a, 1], h[a, 2] = at_0, at_1, inner[a, 2] - at_0 * tx[1] - at_1 * tx[2]
    for b in range(3):
        h[0, b] = h[0, b] / tu[0] + tu[1] * h[2, b]
        h[1, b] = h[1, b] / tu[0] + tu[2] * h[2, b]


@njit(cache=True, nogil=True, error_model="numpy")
def _linear(x: FloatArray, u: FloatArray, N: FloatArray, h: FloatArray) -> bool:
    """The direct linear transformation h (3, 3), of unit size and positive determinant; N (9, 9) is lost."""
    _clear(N)
    for i in range(len(x)):
        _add_map_rows(x[i, 0], x[i, 1], 1.0, u[i, 0], u[i, 1], N)
    _complete_map_rows(N)
    V = np.empty((9, 9))
    eigen_in_place(N, V)
    if not N[1, 1] >= 1e-13 * N[8, 8]:
        return False
    for a in range(9):
        h[a // 3, a % 3] = V[a, 0]
    det = (h[0, 0] * (h[1, 1] * h[2, 2] - h[1, 2] * h[2, 1]) - h[0, 1] * (h[1, 0] * h[2, 2] - h[1, 2] * h[2, 0])
           + h[0, 2] * (h[1, 0] * h[2, 1] - h[1, 1] * h[2, 0]))  # fmt: skip
    if not det > 0:
        for a in range(9):
            h[a // 3, a % 3] = -V[a, 0]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _clear(N: FloatArray) -> None:
    for i in range(len(N)):
        for j in range(len(N)):
            N[i, j] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _map_rms(h: FloatArray, x: FloatArray, u: FloatArray) -> float:
    total = 0.0
    for i in range(len(x)):
        w = h[2, 0] * x[i, 0] + h[2, 1] * x[i, 1] + h[2, 2]
        du = (h[0, 0] * x[i, 0] + h[0, 1] * x[i, 1] + h[0, 2]) / w - u[i, 0]
        dv = (h[1, 0] * x[i, 0] + h[1, 1] * x[i, 1] + h[1, 2]) / w - u[i, 1]
        total += du * du + dv * dv
    return float(np.sqrt(total / len(x)))


@njit(cache=True, nogil=True, error_model="numpy")
def _map_step(h: FloatArray, x: FloatArray, u: FloatArray, N: FloatArray, g: FloatArray) -> None:
    """N (9, 9) and g (9,) of a Gauss-Newton step of h on the distances in the image: N step = g."""
    _clear(N)
    g[:] = 0.0
    for i in range(len(x)):
        w = h[2, 0] * x[i, 0] + h[2, 1] * x[i, 1] + h[2, 2]
        x0, x1, x2 = x[i, 0] / w, x[i, 1] / w, 1.0 / w
        v0 = h[0, 0] * x0 + h[0, 1] * x1 + h[0, 2] * x2
        v1 = h[1, 0] * x0 + h[1, 1] * x1 + h[1, 2] * x2
        _add_map_rows(x0, x1, x2, v0, v1, N)
        for k in range(2):
            v = v0 if k == 0 else v1
            e = v - u[i, k]
            g[3 * k] -= x0 * e
            g[3 * k + 1] -= x1 * e
            g[3 * k + 2] -= x2 * e
            g[6] += v * x0 * e
            g[7] += v * x1 * e
            g[8] += v * x2 * e
    _complete_map_rows(N)
    # the scale of h has no effect: one more row holds it
    for a in range(9):
        for b in range(9):
            N[a, b] += h[a // 3, a % 3] * h[b // 3, b % 3]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_map_rows(x0: float, x1: float, x2: float, u: float, v: float, N: FloatArray) -> None:
    """Add (x, 0, -u x) and (0, x, -v x), each times itself, to N (9, 9): the lower triangles that differ."""
    uv = u * u + v * v
    for a in range(3):
        xa = x0 if a == 0 else x1 if a == 1 else x2
        for b in range(a + 1):
            xx = xa * (x0 if b == 0 else x1 if b == 1 else x2)
            N[a, b] += xx
            N[6 + a, b] -= u * xx
            N[6 + a, 3 + b] -= v * xx
            N[6 + a, 6 + b] += uv * xx


@njit(cache=True, nogil=True, error_model="numpy")
def _complete_map_rows(N: FloatArray) -> None:
    for a in range(3):
        for b in range(a + 1):
            N[3 + a, 3 + b] = N[a, b]
            N[6 + b, a], N[6 + b, 3 + a] = N[6 + a, b], N[6 + a, 3 + b]
    for i in range(9):
        for j in range(i):
            N[j, i] = N[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _turn_to_front(mean: FloatArray, out: FloatArray) -> None:
    """The smallest rotation (3, 3) that turns a direction, not nearly backwards, to +z."""
    size = np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
    x, y, z = mean[0] / size, mean[1] / size, mean[2] / size
    k = 1.0 / (1.0 + z)
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - x * x * k, -x * y * k, -x
    out[1, 0], out[1, 1], out[1, 2] = -x * y * k, 1.0 - y * y * k, -y
    out[2, 0], out[2, 1], out[2, 2] = x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def _infinitesimal(H: FloatArray, turns: FloatArray) -> bool:
    """Both rotations (2, 3, 3) of a plane whose homography H (3, 3), H22 = 1, is known at its origin."""
    v, front, T = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    v[0], v[1], v[2] = H[0, 2], H[1, 2], 1.0
    j00, j01 = H[0, 0] - H[2, 0] * v[0], H[0, 1] - H[2, 1] * v[0]
    j10, j11 = H[1, 0] - H[2, 0] * v[1], H[1, 1] - H[2, 1] * v[1]
    # its transpose turns +z to the direction of the origin
    _turn_to_front(v, front)
    b00, b01 = front[0, 0] - v[0] * front[0, 2], front[1, 0] - v[0] * front[1, 2]
    b10, b11 = front[0, 1] - v[1] * front[0, 2], front[1, 1] - v[1] * front[1, 2]
    det = b00 * b11 - b01 * b10
    if not abs(det) >= 1e-12:
        return False
    a00, a01 = (b11 * j00 - b01 * j10) / det, (b11 * j01 - b01 * j11) / det
    a10, a11 = (b00 * j10 - b10 * j00) / det, (b00 * j11 - b10 * j01) / det
    s00, s11, s01 = a00 * a00 + a01 * a01, a10 * a10 + a11 * a11, a00 * a10 + a01 * a11
    gamma = np.sqrt(0.5 * (s00 + s11 + np.sqrt((s00 - s11) ** 2 + 4.0 * s01**2)))
    if not gamma > 1e-12:
        return False
    a00, a01, a10, a11 = a00 / gamma, a01 / gamma, a10 / gamma, a11 / gamma
    b0 = np.sqrt(max(1.0 - a00**2 - a10**2, 0.0))
    b1 = np.sqrt(max(1.0 - a01**2 - a11**2, 0.0))
    if -(a00 * a01 + a10 * a11) < 0:
        b1 = -b1
    for k in range(2):
        sign = 1.0 if k == 0 else -1.0
        # the columns of the rotation as rows, for the third to follow from them
        T[0, 0], T[0, 1], T[0, 2] = a00, a10, sign * b0
        T[1, 0], T[1, 1], T[1, 2] = a01, a11, sign * b1
        _cross_rows(T)
        for i in range(3):
            for j in range(3):
                turns[k, i, j] = front[0, i] * T[j, 0] + front[1, i] * T[j, 1] + front[2, i] * T[j, 2]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _shift(R: FloatArray, local: FloatArray, xy: FloatArray, t: FloatArray) -> bool:
    """The translation t (3,) for which the points (n, 2) of the plane fall on their images (n, 2), linearly."""
    N = np.zeros((3, 3))
    t[:] = 0.0
    for i in range(len(local)):
        depth = R[2, 0] * local[i, 0] + R[2, 1] * local[i, 1]
        for k in range(2):
            at = xy[i, k]
            right = at * depth - R[k, 0] * local[i, 0] - R[k, 1] * local[i, 1]
            t[k] += right
            t[2] -= at * right
            N[k, k] += 1.0
            N[k, 2] -= at
            N[2, k] -= at
            N[2, 2] += at * at
    return solve_in_place(N, t)
