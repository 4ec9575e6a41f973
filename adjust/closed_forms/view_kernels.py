"""The work on single views, compiled: refining poses and judging them."""

import numpy as np

from adjust.closed_forms.small_kernels import median_in_place, select, solve_in_place
from adjust.compiling import njit
from adjust.model import BoolArray, FloatArray, IntArray

_ALL_STEPS = 2  # of refinement with all points of a view
_ROBUST = 3.0  # times the median offset: where Cauchy's weight is a half


@njit(cache=True, nogil=True, error_model="numpy")
def error_of_view(pose: FloatArray, x: FloatArray, rays: FloatArray, first: int, last: int, k: int, rms: FloatArray,
                  in_front: BoolArray) -> None:  # fmt: skip
    """Of the pose (4, 4) for the points first ... last the rms offset rad, and whether all lie in front, at k."""
    total, front = 0.0, True
    for i in range(first, last):
        p0 = pose[0, 0] * x[i, 0] + pose[0, 1] * x[i, 1] + pose[0, 2] * x[i, 2] + pose[0, 3]
        p1 = pose[1, 0] * x[i, 0] + pose[1, 1] * x[i, 1] + pose[1, 2] * x[i, 2] + pose[1, 3]
        p2 = pose[2, 0] * x[i, 0] + pose[2, 1] * x[i, 1] + pose[2, 2] * x[i, 2] + pose[2, 3]
        depth = p0 * rays[i, 0] + p1 * rays[i, 1] + p2 * rays[i, 2]
        front = front and depth > 0
        safe = depth if abs(depth) >= 1e-12 else 1e-12
        c0 = (p1 * rays[i, 2] - p2 * rays[i, 1]) / safe
        c1 = (p2 * rays[i, 0] - p0 * rays[i, 2]) / safe
        c2 = (p0 * rays[i, 1] - p1 * rays[i, 0]) / safe
        total += c0 * c0 + c1 * c1 + c2 * c2
    rms[k], in_front[k] = np.sqrt(total / (last - first)), front


@njit(cache=True, nogil=True, error_model="numpy")
def errors_of_views(poses: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray, rms: FloatArray,
                    in_front: BoolArray) -> None:  # fmt: skip
    """Per view the rms offset (B,) rad, and whether (B,) all its points lie in front."""
    for view in range(len(ptr) - 1):
        error_of_view(poses[view], x, rays, ptr[view], ptr[view + 1], view, rms, in_front)


@njit(cache=True, nogil=True, error_model="numpy")
def refine_views(poses: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray, iterations: int,
                 robust: bool) -> None:  # fmt: skip
    """Levenberg-Marquardt on the offsets of each view by itself; poses (B, 4, 4) are improved in place."""
    for view in range(len(ptr) - 1):
        _refine(poses[view], x, rays, ptr[view], ptr[view + 1], iterations, robust)


@njit(cache=True, nogil=True, error_model="numpy")
def refine_candidates(run: IntArray, x: FloatArray, rays: FloatArray, ptr: IntArray, few: IntArray, few_ptr: IntArray,
                      first: IntArray, iterations: int, rival: float, noise: FloatArray, poses: FloatArray,
                      rms: FloatArray, in_front: BoolArray, kept: BoolArray) -> None:  # fmt: skip
    """Candidate poses first[v] ... first[v + 1] of the views of a run, refined in place, robustly.

    A view's rows ``few`` of x and rays, where they are not all of its points, decide which candidates are refined on
    all of them: those of :func:`_plausible`, marked in ``kept`` (K,). rms, in_front: (K,) of these.
    """
    for view in run:
        a, b = ptr[view], ptr[view + 1]
        n = few_ptr[view + 1] - few_ptr[view]
        some_x, some_rays = np.empty((n, 3)), np.empty((n, 3))
        for i in range(n):
            for c in range(3):
                some_x[i, c] = x[few[few_ptr[view] + i], c]
                some_rays[i, c] = rays[few[few_ptr[view] + i], c]
        for k in range(first[view], first[view + 1]):
            _refine(poses[k], some_x, some_rays, 0, n, iterations, True)
            error_of_view(poses[k], some_x, some_rays, 0, n, k, rms, in_front)
            kept[k] = True
        _plausible(rms, in_front, first[view], first[view + 1], rival, noise[view], kept)
        if n == b - a:
            continue
        for k in range(first[view], first[view + 1]):
            if kept[k]:
                _refine(poses[k], x, rays, a, b, _ALL_STEPS, True)
                error_of_view(poses[k], x, rays, a, b, k, rms, in_front)
        _plausible(rms, in_front, first[view], first[view + 1], rival, noise[view], kept)


@njit(cache=True, nogil=True, error_model="numpy")
def offsets_of_views(run: IntArray, poses: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray, out: FloatArray,
                     medians: FloatArray) -> None:  # fmt: skip
    """Tangents (N,) of the angles between rays and points, infinite for points behind, and their medians (B,)."""
    p = np.empty(3)
    for view in run:
        n = ptr[view + 1] - ptr[view]
        mine = np.empty(n)
        for k in range(n):
            i = ptr[view] + k
            for a in range(3):
                p[a] = (poses[view, a, 0] * x[i, 0] + poses[view, a, 1] * x[i, 1] + poses[view, a, 2] * x[i, 2]
                        + poses[view, a, 3])  # fmt: skip
            along = p[0] * rays[i, 0] + p[1] * rays[i, 1] + p[2] * rays[i, 2]
            across2 = max(p[0] ** 2 + p[1] ** 2 + p[2] ** 2 - along**2, 0.0)
            out[i] = np.sqrt(across2) / along if along > 0 else np.inf
            mine[k] = out[i]
        medians[view] = median_in_place(mine, n)


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(pose: FloatArray, x: FloatArray, rays: FloatArray, first: int, last: int, iterations: int,
            robust: bool) -> None:  # fmt: skip
    """Levenberg-Marquardt on the offsets of the points first ... last; pose (4, 4) is improved in place."""
    n = last - first
    across, size, w = np.empty((n, 6)), np.empty(n), np.ones(n)
    # what _offsets says, for the pose and the trial by turns
    state, now = np.empty((2, n, 6)), 0
    N, g, trial = np.empty((6, 6)), np.empty(6), np.empty((4, 4))
    _tangents(rays, first, across)
    _offsets(pose, x, rays, first, across, state, now)
    damping = 1e-6
    for _ in range(iterations):
        if robust:
            _weights(state, now, size, w)
        _normal_equations(rays, first, across, state, now, w, N, g)
        largest = 0.0
        for k in range(6):
            largest = max(largest, N[k, k])
        for k in range(6):
            N[k, k] += damping * N[k, k] + 1e-14 * largest
        if not solve_in_place(N, g):
            break
        _moved(g, pose, trial)
        _offsets(trial, x, rays, first, across, state, 1 - now)
        old, new = 0.0, 0.0
        for i in range(n):
            old += w[i] * (state[now, i, 3] ** 2 + state[now, i, 4] ** 2)
            new += w[i] * (state[1 - now, i, 3] ** 2 + state[1 - now, i, 4] ** 2)
        if not new < old:
            damping *= 30.0
            # a step that small lowers nothing any more
            if damping > 1e3:
                break
            continue
        damping *= 0.1
        now = 1 - now
        for a in range(3):
            for b in range(4):
                pose[a, b] = trial[a, b]
        if old - new <= 1e-12 * old:
            break


@njit(cache=True, nogil=True, error_model="numpy")
def _tangents(rays: FloatArray, first: int, out: FloatArray) -> None:
    """Two unit vectors (n, 2 * 3) across each unit ray (Duff et al., J. Comput. Graph. Techn. 6(1), 2017)."""
    for i in range(len(out)):
        x, y, z = rays[first + i, 0], rays[first + i, 1], rays[first + i, 2]
        sign = 1.0 if z >= 0 else -1.0
        a = -1.0 / (sign + z)
        b = x * y * a
        out[i, 0], out[i, 1], out[i, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
        out[i, 3], out[i, 4], out[i, 5] = b, sign + y * y * a, -y


@njit(cache=True, nogil=True, error_model="numpy")
def _offsets(pose: FloatArray, x: FloatArray, rays: FloatArray, first: int, across: FloatArray, out: FloatArray,
             which: int) -> None:  # fmt: skip
    """Points (3) in the camera, offsets (2) rad across their rays, depth along them, as out[which] (n, 6).

    A point behind the camera is off by more than any in front can be.
    """
    for k in range(len(across)):
        i = first + k
        p0 = pose[0, 0] * x[i, 0] + pose[0, 1] * x[i, 1] + pose[0, 2] * x[i, 2] + pose[0, 3]
        p1 = pose[1, 0] * x[i, 0] + pose[1, 1] * x[i, 1] + pose[1, 2] * x[i, 2] + pose[1, 3]
        p2 = pose[2, 0] * x[i, 0] + pose[2, 1] * x[i, 1] + pose[2, 2] * x[i, 2] + pose[2, 3]
        depth = p0 * rays[i, 0] + p1 * rays[i, 1] + p2 * rays[i, 2]
        out[which, k, 0], out[which, k, 1], out[which, k, 2], out[which, k, 5] = p0, p1, p2, depth
        if not depth > 0:
            out[which, k, 3] = out[which, k, 4] = 1e3
            continue
        safe = max(depth, 1e-12)
        out[which, k, 3] = (across[k, 0] * p0 + across[k, 1] * p1 + across[k, 2] * p2) / safe
        out[which, k, 4] = (across[k, 3] * p0 + across[k, 4] * p1 + across[k, 5] * p2) / safe


@njit(cache=True, nogil=True, error_model="numpy")
def _weights(state: FloatArray, now: int, size: FloatArray, w: FloatArray) -> None:
    """Cauchy's weights (n,) at ``_ROBUST`` times the median offset."""
    n = len(w)
    for i in range(n):
        w[i] = np.sqrt(state[now, i, 3] ** 2 + state[now, i, 4] ** 2)
        size[i] = w[i]
    limit = max(_ROBUST * select(size, n, n // 2), 1e-12)
    for i in range(n):
        w[i] = 1.0 / (1.0 + (w[i] / limit) ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(rays: FloatArray, first: int, across: FloatArray, state: FloatArray, now: int, w: FloatArray,
                      N: FloatArray, g: FloatArray) -> None:  # fmt: skip
    """N (6, 6) and g (6,) of the step -> N step = g: a turn, then a shift, in the camera's frame."""
    for a in range(6):
        g[a] = 0.0
        for b in range(6):
            N[a, b] = 0.0
    j = np.empty(6)
    for i in range(len(across)):
        p0, p1, p2, depth = state[now, i, 0], state[now, i, 1], state[now, i, 2], state[now, i, 5]
        for k in range(2):
            r = state[now, i, 3 + k]
            for a in range(3):
                j[3 + a] = (across[i, 3 * k + a] - r * rays[first + i, a]) / depth
            # the derivative by a turn is -b [p]x = p x b
            j[0] = p1 * j[5] - p2 * j[4]
            j[1] = p2 * j[3] - p0 * j[5]
            j[2] = p0 * j[4] - p1 * j[3]
            for a in range(6):
                wj = w[i] * j[a]
                g[a] -= wj * r
                for b in range(a + 1):
                    N[a, b] += wj * j[b]
    for a in range(6):
        for b in range(a):
            N[b, a] = N[a, b]


@njit(cache=True, nogil=True, error_model="numpy")
def _moved(step: FloatArray, pose: FloatArray, out: FloatArray) -> None:
    """``[exp(turn) shift] * pose`` (Rodrigues)."""
    w0, w1, w2 = step[0], step[1], step[2]
    square = w0 * w0 + w1 * w1 + w2 * w2
    angle = np.sqrt(square)
    a = 1.0 - square / 6.0 if angle < 1e-6 else np.sin(angle) / angle
    b = 0.5 if angle < 1e-6 else (1.0 - np.cos(angle)) / square
    for k in range(4):
        x, y, z = pose[0, k], pose[1, k], pose[2, k]
        # exp(w) v = v + a (w x v) + b (w (w v) - w^2 v)
        along = b * (w0 * x + w1 * y + w2 * z)
        rest = 1.0 - b * square
        out[0, k] = rest * x + along * w0 + a * (w1 * z - w2 * y)
        out[1, k] = rest * y + along * w1 + a * (w2 * x - w0 * z)
        out[2, k] = rest * z + along * w2 + a * (w0 * y - w1 * x)
        out[3, k] = pose[3, k]
    for i in range(3):
        out[i, 3] += step[3 + i]


@njit(cache=True, nogil=True, error_model="numpy")
def _plausible(rms: FloatArray, in_front: BoolArray, first: int, last: int, rival: float, noise: float,
               kept: BoolArray) -> None:  # fmt: skip
    """Keep of the kept those in front that are within a factor or the noise of the best; the best where none is."""
    best = -1
    for k in range(first, last):
        if kept[k] and (best < 0 or (in_front[k] and not in_front[best])
                        or (in_front[k] == in_front[best] and rms[k] < rms[best])):  # fmt: skip
            best = k
    limit = max(rival * rms[best], rms[best] + noise)
    for k in range(first, last):
        kept[k] = kept[k] and (k == best or (in_front[k] and in_front[best] and rms[k] <= limit))
