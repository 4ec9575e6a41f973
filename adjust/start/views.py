"""Blocks of image points as rays, and the camera poses that each explains by itself."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np

from adjust.lenses.models import camera_constants, focal_length_px, lens_model, unit_rays
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.survey import BoolArray, Camera, FloatArray, IntArray, Survey, Target
from adjust.start.closed_forms.absolute_pose import pose_solutions
from adjust.start.closed_forms.planes import plane_poses
from adjust.start.closed_forms.views import refine_poses, view_errors, view_offsets

_RIVAL = 4.0  # a second pose whose error is within this factor of the best stays a candidate
_NOISE_PX = 0.3  # ... or within this much of it
_ENOUGH = 36  # points of a view from which its pose is found before all of them refine it
_ALL_STEPS = 2  # of refinement with all points of a view
_FEW = 4, 5  # points of a view, not in a plane, that have poses from each three of them too
_GROSS_SHARE = 0.2  # more gross points than this make a whole block untrustworthy


@dataclass(frozen=True, eq=False)
class View:
    """One block as rays. x: (n, 3) m in the target. rays: (n, 3) unit in the camera. focal_px: turns angles into px.

    poses: (k, 4, 4) camera_from_target, likeliest first; error_px: (k,).
    """

    block_idx: int
    x: FloatArray
    rays: FloatArray
    focal_px: float
    poses: FloatArray
    error_px: FloatArray


def used_rows(block: ImageBlock) -> BoolArray:
    """Rows of the block that take part, (n,) bool."""
    return np.ones(len(block.uv), dtype=bool) if block.used is None else np.asarray(block.used, dtype=bool)


def target_points(target: Target) -> FloatArray:
    """Points (n, 3) m of a target, with the sag of its given warp."""
    x = np.array(target.x_in_target, dtype=float)
    if target.warp is not None and np.any(target.warp.values):
        low, span = x.min(axis=0), np.maximum(np.ptp(x, axis=0), 1e-12)
        u, v = ((x - low) / span).T[:2]
        sag = dict(zip(target.warp.names, target.warp.values, strict=True))
        x[:, 2] += sag.get("warp_x", 0.0) * 4 * u * (1 - u) + sag.get("warp_y", 0.0) * 4 * v * (1 - v)
    return x


def block_text(block: ImageBlock) -> str:
    """The block as people know it."""
    seen = f"target {block.target_id!r}" if block.target_id else "world points"
    return f"camera {block.camera_id!r}, epoch {block.epoch_id!r}, {seen}"


def rays_of(camera: Camera, values: FloatArray, uv: FloatArray) -> FloatArray:
    """Unit rays (n, 3) of pixels (n, 2); raises SurveyError for pixels the lens cannot have imaged."""
    model = lens_model(camera.lens.model)
    constants = camera_constants(camera)
    return unit_rays(model, values, constants, np.asarray(uv, dtype=float))


def focal_px(camera: Camera, values: FloatArray) -> float:
    """Principal distance in px."""
    model = lens_model(camera.lens.model)
    return focal_length_px(model, values, camera_constants(camera))


def all_rays(survey: Survey, lenses: dict[str, FloatArray]) -> tuple[dict[int, FloatArray], dict[int, str]]:
    """Rays (n, 3) of all rows of every block, and the reason for each block that has none."""
    rays: dict[int, FloatArray] = {}
    failed: dict[int, str] = {}
    cameras = {c.camera_id: c for c in survey.cameras}
    for camera_id, values in lenses.items():
        mine = [i for i, b in enumerate(survey.image_blocks) if b.camera_id == camera_id and len(b.uv)]
        if not mine:
            continue
        camera, blocks = cameras[camera_id], [survey.image_blocks[i] for i in mine]
        try:
            found = rays_of(camera, values, np.concatenate([b.uv for b in blocks]))
            ends = np.cumsum([len(b.uv) for b in blocks])
            rays.update(zip(mine, np.split(found, ends[:-1]), strict=True))
        except SurveyError:  # some pixel of some block: find out which
            for i, block in zip(mine, blocks, strict=True):
                try:
                    rays[i] = rays_of(camera, values, block.uv)
                except SurveyError as error:
                    failed[i] = str(error)
    return rays, failed


@dataclass(frozen=True, eq=False)
class Sight:
    """One block to make a view of: the same fields."""

    block_idx: int
    x: FloatArray
    rays: FloatArray
    focal_px: float


def make_views(sights: Sequence[Sight]) -> tuple[list[View], dict[int, str]]:
    """Views with their unrefined candidate poses, and for every block that has none the reason."""
    if not sights:
        return [], {}
    rows, ptr = _samples(sights)
    x, rays = np.concatenate([s.x for s in sights])[rows], np.concatenate([s.rays for s in sights])[rows]
    both, planar = plane_poses(x, rays, ptr)
    candidates, failed = list(both), {}
    for i in np.flatnonzero(~planar).tolist():
        part = slice(ptr[i], ptr[i + 1])
        try:
            candidates[i] = _solutions(x[part], rays[part])
            if not len(candidates[i]):
                n = len(sights[i].x)
                raise SurveyError(f"no camera pose explains its {n} points; check their order and coordinates")
        except SurveyError as reason:
            candidates[i], failed[sights[i].block_idx] = np.zeros((0, 4, 4)), str(reason)
    of, poses = np.repeat(np.arange(len(sights)), [len(c) for c in candidates]), np.concatenate(candidates)
    return _with_poses(sights, poses, *view_errors(poses, x, rays, ptr, of), of), failed


def _solutions(x: FloatArray, rays: FloatArray) -> FloatArray:
    """Poses (k, 4, 4) from all points, and where these are four or five from each three of them too.

    The square sum of so few points has several minima, and SQPnP may end in one that is not the least.
    """
    every = pose_solutions(x, rays)
    if not _FEW[0] <= len(x) <= _FEW[1]:
        return every
    found = [every]
    for three in combinations(range(len(x)), 3):
        try:
            found.append(pose_solutions(x[list(three)], rays[list(three)]))
        except SurveyError:  # on a line
            continue
    return np.concatenate(found)


@lru_cache(maxsize=256)
def _sample(n: int) -> IntArray:
    """Positions of at most ``_ENOUGH`` of n points, without the pattern of a grid, the same at every call."""
    return np.arange(n) if n <= _ENOUGH else np.sort(np.random.default_rng(n).permutation(n)[:_ENOUGH])


def _samples(views: Sequence[View | Sight]) -> tuple[IntArray, IntArray]:
    """Rows of all views' points, one after the other, that :func:`_sample` takes, and where each view's begin."""
    sizes = [len(v.x) for v in views]
    starts = np.cumsum([0, *sizes[:-1]])
    few = [_sample(n) for n in sizes]
    ptr = np.cumsum([0] + [len(r) for r in few])
    return np.concatenate(few) + np.repeat(starts, np.diff(ptr)), ptr


def refine_views(views: Sequence[View], iterations: int = 8) -> list[View]:
    """All candidates of all views refined in one go, robustly; implausible candidates dropped.

    First on a sample of each view's points, then in two more steps on all of them.
    """
    if not views:
        return []
    ptr = np.cumsum([0] + [len(v.x) for v in views])
    of = np.repeat(np.arange(len(views)), [len(v.poses) for v in views])
    poses = np.concatenate([v.poses for v in views])
    x, rays = np.concatenate([v.x for v in views]), np.concatenate([v.rays for v in views])
    rows, few_ptr = _samples(views)
    poses = refine_poses(poses, x[rows], rays[rows], few_ptr, iterations, True, of)
    error, in_front = view_errors(poses, x[rows], rays[rows], few_ptr, of)
    kept = _likeliest(views, error, in_front, of)
    poses, error, in_front, of = poses[kept], error[kept], in_front[kept], of[kept]
    more = (np.diff(few_ptr) < np.diff(ptr))[of]
    if more.any():
        poses[more] = refine_poses(poses[more], x, rays, ptr, _ALL_STEPS, True, of[more])
        error[more], in_front[more] = view_errors(poses[more], x, rays, ptr, of[more])
    return _with_poses(views, poses, error, in_front, of)


def _with_poses(
    seen: Sequence[View | Sight], poses: FloatArray, error: FloatArray, in_front: BoolArray, of: IntArray
) -> list[View]:
    """Views with the likeliest of their candidate poses; those without any are left out."""
    kept = _likeliest(seen, error, in_front, of)
    poses, error_px = poses[kept], error[kept] * _focal(seen)[of[kept]]
    ends = np.cumsum(np.bincount(of[kept], minlength=len(seen))).tolist()
    return [
        View(s.block_idx, s.x, s.rays, s.focal_px, poses[a:b], error_px[a:b])
        for s, a, b in zip(seen, [0, *ends], ends, strict=False)
        if b > a
    ]


def _likeliest(seen: Sequence[View | Sight], error: FloatArray, in_front: BoolArray, of: IntArray) -> IntArray:
    """Of candidates (K,) of the views ``of`` (K,) the best, and those in front that come near it, if it is.

    View by view, the best first. error: (K,) rad.
    """
    order = np.lexsort((error, ~in_front, of))
    of, error, in_front = of[order], error[order], in_front[order]
    first = np.diff(of, prepend=-1) > 0
    best = np.flatnonzero(first)[np.cumsum(first) - 1]
    limit = np.maximum(_RIVAL * error[best], error[best] + _NOISE_PX / _focal(seen)[of])
    return np.asarray(order[first | (in_front & (error <= limit))])


def _focal(seen: Sequence[View | Sight]) -> FloatArray:
    return np.array([s.focal_px for s in seen])


def untrustworthy(views: Sequence[View], survey: Survey) -> tuple[dict[int, str], list[str]]:
    """Reasons against blocks that no pose explains, and notes on blocks with single gross points.

    The limit of a camera is ten times the median error of its blocks, but at least 3 px.
    """
    reasons: dict[int, str] = {}
    notes: list[str] = []
    if not views:
        return reasons, notes
    ptr = np.cumsum([0] + [len(v.x) for v in views])
    offsets, medians = view_offsets(
        np.array([v.poses[0] for v in views]), np.concatenate([v.x for v in views]),
        np.concatenate([v.rays for v in views]), ptr,
    )  # fmt: skip
    focal = _focal(views)
    worst = np.maximum.reduceat(offsets, ptr[:-1]) * focal
    by_camera: dict[str, list[int]] = {}
    for i, view in enumerate(views):
        by_camera.setdefault(survey.image_blocks[view.block_idx].camera_id, []).append(i)
    for mine in by_camera.values():
        limit = max(3.0, 10.0 * float(np.median(medians[mine] * focal[mine])))
        for i in (i for i in mine if worst[i] > limit):
            view, bad = views[i], offsets[ptr[i] : ptr[i + 1]] * focal[i] > limit
            text = block_text(survey.image_blocks[view.block_idx])
            if bad.mean() > _GROSS_SHARE:
                reasons[view.block_idx] = (
                    f"{text}: {int(bad.sum())} of {len(bad)} points are more than {limit:.1f} px off the best pose"
                    " (mis-detected, or points in the wrong order)"
                )
            else:
                notes.append(f"{text}: {int(bad.sum())} of {len(bad)} points are gross errors (over {limit:.1f} px)")
    return reasons, notes
