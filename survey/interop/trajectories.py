"""Trajectories of a station that moves: TUM (time, position, quaternion) and KITTI (matrices, 3 x 4 by rows).

Both are world from body, metres, the quaternion's real part last. An epoch whose id is a number is its own time in TUM;
else epochs count 0, 1, 2 ..., and their ids stand in comments, from which they come back.
"""

import re
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from adjust.model.survey import PoseParameter, Station, Survey
from survey.folder.text import id_problem
from survey.interop.cameras.rig import pose_of, pose_of_quaternion, quaternion_xyzw
from survey.interop.cameras.values import CameraValues
from survey.interop.networks.foreign import ForeignNetwork, Where, number, text_of

_EPOCH = re.compile(r"#\s*epoch\s+(.*\S)\s*")
_NUMBER = re.compile(r"\d+(\.\d+)?")
_STATION = "body"


def read_tum(path: Path) -> ForeignNetwork:
    """A station with one pose per line. Raises SurveyError with file and line for what cannot be read."""
    return _read(path, 8, "timestamp tx ty tz qx qy qz qw")


def read_kitti(path: Path) -> ForeignNetwork:
    """A station with one pose per line, epochs counted from 0. Raises SurveyError with file and line."""
    return _read(path, 12, "the 12 numbers of a matrix 3 x 4")


def _read(path: Path, count: int, expected: str) -> ForeignNetwork:
    poses: dict[str, PoseParameter] = {}
    name: str | None = None
    for line, raw in enumerate(text_of(path).splitlines(), 1):
        where = Where(path, line)
        if (found := _EPOCH.fullmatch(raw.strip())) is not None:
            name = found[1]
        words = raw.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        if len(words) != count:
            raise where.error(f"found {len(words)} numbers; expected {expected}")
        row = np.array([number(w, "pose", where) for w in words])
        epoch = name or (words[0] if count == 8 else f"{len(poses):06d}")
        if epoch in poses or (problem := id_problem(epoch)) is not None:
            raise where.error(f"epoch {epoch!r} is there already; remove one" if epoch in poses else problem or "")
        pose = pose_of_quaternion(row[4:], row[1:4], where) if count == 8 else pose_of(row.reshape(3, 4), where)
        poses[epoch], name = PoseParameter(pose), None
    if not poses:
        raise SurveyError(f"{path}: holds no pose; give another file")
    survey = Survey(stations=(Station(_STATION, motion="epoch", epochs=poses),))
    return ForeignNetwork(survey, path.stem)


def _moving(values: CameraValues, station: str | None, format: str) -> tuple[Station, list[str]]:
    moving = {s.station_id: s for s in values.survey.stations if s.motion != "fixed"}
    if station is None and len(moving) == 1:
        station = next(iter(moving))
    if station not in moving:
        known = ", ".join(moving) or "none of this project does"
        raise SurveyError(f"{format} holds the poses of one station that moves; choose with --station: {known}")
    epochs = values.epochs_of(moving[station])
    if not epochs:
        raise SurveyError(f"station {station!r} has no poses yet; adjust the project first")
    return moving[station], epochs


def tum_files(values: CameraValues, station: str | None) -> tuple[dict[str, str], tuple[str, ...]]:
    """The poses of a station as TUM's lines."""
    found, epochs = _moving(values, station, "tum")
    numeric = all(_NUMBER.fullmatch(e) for e in epochs)
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for i, epoch in enumerate(epochs):
        pose = values.world_from(FrameRef("station", found.station_id, epoch))
        lines += [] if numeric else [f"# epoch {epoch}"]
        numbers = [*pose.translation(), *quaternion_xyzw(pose)]
        lines += [" ".join([epoch if numeric else str(i), *(repr(float(v)) for v in numbers)])]
    notes = () if numeric else (f"epochs are counted 0 to {len(epochs) - 1}; their ids stand in comments",)
    return {"": "\n".join(lines) + "\n"}, notes


def kitti_files(values: CameraValues, station: str | None) -> tuple[dict[str, str], tuple[str, ...]]:
    """The poses of a station as KITTI's lines, which have no room for names."""
    found, epochs = _moving(values, station, "kitti")
    poses = [values.world_from(FrameRef("station", found.station_id, e)).matrix()[:3] for e in epochs]
    shown = ", ".join(epochs[:8]) + (", ..." if len(epochs) > 8 else "")
    lines = [" ".join(repr(float(v)) for v in pose.ravel()) for pose in poses]
    return {"": "\n".join(lines) + "\n"}, (f"the lines are, in order, the epochs {shown}",)
