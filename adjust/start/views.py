"""Blocks of image points as rays, and the camera poses that each explains by itself."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from adjust.lenses.models import camera_constants, focal_length_px, lens_model, unit_rays
from adjust.model.errors import SurveyError
from adjust.model.names import grouped
from adjust.model.observations import ImageBlock
from adjust.model.survey import BoolArray, Camera, FloatArray, IntArray, Survey
from adjust.native.parallel import side_by_side
from adjust.native.views import refine_poses, view_errors, view_offsets
from adjust.start.closed_forms.absolute_pose import view_poses

_RIVAL = 4.0  # a second pose whose error is within this factor of the best stays a candidate
_NOISE_PX = 0.3  # ... or within this much of it
ENOUGH = 36  # points of a view from which its pose is found before all of them refine it
_STEPS = 8, 2  # of refinement with these, and with all points of a view
_GROSS_SHARE = 0.2  # more gross points than this make a whole block untrustworthy


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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
    none = [np.zeros((0, 3))]
    ptr = ends_of([len(part) for part in x])
    return Sights(np.array(blocks, dtype=np.int64), np.concatenate(x or none), np.concatenate(rays or none), ptr,
                  np.array(focal, dtype=np.float64))  # fmt: skip


def block_text(block: ImageBlock) -> str:
    """The block as people know it."""
    seen = f"target {block.target_id!r}" if block.target_id else "world points"
    return f"camera {block.camera_id!r}, epoch {block.epoch_id!r}, {seen}"


def focal_px(camera: Camera, values: FloatArray) -> float:
    """Principal distance in px."""
    return focal_length_px(lens_model(camera.lens.model), values, camera_constants(camera))


def rays_by_block(
    survey: Survey, lenses: Mapping[str, FloatArray], seen: Mapping[int, FloatArray]
) -> tuple[dict[int, FloatArray], dict[int, str]]:
    """Rays (n, 3) of the image points ``seen`` (n, 2) px of some blocks, and the reason for each that has none."""
    rays: dict[int, FloatArray] = {}
    failed: dict[int, str] = {}
    mine = grouped((survey.image_blocks[i].camera_id, i) for i, uv in seen.items() if len(uv))
    cameras = [c for c in survey.cameras if c.camera_id in mine]
    found = side_by_side(
        lambda c: rays_of_images(c, lenses[c.camera_id], [seen[i] for i in mine[c.camera_id]]), cameras
    )
    for camera, of_camera in zip(cameras, found, strict=True):
        for i, of_block in zip(mine[camera.camera_id], of_camera, strict=True):
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
    uv = np.concatenate(images, dtype=float)
    try:
        rays = unit_rays(lens_model(camera.lens.model), values, camera_constants(camera), uv)
        return [rays[a:b] for a, b in pairwise(ends_of([len(uv) for uv in images]).tolist())]
    except SurveyError as error:  # some pixel of some image: find out which
        return [error] if len(images) == 1 else [rays_of_images(camera, values, [uv])[0] for uv in images]


@lru_cache(maxsize=256)
def few_of(n: int, most: int = ENOUGH) -> IntArray:
    """Positions of at most so many of n points, without the pattern of a grid, the same at every call."""
    return np.arange(n) if n <= most else np.sort(np.random.default_rng(n).permutation(n)[:most])


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
    few = [few_of(n) for n in np.diff(ptr).tolist()]
    few_ptr = ends_of([len(r) for r in few])
    rows = np.concatenate(few) + np.repeat(ptr[:-1], np.diff(few_ptr))
    part = x[rows], rays[rows], few_ptr
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
