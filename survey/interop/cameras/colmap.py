"""COLMAP's sparse models: a station is a rig, a station at an epoch a frame, target points and beacons are 3-D points.

COLMAP counts pixels from the corner of the first one: its image coordinates and principal points are ours + 0.5. A
rig's frame is that of its first camera. Poses are sensor from world; COLMAP's covariances of poses (which are in no
file) are rotation, then translation, perturbed on the left of cam_from_world, ours on the right of world_from_camera:
the numbers are the same but for the sign of the tangent. A model holds no weights, tables, pairs or distances.
"""

import re
from pathlib import Path, PurePosixPath

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.survey import (
    Camera,
    Datum,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
)
from survey.folder.text import csv_rows, id_problem
from survey.interop.cameras.colmap_model import ColmapCamera, ColmapModel, read_model
from survey.interop.cameras.rig import lens_of
from survey.interop.networks.foreign import ForeignNetwork, Where, safe_ids, text_of

HALF_PIXEL = 0.5
NAMES_FILE = "point_names.csv"
SIGMA_PX = 1.0
_FULL = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# COLMAP's parameters by ours; "f" is fx and fy
PARAMETERS = {
    "SIMPLE_PINHOLE": ("brown", ("f", "u0", "v0")), "PINHOLE": ("brown", _FULL[:4]),
    "SIMPLE_RADIAL": ("brown", ("f", "u0", "v0", "k1")), "RADIAL": ("brown", ("f", "u0", "v0", "k1", "k2")),
    "OPENCV": ("brown", _FULL[:8]), "FULL_OPENCV": ("brown", _FULL),
    "OPENCV_FISHEYE": ("fisheye", ("fx", "fy", "u0", "v0", "k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", ("f", "u0", "v0", "k1")),
    "RADIAL_FISHEYE": ("fisheye", ("f", "u0", "v0", "k1", "k2")),
}  # fmt: skip


def read_colmap(path: Path) -> ForeignNetwork:
    """A model from its folder, text or binary, as a free network. Raises SurveyError for what cannot be read."""
    folder = path if path.is_dir() else path.parent
    model = read_model(folder)
    if not model.images or not (model.cameras and model.points):
        raise SurveyError(f"{folder}: the model has no cameras, images or points; give another one")
    _complete(model)
    names = _point_names(folder / NAMES_FILE, model)
    cameras, stations, epochs = _bodies(model)
    order = {point: i for i, point in enumerate(model.points)}
    points = tuple(Point(names[p], PointParameter(x)) for p, x in model.points.items())
    blocks = []
    for image_id, image in model.images.items():
        shown = np.array([p in order for p in image.points.tolist()], dtype=bool)
        idx = np.array([order[p] for p in image.points[shown].tolist()], dtype=np.int64)
        if len(set(idx.tolist())) < len(idx):
            raise image.where.error(f"image {image.name!r} shows a 3-D point twice; merge its tracks")
        if len(idx):
            cov = np.tile(SIGMA_PX**2 * np.eye(2), (len(idx), 1, 1))
            camera_id = cameras[image.camera].camera_id
            blocks.append(ImageBlock(camera_id, epochs[image_id], None, idx, image.xy[shown] - HALF_PIXEL, cov))
    survey = Survey(tuple(cameras.values()), tuple(stations), points=points, image_blocks=tuple(blocks),
                    datum=Datum("inner"))  # fmt: skip
    note = f"a model has no weights: every image point has a sigma of {SIGMA_PX} px; its scale is that of the model"
    return ForeignNetwork(survey, folder.name, notes=(note,))


def _complete(model: ColmapModel) -> None:
    """Rigs of one camera and frames of one image, where the model (of COLMAP 3) has none; images without a frame go."""
    if not model.rigs:
        model.rigs = {c: {c: Pose3()} for c in model.cameras}
        model.frames = {i: (image.camera, image.cam_from_world, (i,)) for i, image in model.images.items()}
    framed = {i for _, _, images in model.frames.values() for i in images}
    model.images = {i: image for i, image in model.images.items() if i in framed}


def _bodies(model: ColmapModel) -> tuple[dict[int, Camera], list[Station], dict[int, str]]:
    """Cameras by COLMAP's id, stations, and the epoch of every image."""
    folders: dict[int, set[str]] = {}
    for image in model.images.values():
        folders.setdefault(image.camera, set()).add(PurePosixPath(image.name).parent.name)
    wanted = {c: f"camera{c}" for c in model.cameras}
    own = {c: next(iter(names)) for c, names in folders.items() if len(names) == 1}
    counts = list(own.values())
    wanted |= {c: name for c, name in own.items() if id_problem(name) is None and counts.count(name) == 1}
    if len(set(wanted.values())) < len(wanted):
        wanted = {c: f"camera{c}" for c in model.cameras}
    cameras: dict[int, Camera] = {}
    stations, epochs = [], dict[int, str]()
    for rig_id, rig in model.rigs.items():
        station_id = f"rig{rig_id}"
        for k, (c, camera_from_rig) in enumerate(rig.items()):
            if c in cameras:
                raise model.cameras[c].where.error(f"camera {c} is in two rigs; give every rig its own cameras")
            pose = PoseParameter(camera_from_rig.inverse(), "held" if k == 0 else "free")
            lens = _lens(model.cameras[c])
            cameras[c] = Camera(wanted[c], station_id, model.cameras[c].size, lens, pose)
        poses = {}
        for frame_id, epoch in _epochs(model, rig_id).items():
            _, rig_from_world, images = model.frames[frame_id]
            poses[epoch] = PoseParameter(rig_from_world.inverse())
            epochs |= dict.fromkeys(images, epoch)
        stations.append(Station(station_id, motion="epoch", epochs=poses))
    used = {s.station_id for s in stations if s.epochs}
    return (
        {c: camera for c, camera in cameras.items() if camera.station_id in used},
        [s for s in stations if s.epochs], epochs,
    )  # fmt: skip


def _epochs(model: ColmapModel, rig_id: int) -> dict[int, str]:
    """Name of every frame of a rig: that of its images where they agree, and all frames differ."""
    stems = {}
    for frame_id, (rig, _, images) in model.frames.items():
        names = {PurePosixPath(model.images[i].name).stem for i in images if i in model.images}
        if rig == rig_id and names:
            name = next(iter(names))
            stems[frame_id] = name if len(names) == 1 and id_problem(name) is None else ""
    if "" in stems.values() or len(set(stems.values())) < len(stems):
        return {frame_id: f"frame{frame_id}" for frame_id in stems}
    return stems


def _lens(camera: ColmapCamera) -> LensParameter:
    model, names = PARAMETERS[camera.model]
    values = dict(zip(names, camera.params.tolist(), strict=True))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    values["u0"] -= HALF_PIXEL
    values["v0"] -= HALF_PIXEL
    return lens_of(model, camera.where, **values)


def _point_names(path: Path, model: ColmapModel) -> dict[int, str]:
    """Names of the points: as the file beside the model says, else P and the id."""
    names = {p: f"P{p}" for p in model.points}
    if path.is_file():
        for line, row in list(csv_rows(path, text_of(path)))[1:]:
            if len(row) != 2 or re.fullmatch(r"\d{1,18}", row[0]) is None:
                raise Where(path, line).error("expected point3D_id,name; correct the line")
            if int(row[0]) in names:
                names[int(row[0])] = row[1]
    if len(set(names.values())) < len(names):
        raise Where(path, 1).error("two points have one name; make them differ")
    changed = safe_ids(list(names.values()), {"world"})
    return {p: changed.get(name, name) for p, name in names.items()}
