"""Images that are wrong as such, told once for each camera: mosaics, interlaced fields, motion while exposed."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import Survey
from adjust.native.parallel import side_by_side
from survey.project.detected import DetectedImage, ImageKey, named

if TYPE_CHECKING:  # brings in OpenCV
    from adjust.diagnosis.hypothesis import Hypothesis
    from survey.detection import ImageReport
    from survey.detection.gray import Gray32

_LOOKED_AT = 8  # images of each camera, and of the others those that are blurred
_BLURRED = 1.5  # times as much as the typical image of their camera
_REGION_PX = 640  # each way, about the middle of what was found
_MOTION = "motion blur"
_REMEDIES = {
    "bayer mosaic": "make grey images of them by their mosaic's pattern (cv2.COLOR_BayerBG2GRAY and its kin), or let "
    "the camera do so, and detect them again: corners are poor, or not found",
    "interlaced": "take every second row of each, read apart, or whole images, and detect them again: what moves is in "
    "two places",
    _MOTION: "expose for a shorter time, or stand still; leave them out where the others suffice",
}


def defects(reports: "Sequence[ImageReport]") -> dict[ImageKey, str]:
    """By image what is wrong with it, and the measure of that, of those that were looked at."""
    chosen = _chosen([r for r in reports if r.status != "failed"])
    texts = side_by_side(_defect, chosen)
    return {(r.camera_id, r.epoch_id): text for r, text in zip(chosen, texts, strict=True) if text}


def _defect(report: "ImageReport") -> str:
    from survey.detection.defects import image_defect
    from survey.detection.gray import gray_values, read_image

    defect = image_defect(_region(gray_values(read_image(report.path)), report))
    return defect.text if defect is not None else ""


def _chosen(reports: "Sequence[ImageReport]") -> "list[ImageReport]":
    """Some of each camera, evenly, and those that are more blurred than its others."""
    by_camera: dict[str, list[ImageReport]] = {}
    for report in reports:
        by_camera.setdefault(report.camera_id, []).append(report)
    chosen = []
    for mine in by_camera.values():
        blur = np.array([np.nanmedian([np.nan, *(d.blur_px for d in r.detections.values() if len(d))]) if _seen(r)
                         else np.nan for r in mine])  # fmt: skip
        usual = np.nanmedian(blur) if np.isfinite(blur).any() else np.inf
        even = set(np.linspace(0, len(mine) - 1, min(_LOOKED_AT, len(mine))).round().astype(int).tolist())
        chosen += [r for i, r in enumerate(mine) if i in even or blur[i] > _BLURRED * usual]
    return chosen


def _seen(report: "ImageReport") -> bool:
    return any(len(d) and np.isfinite(d.blur_px) for d in report.detections.values())


def _region(gray: "Gray32", report: "ImageReport") -> "Gray32":
    """Of an image what is about the points that were found, or its middle: where it moves, the background may not."""
    size = np.array(gray.shape[::-1])
    points = [np.asarray(d.uv) for d in report.detections.values() if len(d)] or [size[None] / 2.0]
    uv = np.concatenate(points)
    half = np.clip(0.6 * np.ptp(uv, axis=0), 64.0, _REGION_PX / 2.0) if len(uv) > 1 else np.full(2, _REGION_PX / 2.0)
    middle = (uv.min(axis=0) + uv.max(axis=0)) / 2.0
    (u, v), (u_end, v_end) = (np.clip(middle + s * half, 0, size).astype(int) // 2 * 2 for s in (-1.0, 1.0))
    return gray[v:v_end, u:u_end]


@frozen
class DefectiveImages:
    """Images of a camera with the same defect; text: what was measured in the first of them. remedy: what to do."""

    kind: str
    images: tuple[ImageKey, ...]
    text: str
    remedy: str

    @property
    def found(self) -> str:
        """For people: which images, and what was measured."""
        alike = f"; alike: {named(self.images[1:])}" if len(self.images) > 1 else ""
        return f"images/{'/'.join(self.images[0])}: {self.text}{alike}"


def defective(texts: Mapping[ImageKey, str]) -> tuple[DefectiveImages, ...]:
    """The same by camera and kind. texts: those of :func:`defects`, empty ones where nothing is wrong."""
    groups: dict[tuple[str, str], list[ImageKey]] = {}
    for key, text in texts.items():
        kind = next((kind for kind in _REMEDIES if kind in text.lower()), "")
        if kind:
            groups.setdefault((key[0], kind), []).append(key)
    return tuple(DefectiveImages(kind, tuple(keys), texts[keys[0]], _REMEDIES[kind])
                 for (_, kind), keys in groups.items())  # fmt: skip


def defect_warnings(
    texts: Mapping[ImageKey, str], offered: Mapping[str, int] = MappingProxyType({})
) -> tuple[str, ...]:
    """The same as lines for people. offered: by camera the number of the change that leaves its blurred images out."""
    return tuple(
        f"{d.found}; {d.remedy}{f'; --try {n}' if (n := offered.get(d.images[0][0])) and d.kind == _MOTION else ''}"
        for d in defective(texts)
    )


def blurred(survey: Survey, images: Mapping[ImageKey, DetectedImage]) -> "tuple[Hypothesis, ...]":
    """Of every camera its images in use that moved while they were exposed, left out, where more of its others are not.

    A mosaic or interlaced fields are in all images of a camera: what is left out then is the camera.
    """
    if not any(i.defect for i in images.values()):
        return ()
    used = {(b.camera_id, b.epoch_id) for b in survey.image_blocks if b.n_used}
    found = [d for d in defective({key: i.defect for key, i in images.items() if key in used}) if d.kind == _MOTION]
    return tuple(_left_out(d) for d in found if 2 * len(d.images) < sum(c == d.images[0][0] for c, _ in used))


def _left_out(d: DefectiveImages) -> "Hypothesis":
    from adjust.diagnosis.hypothesis import Hypothesis, LeaveOut, Place  # here: good images start without it

    place = Place("camera", (d.images[0][0],), epochs=tuple(epoch for _, epoch in d.images))
    names = tuple("image:" + "/".join(key) for key in d.images)
    return Hypothesis(d.kind, d.found, "leave them out", place, lambda: None, (LeaveOut(names),))
