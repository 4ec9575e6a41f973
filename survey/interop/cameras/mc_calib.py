"""MC-Calib's calibrated_cameras_data.yml: lenses and poses of cameras, in groups.

``camera_pose_matrix`` is ``reference camera of the group from camera``, in the unit of its board; metres are taken and
written. ``distortion_type`` 0 is Brown's with five coefficients, 1 OpenCV's fisheye.
"""

from pathlib import Path

import numpy as np
from gtsam import Pose3

from survey.interop.cameras.lens_maps import BROWN_5, FISHEYE_4
from survey.interop.cameras.opencv_files import OpencvYaml, Value, camera_matrix
from survey.interop.cameras.rig import Rig, RigCamera, opencv_lens, pose_of, rig_network
from survey.interop.cameras.values import CameraValues, RigValues, rig_values
from survey.interop.networks.foreign import ForeignNetwork
from survey.interop.safe_yaml import read_yaml

CHOICES = {"brown": BROWN_5, "fisheye": FISHEYE_4}
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


def mc_calib_files(values: CameraValues, station: str | None) -> tuple[dict[str, str], tuple[str, ...]]:
    """The cameras of one station, relative to the first, and what was approximated."""
    found = rig_values(values, station, "mc-calib", CHOICES)
    return {"": mc_calib_text(found)}, found.notes


def mc_calib_text(found: RigValues) -> str:
    """What MC-Calib and cv2.FileStorage read."""
    base = (found.rig.cameras[0].rig_from_camera or Pose3()).inverse()
    lines = ["%YAML:1.0\n---\n", f"nb_camera: {len(found.lenses)}\n"]
    for i, (camera, lens) in enumerate(zip(found.rig.cameras, found.lenses, strict=True)):
        fisheye = lens.model == "fisheye"
        k = lens.array(*(("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")))
        entry: dict[str, Value] = {
            "camera_matrix": camera_matrix(lens), "distortion_vector": k.reshape(1, -1),
            "distortion_type": int(fisheye), "camera_group": 0,
            "img_width": camera.image_size[0], "img_height": camera.image_size[1],
            "camera_pose_matrix": np.asarray((base * (camera.rig_from_camera or Pose3())).matrix()),
        }  # fmt: skip
        lines += [f"camera_{i}:\n", *OpencvYaml().lines(entry, "   ")]
    return "".join(lines)
