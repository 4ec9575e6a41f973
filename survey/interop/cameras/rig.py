"""What most calibration files of other programs hold: cameras fixed to each other, or one that moves, with lenses."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock
from adjust.model.survey import Camera, FloatArray, LensParameter, Point, PoseParameter, Station, Survey, VectorPrior
from adjust.spatial.rigid import nearest_rotation
from survey.interop.networks.foreign import ForeignNetwork, Where, safe_ids

MOST_FILES = 1000
_ROTATION_TOLERANCE = 1e-3
"""What a written rotation matrix may miss orthonormality by: files round to four digits and fewer."""


@frozen(eq=False)
class RigCamera:
    """One camera: ``lens.values`` are given; rig_from_camera is None where the file has lenses only.

    lens_cov: (n, n) of the lens's parameters. pose_cov: (6, 6) in the tangent of rig_from_camera.
    """

    camera_id: str
    image_size: tuple[int, int]
    lens: LensParameter
    rig_from_camera: Pose3 | None = None
    lens_cov: FloatArray | None = None
    pose_cov: FloatArray | None = None


@frozen(eq=False)
class Rig:
    """Cameras on one body. notes: what was changed on the way here, for people."""

    rig_id: str
    cameras: tuple[RigCamera, ...]
    notes: tuple[str, ...] = ()


class Placed(Protocol):
    """A place in a file."""

    def error(self, problem: str) -> SurveyError:
        """What makes an error of a problem there."""
        ...


def lens_of(model: str, where: Placed, /, **values: float) -> LensParameter:
    """A lens whose named parameters are given and free; the others are zero. Raises SurveyError for no focal length."""
    if not (values["fx"] > 0.0 and values["fy"] > 0.0):
        raise where.error("the focal lengths must be positive; correct them")
    names = MODELS[model].names
    free = tuple(n for n in names if n in values and n != "skew")
    return LensParameter(model, free, np.array([float(values.get(n, 0.0)) for n in names]))


def opencv_lens(matrix: FloatArray, distortion: FloatArray, fisheye: bool, where: Where) -> LensParameter:
    """The lens of a camera matrix (3, 3) and distortion coefficients in OpenCV's order (4, 5, 8; fisheye 4).

    Raises SurveyError for what the models here do not have: thin prism and tilted sensors (more than 8 coefficients).
    """
    k = np.asarray(distortion, dtype=float).ravel()
    if fisheye:
        if len(k) not in (0, 4):
            raise where.error(f"a fisheye lens has 4 coefficients, found {len(k)}; correct the file")
        names: tuple[str, ...] = ("k1", "k2", "k3", "k4")
    else:
        if len(k) in (12, 14) and not k[8:].any():
            k = k[:8]
        if len(k) not in (0, 4, 5, 8):
            raise where.error(
                f"found {len(k)} distortion coefficients; 0, 4, 5 or 8 are read, thin prisms and tilted sensors are "
                "no part of any lens model here: calibrate without them"
            )
        names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")[: len(k)]
    matrix = np.asarray(matrix, dtype=float).reshape(3, 3)
    lower = abs(matrix[1, 0]) + abs(matrix[2, 0]) + abs(matrix[2, 1])
    if lower > 1e-12 or abs(matrix[2, 2] - 1.0) > 1e-12:
        raise where.error("the camera matrix must be [fx skew cx; 0 fy cy; 0 0 1]; correct it")
    values = dict(zip(names, k.tolist(), strict=False)) | {
        "fx": matrix[0, 0], "fy": matrix[1, 1], "skew": matrix[0, 1], "u0": matrix[0, 2], "v0": matrix[1, 2]
    }  # fmt: skip
    return lens_of("fisheye" if fisheye else "brown", where, **values)


def pose_of(matrix: FloatArray, where: Where) -> Pose3:
    """A pose from a matrix (4, 4) or (3, 4); raises SurveyError where its rotation is none."""
    matrix = np.asarray(matrix, dtype=float)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise where.error(f"a matrix of {' x '.join(map(str, matrix.shape))} is no pose; expected 4 x 4 or 3 x 4")
    R = nearest_rotation(matrix[:3, :3])
    off = float(np.abs(R - matrix[:3, :3]).max())
    if not off < _ROTATION_TOLERANCE or (len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9)):
        raise where.error(f"the matrix is no rigid motion (its rotation is {off:.2g} off); correct it")
    return Pose3(Rot3(R), matrix[:3, 3])


def pose_of_quaternion(xyzw: FloatArray, translation: FloatArray, where: Where) -> Pose3:
    """A pose from a quaternion with the real part last; raises SurveyError where its length is far from 1."""
    length = float(np.linalg.norm(xyzw))
    if not abs(length - 1.0) < _ROTATION_TOLERANCE:
        raise where.error(f"the quaternion has the length {length:.4g} instead of 1; correct it")
    return Pose3(Rot3(Rotation.from_quat(xyzw).as_matrix()), translation)


def quaternion_xyzw(pose: Pose3) -> FloatArray:
    """The rotation as a unit quaternion, real part last and not negative."""
    q = np.asarray(Rotation.from_matrix(pose.rotation().matrix()).as_quat())
    return -q if q[3] < 0.0 else q


def camera_files(path: Path, ending: str, but: str = "") -> list[Path]:
    """The file of a camera, or all with this ending of a folder of them, without the one called ``but``.

    Raises SurveyError for a folder with none or with very many.
    """
    if not path.is_dir():
        return [path]
    files = sorted(p for p in path.glob(f"*{ending}") if p.name != but)
    if not files or len(files) > MOST_FILES:
        raise SurveyError(f"{path}: holds {len(files) or 'no'} {ending} files; one per camera is expected, "
                          f"{MOST_FILES} at most")  # fmt: skip
    return files


def joined(rigs: Sequence[Rig]) -> Rig:
    """Cameras of several files as one rig, named as in the first; each note once."""
    notes = dict.fromkeys(note for rig in rigs for note in rig.notes)
    return Rig(rigs[0].rig_id, tuple(c for rig in rigs for c in rig.cameras), tuple(notes))


def rig_network(rig: Rig, path: Path) -> ForeignNetwork:
    """The rig as a survey without observations, ready for images of its own: lenses and poses are start values.

    The first camera holds its pose and so the frame of the rig; covariances become priors.
    """
    names = [c.camera_id for c in rig.cameras]
    if not names or len(set(names)) < len(names):
        raise Where(path, 1).error("the file must name at least one camera, and every one differently; correct it")
    safe = safe_ids(names)
    cameras = [_camera(c, rig.rig_id, i == 0, safe) for i, c in enumerate(rig.cameras)]
    survey = Survey(cameras=tuple(cameras), stations=(Station(rig.rig_id, motion="epoch"),))
    renamed = tuple(f"camera {old!r} is called {new!r} here" for old, new in safe.items())
    return ForeignNetwork(survey, path.stem, notes=(*rig.notes, *renamed))


def _camera(c: RigCamera, rig_id: str, first: bool, safe: dict[str, str]) -> Camera:
    lens = c.lens
    if c.lens_cov is not None:
        model = MODELS[lens.model]
        known = [i for i, n in enumerate(model.names) if n in lens.free and c.lens_cov[i, i] > 0.0]
        if known and lens.values is not None:
            prior = VectorPrior(tuple(model.names[i] for i in known), lens.values[known],
                                c.lens_cov[np.ix_(known, known)])  # fmt: skip
            lens = replace(lens, free=prior.names, prior=prior)
    pose = PoseParameter(c.rig_from_camera, "free")
    if first:
        pose = PoseParameter(c.rig_from_camera or Pose3(), "held")
    elif c.pose_cov is not None and c.rig_from_camera is not None and (np.diagonal(c.pose_cov) > 0.0).all():
        pose = PoseParameter(c.rig_from_camera, "prior", c.pose_cov)
    return Camera(safe.get(c.camera_id, c.camera_id), rig_id, c.image_size, lens, pose)


_LOOKING_BACK = np.diag([1.0, -1.0, -1.0])


def world_from_camera(angles: FloatArray, centre: FloatArray) -> Pose3:
    """Pose from omega phi kappa (3,) rad and the projection centre (3,) m: R = Rx(omega) Ry(phi) Rz(kappa).

    Formula: Kraus, Photogrammetry, vol. 1, for a camera looking along -z; ours looks along +z with y down.
    """
    R = Rot3.Rx(angles[0]).matrix() @ Rot3.Ry(angles[1]).matrix() @ Rot3.Rz(angles[2]).matrix()
    return Pose3(Rot3(R @ _LOOKING_BACK), centre)


def moving_camera(
    camera_id: str, image_size: tuple[int, int], lens: LensParameter, start: dict[str, PoseParameter] | None = None
) -> tuple[Camera, Station]:
    """A camera alone on a station that has one pose per epoch."""
    station = Station(f"{camera_id}_body", motion="epoch", epochs=start or {})
    return Camera(camera_id, station.station_id, image_size, lens, PoseParameter(Pose3(), "held")), station


def image_blocks(rows: dict[tuple[str, str], list[tuple[str, float, float, float]]], points: list[Point]) -> Survey:
    """Points and blocks as a survey: by (camera, epoch) rows of point, u, v and sigma (px)."""
    place = {p.point_id: k for k, p in enumerate(points)}
    blocks = []
    for (camera_id, epoch_id), seen in rows.items():
        numbers = np.array([row[1:] for row in seen], dtype=float).reshape(-1, 3)
        idx = np.array([place[row[0]] for row in seen], dtype=np.int64)
        cov = np.eye(2) * numbers[:, 2, None, None] ** 2
        blocks.append(ImageBlock(camera_id, epoch_id, None, idx, numbers[:, :2].copy(), cov))
    return Survey(points=tuple(points), image_blocks=tuple(blocks))
