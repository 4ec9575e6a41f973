"""OpenCV's files of calibrations (YAML or JSON): lenses, and the stereo pair's or the whole rig's poses.

One camera: the keys of OpenCV's calibration sample. Two: those of its stereo sample, M1 D1 M2 D2 R T, where
x_2 = R x_1 + T. More: a list ``cameras`` with R and T from the first one. Pixels and lenses are OpenCV's own here; the
unit of T is metres.

MC-Calib's calibrated_cameras_data.yml: ``camera_pose_matrix`` is ``reference camera of the group from camera``, in the
unit of its board; metres are taken and written. ``distortion_type`` 0 is Brown's with five coefficients, 1 OpenCV's
fisheye.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from gtsam import Pose3

from adjust.model.survey import FloatArray
from survey.interop.cameras.rig import Rig, RigCamera, opencv_lens, pose_of, rig_network
from survey.interop.cameras.values import BROWN_5, BROWN_8, FISHEYE_4, MappedLens, RigValues
from survey.interop.networks.foreign import ForeignNetwork
from survey.interop.safe_yaml import Entry, quoted, read_yaml, yaml_text

CHOICES = {"brown": ("skew", *BROWN_8), "fisheye": FISHEYE_4}
_MATRIX = ("camera_matrix", "cameraMatrix", "K", "M", "intrinsic_matrix")
_DISTORTION = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "distortion")


def read_opencv(path: Path) -> ForeignNetwork:
    """One camera, a stereo pair or a rig. Raises SurveyError with file and line for what cannot be read."""
    root = read_yaml(path)
    if "cameras" in root:
        return rig_network(_listed(root.get("cameras")), path)
    if "M1" in root or "cameraMatrix1" in root:
        return rig_network(_stereo(root), path)
    return rig_network(Rig("rig", (_camera(root, _label(root, "camera")),)), path)


def _first(root: Entry, names: tuple[str, ...]) -> Entry:
    return root.get(next((n for n in names if n in root), names[0]))


def _camera(root: Entry, name: str, pose: Pose3 | None = None) -> RigCamera:
    distortion = _first(root, _DISTORTION)
    fisheye = any(k in root and root.get(k).text.lower() in ("1", "true", "fisheye") for k in ("fisheye_model",))
    lens = opencv_lens(_first(root, _MATRIX).matrix(3, 3), distortion.matrix(-1), fisheye, distortion.where)
    return RigCamera(name, _size(root, ""), lens, pose)


def _label(root: Entry, default: str, key: str = "name") -> str:
    return root.get(key).text if key in root else default


def _size(root: Entry, suffix: str) -> tuple[int, int]:
    for wide, high in ((f"image_width{suffix}", f"image_height{suffix}"), (f"width{suffix}", f"height{suffix}")):
        if wide in root:
            return root.get(wide).count(), root.get(high).count()
    for key in (f"image_size{suffix}", "image_size", "imageSize"):
        if key in root:
            width, height = (item.count() for item in root.get(key).items[:2])
            return width, height
    if suffix and "image_width" in root:
        return _size(root, "")
    raise root.error(f"image_width{suffix} and image_height{suffix} are missing; add them")


def _stereo(root: Entry) -> Rig:
    cameras = []
    fisheye = "fisheye_model" in root and root.get("fisheye_model").text.lower() in ("1", "true")
    for i in ("1", "2"):
        matrix = _first(root, (f"M{i}", f"cameraMatrix{i}"))
        distortion = _first(root, (f"D{i}", f"distCoeffs{i}"))
        lens = opencv_lens(matrix.matrix(3, 3), distortion.matrix(-1), fisheye, distortion.where)
        pose = Pose3() if i == "1" else _pose(root) if "R" in root else None
        cameras.append(RigCamera(_label(root, f"camera{i}", f"name{i}"), _size(root, i), lens, pose))
    notes = () if "R" in root else ("the file has no R and T: the second camera's pose is found by an adjustment",)
    return Rig(_label(root, "rig", "rig"), tuple(cameras), notes)


def _pose(root: Entry) -> Pose3:
    """First camera from this one."""
    R, T = root.get("R"), root.get("T")
    return pose_of(np.column_stack([R.matrix(3, 3), T.matrix(3)]), R.where).inverse()


def _listed(entry: Entry) -> Rig:
    cameras = []
    for i, item in enumerate(entry.items):
        pose = _pose(item) if "R" in item else Pose3() if i == 0 else None
        cameras.append(_camera(item, _label(item, f"camera{i + 1}"), pose))
    return Rig("rig", tuple(cameras))


def opencv_files(found: RigValues, json: bool = False) -> dict[str, str]:
    """The file of one station's cameras that cv2.FileStorage reads, as YAML or JSON."""
    cameras, lenses = found.rig.cameras, found.lenses
    base = cameras[0].rig_from_camera or Pose3()
    poses = [(c.rig_from_camera or Pose3()).inverse() * base for c in cameras]
    out: dict[str, Value] = {}
    if len(cameras) == 1:
        out = _camera_values(cameras[0], lenses[0])
    elif len(cameras) == 2 and lenses[0].model == lenses[1].model:
        out = {"fisheye_model": int(lenses[0].model == "fisheye")}
        for i, (camera, lens) in enumerate(zip(cameras, lenses, strict=True), 1):
            own = _camera_values(camera, lens)
            out |= {f"name{i}": camera.camera_id, f"image_width{i}": camera.image_size[0],
                    f"image_height{i}": camera.image_size[1], f"M{i}": own["camera_matrix"],
                    f"D{i}": own["distortion_coefficients"]}  # fmt: skip
        out |= _motion(poses[1])
    else:
        out["cameras"] = [_camera_values(c, lens) | _motion(pose)
                          for c, lens, pose in zip(cameras, lenses, poses, strict=True)]  # fmt: skip
    return {"": f"{_json(out)}\n" if json else opencv_yaml(out)}


Value = str | int | FloatArray | list[dict[str, "Value"]]


def _camera_values(camera: RigCamera, lens: MappedLens) -> dict[str, Value]:
    return {
        "name": camera.camera_id, "image_width": camera.image_size[0], "image_height": camera.image_size[1],
        "fisheye_model": int(lens.model == "fisheye"), "camera_matrix": camera_matrix(lens),
        "distortion_coefficients": lens.distortion()[None],
    }  # fmt: skip


def camera_matrix(lens: MappedLens) -> FloatArray:
    """[fx skew u0; 0 fy v0; 0 0 1]."""
    fx, fy, u0, v0 = lens.array("fx", "fy", "u0", "v0")
    return np.array([[fx, lens.values.get("skew", 0.0), u0], [0.0, fy, v0], [0.0, 0.0, 1.0]])


def _motion(pose: Pose3) -> dict[str, Value]:
    return {"R": pose.rotation().matrix(), "T": np.asarray(pose.translation()).reshape(3, 1)}


def opencv_yaml(values: Mapping[str, object]) -> str:
    """What cv2.FileStorage reads; arrays (n, m) as its matrices."""
    return "%YAML:1.0\n---\n" + yaml_text(values)


def _json(value: "Value | dict[str, Value]", indent: str = "") -> str:
    """As cv2.FileStorage wants it: matrices in one line, and a point in each of their numbers."""
    if isinstance(value, dict):
        inner = indent + "    "
        rows = ",\n".join(f'{inner}"{key}": {_json(item, inner)}' for key, item in value.items())
        return f"{{\n{rows}\n{indent}}}"
    if isinstance(value, list):
        return f"[ {', '.join(_json(item, indent) for item in value)} ]"
    if isinstance(value, np.ndarray):
        n, cols = value.shape
        data = f'"rows": {n}, "cols": {cols}, "dt": "d", "data": [ {_numbers(value)} ]'
        return f'{{ "type_id": "opencv-matrix", {data} }}'
    return str(value) if isinstance(value, int) else quoted(value)


def _numbers(matrix: FloatArray) -> str:
    """Numbers with every bit; OpenCV wants a point in each."""
    return ", ".join(re.sub(r"^(-?\d+)(e.*)$", r"\1.0\2", repr(float(v))) for v in matrix.ravel())


MC_CALIB_CHOICES = {"brown": BROWN_5, "fisheye": FISHEYE_4}
_MOST_CAMERAS = 1000


def read_mc_calib(path: Path) -> ForeignNetwork:
    """The cameras of a result. Raises SurveyError with file and line for what cannot be read."""
    root = read_yaml(path)
    groups: dict[str, str] = {}
    cameras = []
    for i in range(root.get("nb_camera").count(_MOST_CAMERAS)):
        entry = root.get(f"camera_{i}")
        distortion, matrix = entry.get("distortion_vector"), entry.get("camera_pose_matrix")
        kind = entry.get("distortion_type")
        if kind.text not in ("0", "1"):
            raise kind.error(f"found {kind.text}; 0 (Brown) and 1 (fisheye) are read")
        lens = opencv_lens(entry.get("camera_matrix").matrix(3, 3), distortion.matrix(-1), kind.text == "1",
                           distortion.where)  # fmt: skip
        size = (entry.get("img_width").count(), entry.get("img_height").count())
        group = entry.get("camera_group").text if "camera_group" in entry else "0"
        groups[group] = f"camera_{i}"
        cameras.append(RigCamera(f"camera_{i}", size, lens, pose_of(matrix.matrix(4, 4), matrix.where)))
    if len(groups) > 1:
        raise root.error(f"found {len(groups)} groups of cameras without poses between them; give one group per file")
    note = "MC-Calib's poses are in the unit of its board; they are taken for metres"
    return rig_network(Rig("rig", tuple(cameras), (note,)), path)


def mc_calib_files(found: RigValues) -> dict[str, str]:
    """The cameras of one station, relative to the first, as MC-Calib and cv2.FileStorage read them."""
    base = (found.rig.cameras[0].rig_from_camera or Pose3()).inverse()
    document: dict[str, object] = {"nb_camera": len(found.lenses)}
    for i, (camera, lens) in enumerate(zip(found.rig.cameras, found.lenses, strict=True)):
        document[f"camera_{i}"] = {
            "camera_matrix": camera_matrix(lens), "distortion_vector": lens.distortion()[None],
            "distortion_type": int(lens.model == "fisheye"), "camera_group": 0,
            "img_width": camera.image_size[0], "img_height": camera.image_size[1],
            "camera_pose_matrix": np.asarray((base * (camera.rig_from_camera or Pose3())).matrix()),
        }  # fmt: skip
    return {"": opencv_yaml(document)}
