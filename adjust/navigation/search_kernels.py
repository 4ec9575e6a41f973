"""Hypotheses of which spot is which beacon, compiled: three spots named at a time, all poses, consensus of the rest."""

import numpy as np

from adjust.compiling import njit
from adjust.model import BoolArray, FloatArray, IntArray
from adjust.navigation.minimal_kernels import three_point_poses


@njit(cache=True, nogil=True, error_model="numpy")
def _ray_gap(o: FloatArray, d: FloatArray, i: int, j: int, nearest: float, farthest: float, out: FloatArray) -> None:
    """Least and largest distance (2,) between points of two rays at depths nearest to farthest."""
    a = o[i] - o[j]
    c, p, q = d[i] @ d[j], a @ d[i], a @ d[j]
    out[1] = 0.0
    for s in (nearest, farthest):
        for u in (nearest, farthest):
            out[1] = max(out[1], np.sqrt(_square(a + s * d[i] - u * d[j])))
    out[0] = out[1]
    s = 0.5 * (nearest + farthest)
    # alternate: the distance is convex on the square of depths
    for _ in range(40):
        u = min(max(c * s + q, nearest), farthest)
        s = min(max(c * u - p, nearest), farthest)
    out[0] = np.sqrt(_square(a + s * d[i] - u * d[j]))


@njit(cache=True, nogil=True, error_model="numpy")
def _square(v: FloatArray) -> float:
    return float(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True, nogil=True, error_model="numpy")
def consensus(
    R: FloatArray, t: FloatArray, x_in_world: FloatArray, camera_R: FloatArray, camera_t: FloatArray,
    field: FloatArray, camera: IntArray, ray: FloatArray, allowed: BoolArray, gate: float, named: FloatArray,
    missed: FloatArray, match: IntArray,
) -> float:  # fmt: skip
    """Coarse score of a pose.

    ``named`` (n,) for every spot with a beacon within ``gate`` (rad), less for its distance, and ``missed`` (c,) off
    for every beacon that a camera should have seen. match (n,) receives the beacons, -1 for none.
    """
    n, m = camera.size, x_in_world.shape[0]
    score = 0.0
    best = np.full(n, gate * gate)
    match[:] = -1
    q, p, w = np.empty(3), np.empty(3), np.empty(3)
    for b in range(m):
        for a in range(3):
            q[a] = 0.0
            for k in range(3):
                q[a] += R[k, a] * (x_in_world[b, k] - t[k])
        for c in range(camera_R.shape[0]):
            for a in range(3):
                w[a] = q[a] - camera_t[c, a]
            size = np.sqrt(_square(w))
            for a in range(3):
                p[a] = camera_R[c, 0, a] * w[0] + camera_R[c, 1, a] * w[1] + camera_R[c, 2, a] * w[2]
            fisheye = field[c, 4] < 1.5
            if fisheye:
                inside = p[2] > field[c, 4] * size
            else:
                x, y = p[0] / p[2], p[1] / p[2]
                inside = p[2] > 0 and field[c, 0] < x < field[c, 1] and field[c, 2] < y < field[c, 3]
                # a beacon just outside may still be the one of a spot at the border
                if p[2] <= 0 or x < field[c, 0] - 0.05 or x > field[c, 1] + 0.05:
                    continue
                if y < field[c, 2] - 0.05 or y > field[c, 3] + 0.05:
                    continue
            chosen, nearest = -1, gate * gate
            for i in range(n):
                if camera[i] == c and allowed[i, b]:
                    apart = 0.0
                    for a in range(3):
                        apart += (w[a] / size - ray[i, a]) ** 2
                    if apart < nearest:
                        chosen, nearest = i, apart
            if chosen >= 0:
                if nearest < best[chosen]:
                    best[chosen] = nearest
                    match[chosen] = b
            elif inside:
                score -= missed[c]
    for i in range(n):
        if match[i] >= 0:
            score += named[i] - 4.0 * best[i] / (gate * gate)
    return float(score)


@njit(cache=True, nogil=True, error_model="numpy")
def search(
    origin: FloatArray, ray: FloatArray, camera: IntArray, allowed: BoolArray, triples: IntArray,
    x_in_world: FloatArray, camera_R: FloatArray, camera_t: FloatArray, field: FloatArray, gate: float,
    named: FloatArray, missed: FloatArray, nearest: float, farthest: float, most: int,
    out_R: FloatArray, out_t: FloatArray, out_score: FloatArray, out_match: IntArray,
) -> tuple[int, int]:  # fmt: skip
    """Try the beacons ``allowed`` (n, m) on triples (T, 3) of spots; keep the best poses, each naming once.

    Stops after ``most`` three-point problems, or when the best consensus makes it hopeless that a triple of true spots
    was not among those tried (the usual stop of RANSAC, with all beacons tried on each triple).
    Returns how many poses were kept and how many problems were solved.
    """
    n, m, room = camera.size, x_in_world.shape[0], out_score.size
    R, t = np.empty((8, 3, 3)), np.empty((8, 3))
    o, d, x = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    match = np.empty(n, dtype=np.int64)
    apart = np.empty((m, m))
    for a in range(m):
        for b in range(m):
            apart[a, b] = np.sqrt(_square(x_in_world[a] - x_in_world[b]))
    gaps = np.empty((3, 2))
    kept, solved, most_named = 0, 0, 0
    for number in range(triples.shape[0]):
        if most_named >= 4:
            inliers = most_named / n
            # four named spots may still be chance: some more triples. All named leaves nothing to look for
            more = 0 if most_named == n and n > 4 else 3
            if number > np.log(1e-6) / np.log(1.0 - min(inliers**3, 0.9999999)) - 1 + more:
                break
        i, j, k = triples[number]
        o[0], o[1], o[2] = origin[i], origin[j], origin[k]
        d[0], d[1], d[2] = ray[i], ray[j], ray[k]
        _ray_gap(o, d, 0, 1, nearest, farthest, gaps[0])
        _ray_gap(o, d, 1, 2, nearest, farthest, gaps[1])
        _ray_gap(o, d, 0, 2, nearest, farthest, gaps[2])
        for a in range(m):
            if not allowed[i, a]:
                continue
            for b in range(m):
                if b == a or not (allowed[j, b] and gaps[0, 0] <= apart[a, b] <= gaps[0, 1]):
                    continue
                for c in range(m):
                    if c in (a, b) or not (allowed[k, c] and gaps[1, 0] <= apart[b, c] <= gaps[1, 1]):
                        continue
                    if not (gaps[2, 0] <= apart[a, c] <= gaps[2, 1]):
                        continue
                    if solved >= most:
                        return kept, solved
                    solved += 1
                    x[0], x[1], x[2] = x_in_world[a], x_in_world[b], x_in_world[c]
                    for s in range(three_point_poses(o, d, x, nearest, farthest, R, t)):
                        score = consensus(R[s], t[s], x_in_world, camera_R, camera_t, field, camera, ray, allowed,
                                          gate, named, missed, match)  # fmt: skip
                        if match[i] != a or match[j] != b or match[k] != c:
                            continue
                        count = 0
                        for e in range(n):
                            if match[e] >= 0:
                                count += 1
                        most_named = max(most_named, count)
                        kept = _keep(R[s], t[s], score, match, count, kept, room, out_R, out_t, out_score,
                                     out_match)  # fmt: skip
    return kept, solved


@njit(cache=True, nogil=True, error_model="numpy")
def _keep(
    R: FloatArray, t: FloatArray, score: float, match: IntArray, count: int, kept: int, room: int,
    out_R: FloatArray, out_t: FloatArray, out_score: FloatArray, out_match: IntArray,
) -> int:  # fmt: skip
    """Put a pose among the best; one naming may stand for several poses (mirror solutions), told by their turn.

    Of four spots or more (``count``) different triples give about the same pose; three give all theirs at once.
    """
    place, alike = -1, 2.9 if count > 3 else 3.0 - 1e-9
    for e in range(kept):
        same = True
        for i in range(match.size):
            if out_match[e, i] != match[i]:
                same = False
                break
        if same:
            trace = 0.0
            for a in range(3):
                for b in range(3):
                    trace += out_R[e, a, b] * R[a, b]
            if trace > alike:
                if out_score[e] >= score:
                    return kept
                place = e
                break
    if place < 0:
        if kept < room:
            place = kept
            kept += 1
        else:
            place = int(np.argmin(out_score))
            if out_score[place] >= score:
                return kept
    out_R[place], out_t[place], out_score[place], out_match[place] = R, t, score, match
    return kept
