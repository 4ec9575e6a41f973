"""COLMAP's sparse models as they stand in files: cameras, rigs, frames, images and points, as text or binary.

Read here and not by pycolmap, because a damaged file must end in a message and not in the end of the program. The
layouts are those of COLMAP 4: rigs and frames may be missing, as in models of COLMAP 3.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from survey.folder.text import read_bytes
from survey.interop.cameras.rig import pose_of_quaternion
from survey.interop.networks.foreign import Where, number, text_of

MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5,
}  # fmt: skip
"""How many parameters each model has."""
_NUMBERS = dict(zip((0, 1, 2, 3, 4, 5, 6, 8, 9), MODELS, strict=True))


@frozen(eq=False)
class ColmapCamera:
    """A lens: model, image size and parameters in COLMAP's order."""

    where: Where
    model: str
    size: tuple[int, int]
    params: FloatArray


@frozen(eq=False)
class ColmapImage:
    """An image: its pose, points xy (n, 2) with COLMAP's pixel origin, and the 3-D points they show (-1: none)."""

    where: Where
    camera: int
    name: str
    cam_from_world: Pose3
    xy: FloatArray
    points: IntArray


@dataclass(eq=False)
class ColmapModel:
    """Everything by COLMAP's ids. rigs: camera from rig by camera; frames: rig, rig from world, its images."""

    cameras: dict[int, ColmapCamera] = field(default_factory=dict)
    rigs: dict[int, dict[int, Pose3]] = field(default_factory=dict)
    frames: dict[int, tuple[int, Pose3, tuple[int, ...]]] = field(default_factory=dict)
    images: dict[int, ColmapImage] = field(default_factory=dict)
    points: dict[int, FloatArray] = field(default_factory=dict)


def read_model(folder: Path) -> ColmapModel:
    """The model in a folder. Raises SurveyError with file and place for what cannot be read."""
    for kind in (_Bytes, _Words):
        if (folder / f"cameras{kind.ending}").is_file():
            model = _read(folder, kind)
            _check(model, folder)
            return model
    raise SurveyError(f"{folder}: holds neither cameras.bin nor cameras.txt; give the folder of a sparse model")


def _check(model: ColmapModel, folder: Path) -> None:
    """Raise where something refers to what is not there."""
    for image in model.images.values():
        if image.camera not in model.cameras:
            raise image.where.error(f"image {image.name!r}: camera {image.camera} is not in the model; add it")
    for rig_id, rig in model.rigs.items():
        missing = [c for c in rig if c not in model.cameras]
        if missing:
            raise SurveyError(f"{folder}: rig {rig_id}: camera {missing[0]} is not in the model; add it")
    for frame_id, (rig_id, _, images) in model.frames.items():
        if rig_id not in model.rigs:
            raise SurveyError(f"{folder}: frame {frame_id}: rig {rig_id} is not in the model; add it")
        for i in images:
            if i in model.images and model.images[i].camera not in model.rigs[rig_id]:
                raise SurveyError(f"{folder}: frame {frame_id}: image {i} is of a camera outside rig {rig_id}")


class _Words:
    """A file of lines read entry by entry, in the order of its words."""

    ending = ".txt"

    def __init__(self, path: Path) -> None:
        self.where, self._words = Where(path, 1), list[str]()
        self._lines = iter([(Where(path, line), raw.split()) for line, raw in enumerate(text_of(path).splitlines(), 1)
                            if not raw.startswith("#")])  # fmt: skip

    def entries(self, least_bytes: int) -> Iterator[None]:
        """One line after the other; what nobody takes of a line does not matter."""
        for where, words in self._lines:
            self.where, self._words = where, words[::-1]
            if words:
                yield

    def fail(self, problem: str) -> SurveyError:
        return self.where.error(problem)

    def _take(self, n: int) -> list[str]:
        if len(self._words) < n:
            raise self.fail(f"the line ends where {n} more words are expected; correct it")
        return [self._words.pop() for _ in range(n)]

    def id(self, layout: str = "I") -> int:
        """A whole number of 53 bits at most."""
        (word,) = self._take(1)
        value = number(word, "id", self.where)
        if value != int(value) or not 0 <= value < 2**53:
            raise self.fail(f"found {word!r} where an id is expected; correct it")
        return int(value)

    def count(self, least_bytes: int, layout: str = "I") -> int:
        return self.id()

    def floats(self, n: int) -> FloatArray:
        return np.array([number(word, "model", self.where) for word in self._take(n)])

    def model(self) -> str:
        return self._take(1)[0]

    def parameters(self, model: str) -> FloatArray:
        return self.floats(len(self._words))

    def is_camera(self) -> bool:
        return self._take(1) == ["CAMERA"]

    def name(self) -> str:
        found = " ".join(self._words[::-1])
        self._words = []
        return found

    def end(self) -> None:
        """Nothing more may stand in the line."""
        if self._words:
            raise self.fail(f"found {len(self._words)} words more than its counts say; correct the line")

    def points(self) -> tuple[FloatArray, IntArray]:
        """The line behind: x, y, and the 3-D point of each image point, -1 for none."""
        _, seen = next(self._lines, (self.where, []))
        if len(seen) % 3:
            raise self.fail(f"found {len(seen)} words of image points, expected x y id of each; correct them")
        rows = np.array([number(word, "image point", self.where) for word in seen]).reshape(-1, 3)
        if not ((rows[:, 2] == np.round(rows[:, 2])) & (rows[:, 2] >= -1) & (rows[:, 2] < 2**53)).all():
            raise self.fail("found no id of a point where one is expected; correct it")
        return rows[:, :2], rows[:, 2].astype(np.int64)


class _Bytes:
    """A binary file read in order; what it says of lengths is believed only as far as the file reaches."""

    ending = ".bin"

    def __init__(self, path: Path) -> None:
        self.data, self.at, self.path = read_bytes(path)[0], 0, path

    @property
    def where(self) -> Where:
        """The place, its bytes counted as lines."""
        return Where(self.path, self.at)

    def entries(self, least_bytes: int) -> Iterator[None]:
        """So many as the file says, each of at least so many bytes."""
        yield from repeat(None, self.count(least_bytes, "Q"))

    def fail(self, problem: str) -> SurveyError:
        return SurveyError(f"{self.path}, byte {self.at}: {problem}")

    def _array(self, dtype: npt.DTypeLike, n: int) -> npt.NDArray[Any]:
        size = np.dtype(dtype).itemsize * n
        if self.at + size > len(self.data):
            raise self.fail("the file ends in the middle of an entry; write it again")
        out = np.frombuffer(self.data, dtype, n, self.at)
        self.at += size
        return out

    def id(self, layout: str = "I") -> int:
        return int(self._array(f"<{layout}", 1)[0])

    def count(self, least_bytes: int, layout: str = "I") -> int:
        """A number of entries, each of at least so many bytes."""
        n = self.id(layout)
        if n * least_bytes > len(self.data) - self.at:
            raise self.fail(f"found a count of {n}, more than the file can hold; write it again")
        return n

    def floats(self, n: int) -> FloatArray:
        return np.array(self._array("<f8", n))

    def model(self) -> str:
        kind = self.id("i")
        return _NUMBERS.get(kind, f"number {kind}")

    def parameters(self, model: str) -> FloatArray:
        return self.floats(MODELS.get(model, 0))

    def is_camera(self) -> bool:
        return self.id("i") == 0

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0 or end - self.at > 4096:
            raise self.fail("a name has no end; write the file again")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise self.fail("a name is not UTF-8; write the file again") from None

    def points(self) -> tuple[FloatArray, IntArray]:
        rows = self._array([("xy", "<f8", 2), ("id", "<u8")], self.count(24, "Q"))
        return np.array(rows["xy"]), rows["id"].astype(np.int64)  # the largest of 64 bits, no point, becomes -1

    def skip(self, n_bytes: int) -> None:
        self._array("u1", n_bytes)

    def end(self) -> None:
        """An entry has no end of its own here."""


def _read(folder: Path, kind: type[_Words] | type[_Bytes]) -> ColmapModel:
    model = ColmapModel()
    for name, read in (("cameras", _cameras), ("rigs", _rigs), ("frames", _frames), ("images", _images),
                       ("points3D", _points)):  # fmt: skip
        path = folder / f"{name}{kind.ending}"
        if path.is_file() or name in ("cameras", "images"):
            read(model, kind(path))
    return model


def _cameras(model: ColmapModel, file: _Words | _Bytes) -> None:
    for _ in file.entries(24):
        camera, name = file.id(), file.model()
        if name not in MODELS:
            raise file.fail(f"the camera model {name} has no lens here; {', '.join(MODELS)} are read")
        size = file.id("Q"), file.id("Q")
        params = file.parameters(name)
        if len(params) != MODELS[name]:
            raise file.fail(f"found {len(params)} parameters, {name} has {MODELS[name]}; correct the camera")
        if not (np.isfinite(params).all() and np.abs(params).max() < 1e9 and params[0] > 0.0):
            raise file.fail("the parameters must be finite and the focal length positive; correct the camera")
        if not (1 <= size[0] <= 1e6 and 1 <= size[1] <= 1e6):
            raise file.fail(f"the image size {size[0]} x {size[1]} cannot be meant; correct the camera")
        model.cameras[camera] = ColmapCamera(file.where, name, size, params)


def _pose(file: _Words | _Bytes) -> Pose3:
    """Quaternion wxyz, translation."""
    row = file.floats(7)
    if not (np.isfinite(row).all() and np.abs(row).max() < 1e12):
        raise file.fail("a pose is not finite; correct it")
    return pose_of_quaternion(row[[1, 2, 3, 0]], row[4:7], file.where)


def _rigs(model: ColmapModel, file: _Words | _Bytes) -> None:
    for _ in file.entries(8):
        rig_id, rig = file.id(), dict[int, Pose3]()
        for k in range(file.count(8)):
            if not file.is_camera():
                raise file.fail("a sensor is no camera; only cameras are read")
            camera = file.id()
            if k and file.id("B") != 1:
                raise file.fail(f"camera {camera} has no pose in its rig; give it one")
            rig[camera] = _pose(file) if k else Pose3()
        file.end()
        model.rigs[rig_id] = rig


def _frames(model: ColmapModel, file: _Words | _Bytes) -> None:
    for _ in file.entries(68):
        frame, rig, pose, images = file.id(), file.id(), _pose(file), []
        for _ in range(file.count(16)):
            file.is_camera()
            file.id()
            images.append(file.id("Q"))
        file.end()
        model.frames[frame] = (rig, pose, tuple(images))


def _images(model: ColmapModel, file: _Words | _Bytes) -> None:
    for _ in file.entries(73):
        image, pose, camera, name = file.id(), _pose(file), file.id(), file.name()
        where, (xy, points) = file.where, file.points()
        if not np.isfinite(xy).all():
            raise file.fail(f"image {name!r}: an image point is not finite; correct it")
        model.images[image] = ColmapImage(where, camera, name, pose, xy, points)


def _points(model: ColmapModel, file: _Words | _Bytes) -> None:
    for _ in file.entries(51):
        point, xyz = file.id("Q"), file.floats(3)
        if not np.isfinite(xyz).all():
            raise file.fail(f"point {point} is not finite; correct it")
        model.points[point] = xyz
        if isinstance(file, _Bytes):
            file.skip(11)  # colour and error
            file.skip(8 * file.count(8, "Q"))
