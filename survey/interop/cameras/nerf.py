"""transforms.json as nerfstudio, instant-ngp and others read it: one pose and one lens per image.

``transform_matrix`` is world from camera with OpenGL's camera (x right, y up, z backwards). The principal point counts
from the corner of the first pixel, half a pixel off ours. Lenses: OPENCV (k1 k2 p1 p2 k3) and OPENCV_FISHEYE.
"""

from pathlib import Path, PurePosixPath

import numpy as np
from gtsam import Pose3

from adjust.model.observations import FrameRef
from adjust.model.survey import LensParameter, PoseParameter, Survey
from survey.folder.text import id_problem, json_text
from survey.interop.cameras.rig import lens_of, moving_camera, pose_of
from survey.interop.cameras.values import BROWN_5, FISHEYE_4, CameraValues, MappedLens, mapped_lens, stations_of_cameras
from survey.interop.networks.foreign import ForeignNetwork
from survey.interop.safe_yaml import Entry, read_yaml

CHOICES = {"brown": BROWN_5, "fisheye": FISHEYE_4}
HALF_PIXEL = 0.5
_OPENGL = Pose3(np.diag([1.0, -1.0, -1.0, 1.0]))
_LENS = ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2")


def read_nerf(path: Path) -> ForeignNetwork:
    """Cameras and poses of images. Raises SurveyError with file and line for what cannot be read.

    An image at FOLDER/NAME is epoch NAME of camera FOLDER; the images of one folder must share a lens.
    """
    root = read_yaml(path)
    undo = Pose3()
    if "applied_transform" in root:
        entry = root.get("applied_transform")
        undo = pose_of(entry.numbers(-1, 4), entry.where).inverse()
    if "applied_scale" in root and root.get("applied_scale").number != 1.0:
        raise root.get("applied_scale").error("scaled poses are not read; export with a scale of 1")
    lenses: dict[str, tuple[LensParameter, tuple[int, int]]] = {}
    poses: dict[str, dict[str, PoseParameter]] = {}
    for frame in root.get("frames").items:
        camera_id, epoch = _names(frame.get("file_path"))
        own = _lens(root, frame)
        if camera_id in lenses and not _same(lenses[camera_id], own):
            raise frame.error(f"its lens differs from that of other images in {camera_id!r}; one folder per camera")
        lenses[camera_id] = own
        matrix = frame.get("transform_matrix")
        if epoch in poses.setdefault(camera_id, {}):
            raise frame.error(f"the image {epoch!r} of {camera_id!r} is there twice; remove one")
        pose = undo * pose_of(matrix.numbers(-1, 4), matrix.where) * _OPENGL
        poses[camera_id][epoch] = PoseParameter(pose)
    if not lenses:
        raise root.get("frames").error("holds no image; give another file")
    pairs = [moving_camera(c, lenses[c][1], lenses[c][0], poses[c]) for c in lenses]
    survey = Survey(cameras=tuple(c for c, _ in pairs), stations=tuple(s for _, s in pairs))
    return ForeignNetwork(survey, path.stem)


def _names(entry: Entry) -> tuple[str, str]:
    """Camera and epoch of an image's path."""
    path = PurePosixPath(entry.text.replace("\\", "/"))
    camera = path.parent.name if path.parent.name not in ("", "images", "..") else "camera"
    for name in (camera, path.stem):
        if (problem := id_problem(name)) is not None:
            raise entry.error(problem)
    return camera, path.stem


def _same(a: tuple[LensParameter, tuple[int, int]], b: tuple[LensParameter, tuple[int, int]]) -> bool:
    one, two = (np.asarray(lens.values, dtype=float) for lens, _ in (a, b))
    return a[1] == b[1] and a[0].model == b[0].model and np.array_equal(one, two)


def _lens(root: Entry, frame: Entry) -> tuple[LensParameter, tuple[int, int]]:
    """The lens of a frame: its own keys before those of the file."""
    found = {key: (frame if key in frame else root).get(key) for key in _LENS if key in frame or key in root}
    for key in ("fl_x", "cx", "cy", "w", "h"):
        if key not in found:
            raise frame.error(f"{key!r} is missing, here and at the top; add it")
    value = {k: e.number for k, e in found.items() if k != "camera_model"}
    value.setdefault("fl_y", value["fl_x"])
    kind = found["camera_model"].text if "camera_model" in found else "OPENCV"
    plain = {"fx": value["fl_x"], "fy": value["fl_y"], "u0": value["cx"] - HALF_PIXEL, "v0": value["cy"] - HALF_PIXEL}
    size = (found["w"].count(), found["h"].count())
    if kind == "OPENCV_FISHEYE":
        terms = {n: value.get(n, 0.0) for n in ("k1", "k2", "k3", "k4")}
        return lens_of("fisheye", found["fl_x"], **plain, **terms), size
    if kind not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
        raise found["camera_model"].error(f"found {kind!r}; OPENCV, OPENCV_FISHEYE, PINHOLE are read")
    if value.get("k4", 0.0) != 0.0:
        raise found["k4"].error("a fourth radial term is in no lens model here; calibrate without it")
    terms = {n: value[n] for n in ("k1", "k2", "p1", "p2", "k3") if n in value and kind == "OPENCV"}
    return lens_of("brown", found["fl_x"], **plain, **terms), size


def nerf_files(values: CameraValues, station: str | None) -> tuple[dict[str, str], tuple[str, ...]]:
    """All images with image points, or those of one station; what was approximated."""
    carriers = stations_of_cameras(values, station, "nerf")
    cameras = {c.camera_id: c for c in values.survey.cameras if c.station_id in carriers}
    lenses = {k: mapped_lens(c, values.lens(c), CHOICES) for k, c in cameras.items()}
    seen = dict.fromkeys((b.camera_id, b.epoch_id) for b in values.blocks() if b.camera_id in cameras)
    if not seen:  # poses alone, as from another file
        stations = values.survey.stations_by_id
        seen = dict.fromkeys((k, e) for k, c in cameras.items() for e in values.epochs_of(stations[c.station_id]))
    frames = []
    for camera_id, epoch in seen:
        pose = values.world_from(FrameRef("camera", camera_id, epoch)) * _OPENGL
        frame: dict[str, object] = {"file_path": f"images/{camera_id}/{epoch}.png"}
        frame |= _lens_keys(lenses[camera_id], cameras[camera_id].image_size)
        frames.append(frame | {"transform_matrix": [[float(v) for v in row] for row in pose.matrix()]})
    text = json_text({"frames": frames})
    return {"": text}, tuple(lens.note for lens in lenses.values() if lens.note)


def _lens_keys(lens: MappedLens, size: tuple[int, int]) -> dict[str, object]:
    fisheye = lens.model == "fisheye"
    fx, fy, u0, v0 = lens.array("fx", "fy", "u0", "v0").tolist()
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV", "w": size[0], "h": size[1],
        "fl_x": fx, "fl_y": fy, "cx": u0 + HALF_PIXEL, "cy": v0 + HALF_PIXEL, **{n: lens.values[n] for n in names},
    }  # fmt: skip
