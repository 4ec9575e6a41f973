"""Blocks of image points as rays, and the camera poses that each explains by itself."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from adjust.closed_forms import PLANAR, WIDEST, pose_solutions, view_errors
from adjust.closed_forms.plane_kernels import first_poses
from adjust.closed_forms.view_kernels import offsets_of_views, refine_candidates
from adjust.errors import SurveyError
from adjust.lens import camera_constants, focal_length_px, lens_model, unit_rays
from adjust.model import BoolArray, Camera, FloatArray, IntArray, Survey, Target
from adjust.observations import ImageBlock
from adjust.parallel import run_split, split_blocks

_RIVAL = 4.0  # a second pose whose error is within this factor of the best stays a candidate
_NOISE_PX = 0.3  # ... or within this much of it
_ENOUGH = 36  # points of a view from which its pose is found before all of them refine it
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
    n = len(sights)
    poses, error = np.empty((n, 2, 4, 4)), np.zeros((n, 2))
    in_front, planar = np.zeros((n, 2), dtype=np.bool_), np.empty(n, dtype=np.bool_)
    if n:
        rows, ptr = _samples(sights)
        x, rays = np.concatenate([s.x for s in sights])[rows], np.concatenate([s.rays for s in sights])[rows]
        run_split(first_poses, split_blocks(ptr), x, rays, ptr, PLANAR, WIDEST, poses, error, in_front, planar)
    views: list[View] = []
    failed: dict[int, str] = {}
    error *= np.array([s.focal_px for s in sights]).reshape(-1, 1)
    count = _rank_pairs(poses, error, in_front).tolist()
    for i, (s, plane) in enumerate(zip(sights, planar.tolist(), strict=True)):
        if plane:
            views.append(View(s.block_idx, s.x, s.rays, s.focal_px, poses[i, : count[i]], error[i, : count[i]]))
            continue
        try:
            views.append(make_view(s.block_idx, s.x, s.rays, s.focal_px))
        except SurveyError as reason:
            failed[s.block_idx] = str(reason)
    return views, failed


def make_view(block_idx: int, x: FloatArray, rays: FloatArray, focal: float) -> View:
    """A view with its unrefined candidate poses; raises SurveyError where there are none."""
    few = _sample(len(x))
    poses = pose_solutions(x[few], rays[few])
    if not len(poses):
        raise SurveyError(f"no camera pose explains its {len(x)} points; check their order and coordinates")
    ptr = np.arange(len(poses) + 1) * len(few)
    error, in_front = view_errors(poses, np.tile(x[few], (len(poses), 1)), np.tile(rays[few], (len(poses), 1)), ptr)
    return _ranked(Sight(block_idx, x, rays, focal), poses, error * focal, in_front)


@lru_cache(maxsize=256)
def _sample(n: int) -> IntArray:
    """Positions of at most ``_ENOUGH`` of n points, without the pattern of a grid, the same at every call."""
    return np.arange(n) if n <= _ENOUGH else np.sort(np.random.default_rng(n).permutation(n)[:_ENOUGH])


def _samples(views: "Sequence[View | Sight]") -> tuple[IntArray, IntArray]:
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
    first = np.cumsum([0] + [len(v.poses) for v in views])
    x, rays = np.concatenate([v.x for v in views]), np.concatenate([v.rays for v in views])
    poses, focal = np.concatenate([v.poses for v in views]), np.array([v.focal_px for v in views])
    error, in_front, kept = (np.empty(len(poses), dtype=t) for t in (np.float64, np.bool_, np.bool_))
    run_split(
        refine_candidates, split_blocks(ptr), x, rays, ptr, *_samples(views), first, iterations, _RIVAL,
        _NOISE_PX / focal, poses, error, in_front, kept,
    )  # fmt: skip
    # by view, the best first, and of equal ones the first
    owner = np.repeat(np.arange(len(views)), np.diff(first))[kept]
    order = np.flatnonzero(kept)[np.lexsort((error[kept], owner))]
    poses, error = poses[order], error[order] * focal[owner]
    ends = np.cumsum(np.bincount(owner, minlength=len(views))).tolist()
    return [
        View(v.block_idx, v.x, v.rays, v.focal_px, poses[a:b], error[a:b])
        for v, a, b in zip(views, [0, *ends], ends, strict=False)
    ]


def _rank_pairs(poses: FloatArray, error_px: FloatArray, in_front: BoolArray) -> IntArray:
    """Of two candidates each (n, 2, ...) the likelier first, in place; how many (n,) stay: as :func:`_ranked`."""
    (e0, e1), (front0, front1) = error_px.T, in_front.T
    swapped = (front1 & ~front0) | ((front0 == front1) & (e1 < e0))
    for array in (poses, error_px, in_front):
        array[swapped] = array[swapped, ::-1]
    best = error_px[:, 0]
    rivals = in_front[:, 1] & (error_px[:, 1] <= np.maximum(_RIVAL * best, best + _NOISE_PX))
    return np.asarray(1 + rivals)


def _ranked(view: View | Sight, poses: FloatArray, error_px: FloatArray, in_front: BoolArray) -> View:
    errors, front = error_px.tolist(), in_front.tolist()
    order = sorted(range(len(errors)), key=lambda i: (not front[i], errors[i]))
    best = errors[order[0]]
    keep = [i for i in order if front[i] and errors[i] <= max(_RIVAL * best, best + _NOISE_PX)]
    keep = keep or order[:1]
    return View(view.block_idx, view.x, view.rays, view.focal_px, poses[keep], error_px[keep])


def untrustworthy(views: Sequence[View], survey: Survey) -> tuple[dict[int, str], list[str]]:
    """Reasons against blocks that no pose explains, and notes on blocks with single gross points.

    The limit of a camera is ten times the median error of its blocks, but at least 3 px.
    """
    reasons: dict[int, str] = {}
    notes: list[str] = []
    if not views:
        return reasons, notes
    ptr = np.cumsum([0] + [len(v.x) for v in views])
    offsets, medians = np.empty(int(ptr[-1])), np.empty(len(views))
    run_split(
        offsets_of_views, split_blocks(ptr), np.array([v.poses[0] for v in views]),
        np.concatenate([v.x for v in views]), np.concatenate([v.rays for v in views]), ptr, offsets, medians,
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
