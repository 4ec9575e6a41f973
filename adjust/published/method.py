"""The whole calibration, its sigmas as the paper forms them, and their propagation from what was observed."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.published.steps import (
    TableImages,
    body_origin,
    camera_position,
    camera_rotation,
    lateral_offset,
    table_and_main_camera,
    table_origin,
)
from adjust.spatial.rigid import rigid, rotation_exp, rotation_log
from adjust.spatial.rotation_forms import euler_from_matrix, matrix_from_euler

_STEP = 1e-6  # rad, m: of the numerical derivatives; second differences stay below a billionth


@frozen(eq=False)
class PaperRotation:
    """``C_a^b``: the matrix that takes coordinates in a to coordinates in b (``b_from_a``).

    sigma_deg: (3,) about the axes x, y, z of the frame a. For a small rotation these are the sigmas of its Euler
    angles.
    """

    matrix: FloatArray
    sigma_deg: FloatArray

    @property
    def angles_deg(self) -> FloatArray:
        """Euler angles (phi, theta, psi) of equation 9, phi within a quarter turn.

        A camera that looks along the body's y axis stands at phi = 90 deg, where theta and psi turn about one axis: its
        sigmas have no counterpart in Euler angles. Raises SurveyError where they are not defined at all.
        """
        return np.degrees(euler_from_matrix(self.matrix, "213"))


@frozen(eq=False)
class PaperVector:
    """``r_ij^k``: from the origin of i to that of j, in the axes of k; (3,) mm. nan: a component by definition."""

    value_mm: FloatArray
    sigma_mm: FloatArray


@frozen(eq=False)
class CpcInput:
    """What the calibration starts from.

    main: images of the camera that looks along the main axis, nearly aligned with it (camera Z). others: those of the
    other cameras. b_z_m: height of the body's origin in the world at the table's zero, by caliper, with the sign of the
    world's z.
    """

    main: TableImages
    others: tuple[TableImages, ...]
    b_z_m: float
    b_z_sigma_m: float
    angle_sigma_rad: float


@frozen(eq=False)
class Calibration:
    """The result in the paper's notation; ``rotations["C_t^w"]``, ``vectors["r_bz^b"]``, cameras in lower case.

    The sigmas are the paper's: each least squares judges itself by its own residuals and takes what came before as
    free of error. ``propagate`` gives those that the observations cause.
    """

    rotations: Mapping[str, PaperRotation]
    vectors: Mapping[str, PaperVector]
    camera_ids: tuple[str, ...]

    @property
    def world_from_table(self) -> Pose3:
        """Our pose of the table, at its centre."""
        return self._pose("C_t^w", "r_wt^w")

    @property
    def mount_from_station(self) -> Pose3:
        """Our pose of the body on the table: parallel axes, origin on the main axis."""
        return Pose3(Rot3(), self.vectors["r_tb^b"].value_mm / 1e3)

    def station_from_camera(self, camera_id: str) -> Pose3:
        """Our pose of a camera in the body."""
        return self._pose(f"C_{camera_id.lower()}^b", f"r_b{camera_id.lower()}^b")

    def _pose(self, rotation: str, vector: str) -> Pose3:
        return Pose3(Rot3(self.rotations[rotation].matrix), self.vectors[vector].value_mm / 1e3)


@frozen(eq=False)
class _Table:
    """What the main camera tells: C_tw (3, 3), the table's place (3,) and the body's height over it in m, by name."""

    C_tw: FloatArray
    r_wt: FloatArray
    height: float
    rotations: Mapping[str, PaperRotation]
    vectors: Mapping[str, PaperVector]


def calibrate(given: CpcInput) -> Calibration:
    """Equations A10 to A18 in the paper's order. Raises SurveyError naming what the images do not determine."""
    table = _table(given.main, given.b_z_m, given.b_z_sigma_m)
    rotations, vectors = dict(table.rotations), dict(table.vectors)
    for images in given.others:
        k = images.camera_id.lower()
        rotations[f"C_{k}^b"], vectors[f"r_b{k}^b"] = _camera(table, images)
    return Calibration(rotations, vectors, (given.main.camera_id, *(i.camera_id for i in given.others)))


@lru_cache(maxsize=4)  # derivatives change one thing at a time
def _table(main: TableImages, b_z: float, b_z_sigma: float) -> _Table:
    angles = table_and_main_camera(main)
    C_tw, C_zb = matrix_from_euler(angles.values[:3], "213"), matrix_from_euler(angles.values[3:], "213")
    lateral = lateral_offset(C_tw, main)
    origin = body_origin(C_tw, main, lateral.values, b_z)
    r_bz = np.append(lateral.values, origin.values[2])
    table = table_origin(C_tw, main, r_bz)
    z, nan = main.camera_id.lower(), np.full(2, np.nan)
    rotations = {"C_t^w": _rotation(C_tw, angles.sigmas[:3]), f"C_{z}^b": _rotation(C_zb, angles.sigmas[3:])}
    vectors = {
        "r_wb^w": _vector(np.append(origin.values[:2], b_z), np.append(origin.sigmas[:2], b_z_sigma)),
        "r_wt^w": _vector(table.values[:3], table.sigmas[:3]),
        "r_tb^b": _vector(np.array([0.0, 0.0, table.values[3]]), np.append(nan, table.sigmas[3])),
        f"r_b{z}^b": _vector(r_bz, np.append(lateral.sigmas, origin.sigmas[2])),
    }
    return _Table(C_tw, table.values[:3], float(table.values[3]), rotations, vectors)


@lru_cache(maxsize=16)
def _camera(table: _Table, images: TableImages) -> tuple[PaperRotation, PaperVector]:
    """Of another camera."""
    rotation = camera_rotation(table.C_tw, images)
    position = camera_position(table.C_tw, table.r_wt, table.height, images)
    return _rotation(rotation.values.reshape(3, 3), rotation.sigmas), _vector(position.values, position.sigmas)


def difference(a: Calibration, b: Calibration) -> tuple[tuple[tuple[str, str], ...], FloatArray]:
    """Names (quantity, axis) and b minus a: rotations as small turns (rad) of the frame on the right, vectors in m."""
    names, values = [], []
    for name, rotation in a.rotations.items():
        names += [(name, axis) for axis in "xyz"]
        values.append(rotation_log(rotation.matrix.T @ b.rotations[name].matrix))
    for name, vector in a.vectors.items():
        names += [(name, axis) for axis in "xyz"]
        values.append((b.vectors[name].value_mm - vector.value_mm) / 1e3)
    return tuple(names), np.concatenate(values)


def propagate(given: CpcInput) -> tuple[tuple[tuple[str, str], ...], FloatArray]:
    """Names as in ``difference`` and the covariance (rad, m) of a calibration that its observations cause.

    First order through all steps, with numerical derivatives: poses of each camera with their joint covariance, table
    angles and caliper independent. Raises SurveyError where a camera's covariance is not known.
    """
    at = calibrate(given)

    def derivative(plus: CpcInput, minus: CpcInput) -> FloatArray:
        return np.asarray((difference(at, calibrate(plus))[1] - difference(at, calibrate(minus))[1]) / (2.0 * _STEP))

    caliper = derivative(*(replace(given, b_z_m=given.b_z_m + s * _STEP) for s in (1, -1)))
    cov = given.b_z_sigma_m**2 * np.outer(caliper, caliper)
    for i, images in enumerate((given.main, *given.others)):
        if images.cov is None:
            raise SurveyError(f"camera {images.camera_id}: the covariance of its poses is needed to propagate it")
        n = len(images.angles)
        for change, of in ((_moved, images.cov), (_read, given.angle_sigma_rad**2 * np.eye(2 * n))):
            moved = [[_with(given, i, change(images, j, s * _STEP)) for s in (1, -1)] for j in range(len(of))]
            J = np.stack([derivative(*pair) for pair in moved], axis=1)
            cov += J @ of @ J.T
    return difference(at, at)[0], cov


def _with(given: CpcInput, i: int, images: TableImages) -> CpcInput:
    if i == 0:
        return replace(given, main=images)
    return replace(given, others=given.others[: i - 1] + (images,) + given.others[i:])


def _moved(images: TableImages, j: int, step: float) -> TableImages:
    """With component j of the (6n,) tangents of its poses moved."""
    tangent = step * np.eye(6)[j % 6]
    poses = images.world_from_camera.copy()
    poses[j // 6] = poses[j // 6] @ rigid(rotation_exp(tangent[:3]), tangent[3:])
    return replace(images, world_from_camera=poses)


def _read(images: TableImages, j: int, step: float) -> TableImages:
    """With reading j of the (2n,) moved."""
    angles = images.angles.copy()
    angles[j // 2, j % 2] += step
    return replace(images, angles=angles)


def _rotation(matrix: FloatArray, sigmas: FloatArray) -> PaperRotation:
    return PaperRotation(matrix, np.degrees(sigmas))


def _vector(value: FloatArray, sigmas: FloatArray) -> PaperVector:
    return PaperVector(1e3 * value, 1e3 * sigmas)
