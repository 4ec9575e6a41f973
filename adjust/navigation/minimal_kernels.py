"""Pose of several cameras from three rays to known points: all solutions (generalised P3P), compiled.

With ray i from ``o_i`` along the unit vector ``d_i`` and the point at depth ``x_i``, the three distances between the
points give three quadratic equations (Nister and Stewenius, J. Math. Imaging Vis. 27, 2007). Two resultants leave a
polynomial of degree 8 in one depth; its positive roots are bracketed by those of its derivatives, and every root is
polished on the three equations, so that the polynomial only has to find the neighbourhood.
"""

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray

MAX_SOLUTIONS = 8
_CLOSE = 2e-2  # what an unpolished solution may miss the third equation by, in squared extents


@njit(cache=True, nogil=True, error_model="numpy")
def _value(c: FloatArray, n: int, x: float) -> float:
    """Polynomial with coefficients c[0] ... c[n], lowest first."""
    y = c[n]
    for i in range(n - 1, -1, -1):
        y = y * x + c[i]
    return float(y)


@njit(cache=True, nogil=True, error_model="numpy")
def _bracketed(c: FloatArray, d: FloatArray, n: int, lo: float, hi: float, flo: float) -> float:
    """The root between lo and hi, where the signs differ: Newton, held by bisection."""
    x = 0.5 * (lo + hi)
    for _ in range(60):
        f = _value(c, n, x)
        if (f > 0.0) == (flo > 0.0):
            lo = x
        else:
            hi = x
        slope = _value(d, n - 1, x)
        new = x - f / slope if slope != 0.0 else lo
        if not (lo < new < hi):
            new = 0.5 * (lo + hi)
        if abs(new - x) <= 1e-13 * (1.0 + abs(x)):
            return new
        x = new
    return x


@njit(cache=True, nogil=True, error_model="numpy")
def real_roots(c: FloatArray, lo: float, hi: float, out: FloatArray) -> int:
    """Roots of a polynomial (lowest coefficient first) between lo and hi, ascending, and near-touching extrema.

    out: room for 2 (degree) values. Returns their number.
    """
    n = c.size - 1
    chain = np.zeros((n + 1, n + 1))
    chain[n, : n + 1] = c
    for k in range(n - 1, 0, -1):
        for i in range(k + 1):
            chain[k, i] = chain[k + 1, i + 1] * (i + 1)
    stops = np.empty(n + 2)
    found = np.empty(n + 2)
    m = 0
    for k in range(1, n + 1):
        stops[0] = lo
        for i in range(m):
            stops[i + 1] = found[i]
        stops[m + 1] = hi
        count, last = m + 2, 0
        for i in range(count - 1):
            fa = _value(chain[k], k, stops[i])
            fb = _value(chain[k], k, stops[i + 1])
            if fa == 0.0 or (fa > 0.0) != (fb > 0.0):
                found[last] = stops[i]
                if fa != 0.0:
                    found[last] = _bracketed(chain[k], chain[k - 1], k, stops[i], stops[i + 1], fa)
                last += 1
        if k == n:
            total = 0
            for i in range(last):
                out[total] = found[i]
                total += 1
            for i in range(1, count - 1):
                # an extremum that nearly touches zero is a double root lost to rounding
                size = 0.0
                power = 1.0
                for j in range(n + 1):
                    size += abs(c[j]) * power
                    power *= abs(stops[i])
                if abs(_value(c, n, stops[i])) < 1e-7 * size and total < out.size:
                    out[total] = stops[i]
                    total += 1
            return total
        m = last
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def _multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    out = np.zeros(a.size + b.size - 1)
    for i in range(a.size):
        for j in range(b.size):
            out[i + j] += a[i] * b[j]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _add_to(total: FloatArray, a: FloatArray, factor: float) -> None:
    for i in range(a.size):
        total[i] += factor * a[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _octic(k: FloatArray) -> FloatArray:
    """Polynomial (9,) in depth y of ray 1; k (3, 4): x^2 + y^2 + k0 x y + k1 x + k2 y + k3 of pairs 01, 12, 02.

    Pair 01 is x^2 + B1(y) x + C1(y), pair 02 is x^2 + B2(z) x + C2(z), pair 12 is z^2 + B3(y) z + C3(y).
    """
    b1 = np.array([k[0, 1], k[0, 0]])
    c1 = np.array([k[0, 3], k[0, 2], 1.0])
    b3 = np.array([k[1, 2], k[1, 0]])
    c3 = np.array([k[1, 3], k[1, 1], 1.0])
    p, q = k[2, 1], k[2, 0]  # B2 = p + q z
    r, s = k[2, 3], k[2, 2]  # C2 = r + s z + z^2
    # z^2 = -B3 z - C3: C2 = e + f z
    e, f = -c3.copy(), -b3.copy()
    e[0] += r
    f[0] += s
    # resultant (C1 - C2)^2 + (B1 - B2)(B1 C2 - B2 C1) as g0 + g1 z + g2 z^2
    u = c1 - e
    g0, g1, g2 = np.zeros(5), np.zeros(4), np.zeros(3)
    _add_to(g0, _multiply(u, u), 1.0)
    _add_to(g1, _multiply(u, f), -2.0)
    _add_to(g2, _multiply(f, f), 1.0)
    v = b1.copy()
    v[0] -= p
    w0 = np.zeros(4)
    _add_to(w0, _multiply(b1, e), 1.0)
    _add_to(w0, c1, -p)
    w1 = np.zeros(3)
    _add_to(w1, _multiply(b1, f), 1.0)
    _add_to(w1, c1, -q)
    _add_to(g0, _multiply(v, w0), 1.0)
    _add_to(g1, _multiply(v, w1), 1.0)
    _add_to(g1, w0, -q)
    _add_to(g2, w1, -q)
    P, Q = np.zeros(5), np.zeros(4)
    _add_to(P, g0, 1.0)
    _add_to(P, _multiply(g2, c3), -1.0)
    _add_to(Q, g1, 1.0)
    _add_to(Q, _multiply(g2, b3), -1.0)
    out = np.zeros(9)
    _add_to(out, _multiply(P, P), 1.0)
    _add_to(out, _multiply(_multiply(P, Q), b3), -1.0)
    _add_to(out, _multiply(_multiply(Q, Q), c3), 1.0)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _equation(k: FloatArray, x: float, y: float) -> float:
    return float(x * x + y * y + k[0] * x * y + k[1] * x + k[2] * y + k[3])


@njit(cache=True, nogil=True, error_model="numpy")
def _polish(k: FloatArray, depths: FloatArray) -> bool:
    """Newton on the three equations; whether it settled."""
    for _ in range(12):
        x, y, z = depths[0], depths[1], depths[2]
        f0, f1, f2 = _equation(k[0], x, y), _equation(k[1], y, z), _equation(k[2], x, z)
        a, b = 2 * x + k[0, 0] * y + k[0, 1], 2 * y + k[0, 0] * x + k[0, 2]
        c, d = 2 * y + k[1, 0] * z + k[1, 1], 2 * z + k[1, 0] * y + k[1, 2]
        e, g = 2 * x + k[2, 0] * z + k[2, 1], 2 * z + k[2, 0] * x + k[2, 2]
        # rows (a, b, 0), (0, c, d), (e, 0, g)
        det = a * c * g + b * d * e
        if abs(det) < 1e-14:
            return False
        dx = (f0 * c * g - b * (f1 * g - d * f2)) / det
        dy = (a * (f1 * g - d * f2) + d * e * f0) / det
        dz = (a * c * f2 - c * e * f0 + b * e * f1) / det
        depths[0] -= dx
        depths[1] -= dy
        depths[2] -= dz
        if abs(dx) + abs(dy) + abs(dz) < 1e-11 * (1.0 + abs(x) + abs(y) + abs(z)):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _triad(a: FloatArray, b: FloatArray, c: FloatArray, out: FloatArray) -> float:
    """Columns of out: the frame of a triangle; returns the sine at its first corner."""
    p, q = b - a, c - a
    p = p / np.sqrt(p @ p)
    n = np.array([p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]])
    size = np.sqrt(n @ n)
    n = n / size
    out[:, 0] = p
    out[:, 2] = n
    out[0, 1] = n[1] * p[2] - n[2] * p[1]
    out[1, 1] = n[2] * p[0] - n[0] * p[2]
    out[2, 1] = n[0] * p[1] - n[1] * p[0]
    return float(size / np.sqrt(q @ q))


@njit(cache=True, nogil=True, error_model="numpy")
def _known(solutions: FloatArray, n: int, depths: FloatArray) -> bool:
    closest = np.inf
    for i in range(n):
        closest = min(closest, np.max(np.abs(solutions[i] - depths)))
    return bool(closest < 1e-6 * (1.0 + np.max(np.abs(depths))))


@njit(cache=True, nogil=True, error_model="numpy")
def three_point_poses(
    o: FloatArray, d: FloatArray, x: FloatArray, nearest: float, farthest: float, R: FloatArray, t: FloatArray
) -> int:
    """All poses ``world_from_station`` with points x (3, 3) m on rays o, d (3, 3) at depths nearest to farthest (m).

    R (8, 3, 3) and t (8, 3) receive them; returns their number, zero for points on one line.
    """
    frame = np.empty((3, 3))
    scale = np.sqrt(max(_square(x[0] - x[1]), _square(x[1] - x[2]), _square(x[0] - x[2])))
    if scale <= 0.0 or not _triad(x[0], x[1], x[2], frame) > 1e-3:
        return 0
    k = np.empty((3, 4))
    for row in range(3):
        i, j = (0, 1) if row == 0 else ((1, 2) if row == 1 else (0, 2))
        apart = (o[i] - o[j]) / scale
        k[row, 0] = -2.0 * (d[i] @ d[j])
        k[row, 1] = 2.0 * (d[i] @ apart)
        k[row, 2] = -2.0 * (d[j] @ apart)
        k[row, 3] = apart @ apart - _square(x[i] - x[j]) / scale**2
    roots = np.empty(18)
    n_roots = real_roots(_octic(k), 0.0, farthest / scale, roots)
    solutions, n = np.empty((MAX_SOLUTIONS, 3)), 0
    depths = np.empty(3)
    for root in range(n_roots):
        y = roots[root]
        hx, hz = -0.5 * (k[0, 0] * y + k[0, 1]), -0.5 * (k[1, 0] * y + k[1, 2])
        sx = np.sqrt(max(hx * hx - (y * y + k[0, 2] * y + k[0, 3]), 0.0))
        sz = np.sqrt(max(hz * hz - (y * y + k[1, 1] * y + k[1, 3]), 0.0))
        for side in range(4):
            depths[0] = hx + (sx if side & 1 else -sx)
            depths[1] = y
            depths[2] = hz + (sz if side & 2 else -sz)
            if abs(_equation(k[2], depths[0], depths[2])) > _CLOSE * (1.0 + y * y) or not _polish(k, depths):
                continue
            if depths.min() * scale < nearest or depths.max() * scale > farthest or _known(solutions, n, depths):
                continue
            if n < MAX_SOLUTIONS:
                solutions[n] = depths
                n += 1
    own = np.empty((3, 3))
    kept = 0
    for i in range(n):
        p = o + d * (solutions[i] * scale).reshape(3, 1)
        if not _triad(p[0], p[1], p[2], own) > 1e-4:
            continue
        for a in range(3):
            for b in range(3):
                R[kept, a, b] = frame[a, 0] * own[b, 0] + frame[a, 1] * own[b, 1] + frame[a, 2] * own[b, 2]
        for a in range(3):
            t[kept, a] = x[0, a] - (R[kept, a, 0] * p[0, 0] + R[kept, a, 1] * p[0, 1] + R[kept, a, 2] * p[0, 2])
        kept += 1
    return kept


@njit(cache=True, nogil=True, error_model="numpy")
def _square(v: FloatArray) -> float:
    return float(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
