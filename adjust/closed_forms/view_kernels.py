"""The work on single views, compiled: refining poses, judging them, and the homography of a plane."""

import numpy as np

from adjust.compiling import njit
from adjust.model import BoolArray, FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def tangents(ray: FloatArray, out: FloatArray) -> None:
    """Two unit vectors (2, 3) across a unit ray (Duff et al., J. Comput. Graph. Techn. 6(1), 2017)."""
    x, y, z = ray
    sign = 1.0 if z >= 0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    out[0, 0], out[0, 1], out[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    out[1, 0], out[1, 1], out[1, 2] = b, sign + y * y * a, -y


@njit(cache=True, nogil=True, error_model="numpy")
def _offsets(pose: FloatArray, x: FloatArray, rays: FloatArray, across: FloatArray, p: FloatArray, r: FloatArray,
             depth: FloatArray) -> None:  # fmt: skip
    """Points (n, 3) in the camera, offsets (n, 2) rad across their rays, depths (n,) along them."""
    for i in range(len(x)):
        for a in range(3):
            p[i, a] = pose[a, 0] * x[i, 0] + pose[a, 1] * x[i, 1] + pose[a, 2] * x[i, 2] + pose[a, 3]
        depth[i] = p[i, 0] * rays[i, 0] + p[i, 1] * rays[i, 1] + p[i, 2] * rays[i, 2]
        safe = depth[i] if abs(depth[i]) >= 1e-12 else 1e-12
        for k in range(2):
            r[i, k] = (across[i, k, 0] * p[i, 0] + across[i, k, 1] * p[i, 1] + across[i, k, 2] * p[i, 2]) / safe


@njit(cache=True, nogil=True, error_model="numpy")
def errors_of_views(poses: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray, rms: FloatArray,
                    in_front: BoolArray) -> None:  # fmt: skip
    """Per view the rms offset (B,) rad, and whether (B,) all its points lie in front."""
    across = np.empty((len(x), 2, 3))
    for i in range(len(x)):
        tangents(rays[i], across[i])
    for view in range(len(ptr) - 1):
        a, b = ptr[view], ptr[view + 1]
        n = b - a
        p, r, depth = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
        _offsets(poses[view], x[a:b], rays[a:b], across[a:b], p, r, depth)
        rms[view] = np.sqrt(np.sum(r * r) / n)
        in_front[view] = depth.min() > 0


@njit(cache=True, nogil=True, error_model="numpy")
def refine_views(poses: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray, iterations: int,
                 robust: bool) -> None:  # fmt: skip
    """Levenberg-Marquardt on the offsets of each view by itself; poses (B, 4, 4) are improved in place."""
    for view in range(len(ptr) - 1):
        _refine(poses[view], x[ptr[view] : ptr[view + 1]], rays[ptr[view] : ptr[view + 1]], iterations, robust)


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(pose: FloatArray, x: FloatArray, rays: FloatArray, iterations: int, robust: bool) -> None:
    n = len(x)
    across, p, r, depth = np.empty((n, 2, 3)), np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    new_p, new_r, new_depth = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    for i in range(n):
        tangents(rays[i], across[i])
    _offsets(pose, x, rays, across, p, r, depth)
    _forbid_behind(r, depth)
    damping, w = 1e-6, np.ones(n)
    N, g, trial = np.empty((6, 6)), np.empty(6), np.empty((4, 4))
    for _ in range(iterations):
        if robust:
            size = np.sqrt(r[:, 0] ** 2 + r[:, 1] ** 2)
            limit = max(3.0 * np.sort(size)[n // 2], 1e-12)
            w = 1.0 / (1.0 + (size / limit) ** 2)
        _normal_equations(p, rays, across, r, depth, w, N, g)
        largest = 0.0
        for k in range(6):
            largest = max(largest, N[k, k])
        for k in range(6):
            N[k, k] += damping * N[k, k] + 1e-14 * largest
        step = -np.linalg.solve(N, g)
        _moved(step, pose, trial)  # type: ignore[arg-type]  # NumPy's stub of solve forgets the 64 bits
        _offsets(trial, x, rays, across, new_p, new_r, new_depth)
        _forbid_behind(new_r, new_depth)
        old, new = 0.0, 0.0
        for i in range(n):
            old += w[i] * (r[i, 0] ** 2 + r[i, 1] ** 2)
            new += w[i] * (new_r[i, 0] ** 2 + new_r[i, 1] ** 2)
        if not new < old:
            damping *= 30.0
            # a step that small lowers nothing any more
            if damping > 1e3:
                break
            continue
        damping *= 0.1
        pose[:] = trial
        p[:], r[:], depth[:] = new_p, new_r, new_depth
        if old - new <= 1e-12 * old:
            break


@njit(cache=True, nogil=True, error_model="numpy")
def _forbid_behind(r: FloatArray, depth: FloatArray) -> None:
    for i in range(len(r)):
        if not depth[i] > 0:
            r[i, 0] = r[i, 1] = 1e3


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(p: FloatArray, rays: FloatArray, across: FloatArray, r: FloatArray, depth: FloatArray,
                      w: FloatArray, N: FloatArray, g: FloatArray) -> None:  # fmt: skip
    N[:] = 0.0
    g[:] = 0.0
    j = np.empty(6)
    for i in range(len(p)):
        for k in range(2):
            for a in range(3):
                j[3 + a] = (across[i, k, a] - r[i, k] * rays[i, a]) / depth[i]
            # the derivative by a turn is -b [p]x = p x b
            j[0] = p[i, 1] * j[5] - p[i, 2] * j[4]
            j[1] = p[i, 2] * j[3] - p[i, 0] * j[5]
            j[2] = p[i, 0] * j[4] - p[i, 1] * j[3]
            for a in range(6):
                wj = w[i] * j[a]
                g[a] += wj * r[i, k]
                for b in range(a + 1):
                    N[a, b] += wj * j[b]
    for a in range(6):
        for b in range(a):
            N[b, a] = N[a, b]


@njit(cache=True, nogil=True, error_model="numpy")
def _moved(step: FloatArray, pose: FloatArray, out: FloatArray) -> None:
    """``[exp(turn) shift] * pose`` (Rodrigues)."""
    wx, wy, wz = step[0], step[1], step[2]
    angle = np.sqrt(wx * wx + wy * wy + wz * wz)
    a = 1.0 - angle**2 / 6.0 if angle < 1e-6 else np.sin(angle) / angle
    b = 0.5 if angle < 1e-6 else (1.0 - np.cos(angle)) / angle**2
    K = np.array([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]])
    R = np.eye(3) + a * K + b * (K @ K)
    out[:] = 0.0
    out[3, 3] = 1.0
    for i in range(3):
        for k in range(4):
            out[i, k] = R[i, 0] * pose[0, k] + R[i, 1] * pose[1, k] + R[i, 2] * pose[2, k]
        out[i, 3] += step[3 + i]


@njit(cache=True, nogil=True, error_model="numpy")
def _normalised(xy: FloatArray, T: FloatArray) -> FloatArray:
    """Points (n, 2) moved to mean zero and mean distance sqrt(2) by T (3, 3) (Hartley, PAMI 19(6), 1997)."""
    n = len(xy)
    mx, my = xy[:, 0].mean(), xy[:, 1].mean()
    size = 0.0
    for i in range(n):
        size += np.sqrt((xy[i, 0] - mx) ** 2 + (xy[i, 1] - my) ** 2) / n
    s = np.sqrt(2.0) / size if size > 0 else 1.0
    T[:] = 0.0
    T[0, 0], T[0, 2], T[1, 1], T[1, 2], T[2, 2] = s, -s * mx, s, -s * my, 1.0
    out = np.empty((n, 2))
    out[:, 0], out[:, 1] = s * (xy[:, 0] - mx), s * (xy[:, 1] - my)
    return out


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
def plane_to_image(xy: FloatArray, uv: FloatArray, refinements: int, h: FloatArray) -> float:
    """Homography h (3, 3) of a plane and the rms of its residuals in the unit of uv; negative where it is singular.

    Hartley and Zisserman, Multiple View Geometry, algorithm 4.2, then Gauss-Newton steps on the distance in the image.
    """
    n = len(xy)
    Tx, Tu = np.empty((3, 3)), np.empty((3, 3))
    x, u = _normalised(xy, Tx), _normalised(uv, Tu)
    N = np.zeros((9, 9))
    for i in range(n):
        _add_map_rows(x[i, 0], x[i, 1], 1.0, u[i, 0], u[i, 1], N)
    _complete_map_rows(N)
    values, vectors = np.linalg.eigh(N)
    if values[1] < 1e-13 * values[8]:
        return -1.0
    best_h = np.ascontiguousarray(vectors[:, 0]).reshape(3, 3)
    best_h = best_h / np.sqrt(np.sum(best_h**2))
    if not np.linalg.det(best_h) > 0:
        best_h = -best_h
    best = _map_rms(best_h, x, u)
    g, p = np.empty(9), np.empty(3)
    for _ in range(refinements):
        N[:] = 0.0
        g[:] = 0.0
        for i in range(n):
            for a in range(3):
                p[a] = best_h[a, 0] * x[i, 0] + best_h[a, 1] * x[i, 1] + best_h[a, 2]
            x0, x1, x2 = x[i, 0] / p[2], x[i, 1] / p[2], 1.0 / p[2]
            v0, v1 = p[0] / p[2], p[1] / p[2]
            _add_map_rows(x0, x1, x2, v0, v1, N)
            for k in range(2):
                v = v0 if k == 0 else v1
                e = v - u[i, k]
                g[3 * k] += x0 * e
                g[3 * k + 1] += x1 * e
                g[3 * k + 2] += x2 * e
                g[6] -= v * x0 * e
                g[7] -= v * x1 * e
                g[8] -= v * x2 * e
        _complete_map_rows(N)
        # the scale of h has no effect: one more row holds it
        flat = best_h.copy().reshape(9)
        N += np.outer(flat, flat)
        step = -np.linalg.solve(N, g).reshape(3, 3)
        error = _map_rms(best_h + step, x, u)
        if not error < best:
            break
        best_h, best = best_h + step, error
    h[:] = np.linalg.solve(Tu, best_h @ Tx)
    return float(best / Tu[0, 0])


@njit(cache=True, nogil=True, error_model="numpy")
def _turn_to_front(mean: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that turns a direction, not nearly backwards, to +z."""
    d = mean / np.sqrt(np.sum(mean**2))
    k = 1.0 / (1.0 + d[2])
    return np.array([
        [1.0 - d[0] * d[0] * k, -d[0] * d[1] * k, -d[0]],
        [-d[0] * d[1] * k, 1.0 - d[1] * d[1] * k, -d[1]],
        [d[0], d[1], d[2]],
    ])  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def plane_poses(x: FloatArray, rays: FloatArray, thickness: float, widest: float, poses: FloatArray) -> int:
    """Both poses (2, 4, 4) of a plane's points (n, 3) m on rays (n, 3); returns 2, or -1 where this is no case of it.

    Source: Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 109, 2014: the rotations from the first
    derivatives of the homography at the centroid; the translations by linear least squares. No case are points off a
    plane, on a line, and rays further from their mean than the cosine ``widest``.
    """
    n = len(x)
    mean = np.array([rays[:, 0].mean(), rays[:, 1].mean(), rays[:, 2].mean()])
    if not mean[2] > -0.5 * np.sqrt(np.sum(mean**2)):
        return -1
    F = _turn_to_front(mean)
    xy = np.empty((n, 2))
    for i in range(n):
        z = F[2, 0] * rays[i, 0] + F[2, 1] * rays[i, 1] + F[2, 2] * rays[i, 2]
        if z <= widest:
            return -1
        for k in range(2):
            xy[i, k] = (F[k, 0] * rays[i, 0] + F[k, 1] * rays[i, 1] + F[k, 2] * rays[i, 2]) / z
    centre = np.array([x[:, 0].mean(), x[:, 1].mean(), x[:, 2].mean()])
    centred = x - centre
    values, vectors = np.linalg.eigh(centred.T @ centred)
    size = np.sqrt(np.maximum(values, 0.0))
    if size[1] <= 1e-6 * size[2] or size[0] >= thickness * size[2]:
        return -1
    axes = np.empty((3, 3))
    axes[0], axes[1] = vectors[:, 2], vectors[:, 1]
    axes[2] = np.cross(axes[0], axes[1])
    scale = np.sqrt(np.max(np.sum(centred**2, axis=1)))
    local = np.ascontiguousarray((centred @ axes.T)[:, :2]) / scale
    H = np.empty((3, 3))
    if plane_to_image(local, xy, 0, H) < 0 or H[2, 2] == 0.0:
        return -1
    H = H / H[2, 2]
    turns = np.empty((2, 3, 3))
    if not _infinitesimal(H, turns):
        return -1
    back = np.ascontiguousarray(F.T)
    for k in range(2):
        t = _shift(turns[k], local, xy)
        R = back @ turns[k] @ axes
        poses[k] = 0.0
        poses[k, :3, :3] = R
        poses[k, :3, 3] = scale * (back @ t) - R @ centre
        poses[k, 3, 3] = 1.0
    return 2 if np.all(np.isfinite(poses)) else -1


@njit(cache=True, nogil=True, error_model="numpy")
def _infinitesimal(H: FloatArray, turns: FloatArray) -> bool:
    """Both rotations (2, 3, 3) of a plane whose homography H (3, 3), H22 = 1, is known at its origin."""
    v = np.array([H[0, 2], H[1, 2]])
    J = np.array([[H[0, 0] - H[2, 0] * v[0], H[0, 1] - H[2, 1] * v[0]],
                  [H[1, 0] - H[2, 0] * v[1], H[1, 1] - H[2, 1] * v[1]]])  # fmt: skip
    # the turn of +z to the direction of the origin: the inverse of that to the front
    Rv = np.ascontiguousarray(_turn_to_front(np.array([v[0], v[1], 1.0])).T)
    B = np.empty((2, 2))
    for a in range(2):
        for b in range(2):
            B[a, b] = Rv[a, b] - v[a] * Rv[2, b]
    if abs(np.linalg.det(B)) < 1e-12:
        return False
    A = np.linalg.solve(B, J)
    S = A @ A.T
    gamma = np.sqrt(0.5 * (S[0, 0] + S[1, 1] + np.sqrt((S[0, 0] - S[1, 1]) ** 2 + 4.0 * S[0, 1] ** 2)))
    if not gamma > 1e-12:
        return False
    R22 = A / gamma
    h00 = max(1.0 - R22[0, 0] ** 2 - R22[1, 0] ** 2, 0.0)
    h11 = max(1.0 - R22[0, 1] ** 2 - R22[1, 1] ** 2, 0.0)
    h01 = -(R22[0, 0] * R22[0, 1] + R22[1, 0] * R22[1, 1])
    b0, b1 = np.sqrt(h00), np.sqrt(h11) if h01 >= 0 else -np.sqrt(h11)
    for k in range(2):
        sign = 1.0 if k == 0 else -1.0
        T = np.empty((3, 3))
        T[0, 0], T[1, 0], T[2, 0] = R22[0, 0], R22[1, 0], sign * b0
        T[0, 1], T[1, 1], T[2, 1] = R22[0, 1], R22[1, 1], sign * b1
        T[:, 2] = np.cross(T[:, 0], T[:, 1])
        turns[k] = Rv @ T
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _shift(R: FloatArray, local: FloatArray, xy: FloatArray) -> FloatArray:
    """The translation (3,) for which the points (n, 2) of the plane fall on their images (n, 2), linearly."""
    N, g = np.zeros((3, 3)), np.zeros(3)
    row = np.zeros(3)
    for i in range(len(local)):
        depth = R[2, 0] * local[i, 0] + R[2, 1] * local[i, 1]
        for k in range(2):
            row[:] = 0.0
            row[k], row[2] = 1.0, -xy[i, k]
            right = xy[i, k] * depth - R[k, 0] * local[i, 0] - R[k, 1] * local[i, 1]
            for a in range(3):
                g[a] += row[a] * right
                for b in range(3):
                    N[a, b] += row[a] * row[b]
    return np.linalg.solve(N, g)  # type: ignore[return-value]  # NumPy's stub forgets the 64 bits


@njit(cache=True, nogil=True, error_model="numpy")
def first_poses(run: IntArray, x: FloatArray, rays: FloatArray, ptr: IntArray, thickness: float, widest: float,
                poses: FloatArray, rms: FloatArray, in_front: BoolArray, found: BoolArray) -> None:  # fmt: skip
    """Both poses (B, 2, 4, 4) of the plane in the views of a run, as :func:`plane_poses` finds them, and how good.

    rms, in_front: (B, 2) as of :func:`errors_of_views`. found: (B,), False where there is no plane.
    """
    whole = np.empty(2, np.int64)
    for view in run:
        a, b = ptr[view], ptr[view + 1]
        found[view] = b - a > 3 and plane_poses(x[a:b], rays[a:b], thickness, widest, poses[view]) == 2
        if not found[view]:
            continue
        whole[0], whole[1] = 0, b - a
        for k in range(2):
            errors_of_views(
                poses[view, k : k + 1], x[a:b], rays[a:b], whole, rms[view, k : k + 1], in_front[view, k : k + 1]
            )


@njit(cache=True, nogil=True, error_model="numpy")
def refine_candidates(run: IntArray, x: FloatArray, rays: FloatArray, ptr: IntArray, few: IntArray, few_ptr: IntArray,
                      first: IntArray, iterations: int, rival: float, noise: FloatArray, poses: FloatArray,
                      rms: FloatArray, in_front: BoolArray, kept: BoolArray) -> None:  # fmt: skip
    """Candidate poses first[v] ... first[v + 1] of the views of a run, refined in place, robustly.

    A view's rows ``few`` of x and rays, where they are not all of its points, decide which candidates are refined on
    all of them: those of :func:`_plausible`, which are marked in ``kept`` (K,). rms, in_front: (K,) of the kept ones.
    """
    whole = np.empty(2, np.int64)
    for view in run:
        a, b = ptr[view], ptr[view + 1]
        c, d = first[view], first[view + 1]
        rows = few[few_ptr[view] : few_ptr[view + 1]]
        sampled = len(rows) < b - a
        whole[0], whole[1] = 0, len(rows)
        some_x, some_rays = x[rows], rays[rows]
        for k in range(c, d):
            _refine(poses[k], some_x, some_rays, iterations, True)
            errors_of_views(poses[k : k + 1], some_x, some_rays, whole, rms[k : k + 1], in_front[k : k + 1])
        kept[c:d] = True
        _plausible(rms[c:d], in_front[c:d], rival, noise[view], kept[c:d])
        if not sampled:
            continue
        whole[1] = b - a
        for k in range(c, d):
            if kept[k]:
                _refine(poses[k], x[a:b], rays[a:b], 2, True)
                errors_of_views(poses[k : k + 1], x[a:b], rays[a:b], whole, rms[k : k + 1], in_front[k : k + 1])
        _plausible(rms[c:d], in_front[c:d], rival, noise[view], kept[c:d])


@njit(cache=True, nogil=True, error_model="numpy")
def _plausible(rms: FloatArray, in_front: BoolArray, rival: float, noise: float, kept: BoolArray) -> None:
    """Keep of the kept those in front that are within a factor or the noise of the best; the best where none is."""
    best = -1
    for k in range(len(rms)):
        if kept[k] and (best < 0 or (in_front[k] and not in_front[best])
                        or (in_front[k] == in_front[best] and rms[k] < rms[best])):  # fmt: skip
            best = k
    limit = max(rival * rms[best], rms[best] + noise)
    for k in range(len(rms)):
        kept[k] = kept[k] and (k == best or (in_front[k] and in_front[best] and rms[k] <= limit))


@njit(cache=True, nogil=True, error_model="numpy")
def offsets_of_views(run: IntArray, poses: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray, out: FloatArray,
                     medians: FloatArray) -> None:  # fmt: skip
    """Tangents (N,) of the angles between rays and points, infinite for points behind, and their medians (B,)."""
    p = np.empty(3)
    for view in run:
        pose = poses[view]
        for i in range(ptr[view], ptr[view + 1]):
            for a in range(3):
                p[a] = pose[a, 0] * x[i, 0] + pose[a, 1] * x[i, 1] + pose[a, 2] * x[i, 2] + pose[a, 3]
            along = p[0] * rays[i, 0] + p[1] * rays[i, 1] + p[2] * rays[i, 2]
            across2 = max(p[0] ** 2 + p[1] ** 2 + p[2] ** 2 - along**2, 0.0)
            out[i] = np.sqrt(across2) / along if along > 0 else np.inf
        mine = out[ptr[view] : ptr[view + 1]]
        medians[view] = np.median(mine) if len(mine) else np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def plane_misfits(x: FloatArray, uv: FloatArray, ptr: IntArray, out: FloatArray) -> None:
    """Per view the median distance (B,) from the image of the points' best plane, relative to their extent there.

    Infinite where the points lie on one line or are fewer than four.
    """
    h = np.empty((3, 3))
    for view in range(len(ptr) - 1):
        a, b = ptr[view], ptr[view + 1]
        out[view] = np.inf
        if b - a < 4:
            continue
        mean = np.array([x[a:b, 0].mean(), x[a:b, 1].mean(), x[a:b, 2].mean()])
        centred = x[a:b] - mean
        vectors = np.linalg.eigh(centred.T @ centred)[1]
        xy = np.ascontiguousarray((centred @ vectors)[:, :0:-1])
        if plane_to_image(xy, uv[a:b], 0, h) < 0:
            continue
        miss = np.empty(b - a)
        for i in range(b - a):
            w = h[2, 0] * xy[i, 0] + h[2, 1] * xy[i, 1] + h[2, 2]
            du = (h[0, 0] * xy[i, 0] + h[0, 1] * xy[i, 1] + h[0, 2]) / w - uv[a + i, 0]
            dv = (h[1, 0] * xy[i, 0] + h[1, 1] * xy[i, 1] + h[1, 2]) / w - uv[a + i, 1]
            miss[i] = np.sqrt(du * du + dv * dv)
        extent = np.sqrt(np.ptp(uv[a:b, 0]) ** 2 + np.ptp(uv[a:b, 1]) ** 2)
        out[view] = np.median(miss) / max(extent, 1e-9)
