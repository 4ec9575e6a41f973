"""mrcal's camera models (.cameramodel): lens, image size, pose in a reference frame, and their covariances.

Pixels and the models LENSMODEL_OPENCV4, 5 and 8 are as here; OPENCV12 only without its thin prism. ``extrinsics`` are
rt_cam_ref: a Rodrigues vector and a translation that take reference coordinates to the camera. mrcal's covariances are
additive on those six numbers; ours stand in keys of their own, ``labsurvey_intrinsics_covariance`` and
``labsurvey_extrinsics_covariance``, which mrcal passes over: what mrcal itself keeps of uncertainty is the whole of its
optimisation (``optimization_inputs``), which is neither read nor made up here.
"""

import ast
from pathlib import Path

import numpy as np
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from adjust.spatial.rigid import skew
from survey.folder.text import decode, read_bytes
from survey.interop.cameras.rig import Rig, RigCamera, camera_files, joined, lens_of, pose_of, rig_network
from survey.interop.cameras.values import BROWN_8, MappedLens, RigValues
from survey.interop.networks.foreign import ForeignNetwork, Where
from survey.interop.safe_yaml import Entry

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
_NO_MODEL = "is no dictionary; give a camera model of mrcal"


def read_mrcal(path: Path) -> ForeignNetwork:
    """One model, or a folder of them. Raises SurveyError with file and line for what cannot be read."""
    read = map(_read, camera_files(path, ENDING))
    return rig_network(joined([Rig("reference", (camera,), notes) for camera, notes in read]), path)


def _read_model(path: Path) -> Entry:
    """The dictionary of a model file: literals only, nothing is evaluated."""
    data = read_bytes(path)[0]
    if len(data) > _MAX_BYTES:
        raise SurveyError(f"{path}: has {len(data)} bytes, more than {_MAX_BYTES} are not read")
    try:
        tree = ast.parse(decode(path, data).strip("\n \t") + "\n", mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise Where(path, getattr(error, "lineno", None) or 1).error(f"this {_NO_MODEL}") from None
    if not isinstance(tree, ast.Dict):
        raise Where(path, tree.lineno).error(f"this {_NO_MODEL}")
    return _entry(tree, path, "")


def _entry(node: ast.expr, path: Path, name: str) -> Entry:
    """A literal as text, list or mapping; bytes, which only mrcal itself understands, as an empty text."""
    where = Where(path, node.lineno)
    match node:
        case ast.Dict():
            keys = [ast.unparse(key or node) if not isinstance(key, ast.Constant) else str(key.value)
                    for key in node.keys]  # fmt: skip
            return Entry(where, name, {k: _entry(v, path, k) for k, v in zip(keys, node.values, strict=True)})
        case ast.List() | ast.Tuple():
            return Entry(where, name, [_entry(item, path, name) for item in node.elts])
    try:
        value = ast.literal_eval(node)
    except (ValueError, TypeError, RecursionError, MemoryError):
        value = np.inf
    if isinstance(value, float) and not np.isfinite(value):
        raise where.error(f"{name}: expected a text, or finite numbers; correct it")
    return Entry(where, name, value if isinstance(value, str) else "" if isinstance(value, bytes) else repr(value))


def _read(path: Path) -> tuple[RigCamera, tuple[str, ...]]:
    model = _read_model(path)
    kind = model.get("lensmodel")
    if kind.text not in _NAMES:
        raise kind.error(f"found {kind.text}; {', '.join(_NAMES)} are read: convert it with mrcal-convert-lensmodel")
    names, intrinsics = _NAMES[kind.text], model.get("intrinsics")
    values = intrinsics.numbers(len(names) + (4 if kind.text == "LENSMODEL_OPENCV12" else 0))
    if values[len(names) :].any():
        raise intrinsics.error("its thin prism terms are in no lens model here; calibrate without them")
    lens = lens_of("brown", intrinsics, **dict(zip(names, values.tolist(), strict=False)))
    extrinsics = model.get("extrinsics" if "extrinsics" in model else "rt_cam_ref")
    rt = extrinsics.numbers(6)
    camera_from_rig = np.column_stack([Rotation.from_rotvec(rt[:3]).as_matrix(), rt[3:]])
    pose = pose_of(camera_from_rig, extrinsics.where).inverse()
    notes = ("left out: mrcal's optimisation inputs",) if "optimization_inputs" in model else ()
    lens_cov, pose_cov = _lens_cov(model, names), _pose_cov(model, rt)
    return RigCamera(path.stem, model.get("imagersize").size(), lens, pose, lens_cov, pose_cov), notes


def _symmetric(model: Entry, key: str, n: int) -> FloatArray | None:
    if key not in model:
        return None
    cov = model.get(key).numbers(n, n)
    if np.abs(cov - cov.T).max() > 1e-9 * np.abs(cov).max() or np.linalg.eigvalsh(cov)[0] < -1e-12 * np.trace(cov):
        raise model.get(key).error("the matrix is no covariance; correct it")
    return cov


def _lens_cov(model: Entry, names: tuple[str, ...]) -> FloatArray | None:
    cov = _symmetric(model, COVARIANCES[0], len(names))
    if cov is None:
        return None
    order = [MODELS["brown"].names.index(n) for n in names]
    full = np.zeros((len(MODELS["brown"].names),) * 2)
    full[np.ix_(order, order)] = cov
    return full


def _pose_cov(model: Entry, rt: FloatArray) -> FloatArray | None:
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


def mrcal_files(found: RigValues) -> dict[str, str]:
    """One model per camera of a station, whose frame is mrcal's reference."""
    return found.files(mrcal_text, ENDING)


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
