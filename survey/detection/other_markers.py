"""What stands in images in place of markers that were declared: another dictionary, inverted print, mirrored images."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from survey.detection.gray import Gray8
from survey.detection.markers import SeenMarkers, board_corners
from survey.project.dictionaries import charuco_board, dictionary_names
from survey.project.targets import Charuco, MarkerBlock, MarkerGrid

_LARGEST = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_16H5", "APRILTAG_25H9",
            "APRILTAG_36H10", "APRILTAG_36H11", "ARUCO_MIP_36H12")  # fmt: skip
_FEWEST, _SHARE = 4, 0.4
"""Markers that are seen at least, and of those that the target has: single ones are read out of noise."""

Markers = Charuco | MarkerGrid | MarkerBlock


@dataclass(frozen=True)
class OtherMarkers:
    """How n markers are seen. dictionary: to be declared. inverted, mirrored: the image. legacy: of a ChArUco board."""

    n: int
    dictionary: str
    inverted: bool = False
    mirrored: bool = False
    legacy: bool | None = None


def other_markers(gray8: Gray8, target: Markers) -> OtherMarkers | None:
    """In which other way the target is in an image where it was not found as declared; None where in none.

    The declared dictionary in another print comes before others: of ways that show as many markers the first.
    """
    wanted = set(marker_ids(target))
    enough = max(_FEWEST, int(np.ceil(_SHARE * len(wanted)))) if len(wanted) > _FEWEST else len(wanted)
    own = target.dictionary.upper().removeprefix("DICT_")
    found = []
    for inverted, mirrored in ((False, False), (True, False), (False, True), (True, True)):
        image = 255 - gray8 if inverted else gray8
        image = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        seen = SeenMarkers(image, max(wanted) + 1)
        for name in (own, *(n for n in _LARGEST if n in dictionary_names() and n != own)):
            if name == own and not (inverted or mirrored):
                continue
            n = len(wanted & set(seen.of(name, wanted)[0].tolist()))
            if n >= enough:
                found.append(OtherMarkers(n, name, inverted, mirrored))
    best = max(found, key=lambda o: o.n, default=None)
    legacy = _legacy(gray8, target)
    if legacy is not None and (best is None or legacy.n >= best.n):
        return legacy
    if best is None or best.dictionary == own:
        return best
    return replace(best, dictionary=_smallest(best.dictionary, wanted))


def marker_ids(target: Markers) -> range | list[int]:
    """The markers of a target."""
    if isinstance(target, Charuco):
        return range(target.squares_x * target.squares_y // 2)
    if isinstance(target, MarkerGrid):
        return range(target.first_id, target.first_id + target.rows * target.columns)
    return sorted(target.corners)


def _legacy(gray8: Gray8, target: Markers) -> OtherMarkers | None:
    """A ChArUco board whose first square is of the other colour."""
    if not isinstance(target, Charuco):
        return None
    other = replace(target, legacy=not target.legacy)
    as_it_is, instead = (board_corners(cv2.aruco.CharucoDetector(charuco_board(t)), gray8) for t in (target, other))
    if len(instead[0]) < 2 * _FEWEST or len(instead[0]) <= 2 * len(as_it_is[0]):
        return None
    return OtherMarkers(instead[2], target.dictionary, legacy=other.legacy)


def _smallest(name: str, wanted: set[int]) -> str:
    """The smallest dictionary of a family that holds these markers: its first ones are those of the larger."""
    family, _, size = name.partition("_")
    if size != "1000":
        return name
    return next(f"{family}_{n}" for n in (50, 100, 250, 1000) if n > max(wanted) or n == 1000)
