"""mrcal's camera models (.cameramodel): lens, image size, pose in a reference frame, and their covariances.

Pixels and the models LENSMODEL_OPENCV4, 5 and 8 are as here; OPENCV12 only without its thin prism. ``extrinsics`` are
rt_cam_ref: a Rodrigues vector and a translation that take reference coordinates to the camera. mrcal's covariances are
additive on those six numbers; ours stand in keys of their own, ``labsurvey_intrinsics_covariance`` and
``labsurvey_extrinsics_covariance``, which mrcal passes over: what mrcal itself keeps of uncertainty is the whole of its
optimisation (``optimization_inputs``), which is neither read nor made up here.
"""

import ast
from pathlib import Path
from typing import NoReturn

import numpy as np
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, LensParameter
from adjust.spatial.rigid import skew
from survey.folder.text import decode, read_bytes
from survey.interop.cameras.rig import Rig, RigCamera, lens_of, pose_of, rig_network
from survey.interop.cameras.values import BROWN_8, CameraValues, MappedLens, rig_values
from survey.interop.networks.foreign import ForeignNetwork, Where

CHOICES = {"brown": BROWN_8}
ENDING = ".cameramodel"
COVARIANCES = ("labsurvey_intrinsics_covariance", "labsurvey_extrinsics_covariance")
_NAMES = {
    "LENSMODEL_PINHOLE": BROWN_8[:4],
    "LENSMODEL_OPENCV4": BROWN_8[:8],
    "LENSMODEL_OPENCV5": BROWN_8[:9],
    "LENSMODEL_OPENCV8": BROWN_8,
    "LENSMODEL_OPENCV12": BROWN_8,
}
_MAX_BYTES = 256_000_000
_MAX_VALUES = 10_000
_MOST_FILES = 1000


def read_mrcal(path: Path) -> ForeignNetwork:
    """One model, or a folder of them. Raises SurveyError with file and line for what cannot be read."""
    if not path.is_dir():
        camera, notes = _read(path)
        return rig_network(Rig("reference", (camera,), notes), path)
    files = sorted(path.glob(f"*{ENDING}"))[:_MOST_FILES]
    if not files:
        raise SurveyError(f"{path}: holds no {ENDING} files")
    read = [_read(file) for file in files]
    notes = tuple(dict.fromkeys(note for _, own in read for note in own))
    return rig_network(Rig("reference", tuple(camera for camera, _ in read), notes), path)


class _Model:
    """The dictionary of a model file: literals only, nothing is evaluated."""

    def __init__(self, path: Path) -> None:
        data = read_bytes(path)[0]
        if len(data) > _MAX_BYTES:
            raise SurveyError(f"{path}: has {len(data)} bytes, more than {_MAX_BYTES} are not read")
        self.path = path
        try:
            tree = ast.parse(decode(path, data).strip("\n \t") + "\n", mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            line = getattr(error, "lineno", None) or 1
            raise Where(path, line).error("this is no dictionary; give a camera model of mrcal") from None
        if not isinstance(tree, ast.Dict):
            self.fail(tree, "this is no dictionary; give a camera model of mrcal")
        self.entries: dict[str, ast.expr] = {}
        for key, value in zip(tree.keys, tree.values, strict=True):
            if not (isinstance(key, ast.Constant) and isinstance(key.value, str)):
                self.fail(key or tree, "a key must be a text; correct the file")
            self.entries[str(key.value)] = value

    def fail(self, node: ast.AST, problem: str) -> NoReturn:
        raise Where(self.path, getattr(node, "lineno", 1)).error(problem)

    def entry(self, key: str) -> ast.expr:
        if key not in self.entries:
            raise Where(self.path, 1).error(f"{key!r} is missing; give a camera model of mrcal")
        return self.entries[key]

    def text(self, key: str) -> str:
        node = self.entry(key)
        if not (isinstance(node, ast.Constant) and isinstance(node.value, str)):
            self.fail(node, f"{key}: expected a text; correct it")
        return str(node.value)

    def numbers(self, key: str, count: int) -> FloatArray:
        """So many numbers, in a list or in nested ones."""
        node, out = self.entry(key), []
        waiting = [node]
        while waiting:
            item = waiting.pop()
            if isinstance(item, (ast.List, ast.Tuple)):
                waiting += item.elts[::-1]
            else:
                out.append(self._number(item, key))
            if len(out) > _MAX_VALUES or len(waiting) > _MAX_VALUES:
                self.fail(node, f"{key}: more than {_MAX_VALUES} numbers; correct it")
        if len(out) != count:
            self.fail(node, f"{key}: found {len(out)} numbers, expected {count}; correct it")
        return np.array(out)

    def _number(self, node: ast.expr, key: str) -> float:
        sign = 1.0
        while isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
            sign *= -1.0 if isinstance(node.op, ast.USub) else 1.0
            node = node.operand
        value = node.value if isinstance(node, ast.Constant) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e15:
            self.fail(node, f"{key}: expected a finite number; correct it")
        return sign * float(value)


def _read(path: Path) -> tuple[RigCamera, tuple[str, ...]]:
    model = _Model(path)
    kind = model.text("lensmodel")
    if kind not in _NAMES:
        model.fail(
            model.entry("lensmodel"),
            f"found {kind}; {', '.join(_NAMES)} are read: convert it with mrcal-convert-lensmodel",
        )
    names = _NAMES[kind]
    n = len(names) + (4 if kind == "LENSMODEL_OPENCV12" else 0)
    values = model.numbers("intrinsics", n)
    if values[len(names) :].any():
        model.fail(model.entry("intrinsics"), "its thin prism terms are in no lens model here; calibrate without them")
    if not (values[:2] > 0.0).all():
        model.fail(model.entry("intrinsics"), "the focal lengths must be positive; correct them")
    size = model.numbers("imagersize", 2)
    if not (size == np.round(size)).all() or size.min() < 1.0 or size.max() > 1e6:
        model.fail(model.entry("imagersize"), "expected width and height in whole pixels; correct them")
    rt = model.numbers("extrinsics" if "extrinsics" in model.entries else "rt_cam_ref", 6)
    where = Where(path, model.entry("imagersize").lineno)
    camera_from_rig = np.column_stack([Rotation.from_rotvec(rt[:3]).as_matrix(), rt[3:]])
    lens = lens_of("brown", **dict(zip(names, values.tolist(), strict=False)))
    pose = pose_of(camera_from_rig, where).inverse()
    notes = ("left out: mrcal's optimisation inputs",) if "optimization_inputs" in model.entries else ()
    camera = RigCamera(
        path.stem, (int(size[0]), int(size[1])), lens, pose, _lens_cov(model, lens, names), _pose_cov(model, rt)
    )
    return camera, notes


def _symmetric(model: _Model, key: str, n: int) -> FloatArray | None:
    if key not in model.entries:
        return None
    cov = model.numbers(key, n * n).reshape(n, n)
    if np.abs(cov - cov.T).max() > 1e-9 * np.abs(cov).max() or np.linalg.eigvalsh(cov)[0] < -1e-12 * np.trace(cov):
        model.fail(model.entry(key), f"{key}: the matrix is no covariance; correct it")
    return cov


def _lens_cov(model: _Model, lens: LensParameter, names: tuple[str, ...]) -> FloatArray | None:
    cov = _symmetric(model, COVARIANCES[0], len(names))
    if cov is None:
        return None
    order = [MODELS["brown"].names.index(n) for n in names]
    full = np.zeros((len(MODELS["brown"].names),) * 2)
    full[np.ix_(order, order)] = cov
    return full


def _pose_cov(model: _Model, rt: FloatArray) -> FloatArray | None:
    cov = _symmetric(model, COVARIANCES[1], 6)
    if cov is None or not cov.any():
        return None
    J = np.linalg.inv(rt_by_tangent(rt))
    return np.asarray(J @ cov @ J.T)


def rt_by_tangent(rt: FloatArray) -> FloatArray:
    """Derivative (6, 6) of rt_cam_ref by the tangent of ref_from_cam (rotation, then translation, in the camera).

    (ref_from_cam Exp(w, v))^-1 = Exp(-w, -v) cam_from_ref: t changes by -w x t - v, and the Rodrigues vector by -w
    through the inverse of the left Jacobian of the rotations (Chirikjian 2012, section 10.8.6).
    """
    r, t = rt[:3], rt[3:]
    angle = float(np.linalg.norm(r))
    K = skew(r)
    # its series near zero, where the closed form is 0 / 0
    c = 1.0 / 12.0 + angle**2 / 720.0 if angle < 1e-3 else (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    J = np.zeros((6, 6))
    J[:3, :3] = -(np.eye(3) - 0.5 * K + c * K @ K)
    J[3:, :3], J[3:, 3:] = skew(t), -np.eye(3)
    return J


def mrcal_files(values: CameraValues, station: str | None) -> tuple[dict[str, str], tuple[str, ...]]:
    """One model per camera of a station, whose frame is mrcal's reference; what was approximated."""
    found = rig_values(values, station, "mrcal", CHOICES)
    texts = {c.camera_id: mrcal_text(c, lens) for c, lens in zip(found.rig.cameras, found.lenses, strict=True)}
    if len(texts) == 1:
        return {"": next(iter(texts.values()))}, found.notes
    return {f"{name}{ENDING}": text for name, text in texts.items()}, found.notes


def rt_of(pose: Pose3) -> FloatArray:
    """rt_cam_ref (6,) of ref_from_cam."""
    inverse = pose.inverse()
    r = Rotation.from_matrix(inverse.rotation().matrix()).as_rotvec()
    return np.concatenate([r, inverse.translation()])


def mrcal_text(camera: RigCamera, lens: MappedLens) -> str:
    """One camera as mrcal writes it; OPENCV8 where its rational terms or k3 are needed, else OPENCV4."""
    kind = "LENSMODEL_OPENCV4"
    if any(lens.values[n] for n in BROWN_8[8:]):
        kind = "LENSMODEL_OPENCV8" if any(lens.values[n] for n in BROWN_8[9:]) else "LENSMODEL_OPENCV5"
    names, rt = _NAMES[kind], rt_of(camera.rig_from_camera or Pose3())
    lines = ["{", f"    'lensmodel':  '{kind}',", "", "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,...."]
    lines += [f"    'intrinsics': {_list(lens.array(*names))},", "", "    # extrinsics are rt_cam_ref"]
    lines += [f"    'extrinsics': {_list(rt)},", ""]
    lines += [f"    'imagersize': [ {camera.image_size[0]}, {camera.image_size[1]} ],", ""]
    if lens.cov is not None:
        order = [MODELS[lens.model].names.index(n) for n in names]
        lines += ["    # of the intrinsics, row by row"]
        lines += [f"    '{COVARIANCES[0]}': {_list(lens.cov[np.ix_(order, order)])},", ""]
    if camera.pose_cov is not None:
        J = rt_by_tangent(rt)
        lines += ["    # of the extrinsics, additive, row by row"]
        lines += [f"    '{COVARIANCES[1]}': {_list(J @ camera.pose_cov @ J.T)},", ""]
    return "\n".join([*lines, "}", ""])


def _list(values: FloatArray) -> str:
    return "[ " + ", ".join(repr(float(v)) for v in np.asarray(values).ravel()) + " ]"
