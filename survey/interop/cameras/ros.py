"""ROS: camera_info (YAML of camera_calibration_parsers) with extrinsics, and ROS-Industrial's calibration files.

One camera is one file; several are a folder with ``<camera_id>.yaml`` each and ``extrinsics.yaml``, a list of
transforms in the fields of geometry_msgs/TransformStamped: ``header.frame_id`` (the station) from ``child_frame_id``
(the camera's optical frame, ``<camera_id>_optical_frame``: x right, y down, z forward, as here). Pixels and lenses are
OpenCV's. ROS-Industrial: ``camera_mount_to_camera`` is the pose of the camera on its mount; in the older lists
``static_cameras`` and ``moving_cameras`` angle_axis and position take reference coordinates to the camera.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from survey.interop.cameras.opencv_files import camera_matrix
from survey.interop.cameras.rig import (
    Rig,
    RigCamera,
    camera_files,
    joined,
    lens_of,
    opencv_lens,
    pose_of,
    pose_of_quaternion,
    quaternion_xyzw,
    rig_network,
)
from survey.interop.cameras.values import BROWN_5, BROWN_8, FISHEYE_4, MappedLens, RigValues
from survey.interop.networks.foreign import ForeignNetwork
from survey.interop.safe_yaml import Entry, matrix_entry, read_yaml, yaml_text

EXTRINSICS = "extrinsics.yaml"
FRAME = "_optical_frame"
CHOICES = {"brown": BROWN_8, "fisheye": FISHEYE_4}
INDUSTRIAL_CHOICES = {"brown": BROWN_5}
_MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")


def read_ros(path: Path) -> ForeignNetwork:
    """A camera_info file, or a folder of them. Raises SurveyError with file and line for what cannot be read."""
    rig_id, poses = _extrinsics(path / EXTRINSICS) if (path / EXTRINSICS).is_file() else ("rig", {})
    cameras = []
    for file in camera_files(path, ".yaml", but=EXTRINSICS):
        camera = _camera(read_yaml(file), file.stem)
        pose = poses.get(f"{camera.camera_id}{FRAME}", poses.get(camera.camera_id))
        cameras.append(RigCamera(camera.camera_id, camera.image_size, camera.lens, pose))
    return rig_network(Rig(rig_id, tuple(cameras)), path)


def _camera(root: Entry, stem: str) -> RigCamera:
    size = (root.get("image_width").count(), root.get("image_height").count())
    model = root.get("distortion_model") if "distortion_model" in root else None
    distortion = root.get("distortion_coefficients")
    k = distortion.matrix(-1)
    name = model.text if model is not None else "plumb_bob"
    if model is not None and name not in _MODELS:
        raise model.error(f"found {name!r}; {', '.join(_MODELS)} are read")
    if len(k) not in _MODELS[name] and k.any():
        raise distortion.error(f"found {len(k)} coefficients for {name}; expected {_MODELS[name]}")
    k = k if len(k) in _MODELS[name] else k[:0]
    lens = opencv_lens(root.get("camera_matrix").matrix(3, 3), k, name == "equidistant", distortion.where)
    return RigCamera(root.get("camera_name").text if "camera_name" in root else stem, size, lens, None)


def _extrinsics(path: Path) -> tuple[str, dict[str, Pose3]]:
    """The parent frame and the poses of its children. Raises SurveyError where there are several parents."""
    root = read_yaml(path)
    listed = root.get("transforms").items if isinstance(root.value, dict) else root.items
    poses, parents = {}, {}
    for entry in listed:
        parent = entry.get("header").get("frame_id")
        parents[parent.text] = parent
        poses[entry.get("child_frame_id").text] = _transform(entry.get("transform"))
    if len(parents) != 1:
        raise root.error(f"found {len(parents)} parent frames; one, that of the rig, is expected")
    return next(iter(parents)), poses


def _transform(entry: Entry) -> Pose3:
    t, q = entry.get("translation"), entry.get("rotation")
    xyzw = np.array([q.get(a).number for a in "xyzw"])
    return pose_of_quaternion(xyzw, np.array([t.get(a).number for a in "xyz"]), q.where)


def ros_files(found: RigValues) -> dict[str, str]:
    """camera_info of one station's cameras, with extrinsics where there are several."""
    files = found.files(camera_info_text, ".yaml")
    if EXTRINSICS in files:
        raise SurveyError("a camera called 'extrinsics' cannot be written beside extrinsics.yaml; rename it")
    return files if "" in files else {**files, EXTRINSICS: extrinsics_text(found.rig)}


def camera_info_text(camera: RigCamera, lens: MappedLens) -> str:
    """One camera as camera_calibration_parsers writes it; rectified to itself."""
    matrix = camera_matrix(lens)
    k = lens.distortion()
    name = {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}[len(k)]
    return yaml_text({
        "image_width": camera.image_size[0], "image_height": camera.image_size[1], "camera_name": camera.camera_id,
        "camera_matrix": matrix_entry(matrix), "distortion_model": name,
        "distortion_coefficients": matrix_entry(k[None]), "rectification_matrix": matrix_entry(np.eye(3)),
        "projection_matrix": matrix_entry(np.column_stack([matrix, np.zeros(3)])),
    })  # fmt: skip


def extrinsics_text(rig: Rig) -> str:
    """Poses of the cameras on their station as a list of transforms."""
    poses = {camera.camera_id: camera.rig_from_camera or Pose3() for camera in rig.cameras}
    return yaml_text({"transforms": [
        {"header": {"frame_id": rig.rig_id}, "child_frame_id": name + FRAME,
         "transform": {"translation": _named("xyz", pose.translation()),
                       "rotation": _named("xyzw", quaternion_xyzw(pose))}} for name, pose in poses.items()
    ]})  # fmt: skip


def _named(names: Iterable[str], values: FloatArray) -> dict[str, float]:
    return dict(zip(names, np.asarray(values, float).tolist(), strict=True))


def read_industrial(path: Path) -> ForeignNetwork:
    """ROS-Industrial's calibration, or a folder of them. Raises SurveyError, with file and line, as all readers do."""
    return rig_network(joined([_industrial_rig(file) for file in camera_files(path, ".yaml")]), path)


def _industrial_rig(path: Path) -> Rig:
    root = read_yaml(path)
    listed = [e for key in ("static_cameras", "moving_cameras") if key in root for e in _industrial_list(root.get(key))]
    if listed:
        return Rig("rig", tuple(_industrial_camera(e) for e in listed))
    own = root.get("intrinsics")
    values = {ours: own.get(key).number for ours, key in _PINHOLE}
    if "distortions" in root:
        values |= {n: root.get("distortions").get(n).number for n in _DISTORTION}
    key = next((k for k in ("camera_mount_to_camera", "camera_mount_to_camera_guess") if k in root), None)
    pose = _industrial_pose(root.get(key)) if key is not None else None
    size = _industrial_size(root, values)
    name = root.get("camera_name").text if "camera_name" in root else path.stem
    camera = RigCamera(name, size[0], lens_of("brown", own, **values), pose)
    return Rig("camera_mount", (camera,), size[1])


_PINHOLE = (("fx", "fx"), ("fy", "fy"), ("u0", "cx"), ("v0", "cy"))


def _industrial_list(entry: Entry) -> list[Entry]:
    return entry.items if isinstance(entry.value, list) else []


def _industrial_size(root: Entry, values: dict[str, float]) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Image size; where the file has none, that in whose middle the principal point lies, and a note."""
    if "image_width" in root:
        return (root.get("image_width").count(), root.get("image_height").count()), ()
    width, height = (max(2, round(2.0 * min(abs(values[n]), 1e5) + 1.0)) for n in ("u0", "v0"))
    return (width, height), (f"the file has no image size: {width} x {height} is written; correct it in survey.toml",)


def _industrial_pose(entry: Entry) -> Pose3:
    q = np.array([entry.get(f"q{a}").number for a in "xyzw"])
    return pose_of_quaternion(q, np.array([entry.get(a).number for a in "xyz"]), entry.where)


def _industrial_camera(entry: Entry) -> RigCamera:
    names = {"fx": "focal_length_x", "fy": "focal_length_y", "u0": "center_x", "v0": "center_y"}
    names |= {n: f"distortion_{n}" for n in ("k1", "k2", "k3", "p1", "p2")}
    values = {ours: entry.get(theirs).number for ours, theirs in names.items()}
    turn = Rotation.from_rotvec([entry.get(f"angle_axis_a{a}").number for a in "xyz"]).as_matrix()
    t = np.array([entry.get(f"position_{a}").number for a in "xyz"])
    pose = pose_of(np.column_stack([turn, t]), entry.where).inverse()
    size = _industrial_size(entry, values)[0]
    return RigCamera(entry.get("camera_name").text, size, lens_of("brown", entry, **values), pose)


def industrial_files(found: RigValues) -> dict[str, str]:
    """One file per camera: intrinsics, distortions and its pose on the station."""
    return found.files(_industrial_text, ".yaml")


def industrial_notes(found: RigValues) -> tuple[str, ...]:
    """What is to be known of distortions, of the first camera that has any."""
    notes = (f"camera {c.camera_id}: distortions are written, but ROS-Industrial's extrinsic tools take lenses without"
             for c, lens in zip(found.rig.cameras, found.lenses, strict=True) if lens.distortion().any())  # fmt: skip
    return tuple(notes)[:1]


def _industrial_text(camera: RigCamera, lens: MappedLens) -> str:
    pose = camera.rig_from_camera or Pose3()
    return yaml_text({
        "camera_name": camera.camera_id, "image_width": camera.image_size[0], "image_height": camera.image_size[1],
        "intrinsics": {key: lens.values[ours] for ours, key in _PINHOLE},
        "distortions": {n: lens.values[n] for n in _DISTORTION},
        "camera_mount_to_camera": _named("xyz", pose.translation())
        | _named(("qx", "qy", "qz", "qw"), quaternion_xyzw(pose)),
    })  # fmt: skip
