"""Corners of ArUco and AprilTag markers and of ChArUco boards.

OpenCV's finders name the markers; the corners are then fitted anew (``refine_corners``), so that all families have
the same pixel origin, the centre of the first pixel, whatever their finder's own. What stands there in place of markers
that were declared is looked for too: another dictionary, inverted print, mirrored images.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from survey.detection.corners import CornerFit, refine_corners, unbent
from survey.detection.gray import Gray8, Gray32, reduced
from survey.detection.results import Detection, nothing_found
from survey.project.dictionaries import charuco_board, dictionary_names, marker_dictionary
from survey.project.targets import Charuco, MarkerBlock, MarkerGrid

_COARSE_PX = 1300  # longer side of the image in which markers are looked for first; the full one where some are missing
_BORDER = 0.01  # of that side, within which of the image's end a marker may be missed: finders want ground around it


class SeenMarkers:
    """The markers of an image, sought once for all targets of a dictionary; of each only the first ones if so said.

    together: dictionaries of which markers are sought in one pass.
    """

    def __init__(self, gray8: Gray8, first: int | None = None, together: Sequence[str] = ()) -> None:
        self._full, self._first, self._together = gray8, first, together
        self._found: dict[tuple[str, bool], tuple[IntArray, FloatArray]] = {}

    @cached_property
    def _reduced(self) -> tuple[Gray8, FloatArray]:
        """The image in which markers are looked for first, and the factor back to the full one."""
        return reduced(self._full, _COARSE_PX)

    def of(self, dictionary: str, wanted: set[int]) -> tuple[IntArray, FloatArray]:
        """Ids (n,) and corners (n, 4, 2) px in ascending id, those of the full image where some wanted ones lack."""
        markers, quads = self._in(dictionary, False)
        coarse, factor = self._reduced
        if coarse is not self._full and not wanted.issubset(markers.tolist()):
            return self._in(dictionary, True)
        return markers, (quads + 0.5) * factor - 0.5

    def _in(self, dictionary: str, full: bool) -> tuple[IntArray, FloatArray]:
        if (dictionary, full) not in self._found:
            image = self._full if full else self._reduced[0]
            sought = self._together if dictionary in self._together else (dictionary,)
            for name, found in zip(sought, _markers_in(image, sought, self._first), strict=True):
                self._found[name, full] = found
        return self._found[dictionary, full]


def find_markers(gray: Gray32, seen: SeenMarkers, target: MarkerGrid | MarkerBlock) -> Detection:
    """The corners of those of the target's markers that are in the image; a marker seen twice is left out."""
    wanted = _first_indices(target)
    markers, quads = seen.of(target.dictionary, set(wanted))
    twice = sorted(m for m, count in Counter(markers.tolist()).items() if count > 1 and m in wanted)
    keep = np.array([m in wanted and m not in twice for m in markers.tolist()], bool)
    if not keep.any():
        copies = f"; seen more than once, and left out: {', '.join(map(str, twice))}" if twice else ""
        return nothing_found(f"none of the {len(wanted)} markers ({target.dictionary}) was found{copies}")
    markers, quads = markers[keep], quads[keep]
    cells = int(marker_dictionary(target.dictionary).markerSize) + 2
    gap = cells * target.gap_m / target.marker_m if isinstance(target, MarkerGrid) else 1.0  # what a finder needs
    fit = _fit_quads(gray, quads, cells, gap)
    point_idx = np.array([wanted[m] + corner for m in markers.tolist() for corner in range(4)], np.int64)
    # the faces of a block do not share a plane
    fit = unbent(fit, target.points()[1][point_idx, :2], fit.good & isinstance(target, MarkerGrid))
    return _detection(point_idx, fit, "marker corners")


def find_charuco(gray: Gray32, gray8: Gray8, target: Charuco) -> Detection:
    """The board's inner corners that are seen, part of it being enough; a longer look only where markers lack."""
    board, squares = charuco_board(target), target.points()[1][:, :2] / target.square_m
    every, (coarse, factor) = cv2.aruco.DetectorParameters(), reduced(gray8, _COARSE_PX)
    looks = [(coarse, factor, one_threshold()), (coarse, factor, every), (gray8, np.ones(2), every)]
    for image, scale, parameters in looks[: 2 + (coarse is not gray8)]:
        detector = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)
        point_idx, start, seen = board_corners(detector, image)
        start = (start + 0.5) * scale - 0.5
        H = _homography(squares[point_idx], start)
        if len(point_idx) == len(squares) or (H is not None and _in_view(board, H, gray8).issubset(seen)):
            break
    if (n := len(point_idx)) < 4:
        return nothing_found(f"{n} corners by {len(seen)} markers ({target.dictionary}) found; at least 4 are needed")
    if H is None:
        return nothing_found(f"the {n} corners found lie on one line")
    edges, margin = _board_edges(squares[point_idx], H), 0.5 * (1.0 - target.marker_m / target.square_m)
    fit = refine_corners(gray, start, edges, margin * _across(edges))
    return _detection(point_idx, unbent(fit, squares[point_idx], fit.good), "corners")


def one_threshold() -> cv2.aruco.DetectorParameters:
    """A search by the widest of OpenCV's three thresholds alone, which shows most markers in two fifths of the time."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax
    return parameters


def board_corners(detector: cv2.aruco.CharucoDetector, gray8: Gray8) -> tuple[IntArray, FloatArray, set[int]]:
    """Positions (n,) and places (n, 2) px of a board's corners, and which of its markers were seen."""
    corners, ids, _, markers = detector.detectBoard(gray8)
    seen = set() if markers is None else {int(m) for m in np.ravel(markers)}
    if ids is None or corners is None:
        return np.zeros(0, np.int64), np.zeros((0, 2)), seen
    return np.ravel(ids).astype(np.int64), np.reshape(corners, (-1, 2)).astype(float), seen


def _first_indices(target: MarkerGrid | MarkerBlock) -> dict[int, int]:
    """Position of corner 0 in the target's points, by marker id."""
    if isinstance(target, MarkerGrid):
        return {target.first_id + k: 4 * k for k in range(target.rows * target.columns)}
    return {marker: 4 * k for k, marker in enumerate(sorted(target.corners))}


def _markers_in(gray8: Gray8, names: Sequence[str], first: int | None) -> list[tuple[IntArray, FloatArray]]:
    """Of each dictionary ids (n,) and corners (n, 4, 2) px of its markers, in ascending id."""
    whole = [marker_dictionary(name) for name in names]
    sought = [cv2.aruco.Dictionary(d.bytesList[:first], d.markerSize, d.maxCorrectionBits) for d in whole]
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    corners, ids, _, of = cv2.aruco.ArucoDetector(sought, parameters).detectMarkersMultiDict(gray8)
    markers, of = (np.ravel([] if found is None else found).astype(np.int64) for found in (ids, of))
    quads = np.array(corners, dtype=float).reshape(-1, 4, 2)
    orders = [np.flatnonzero(of == k)[np.argsort(markers[of == k], kind="stable")] for k in range(len(names))]
    return [(markers[order], quads[order]) for order in orders]


def _fit_quads(gray: Gray32, quads: FloatArray, cells: int, gap_cells: float) -> CornerFit:
    """Corners of dark quadrangles, each by the two edges that end there and as far as one cell from those."""
    edges = np.stack([np.roll(quads, -1, axis=1) - quads, np.roll(quads, 1, axis=1) - quads], axis=2)
    across = _across(edges)
    free = across * min(1.0, gap_cells) / cells
    return refine_corners(gray, quads.reshape(-1, 2), edges.reshape(-1, 2, 2), free.ravel(), crossing=False)


def _across(edges: FloatArray) -> FloatArray:
    """Least height of the parallelogram that two edges span, px."""
    area = np.abs(edges[..., 0, 0] * edges[..., 1, 1] - edges[..., 0, 1] * edges[..., 1, 0])
    return np.asarray(area / np.maximum(np.linalg.norm(edges, axis=-1).max(-1), 1e-9))


def _homography(xy: FloatArray, start: FloatArray) -> FloatArray | None:
    """From corners (n, 2) in squares of the board to px (n, 2); None where they lie on one line."""
    if len(np.unique(xy[:, 0])) < 2 or len(np.unique(xy[:, 1])) < 2 or len(xy) < 4:
        return None
    H, _ = cv2.findHomography(xy, start, cv2.RANSAC, 5.0)
    return None if H is None else np.asarray(H, float)


def _in_view(board: cv2.aruco.CharucoBoard, H: FloatArray, gray8: Gray8) -> set[int]:
    """The board's markers that lie in the image, by the homography of its squares."""
    quads = np.array(board.getObjPoints())[:, :, :2] / board.getSquareLength() - 1.0
    places, border = cv2.perspectiveTransform(quads, H), _BORDER * max(gray8.shape)
    inside = ((places > border) & (places < np.array(gray8.shape[::-1]) - border)).all((1, 2))
    return {int(m) for m in np.ravel(board.getIds())[inside]}


def _board_edges(xy: FloatArray, H: FloatArray) -> FloatArray:
    """Vectors (n, 2, 2) px along the board's rows and columns at its corners, one square long, from a homography."""
    q = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    jacobian = (H[None, :2, :2] - (q[:, :2] / q[:, 2:])[:, :, None] * H[None, 2:, :2]) / q[:, 2, None, None]
    return np.asarray(jacobian.transpose(0, 2, 1))


def _detection(point_idx: IntArray, fit: CornerFit, name: str) -> Detection:
    good = fit.good
    if not good.any():
        return nothing_found(f"found, but none of its {good.size} {name} could be measured")
    order = np.argsort(point_idx[good], kind="stable")
    blur_px = float(np.median(fit.blur_px[good]))
    return Detection(point_idx[good][order], fit.uv[good][order], fit.cov[good][order], blur_px)


_LARGEST = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_16H5", "APRILTAG_25H9",
            "APRILTAG_36H10", "APRILTAG_36H11", "ARUCO_MIP_36H12")  # fmt: skip
_FEWEST, _SHARE = 4, 0.4
"""Markers that are seen at least, and of those that the target has: single ones are read out of noise."""

Markers = Charuco | MarkerGrid | MarkerBlock


@frozen
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
    names, found = (own, *(n for n in _LARGEST if n in dictionary_names() and n != own)), []
    for inverted, mirrored in ((False, False), (True, False), (False, True), (True, True)):
        image = 255 - gray8 if inverted else gray8
        image = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        seen = SeenMarkers(image, max(wanted) + 1, names)
        for name in names:
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
    return OtherMarkers(len(instead[2]), target.dictionary, legacy=other.legacy)


def _smallest(name: str, wanted: set[int]) -> str:
    """The smallest dictionary of a family that holds these markers: its first ones are those of the larger."""
    family, _, size = name.partition("_")
    if size != "1000":
        return name
    return next(f"{family}_{n}" for n in (50, 100, 250, 1000) if n > max(wanted) or n == 1000)
