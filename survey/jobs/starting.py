"""The job ``init``: a project out of nothing but images; cameras, sizes and boards are read out of them."""

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.replacing import filling
from survey.folder.text import atomic_write, id_problem
from survey.project.images import IMAGE_ENDINGS, visible
from survey.project.project import DEFINITION_FILE, IMAGES_FOLDER

if TYPE_CHECKING:  # detection brings in OpenCV
    from survey.detection.gray import AnyImage

_LOOKED_AT = 6  # images of each camera in which a board is looked for
_LONGEST_PX = 1600  # of the image in which it is looked for
_FAMILIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_APRILTAG_36h11")
_MARKERS = 4  # in one image: no chance of a false one each
_SQUARE_MM = 30.0


@frozen
class StartOutcome:
    """A project that was begun.

    cameras: number of images and their size (px) by camera. board: inner corners, columns and rows; None where no
    checkerboard was seen. n_with_board, n_with_markers: of the images that were looked at.
    """

    folder: Path
    cameras: Mapping[str, tuple[int, tuple[int, int]]]
    board: tuple[int, int] | None
    n_looked_at: int
    n_with_board: int
    n_with_markers: int

    def summary(self) -> dict[str, object]:
        """As plain values."""
        return {
            "folder": str(self.folder), "board": None if self.board is None else list(self.board),
            "cameras": {k: {"images": n, "image_size_px": list(size)} for k, (n, size) in self.cameras.items()},
            "images_looked_at": self.n_looked_at, "images_with_board": self.n_with_board,
            "images_with_markers": self.n_with_markers,
        }  # fmt: skip

    def text(self) -> str:
        """What was found and what is to be done, for people."""
        lines = [f"{self.folder}: {sum(n for n, _ in self.cameras.values())} images"]
        lines += [f"  camera {k}: {n} images of {w} x {h} px" for k, (n, (w, h)) in self.cameras.items()]
        if self.board is not None:
            seen = f"{self.n_with_board} of {self.n_looked_at} images looked at"
            lines.append(f"  checkerboard of {self.board[0]} x {self.board[1]} inner corners in {seen}")
            lines.append(f"  measure its squares: square_mm in {DEFINITION_FILE} is a guess that gives every length")
        else:
            markers = f"; {self.n_with_markers} show markers" if self.n_with_markers else ""
            lines.append(f"  no checkerboard in {self.n_looked_at} images looked at{markers}: write your target into "
                         f"{DEFINITION_FILE}")  # fmt: skip
        return "\n".join(lines)


def start_project(images: Path, folder: Path) -> StartOutcome:
    """Begin a project in ``folder`` with the images below ``images``: copies of them, and a commented survey.toml.

    images: a folder of one camera's images, or of one folder for each camera; an image's name is its epoch, and images
    of the same name were taken at the same moment. Raises SurveyError for what cannot be a camera, an epoch or an
    image, and where ``folder`` holds a project. Images that lie in ``folder/images`` already stay as they are.
    """
    from survey.detection.gray import read_image

    cameras = cameras_in(Path(images))
    in_place = Path(images).resolve() == (Path(folder) / IMAGES_FOLDER).resolve()
    if in_place and any(path.parent == Path(images) for paths in cameras.values() for path in paths):
        raise SurveyError(f"{images}: images of a project lie in a folder of their camera; move them into one")
    sizes: dict[str, tuple[int, int]] = {}
    seen: Counter[tuple[int, int]] = Counter()
    looked_at = with_markers = 0
    with filling(Path(folder)) as place:
        for camera, paths in cameras.items():
            chosen = {paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, _LOOKED_AT).astype(int))}
            for path in paths:
                image = read_image(path)
                size = (image.shape[1], image.shape[0])
                if sizes.setdefault(camera, size) != size:
                    first = " x ".join(map(str, sizes[camera]))
                    raise SurveyError(f"{path}: {size[0]} x {size[1]} px, but {paths[0].name} has {first}; images of "
                                      "one camera have one size: put others into a folder of their own")  # fmt: skip
                if path in chosen:
                    board, markers = _shown(image)
                    looked_at += 1
                    with_markers += markers
                    seen.update([board] if board is not None else [])
        board, n = seen.most_common(1)[0] if seen else (None, 0)
        for camera, paths in () if in_place else cameras.items():
            (place / IMAGES_FOLDER / camera).mkdir(parents=True)
            for path in paths:
                (place / IMAGES_FOLDER / camera / path.name).write_bytes(path.read_bytes())
        atomic_write(place / DEFINITION_FILE, _definition(Path(folder).name, sizes, board))
    return StartOutcome(Path(folder), {k: (len(p), sizes[k]) for k, p in cameras.items()}, board, looked_at, n,
                        with_markers)  # fmt: skip


def cameras_in(images: Path) -> dict[str, list[Path]]:
    """Images by camera, in natural order. Raises SurveyError as :func:`start_project`."""
    if not images.is_dir():
        raise SurveyError(f"{images}: there is no such folder")
    folders = [p for p in visible(images) if p.is_dir()]
    found = {p.name: _images(p) for p in folders} if folders else {images.resolve().name: _images(images)}
    cameras = {name: paths for name, paths in found.items() if paths}
    if not cameras:
        raise SurveyError(f"{images}: no images; they end in {', '.join(IMAGE_ENDINGS)}")
    for name, paths in cameras.items():
        if problem := id_problem(name):
            raise SurveyError(f"{paths[0].parent}: its name is that of the camera: {problem}")
        for path in paths:
            if problem := id_problem(path.stem):
                raise SurveyError(f"{path}: its name is its epoch: {problem}")
        twice = [stem for stem, n in Counter(p.stem for p in paths).items() if n > 1]
        if twice:
            raise SurveyError(f"{paths[0].parent}: two images are named {twice[0]}; the name is the epoch: remove one")
    return cameras


def _images(folder: Path) -> list[Path]:
    return [p for p in visible(folder) if p.is_file() and p.suffix.lower() in IMAGE_ENDINGS]


def _shown(image: "AnyImage") -> tuple[tuple[int, int] | None, bool]:
    """Columns and rows of the inner corners of a checkerboard in an image, and whether there are markers.

    OpenCV's finder is asked for the smallest board and for whatever is larger; one with markers is no checkerboard.
    """
    import cv2

    from survey.detection.gray import for_finding, gray_values
    from survey.detection.markers import one_threshold

    gray: Any = for_finding(gray_values(image))
    factor = min(1.0, _LONGEST_PX / max(gray.shape))
    gray = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    for name in _FAMILIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        ids = cv2.aruco.ArucoDetector(dictionary, one_threshold()).detectMarkers(gray)[1]
        if ids is not None and len(ids) >= _MARKERS:
            return None, True
    how = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, _, meta = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), how)
    size = sorted(meta.shape, reverse=True) if found else []
    return ((size[0], size[1]) if size else None), False


def _definition(title: str, sizes: Mapping[str, tuple[int, int]], board: tuple[int, int] | None) -> str:
    """A survey.toml with what is known, and comments on what has to be said by who measured."""
    parts = [f"# Begun by labsurvey init; lines with (!) are guesses.\nformat = 1\ntitle = {_string(title)}\n"]
    own = 'station_from_camera = { treatment = "held" }       # this camera is the frame of its station\n'
    for i, (camera, (width, height)) in enumerate(sizes.items()):
        parts.append(
            f'[cameras.{_string(camera)}]\nstation = "head"         # (!) all cameras on one rigid body\n'
            f"image_size_px = [{width}, {height}]\n{'' if i else own}\n"
            f'[cameras.{_string(camera)}.lens]\nmodel = "brown"\n'
            'free = ["fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2"]\n'
        )
    parts.append('[stations.head]\nmotion = "fixed"\nworld_from_station = { treatment = "held" }        '
                 "# and the station that of the world\n")  # fmt: skip
    columns, rows = board or (9, 6)
    target = (
        f'[targets.board]\nkind = "checkerboard"\ncolumns = {columns}              # inner corners\nrows = {rows}\n'
        f"square_mm = {_SQUARE_MM}         # (!) measure it: every length hangs on it\n"
        'motion = "epoch"         # (!) held by hand: another place in every image\n'
    )
    if board is None:
        commented = "".join(f"# {line}\n" for line in target.splitlines())
        target = f"# (!) no checkerboard was recognised: write your target, such as\n{commented}"
    return "\n".join([*parts, target])


def _string(text: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False)
