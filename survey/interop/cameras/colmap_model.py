"""COLMAP's sparse models as they stand in files: cameras, rigs, frames, images and points, as text or binary.

Read here and not by pycolmap, because a damaged file must end in a message and not in the end of the program. The
layouts are those of COLMAP 4: rigs and frames may be missing, as in models of COLMAP 3.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, IntArray
from survey.folder.text import read_bytes
from survey.interop.cameras.rig import pose_of_quaternion
from survey.interop.networks.foreign import Where, number, text_of

NO_POINT = 2**64 - 1
MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 8: ("SIMPLE_RADIAL_FISHEYE", 4), 9: ("RADIAL_FISHEYE", 5),
}  # fmt: skip
_COUNTS = dict(MODELS.values())


@dataclass(frozen=True, eq=False)
class ColmapCamera:
    """A lens: model, image size and parameters in COLMAP's order."""

    where: Where
    model: str
    size: tuple[int, int]
    params: FloatArray


@dataclass(frozen=True, eq=False)
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
    for ending, reader in ((".bin", _binary), (".txt", _text)):
        if (folder / f"cameras{ending}").is_file():
            model = reader(folder)
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


def _camera(where: Where, model: str, size: tuple[float, float], params: FloatArray) -> ColmapCamera:
    if model not in _COUNTS:
        raise where.error(f"the camera model {model} has no lens here; {', '.join(_COUNTS)} are read")
    if len(params) != _COUNTS[model]:
        raise where.error(f"found {len(params)} parameters, {model} has {_COUNTS[model]}; correct the camera")
    if not (np.isfinite(params).all() and np.abs(params).max() < 1e9 and params[0] > 0.0):
        raise where.error("the parameters must be finite and the focal length positive; correct the camera")
    if not (1 <= size[0] <= 1e6 and 1 <= size[1] <= 1e6):
        raise where.error(f"the image size {size[0]:.0f} x {size[1]:.0f} cannot be meant; correct the camera")
    return ColmapCamera(where, model, (int(size[0]), int(size[1])), params)


def _pose(row: FloatArray, where: Where) -> Pose3:
    """Quaternion wxyz, translation."""
    if not (np.isfinite(row).all() and np.abs(row).max() < 1e12):
        raise where.error("a pose is not finite; correct it")
    return pose_of_quaternion(row[[1, 2, 3, 0]], row[4:7], where)


# ---------------------------------------------------------------------------------------------------------------- text


def _rows(path: Path, optional: bool = False) -> Iterator[tuple[Where, list[str]]]:
    """Lines that are no comments, by their words."""
    if optional and not path.is_file():
        return
    for line, raw in enumerate(text_of(path).splitlines(), 1):
        if not raw.startswith("#"):
            yield Where(path, line), raw.split()


def _numbers(words: list[str], where: Where) -> FloatArray:
    return np.array([number(w, "model", where) for w in words])


def _id(word: str, where: Where) -> int:
    value = number(word, "id", where)
    if value != int(value) or not 0 <= value < 2**53:
        raise where.error(f"found {word!r} where an id is expected; correct it")
    return int(value)


def _text(folder: Path) -> ColmapModel:
    model = ColmapModel()
    for where, words in _rows(folder / "cameras.txt"):
        if words:
            _long(words, 5, where)
            size = _numbers(words[2:4], where)
            model.cameras[_id(words[0], where)] = _camera(where, words[1], tuple(size), _numbers(words[4:], where))
    for where, words in _rows(folder / "rigs.txt", True):
        if words:
            _text_rig(model, words, where)
    for where, words in _rows(folder / "frames.txt", True):
        if words:
            _text_frame(model, words, where)
    _text_images(model, folder / "images.txt")
    for where, words in _rows(folder / "points3D.txt", True):
        if words:
            _long(words, 4, where)
            model.points[_id(words[0], where)] = _numbers(words[1:4], where)
    return model


def _long(words: list[str], least: int, where: Where) -> None:
    if len(words) < least:
        raise where.error(f"found {len(words)} words, expected at least {least}; correct the line")


def _text_rig(model: ColmapModel, words: list[str], where: Where) -> None:
    _long(words, 4, where)
    _sensor(words[2], where)
    rig = {_id(words[3], where): Pose3()}
    rest = words[4:]
    while rest:
        _long(rest, 3, where)
        _sensor(rest[0], where)
        camera = _id(rest[1], where)
        if rest[2] != "1":
            raise where.error(f"camera {camera} has no pose in its rig; give it one")
        _long(rest, 10, where)
        rig[camera] = _pose(_numbers(rest[3:10], where), where)
        rest = rest[10:]
    model.rigs[_id(words[0], where)] = rig


def _sensor(word: str, where: Where) -> None:
    if word != "CAMERA":
        raise where.error(f"the sensor {word!r} is no camera; only cameras are read")


def _text_frame(model: ColmapModel, words: list[str], where: Where) -> None:
    _long(words, 10, where)
    count = _id(words[9], where)
    if len(words) != 10 + 3 * count:
        raise where.error(f"found {len(words) - 10} words after the pose, expected {3 * count}; correct the line")
    images = tuple(_id(words[k + 2], where) for k in range(10, len(words), 3))
    pose = _pose(_numbers(words[2:9], where), where)
    model.frames[_id(words[0], where)] = (_id(words[1], where), pose, images)


def _text_images(model: ColmapModel, path: Path) -> None:
    rows = _rows(path)
    for where, words in rows:
        if not words:
            continue
        _long(words, 10, where)
        _, seen = next(rows, (where, []))
        if len(seen) % 3:
            raise where.error(f"found {len(seen)} words of image points, expected x y id of each; correct them")
        xy = np.array([[number(seen[k], "x", where), number(seen[k + 1], "y", where)] for k in range(0, len(seen), 3)])
        points = np.array([-1 if seen[k] == "-1" else _id(seen[k], where) for k in range(2, len(seen), 3)], np.int64)
        pose = _pose(_numbers(words[1:8], where), where)
        name = " ".join(words[9:])
        image = ColmapImage(where, _id(words[8], where), name, pose, xy.reshape(-1, 2), points)
        model.images[_id(words[0], where)] = image


# -------------------------------------------------------------------------------------------------------------- binary


class _Bytes:
    """A binary file read in order; what it says of lengths is believed only as far as the file reaches."""

    def __init__(self, path: Path) -> None:
        self.data, self.at, self.path = read_bytes(path)[0], 0, path

    @property
    def where(self) -> Where:
        """The place, its bytes counted as lines."""
        return Where(self.path, self.at)

    def fail(self, problem: str) -> SurveyError:
        return SurveyError(f"{self.path}, byte {self.at}: {problem}")

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        if self.at + size > len(self.data):
            raise self.fail("the file ends in the middle of an entry; write it again")
        out = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += size
        return out

    def count(self, least_bytes: int, layout: str = "Q") -> int:
        """A number of entries, each of at least so many bytes."""
        (n,) = self.take(layout)
        if n * least_bytes > len(self.data) - self.at:
            raise self.fail(f"found a count of {n}, more than the file can hold; write it again")
        return int(n)

    def array(self, dtype: Any, n: int) -> Any:
        size = np.dtype(dtype).itemsize * n
        if self.at + size > len(self.data):
            raise self.fail("the file ends in the middle of an entry; write it again")
        out = np.frombuffer(self.data, dtype, n, self.at)
        self.at += size
        return out

    def pose(self) -> Pose3:
        return _pose(np.array(self.take("7d")), self.where)

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0 or end - self.at > 4096:
            raise self.fail("a name has no end; write the file again")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise self.fail("a name is not UTF-8; write the file again") from None


def _binary(folder: Path) -> ColmapModel:
    model = ColmapModel()
    file = _Bytes(folder / "cameras.bin")
    for _ in range(file.count(24)):
        camera, kind, width, height = file.take("IiQQ")
        if kind not in MODELS:
            names = ", ".join(name for name, _ in MODELS.values())
            raise file.fail(f"the camera model number {kind} has no lens here; {names} are read")
        name, count = MODELS[kind]
        model.cameras[camera] = _camera(file.where, name, (width, height), np.array(file.take(f"{count}d")))
    if (folder / "rigs.bin").is_file():
        _binary_rigs(model, _Bytes(folder / "rigs.bin"))
    if (folder / "frames.bin").is_file():
        _binary_frames(model, _Bytes(folder / "frames.bin"))
    _binary_images(model, _Bytes(folder / "images.bin"))
    if (folder / "points3D.bin").is_file():
        file = _Bytes(folder / "points3D.bin")
        for _ in range(file.count(51)):
            point, *xyz = file.take("Q3d3xd")
            if not np.isfinite(xyz[:3]).all():
                raise file.fail(f"point {point} is not finite; correct it")
            model.points[point] = np.array(xyz[:3])
            file.array("<u8", file.count(8))
    return model


def _binary_rigs(model: ColmapModel, file: _Bytes) -> None:
    for _ in range(file.count(8)):
        rig_id, count = file.take("II")
        rig: dict[int, Pose3] = {}
        for k in range(count):
            kind, camera = file.take("iI")
            if kind != 0:
                raise file.fail("a sensor is no camera; only cameras are read")
            if k and file.take("B")[0] != 1:
                raise file.fail(f"camera {camera} has no pose in its rig; give it one")
            rig[camera] = file.pose() if k else Pose3()
        model.rigs[rig_id] = rig


def _binary_frames(model: ColmapModel, file: _Bytes) -> None:
    for _ in range(file.count(68)):
        frame, rig = file.take("II")
        pose = file.pose()
        images = tuple(int(file.take("iIQ")[2]) for _ in range(file.count(16, "I")))
        model.frames[frame] = (rig, pose, images)


def _binary_images(model: ColmapModel, file: _Bytes) -> None:
    layout = np.dtype([("xy", "<f8", 2), ("id", "<u8")])
    for _ in range(file.count(73)):
        (image,) = file.take("I")
        pose = file.pose()
        (camera,) = file.take("I")
        name = file.text()
        rows = file.array(layout, file.count(24))
        if not np.isfinite(rows["xy"]).all():
            raise file.fail(f"image {name!r}: an image point is not finite; correct it")
        ids = np.where(rows["id"] == NO_POINT, np.uint64(0), rows["id"]).astype(np.int64)
        ids = np.where(rows["id"] == NO_POINT, -1, ids)
        model.images[image] = ColmapImage(file.where, camera, name, pose, np.array(rows["xy"]), ids)
