"""Poses and points of ``survey.toml``.

A pose is ``{ treatment, translation_mm, rotation_quaternion_wxyz | rotation_euler_xyz_deg, sigmas }``; the Euler angles
are those of R = Rz(z) Ry(y) Rx(x). The sigmas of a prior hold in the tangent at its value: rotation, then
translation, in the frame on the right of the pose's name.
"""

import math
from typing import Any

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.survey import FloatArray, PointParameter, PoseParameter, Treatment
from adjust.spatial import rotation_forms
from survey.folder.units import to_si
from survey.project.declared.declarations import declared
from survey.project.declared.node import Node
from survey.project.tables.covariance import covariance_problem

TREATMENTS: tuple[Treatment, ...] = ("free", "held", "prior")
POSE_KEYS, POINT_KEYS = tuple(declared("pose").by_name), tuple(declared("point").by_name)
_COMPONENTS = ("rx", "ry", "rz", "tx", "ty", "tz")
_FLAT = {1: ("x", "y"), 2: ("z",)}  # what keeps its value in a network of so many dimensions
_ROTATIONS = ("rotation_quaternion_wxyz", "rotation_euler_xyz_deg")
_SIGMAS = POSE_KEYS[4:-1]


def is_unit(length: Any) -> Any:
    """Whether a quaternion of that length is one, or of those lengths (n,): what stands in files is rounded."""
    return abs(length - 1.0) <= 1e-3


def rotation_from_quaternion(wxyz: FloatArray) -> Rot3 | None:
    """The rotation of a quaternion, or None where its length is not 1 within 1e-3."""
    parts = wxyz.tolist()
    if not max(map(abs, parts)) < 2.0:  # nor is there an end to what stands in files
        return None
    length = math.sqrt(wxyz @ wxyz)
    if not is_unit(length):
        return None
    return Rot3.Quaternion(*(part / length for part in parts))


def quaternion_wxyz(rotation: Rot3) -> list[float]:
    """The unit quaternion of a rotation, w first, to 1e-15: the way there and back through a matrix keeps no more."""
    return [round(part, 15) for part in rotation_forms.quaternion_wxyz(rotation)]


def rotation_from_euler(xyz: FloatArray) -> Rot3:
    """Rz(z) Ry(y) Rx(x) of angles (3,) in rad."""
    x, y, z = xyz
    return Rot3.RzRyRx(x, y, z)


def read_pose(node: Node) -> PoseParameter:
    """A pose with its treatment; an absent table is a free pose without start."""
    if not node.values:
        return PoseParameter()
    node.allow(*POSE_KEYS)
    treatment = node.choice("treatment", TREATMENTS, "free")
    held = _held(node, treatment, _COMPONENTS)
    cov = _pose_cov(node) if treatment == "prior" else None
    if treatment != "prior":
        _refuse_sigmas(node, treatment, _SIGMAS)
    rotation, translation = read_rotation(node), _translation(node)
    if rotation is None and translation is None and treatment == "free":
        if held:
            raise node.error("components are held but the pose has no value; give rotation and translation", "held")
        return PoseParameter()
    if rotation is None or translation is None:
        vague = np.isinf(np.diagonal(cov)) if cov is not None else np.full(6, treatment == "held")
        if rotation is None and not vague[:3].all():
            raise node.error("the rotation is missing; add rotation_quaternion_wxyz or rotation_euler_xyz_deg")
        if translation is None and not vague[3:].all():
            raise node.error("translation_mm is missing; add it")
    value = Pose3(rotation or Rot3(), np.zeros(3) if translation is None else translation)
    return PoseParameter(value, treatment, cov, held)


def read_point(node: Node, dimensions: int = 3) -> PointParameter:
    """A world point with its treatment. In two dimensions z keeps its value (0), in one x and y do."""
    treatment = node.choice("treatment", TREATMENTS, "free")
    held = _held(node, treatment, tuple("xyz")) or (_FLAT.get(dimensions, ()) if treatment != "held" else ())
    value = _coordinates(node, dimensions, held)
    if treatment != "prior":
        _refuse_sigmas(node, treatment, POINT_KEYS[3:])
    if treatment != "free" and (value is None or np.isnan(value).any()):
        raise node.error(f"x_mm is missing; a point that is {treatment} needs its coordinates")
    return PointParameter(value, treatment, _point_cov(node) if treatment == "prior" else None, held)


def flat_point(dimensions: int) -> PointParameter:
    """A point of which nothing is known, in a network of one, two or three dimensions."""
    held = _FLAT.get(dimensions, ())
    return PointParameter(np.where([a in held for a in "xyz"], 0.0, np.nan) if held else None, held=held)


def _coordinates(node: Node, dimensions: int, held: tuple[str, ...]) -> FloatArray | None:
    """Coordinates (3,) m, nan for those that are not known; as many as there are dimensions will do."""
    if not node.has("x_mm"):
        value = np.where([a in held for a in "xyz"], 0.0, np.nan) if dimensions < 3 else np.full(3, np.nan)
    else:
        given = node.values["x_mm"]
        if dimensions < 3 and isinstance(given, list) and len(given) == dimensions:
            free = [i for i, a in enumerate("xyz") if a not in _FLAT[dimensions]]
            value = np.zeros(3)
            value[free] = to_si(node.numbers("x_mm", (dimensions,)), "mm")
        else:
            value = to_si(node.numbers("x_mm", (3,), blank=True), "mm")
    for axis in held:
        if np.isnan(value["xyz".index(axis)]):
            raise node.error(f"{axis} is held but has no value; give x_mm (nan for the coordinates not known)", "held")
    return None if np.isnan(value).all() else value


def _held(node: Node, treatment: Treatment, components: tuple[str, ...]) -> tuple[str, ...]:
    if "held" not in node.values:
        return ()
    held = node.references("held", components, "component")
    if held and treatment == "held":
        raise node.error('treatment = "held" holds everything; remove one of the two', "held")
    if len(held) == len(components):
        raise node.error('all components are held; write treatment = "held"', "held")
    return tuple(name for name in components if name in held)


def _refuse_sigmas(node: Node, treatment: str, keys: tuple[str, ...]) -> None:
    for key in keys if node.has(*keys) else ():
        if node.has(key):
            raise node.error(f'the treatment is "{treatment}", which has no sigma; write treatment = "prior"', key)


def _translation(node: Node) -> FloatArray | None:
    return to_si(node.numbers("translation_mm", (3,)), "mm") if node.has("translation_mm") else None


def read_rotation(node: Node) -> Rot3 | None:
    """The rotation that a table gives as quaternion or Euler angles, None where it gives none."""
    given = [key for key in _ROTATIONS if key in node.values]
    if len(given) > 1:
        raise node.error("the rotation is given twice; keep the quaternion or the Euler angles", _ROTATIONS[1])
    if not given:
        return None
    if given == ["rotation_euler_xyz_deg"]:
        return rotation_from_euler(to_si(node.numbers("rotation_euler_xyz_deg", (3,)), "deg"))
    wxyz = node.numbers("rotation_quaternion_wxyz", (4,))
    rotation = rotation_from_quaternion(wxyz)
    if rotation is None:
        length = float(np.linalg.norm(wxyz))
        raise node.error(f"the quaternion has length {length:g}, not 1; correct it (w first)", _ROTATIONS[0])
    return rotation


def _pose_cov(node: Node) -> FloatArray:
    if node.has("covariance_rad_m"):
        for key in _SIGMAS[:-1]:
            if node.has(key):
                raise node.error("covariance_rad_m is given too; keep one of the two", key)
        return _matrix(node, "covariance_rad_m", 6)
    rotation = node.sigmas("sigma_rotation", ("deg", "arcsec"), 3, infinite=True)
    translation = node.sigmas("sigma_translation", ("mm",), 3, infinite=True)
    if rotation is None or translation is None:
        missing = "sigma_rotation_deg" if rotation is None else "sigma_translation_mm"
        raise node.error(f"a prior needs its sigma; add {missing} (inf where nothing is known)")
    return np.diag(np.concatenate([rotation, translation]) ** 2)


def _point_cov(node: Node) -> FloatArray:
    if node.has("covariance_mm2"):
        if node.has("sigma_mm"):
            raise node.error("covariance_mm2 is given too; keep one of the two", "sigma_mm")
        return to_si(_matrix(node, "covariance_mm2", 3), "mm2")
    sigma = node.sigmas("sigma", ("mm",), 3, infinite=True)
    if sigma is None:
        raise node.error("a prior needs its sigma; add sigma_mm")
    return np.diag(sigma**2)


def _matrix(node: Node, key: str, k: int) -> FloatArray:
    """A covariance (k, k); a row and column with an infinite variance is not looked at."""
    cov = node.numbers(key, (k, k), infinite=True)
    known = ~np.isinf(np.diagonal(cov))
    problem = covariance_problem(cov[np.ix_(known, known)][None])
    if problem:
        raise node.error(f"{problem[1]}; correct the matrix", key)
    return cov
