"""Two points of the world that are called by each other's names in some images: their rays meet in other places.

The points themselves may be spoilt: of cameras that targets or a table place, the rays of both names are gathered, and
divided anew between the two places where most of them meet.
"""

from collections.abc import Iterator
from itertools import combinations, islice

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.names.images import POINTS, exchange, points_exchanged
from adjust.diagnosis.prediction import Prediction
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.subsets import with_points
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.start.closed_forms.triangulation import intersect
from adjust.start.views import Sighting, sights_of

_NEAR_PX = 15.0
"""Rays of rough poses that miss a point by less are its own."""
_PARALLAX = 0.01  # rad
_SUSPECTS, _MOST, _PAIRS = 8, 3, 300
_EVIDENCE = 100.0  # places without any residual: as of what single images show


@frozen(eq=False)
class Rays:
    """blocks, points: (n,) of which image block and which point. o, d: (n, 3) m, unit, world. focal_px: (n,)."""

    blocks: IntArray
    points: IntArray
    o: FloatArray
    d: FloatArray
    focal_px: FloatArray

    def near(self, rows: IntArray, x: FloatArray) -> BoolArray:
        """Which of the rays (k,) pass a place (3,) in front of their camera."""
        to = x - self.o[rows]
        along = np.einsum("ni,ni->n", to, self.d[rows])
        off = np.linalg.norm(to - along[:, None] * self.d[rows], axis=1)
        return np.asarray((along > 0.0) & (off * self.focal_px[rows] < _NEAR_PX * along))

    def meeting(self, rows: IntArray) -> IntArray:
        """Those of the rays (k,) that meet in one place: as many of them as possible."""
        pairs = np.array(list(islice(combinations(rows.tolist(), 2), _PAIRS)), dtype=np.int64).reshape(-1, 2)
        best: IntArray = rows[:0]
        if not len(pairs):
            return best
        of, both = np.repeat(np.arange(len(pairs)), 2), pairs.ravel()
        met = intersect(self.o[both], self.d[both], of, len(pairs), iterations=0)
        for pair, x in zip(pairs[met.parallax > _PARALLAX], met.x[met.parallax > _PARALLAX], strict=True):
            found = rows[self.near(rows, x)]
            if len(found) > len(best) and np.isin(pair, found).all():
                best = found
        return best


def exchanged_in_images(case: Case) -> Iterator[Hypothesis]:
    """The exchanges after which most rays meet."""
    rays = _rays(case) if any(b.target_id is None for b in case.survey.image_blocks) else None
    if rays is None:
        return
    of = {p: np.flatnonzero(rays.points == p) for p in np.unique(rays.points).tolist()}
    meet = {p: len(rays.meeting(rows)) for p, rows in of.items()}
    suspects = sorted((p for p in of if meet[p] < len(of[p]) > 1), key=lambda p: meet[p] - len(of[p]))[:_SUSPECTS]
    found, pairs = [], list(combinations(suspects, 2))
    for a, b in pairs:
        every = np.concatenate([of[a], of[b]])
        one = rays.meeting(every)
        other = rays.meeting(np.setdiff1d(every, one))
        gain = len(one) + len(other) - meet[a] - meet[b]
        if gain > 0 and len(one) + len(other) == len(every):
            name = a if 2 * (rays.points[one] == a).sum() >= len(one) else b
            right = np.isin(every, one) == (rays.points[every] == name)
            found.append((gain, a, b, sorted(set(rays.blocks[every[~right]].tolist()))))
    for _, a, b, blocks in sorted(found, key=lambda f: -f[0])[:_MOST]:
        ids = case.survey.points[a].point_id, case.survey.points[b].point_id
        new = points_exchanged(case.survey, a, b, blocks)
        yield exchange(case.survey, ids, new, POINTS, _EVIDENCE, len(pairs))


def _rays(case: Case) -> Rays | None:
    """Of all image points of the world whose cameras are placed without them; None where there are none."""
    survey = case.survey
    values = case.rough(with_points(survey, ()))
    if values is None:
        return None
    prediction = Prediction(survey, values)
    cameras = {c.camera_id: c for c in survey.cameras if ("lens", c.camera_id) in values}
    lenses = {c: np.asarray(values["lens", c]) for c in cameras}
    unknown = grouped(
        (b.camera_id, Sighting(i, np.full((len(b.uv), 3), np.nan), b.uv))
        for i, b in enumerate(survey.image_blocks) if b.target_id is None and b.camera_id in lenses
    )  # fmt: skip
    seen, _ = sights_of(cameras, lenses, unknown)
    parts = []
    for k in np.argsort(seen.block_idx).tolist():
        i, rays = int(seen.block_idx[k]), seen.rays[slice(*seen.ptr[k : k + 2])]
        block, n = survey.image_blocks[i], len(rays)
        pose = prediction.pose(block, {})
        if pose is not None:
            o = np.tile(-pose[:3, :3].T @ pose[:3, 3], (n, 1))
            parts.append((np.full(n, i), block.point_idx, o, rays @ pose[:3, :3], np.full(n, seen.focal_px[k])))
    return Rays(*(np.concatenate(x) for x in zip(*parts, strict=True))) if parts else None
