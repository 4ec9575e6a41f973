"""Mirrored images: they show a flat target from behind, from where nobody could have read it."""

from collections.abc import Iterator

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.images.maps import MIRRORED, ImageMap, edits_of, mapped
from adjust.model.survey import FloatArray
from adjust.start.views import View

_FLAT = 0.02
_LEAST = 2


def mirrored_images(case: Case) -> Iterator[Hypothesis]:
    """One hypothesis for every camera, and for either way of mirroring where only some of its images are concerned.

    The points of a flat target lie in its x and y, z pointing away from who looks at it (OpenCV's boards): in a pose
    that fits a mirrored image it is seen from its back.
    """
    behind: dict[str, list[int]] = {}
    seen: dict[str, int] = {}
    for i, view in case.views.items():
        camera = case.survey.image_blocks[i].camera_id
        if _is_flat(view.x):
            seen[camera] = seen.get(camera, 0) + 1
            if _from_behind(view):
                behind.setdefault(camera, []).append(i)
    for camera, blocks in behind.items():
        if len(blocks) < _LEAST:
            continue
        whole = len(blocks) == seen[camera]
        for how in MIRRORED[:1] if whole else MIRRORED:
            yield _hypothesis(case, camera, blocks, whole, how)


def _hypothesis(case: Case, camera: str, blocks: list[int], whole: bool, how: ImageMap) -> Hypothesis:
    survey, bad = case.survey, set(blocks)
    mine = [i for i, b in enumerate(survey.image_blocks) if b.camera_id == camera]
    first = min(blocks)
    # images of other things than flat targets are as those around them
    onwards = all(i in bad for i in mine if i >= first and i in case.views and _is_flat(case.views[i].x))
    chosen = [i for i in mine if whole or i in bad or (onwards and i >= first)]
    epochs = tuple(dict.fromkeys(survey.image_blocks[i].epoch_id for i in chosen))
    n = sum(b.camera_id == camera for b in case.survey.image_blocks)
    which = "all its images" if whole else f"{len(epochs)} of its {n} images ({epochs[0]} ... {epochs[-1]})"
    return Hypothesis(
        "images mirrored",
        f"camera {camera}: {which} are mirrored, {how.text}: they show the front of flat targets from behind",
        f"mirror the images of camera {camera} back and detect them again",
        Place("camera", (camera,), epochs=() if whole else epochs),
        mapped(case.survey, camera, set(epochs), how),
        edits_of(case.survey, camera, epochs, how),
        evidence=1e6 * len(blocks),
    )


def _is_flat(x: FloatArray) -> bool:
    s = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    across = float(np.ptp(x[:, :2], axis=0).max())
    return len(x) >= 4 and s[2] < _FLAT * s[1] and float(np.ptp(x[:, 2])) < _FLAT * across


def _from_behind(view: View) -> bool:
    pose = view.poses[0]
    return float(pose[:3, 2] @ (pose[:3, :3] @ view.x.mean(axis=0) + pose[:3, 3])) < 0.0
