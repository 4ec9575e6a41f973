"""What images cover, how near and how tilted targets are seen, and bodies that are seen to move."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Finding
from adjust.diagnosis.time.forgotten_motion import forgotten_motion
from adjust.frames.lens_times import LensTimes, whole_images
from adjust.model.errors import listed
from adjust.model.names import grouped
from adjust.model.survey import Camera, FloatArray, IntArray, Survey

_CELLS = (8, 6)
_COVERED, _SMALL_IMAGE = 0.5, 0.15
_CORNER = 0.4
"""Share of the way to a corner, where distortion, which grows with the cube of the radius, is 0.4^-3 = 16 times it."""
_NEAR_POINTS_PX = 12.0
"""The window in which a corner is found is 11 px wide: below that neighbours are in it."""
_FLATTEST, _STEEPEST = np.radians(65.0), np.radians(10.0)
"""cos 65 deg = 0.42: less than half of the resolution across. sin(10 deg)^2 = 0.03: depth differs by too little."""
_FEW_VIEWS = 5
"""A view of a plane gives two conditions for the five parameters of a pinhole (Zhang 2000): three do, five check."""


def moved(case: Case) -> Iterator[Finding]:
    """What is said to stand still, and single images show at other places: at most one target or station."""
    first = max(forgotten_motion(case), key=lambda h: h.evidence, default=None)
    if first is not None:
        yield Finding("problem", "motion forgotten", first.place.ids, first.cause, first.change)


def pictured(case: Case) -> Iterator[Finding]:
    """Images, and what they give for the lenses."""
    yield from _images(case)
    yield from _cameras(case)


def coverage(survey: Survey) -> dict[str, dict[str, Any]]:
    """By camera: share of the image that its points cover, corners without any, and the share of the image in each."""
    out, times = dict[str, dict[str, Any]](), LensTimes(survey)
    for camera in survey.cameras:
        mine = [b for b in whole_images(survey).image_blocks if b.camera_id == camera.camera_id and len(b.uv)]
        uv = np.concatenate([np.zeros((0, 2)), *(b.uv for b in mine)])
        given = (b for b in survey.image_blocks if b.camera_id == camera.camera_id and len(b.uv))
        images = grouped((b.epoch_id, b.uv) for b in given)
        shares = {e: float(np.prod(np.ptp(np.concatenate(parts), axis=0) / times.size(camera, e)))
                  for e, parts in images.items()}  # fmt: skip
        out[camera.camera_id] = {"share": _share(camera, uv), "corners_empty": _empty_corners(camera, uv),
                                 "images": shares}  # fmt: skip
    return out


def _share(camera: Camera, uv: FloatArray) -> float:
    return len(np.unique(_cells(camera, uv), axis=0)) / (_CELLS[0] * _CELLS[1])


def _cells(camera: Camera, uv: FloatArray) -> IntArray:
    cells = (uv / np.array(camera.image_size) * _CELLS).astype(np.int64)
    return np.asarray(np.clip(cells, 0, np.array(_CELLS) - 1))


def _empty_corners(camera: Camera, uv: FloatArray) -> list[str]:
    """Corners towards which no point lies further out than four tenths of the way, along both sides."""
    middle = (np.array(camera.image_size) - 1.0) / 2.0
    out = (uv - middle) / middle
    corners = (("top left", -1, -1), ("top right", 1, -1), ("bottom left", -1, 1), ("bottom right", 1, 1))
    return [name for name, u, v in corners if not (out * [u, v] > _CORNER).all(axis=1).any()]


def _images(case: Case) -> Iterator[Finding]:
    """Single images: covered too little, the board too far or seen too flat."""
    cameras, times = case.survey.cameras_by_id, LensTimes(case.survey)
    small, far, flat = list[str](), list[str](), list[str]()
    for i, b in enumerate(case.survey.image_blocks):
        if b.target_id is None or len(b.uv) < 4:
            continue
        name, size = f"{b.camera_id}/{b.epoch_id}", np.array(times.size(cameras[b.camera_id], b.epoch_id))
        if float(np.prod(np.ptp(b.uv, axis=0) / size)) < _SMALL_IMAGE**2:
            small.append(name)
        if _spacing(b.uv) < _NEAR_POINTS_PX:
            far.append(name)
        view = case.views.get(i)
        if view is not None and len(view.poses) and _incidence(view.poses[0]) > _FLATTEST:
            flat.append(name)
    for kind, names, found, remedy in (
        ("target small in the image", small, "the target covers less than a seventh of the image's sides",
         "go nearer, or take a larger target"),
        ("target too far", far, f"neighbouring points are less than {_NEAR_POINTS_PX:.0f} px apart",
         "go nearer, or take larger squares: corners this near disturb each other"),
        ("target too flat", flat, f"the target is seen at more than {np.degrees(_FLATTEST):.0f} deg from its normal",
         "turn it towards the camera: 20 to 50 deg is best"),
    ):  # fmt: skip
        if names:
            n = "1 image" if len(names) == 1 else f"{len(names)} images"
            yield Finding("weak", kind, tuple(names), f"{n}: {found}: {listed(names, 6)}", remedy)


def _spacing(uv: FloatArray) -> float:
    """Median distance (px) of a point from its nearest neighbour, of 60 points at most."""
    some = uv[:: max(1, len(uv) // 60)]
    apart = np.linalg.norm(some[:, None] - uv[None], axis=2)
    apart[apart == 0.0] = np.inf
    return float(np.median(apart.min(axis=1)))


def _incidence(camera_from_target: FloatArray) -> float:
    """Angle (rad) between the target's normal and the line of sight to its origin."""
    sight = camera_from_target[:3, 3] / np.linalg.norm(camera_from_target[:3, 3])
    return float(np.arccos(min(1.0, abs(float(camera_from_target[:3, 2] @ sight)))))


def _cameras(case: Case) -> Iterator[Finding]:
    """Free lenses from too few, frontal or similar views, or from a part of the image."""
    for camera in case.survey.cameras:
        if not camera.lens.free:
            continue
        every = enumerate(whole_images(case.survey).image_blocks)
        blocks = [(i, b) for i, b in every if b.camera_id == camera.camera_id]
        if not blocks:
            yield Finding("problem", "camera without images", (camera.camera_id,),
                          f"camera {camera.camera_id} has no image points", "detect them, or remove it")  # fmt: skip
            continue
        yield from _coverage(camera, np.concatenate([b.uv for _, b in blocks]))
        poses = [case.views[i].poses[0] for i, _ in blocks if i in case.views and len(case.views[i].poses)]
        if camera.lens.prior is None and poses:
            yield from _views(camera, np.array(poses))


def _coverage(camera: Camera, uv: FloatArray) -> Iterator[Finding]:
    cells, share, corners = _cells(camera, uv), _share(camera, uv), _empty_corners(camera, uv)
    if share < _COVERED:
        missing = [n for n, part in (("left", cells[:, 0] < 2), ("right", cells[:, 0] >= _CELLS[0] - 2),
                                     ("top", cells[:, 1] < 2), ("bottom", cells[:, 1] >= _CELLS[1] - 2))
                   if not part.any()]  # fmt: skip
        where = f", none at the {' and '.join(missing)}" if missing else ""
        yield Finding("weak", "image not covered", (camera.camera_id,),
                      f"camera {camera.camera_id}: its points cover {100 * share:.0f} % of the image{where}",
                      "bring the target into corners and edges: distortion is unknown where no points are")  # fmt: skip
    elif corners:
        yield Finding("weak", "corner not covered", (camera.camera_id,),
                      f"camera {camera.camera_id}: no point beyond four tenths of the way to the {', '.join(corners)}",
                      "bring the target there: distortion at the corner is 16 times that where points end")  # fmt: skip


def _views(camera: Camera, poses: FloatArray) -> Iterator[Finding]:
    tilts = np.arccos(np.clip(np.abs(poses[:, 2, 2]), 0.0, 1.0))
    if len(poses) < _FEW_VIEWS:
        yield Finding("weak", "few views", (camera.camera_id,), f"camera {camera.camera_id}: {len(poses)} views for "
                      f"{len(camera.lens.free)} free lens parameters", "take ten, tilted by 20 to 50 deg")  # fmt: skip
    elif np.quantile(tilts, 0.8) < _STEEPEST:
        yield Finding("problem", "only frontal views", (camera.camera_id,),
                      f"camera {camera.camera_id}: {np.degrees(np.quantile(tilts, 0.8)):.0f} deg tilt at most in four "
                      "of five views: focal length and distance replace each other",
                      "take five views tilted by 20 to 50 deg, about both axes")  # fmt: skip
