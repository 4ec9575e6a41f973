"""Blocks of image points as rays, and the camera poses that each explains by itself."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from adjust.lenses.models import camera_constants, focal_length_px, lens_model, unit_rays
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.survey import BoolArray, Camera, FloatArray, IntArray, Survey, Target
from adjust.native.views import refine_poses, view_errors, view_offsets
from adjust.start.closed_forms.absolute_pose import view_poses

_RIVAL = 4.0  # a second pose whose error is within this factor of the best stays a candidate
_NOISE_PX = 0.3  # ... or within this much of it
_ENOUGH = 36  # points of a view from which its pose is found before all of them refine it
_STEPS = 8, 2  # of refinement with these, and with all points of a view
_GROSS_SHARE = 0.2  # more gross points than this make a whole block untrustworthy


@dataclass(frozen=True, eq=False)
class Sight:
    """One block as rays. x: (n, 3) m in the target. rays: (n, 3) unit in the camera. focal_px: turns angles into px."""

    block_idx: int
    x: FloatArray
    rays: FloatArray
    focal_px: float


@dataclass(frozen=True, eq=False)
class View(Sight):
    """A block with what explains it. poses: (k, 4, 4) camera_from_target, likeliest first; error_px: (k,)."""

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
        mine = {i: b.uv for i, b in enumerate(survey.image_blocks) if b.camera_id == camera_id and len(b.uv)}
        found = rays_of_images(cameras[camera_id], values, list(mine.values()))
        for i, of_block in zip(mine, found, strict=True):
            if isinstance(of_block, SurveyError):
                failed[i] = str(of_block)
            else:
                rays[i] = of_block
    return rays, failed


def rays_of_images(
    camera: Camera, values: FloatArray, images: Sequence[FloatArray]
) -> Sequence[FloatArray | SurveyError]:
    """Unit rays (n, 3) of every image (n, 2) px, or why it has none."""
    if not images:
        return []
    try:
        return np.split(rays_of(camera, values, np.concatenate(images)), np.cumsum([len(uv) for uv in images])[:-1])
    except SurveyError as error:  # some pixel of some image: find out which
        return [error] if len(images) == 1 else [rays_of_images(camera, values, [uv])[0] for uv in images]


@lru_cache(maxsize=256)
def _sample(n: int) -> IntArray:
    """Positions of at most ``_ENOUGH`` of n points, without the pattern of a grid, the same at every call."""
    return np.arange(n) if n <= _ENOUGH else np.sort(np.random.default_rng(n).permutation(n)[:_ENOUGH])


def make_views(
    sights: Sequence[Sight], present: Sequence[FloatArray] | None = None
) -> tuple[list[View], dict[int, str]]:
    """Views with the likeliest poses that explain each by itself, and for every block that has none the reason.

    present: poses (4, 4) that are to be tried beside those found. All are refined in one go, robustly, first on a
    sample of each view's points, then in a few more steps on all of them.
    """
    if not sights:
        return [], {}
    sizes, focal = [len(s.x) for s in sights], np.array([s.focal_px for s in sights])
    x, rays = (np.concatenate([getattr(s, name) for s in sights]) for name in ("x", "rays"))
    ptr = np.cumsum([0, *sizes])
    few = [_sample(n) for n in sizes]
    few_ptr = np.cumsum([0] + [len(r) for r in few])
    rows = np.concatenate(few) + np.repeat(ptr[:-1], np.diff(few_ptr))
    sample = x[rows], rays[rows], few_ptr
    poses, of, failed = view_poses(*sample)
    error, in_front = view_errors(poses, *sample, of)
    kept = _likeliest(focal, error, in_front, of)
    poses, of = poses[kept], of[kept]
    if present is not None and len(of):
        beside = np.unique(of)
        poses, of = np.concatenate([np.array(present)[beside], poses]), np.concatenate([beside, of])
    poses = refine_poses(poses, *sample, _STEPS[0], True, of)
    error, in_front = view_errors(poses, *sample, of)
    kept = _likeliest(focal, error, in_front, of)
    poses, error, in_front, of = poses[kept], error[kept], in_front[kept], of[kept]
    more = (np.diff(few_ptr) < sizes)[of]
    if more.any():
        poses[more] = refine_poses(poses[more], x, rays, ptr, _STEPS[1], True, of[more])
        error[more], in_front[more] = view_errors(poses[more], x, rays, ptr, of[more])
        kept = _likeliest(focal, error, in_front, of)
        poses, error, of = poses[kept], error[kept], of[kept]
    error_px, ends = error * focal[of], np.searchsorted(of, np.arange(len(sights) + 1)).tolist()
    views = [
        View(s.block_idx, s.x, s.rays, s.focal_px, poses[a:b], error_px[a:b])
        for s, a, b in zip(sights, ends, ends[1:], strict=False)
        if b > a
    ]
    return views, {sights[i].block_idx: reason for i, reason in failed.items()}


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
    focal = np.array([v.focal_px for v in views])
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
