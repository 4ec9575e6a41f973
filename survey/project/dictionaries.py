"""Marker dictionaries and ChArUco boards by name, the same for every release of OpenCV."""

import difflib
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from adjust.model.errors import SurveyError
from survey.project.targets import Charuco


@lru_cache(maxsize=1)
def dictionary_names() -> dict[str, int]:
    """OpenCV's predefined dictionaries, by upper-case name without ``DICT_``."""
    return {n[5:].upper(): int(getattr(cv2.aruco, n)) for n in dir(cv2.aruco) if n.startswith("DICT_")}


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """The dictionary called ``4X4_50``, ``DICT_4X4_50``, ``APRILTAG_36h11`` ...; case does not matter."""
    names = dictionary_names()
    key = name.upper().removeprefix("DICT_")
    if key not in names:
        near = difflib.get_close_matches(key, names, n=3, cutoff=0.3) or sorted(names)
        raise SurveyError(f"dictionary {name!r}: unknown to OpenCV {cv2.__version__}; use one of {', '.join(near)}")
    return cv2.aruco.getPredefinedDictionary(names[key])


def marker_cells(name: str, marker: int) -> npt.NDArray[np.float64]:
    """Cells of a marker with its black frame of one cell, (n + 2, n + 2), 0 black and 1 white, upper left first."""
    dictionary = marker_dictionary(name)
    count = len(dictionary.bytesList)
    if not 0 <= marker < count:
        raise SurveyError(f"marker {marker}: dictionary {name!r} holds 0 to {count - 1}; change one of them")
    side = int(dictionary.markerSize) + 2
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, marker, side) / 255.0, float)


def charuco_board(target: Charuco) -> cv2.aruco.CharucoBoard:
    """OpenCV's board for the target, in metres; its origin is the outer corner of the first square."""
    if not 0.0 < target.marker_m < target.square_m:
        raise SurveyError(
            f"charuco: marker {target.marker_m * 1e3:g} mm does not fit into a square of {target.square_m * 1e3:g} mm"
        )
    size = (target.squares_x, target.squares_y)
    board = cv2.aruco.CharucoBoard(size, target.square_m, target.marker_m, marker_dictionary(target.dictionary))
    board.setLegacyPattern(target.legacy)
    return board
