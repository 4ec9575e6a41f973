"""Blocks of image points as rays, and the camera poses that each explains by itself."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from adjust.lenses.models import camera_constants, focal_length_px, lens_model, unit_rays
from adjust.model.boards import deformed
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock
from adjust.model.survey import BoolArray, Camera, FloatArray, IntArray, Survey
from adjust.native.views import refine_poses, view_errors, view_offsets
from adjust.start.closed_forms.absolute_pose import view_poses

_RIVAL = 4.0  # a second pose whose error is within this factor of the best stays a candidate
_NOISE_PX = 0.3  # ... or within this much of it
ENOUGH = 36  # points of a view from which its pose is found before all of them refine it
_STEPS = 8, 2  # of refinement with these, and with all points of a view
_GROSS_SHARE = 0.2  # more gross points than this make a whole block untrustworthy
_NO_POINTS, _NO_PIXELS = np.zeros((0, 3)), np.zeros((0, 2))


class Sighting(NamedTuple):
    """Points (n, 3) m of one rigid body, nan where not known, and their image points (n, 2) px in one image."""

    block_idx: int
    x: FloatArray
    uv: FloatArray


@frozen(eq=False)
class View:
    """One image and what explains it. x: (n, 3) m in the target. rays: (n, 3) unit in the camera.

    focal_px: turns angles into px. poses: (k, 4, 4) camera_from_target, likeliest first; error_px: (k,).
    """

    block_idx: int
    x: FloatArray
    rays: FloatArray
    focal_px: float
    poses: FloatArray
    error_px: FloatArray


@frozen(eq=False)
class Sights:
    """Images as rays, one after the other by ptr (B + 1,): x (N, 3) m in the target, rays (N, 3) unit in the camera.

    block_idx: (B,) their positions in the survey. focal_px: (B,) turns angles into px.
    """

    block_idx: IntArray
    x: FloatArray
    rays: FloatArray
    ptr: IntArray
    focal_px: FloatArray

    def __len__(self) -> int:
        return len(self.block_idx)

    def only(self, kept: BoolArray) -> "Sights":
        """Some (B,) of them."""
        if kept.all():
            return self
        rows, sizes = np.repeat(kept, np.diff(self.ptr)), np.diff(self.ptr)[kept]
        return Sights(self.block_idx[kept], self.x[rows], self.rays[rows], ends_of(sizes), self.focal_px[kept])


@frozen(eq=False)
class Views:
    """Images that some pose explains: poses (K, 4, 4) camera_from_target, image after image by first (B + 1,).

    The likeliest of each comes first. error_px: (K,).
    """

    sights: Sights
    poses: FloatArray
    error_px: FloatArray
    first: IntArray

    def __len__(self) -> int:
        return len(self.sights)

    def __iter__(self) -> Iterator[View]:
        s = self.sights
        ends = zip(pairwise(s.ptr.tolist()), pairwise(self.first.tolist()), strict=True)
        for i, ((a, b), (c, d)) in enumerate(ends):
            yield View(int(s.block_idx[i]), s.x[a:b], s.rays[a:b], s.focal_px[i], self.poses[c:d], self.error_px[c:d])


def ends_of(sizes: Sequence[int] | IntArray) -> IntArray:
    """Where parts of these sizes end, one after the other, and 0 before them."""
    return np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])


def joined(items: Sequence[tuple[int, FloatArray, FloatArray, float]]) -> Sights:
    """Images, each as its position in the survey, x (n, 3), rays (n, 3) and principal distance in px."""
    blocks, x, rays, focal = zip(*items, strict=True) if items else ((), (), (), ())
    points, unit = np.concatenate([_NO_POINTS, *x]), np.concatenate([_NO_POINTS, *rays])
    return Sights(np.array(blocks, dtype=np.int64), points, unit, ends_of([len(part) for part in x]),
                  np.array(focal, dtype=np.float64))  # fmt: skip


def block_text(block: ImageBlock) -> str:
    """The block as people know it."""
    seen = f"target {block.target_id!r}" if block.target_id else "world points"
    return f"camera {block.camera_id!r}, epoch {block.epoch_id!r}, {seen}"


def sightings(survey: Survey, x_in_world: FloatArray) -> dict[str, list[Sighting]]:
    """By camera what its blocks show of what is in use, one array of points for all that show the same.

    x_in_world: points (P, 3) m of the survey.
    """
    bodies: dict[str | None, FloatArray] = {t.target_id: deformed(t) for t in survey.targets}
    bodies[None] = x_in_world
    parts, out = dict[tuple[str | None, bytes], FloatArray](), dict[str, list[Sighting]]()
    for i, block in enumerate(survey.image_blocks):
        index, uv = block.point_idx, block.uv
        if block.used is not None:
            index, uv = index[block.used], uv[block.used]
        key = block.target_id, index.tobytes()
        x = parts.get(key)
        if x is None:
            x = parts[key] = bodies[block.target_id][index]
        out.setdefault(block.camera_id, []).append(Sighting(i, x, uv))
    return out


def sights_of(
    cameras: Mapping[str, Camera], lenses: Mapping[str, FloatArray], seen: Mapping[str, Sequence[Sighting]]
) -> tuple[Sights, dict[int, str]]:
    """Images by camera as rays, camera by camera, and the reason for each that has none."""
    every = [s for mine in seen.values() for s in mine]
    x, uv = np.concatenate([_NO_POINTS, *(s.x for s in every)]), np.concatenate([_NO_PIXELS, *(s.uv for s in every)])
    ptr, ends = ends_of([len(s.uv) for s in every]), ends_of([len(mine) for mine in seen.values()])
    rays, lost, focal = np.empty(x.shape), dict[int, str](), np.empty(len(every))
    for camera_id, first, last in zip(seen, ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        camera, values = cameras[camera_id], lenses[camera_id]
        model, constants = lens_model(camera.lens.model), camera_constants(camera)
        focal[first:last] = focal_length_px(model, values, constants)
        try:
            unit_rays(model, values, constants, uv[ptr[first] : ptr[last]], rays[ptr[first] : ptr[last]])
        except SurveyError:  # some pixel of some image: find out which
            for i in range(first, last):
                try:
                    unit_rays(model, values, constants, uv[ptr[i] : ptr[i + 1]], rays[ptr[i] : ptr[i + 1]])
                except SurveyError as error:
                    lost[i] = str(error)
    sights = Sights(np.array([s.block_idx for s in every], dtype=np.int64), x, rays, ptr, focal)
    kept = ~np.isin(np.arange(len(every)), list(lost))
    return sights.only(kept), {every[i].block_idx: reason for i, reason in lost.items()}


@lru_cache(maxsize=256)
def few_of(n: int, most: int = ENOUGH) -> IntArray:
    """Positions of at most so many of n points, without the pattern of a grid, the same at every call."""
    return np.arange(n) if n <= most else np.sort(np.random.default_rng(n).permutation(n)[:most])


def _few_rows(ptr: IntArray) -> tuple[IntArray, IntArray]:
    """Rows (M,) of a few points of each of B images, one after the other, and where those of each begin (B + 1,)."""
    sizes = np.diff(ptr)
    ends = ends_of(np.minimum(sizes, ENOUGH))
    rows = np.empty(ends[-1], dtype=np.int64)
    for n in np.unique(sizes).tolist():
        mine, few = sizes == n, few_of(n)
        rows[ends[:-1][mine, None] + np.arange(len(few))] = ptr[:-1][mine, None] + few
    return rows, ends


def make_views(
    sights: Sights, present: FloatArray | None = None, thorough: bool = True
) -> tuple[Views, dict[int, str]]:
    """Views with the likeliest poses that explain each by itself, and for every block that has none the reason.

    present: (B, 4, 4) poses that are to be tried beside those found. All are refined in one go, robustly, on a sample
    of each view's points; ``thorough``: then in a few more steps on all of them.
    """
    if not len(sights):
        return Views(sights, np.zeros((0, 4, 4)), np.zeros(0), np.zeros(1, dtype=np.int64)), {}
    x, rays, ptr, focal = sights.x, sights.rays, sights.ptr, sights.focal_px
    rows, few_ptr = _few_rows(ptr)
    part = x.take(rows, axis=0), rays.take(rows, axis=0), few_ptr
    poses, of, failed = view_poses(*part)
    error, in_front = view_errors(poses, *part, of)
    kept = _likeliest(focal, error, in_front, of)
    poses, of = poses[kept], of[kept]
    if present is not None:
        beside = np.unique(of)
        poses, of = np.concatenate([present[beside], poses]), np.concatenate([beside, of])
    poses = refine_poses(poses, *part, _STEPS[0], True, of)
    error, in_front = view_errors(poses, *part, of)
    kept = _likeliest(focal, error, in_front, of)
    poses, error, in_front, of = poses[kept], error[kept], in_front[kept], of[kept]
    more = (np.diff(few_ptr) < np.diff(ptr))[of] & thorough
    if more.any():
        poses[more] = refine_poses(poses[more], x, rays, ptr, _STEPS[1], True, of[more])
        error[more], in_front[more] = view_errors(poses[more], x, rays, ptr, of[more])
        kept = _likeliest(focal, error, in_front, of)
        poses, error, of = poses[kept], error[kept], of[kept]
    counts = np.bincount(of, minlength=len(sights))
    views = Views(sights.only(counts > 0), poses, error * focal[of], ends_of(counts[counts > 0]))
    return views, {int(sights.block_idx[i]): reason for i, reason in failed.items()}


def _likeliest(focal: FloatArray, error: FloatArray, in_front: BoolArray, of: IntArray) -> IntArray:
    """Of candidates (K,) of the views ``of`` (K,) the best, and those in front that come near it, if it is.

    View by view, the best first. focal: (B,) px. error: (K,) rad.
    """
    order = np.lexsort((error, ~in_front, of))
    of, error, in_front = of[order], error[order], in_front[order]
    first = np.diff(of, prepend=-1) > 0
    best = np.flatnonzero(first)[np.cumsum(first) - 1]
    limit = np.maximum(_RIVAL * error[best], error[best] + _NOISE_PX / focal[of])
    return np.asarray(order[first | (in_front & (error <= limit))])


def untrustworthy(views: Views, survey: Survey, refused: Collection[int] = ()) -> tuple[dict[int, str], list[str]]:
    """Reasons against blocks that no pose explains, and notes on blocks with single gross points; not of those refused.

    The limit of a camera is ten times the median error of its blocks, but at least 3 px.
    """
    reasons: dict[int, str] = {}
    notes: list[str] = []
    sights, blocks = views.sights, survey.image_blocks
    ptr, focal = sights.ptr, sights.focal_px
    judged = ~np.isin(sights.block_idx, list(refused))
    if not judged.any():
        return reasons, notes
    offsets, medians = view_offsets(views.poses[views.first[:-1]], sights.x, sights.rays, ptr)
    worst = np.maximum.reduceat(offsets, ptr[:-1]) * focal
    cameras = np.array([blocks[i].camera_id for i in sights.block_idx.tolist()])
    for camera_id in dict.fromkeys(cameras.tolist()):
        mine = np.flatnonzero((cameras == camera_id) & judged)
        limit = max(3.0, 10.0 * float(np.median(medians[mine] * focal[mine])))
        for i in mine[worst[mine] > limit].tolist():
            bad, block_idx = offsets[ptr[i] : ptr[i + 1]] * focal[i] > limit, int(sights.block_idx[i])
            text = block_text(blocks[block_idx])
            if bad.mean() > _GROSS_SHARE:
                reasons[block_idx] = (
                    f"{text}: {int(bad.sum())} of {len(bad)} points are more than {limit:.1f} px off the best pose"
                    " (mis-detected, or points in the wrong order)"
                )
            else:
                notes.append(f"{text}: {int(bad.sum())} of {len(bad)} points are gross errors (over {limit:.1f} px)")
    return reasons, notes
