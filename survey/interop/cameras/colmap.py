"""COLMAP's sparse models: a station is a rig, a station at an epoch a frame, target points and beacons are 3-D points.

COLMAP counts pixels from the corner of the first one: its image coordinates and principal points are ours + 0.5. A
rig's frame is that of its first camera. Poses are sensor from world; COLMAP's covariances of poses (which are in no
file) are rotation, then translation, perturbed on the left of cam_from_world, ours on the right of world_from_camera:
the numbers are the same but for the sign of the tangent. A model holds no weights, tables, pairs or distances.
"""

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.survey import (
    Camera,
    Datum,
    FloatArray,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
)
from survey.folder.text import atomic_write, csv_text, id_problem
from survey.interop.cameras.colmap_model import ColmapCamera, ColmapModel, read_model
from survey.interop.cameras.rig import lens_of
from survey.interop.cameras.values import BROWN_8, FISHEYE_4, CameraValues, MappedLens, mapped_lens
from survey.interop.networks.foreign import ForeignNetwork, Where, safe_ids, text_of

HALF_PIXEL = 0.5
NAMES_FILE = "point_names.csv"
CHOICES = {"brown": BROWN_8, "fisheye": FISHEYE_4}
SIGMA_PX = 1.0
_FULL = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# COLMAP's parameters by ours; "f" is fx and fy
_READ = {
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
    model, names = _READ[camera.model]
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
        rows = csv.reader(io.StringIO(text_of(path)), strict=True)
        try:
            for row in list(rows)[1:]:
                if len(row) != 2 or re.fullmatch(r"\d{1,18}", row[0]) is None:
                    raise Where(path, rows.line_num).error("expected point3D_id,name; correct the line")
                if int(row[0]) in names:
                    names[int(row[0])] = row[1]
        except csv.Error as error:
            raise Where(path, rows.line_num).error(f"this is no CSV ({error}); correct it") from None
    if len(set(names.values())) < len(names):
        raise Where(path, 1).error("two points have one name; make them differ")
    changed = safe_ids(list(names.values()), {"world"})
    return {p: changed.get(name, name) for p, name in names.items()}


@dataclass
class _Export:
    """A model while it is built from a survey."""

    values: CameraValues
    lenses: dict[str, MappedLens]
    model: Any
    cameras: dict[str, int] = field(default_factory=dict)
    references: dict[str, Pose3] = field(default_factory=dict)  # station from rig
    points: dict[tuple[str, ...], int] = field(default_factory=dict)
    xyz: dict[int, FloatArray] = field(default_factory=dict)
    tracks: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    sigmas: list[FloatArray] = field(default_factory=list)
    unknown: int = 0


def reconstruction(values: CameraValues) -> tuple[Any, dict[int, str], tuple[str, ...]]:
    """A pycolmap.Reconstruction of the survey, the names of its points, and what was approximated or left out."""
    import pycolmap

    cameras = [c for c in values.survey.cameras if any(b.camera_id == c.camera_id for b in values.blocks())]
    if not cameras:
        raise SurveyError("the project has no image points; a model of COLMAP is made of them")
    lenses = {c.camera_id: mapped_lens(c, values.lens(c), CHOICES) for c in cameras}
    export = _Export(values, lenses, pycolmap.Reconstruction())
    _add_rigs(export, cameras)
    moving = _moving_target(values)
    for (station_id, epoch), blocks in _frames(values).items():
        _add_frame(export, station_id, epoch, blocks, moving)
    for point, track in export.tracks.items():
        elements = pycolmap.Track()
        for image, k in track:
            elements.add_element(image, k)
        export.model.add_point3D_with_id(point, pycolmap.Point3D(xyz=export.xyz[point], track=elements))
    names = {point: "_".join(key) for key, point in export.points.items()}
    return export.model, names, _notes(export, moving)


def _notes(export: _Export, moving: str | None) -> tuple[str, ...]:
    survey = export.values.survey
    notes = [lens.note for lens in export.lenses.values() if lens.note]
    sigmas = np.concatenate(export.sigmas)
    if sigmas.max() > 1.001 * sigmas.min():
        notes.append(f"COLMAP weighs all image points alike; here their sigmas are {sigmas.min():.3g} to "
                     f"{sigmas.max():.3g} px")  # fmt: skip
    if moving:
        notes.append(f"the model's world is the frame of the target {moving!r}, which moves before stations at rest")
    if export.unknown:
        notes.append(f"left out, image points of beacons without coordinates: {export.unknown}")
    counts = {"table readings": survey.table_readings, "pairs": survey.pairs, "distances": survey.distances,
              "coordinates": survey.coordinates, "terrestrial readings": survey.readings}  # fmt: skip
    return (*notes, *(f"left out, {what}: {len(found)}" for what, found in counts.items() if found))


def _moving_target(values: CameraValues) -> str | None:
    """The target that alone is seen and moves before fixed stations: the model is then made in its frame."""
    seen = {b.target_id for b in values.blocks()}
    target = next((t for t in values.survey.targets if seen == {t.target_id}), None)
    fixed = all(s.motion == "fixed" for s in values.survey.stations)
    return target.target_id if target and target.motion == "epoch" and target.station_id is None and fixed else None


def _frames(values: CameraValues) -> dict[tuple[str, str], list[ImageBlock]]:
    cameras = values.survey.cameras_by_id
    out: dict[tuple[str, str], list[ImageBlock]] = {}
    for block in values.blocks():
        out.setdefault((cameras[block.camera_id].station_id, block.epoch_id), []).append(block)
    return out


def rigid3d(pose: Pose3) -> Any:
    """A pose as pycolmap's."""
    import pycolmap

    xyzw = Rotation.from_matrix(pose.rotation().matrix()).as_quat()
    return pycolmap.Rigid3d(pycolmap.Rotation3d(xyzw), np.asarray(pose.translation()))


def _add_rigs(export: _Export, cameras: list[Camera]) -> None:
    import pycolmap

    stations = list(dict.fromkeys(c.station_id for c in cameras))
    for rig_id, station_id in enumerate(stations, 1):
        rig = pycolmap.Rig(rig_id=rig_id)
        for camera in (c for c in cameras if c.station_id == station_id):
            camera_id = len(export.cameras) + 1
            export.cameras[camera.camera_id] = camera_id
            model, params = camera_params(export.lenses[camera.camera_id])
            width, height = camera.image_size
            added = pycolmap.Camera(model=model, width=width, height=height, params=params, camera_id=camera_id)
            export.model.add_camera(added)
            pose = export.values.station_from_camera(camera)
            if station_id not in export.references:
                export.references[station_id] = pose
                rig.add_ref_sensor(added.sensor_id)
            else:
                rig.add_sensor(added.sensor_id, rigid3d(pose.inverse() * export.references[station_id]))
        export.model.add_rig(rig)


def camera_params(lens: MappedLens) -> tuple[str, list[float]]:
    """COLMAP's model and parameters: the shortest that holds the lens."""
    if lens.model == "fisheye":
        model, names = "OPENCV_FISHEYE", _READ["OPENCV_FISHEYE"][1]
    else:
        rest = [any(lens.values[n] for n in _FULL[k:]) for k in (4, 8)]
        model = "FULL_OPENCV" if rest[1] else "OPENCV" if rest[0] else "PINHOLE"
        names = _READ[model][1]
    values = lens.array(*names)
    values[2:4] += HALF_PIXEL
    return model, values.tolist()


def _add_frame(export: _Export, station_id: str, epoch: str, blocks: list[ImageBlock], moving: str | None) -> None:
    import pycolmap

    values, model = export.values, export.model
    world_from_rig = values.world_from(FrameRef("station", station_id, epoch)) * export.references[station_id]
    if moving:
        world_from_rig = values.world_from(FrameRef("target", moving, epoch)).inverse() * world_from_rig
    frame = pycolmap.Frame(frame_id=model.num_frames() + 1, rig_id=list(export.references).index(station_id) + 1)
    images: list[Any] = []
    for camera_id in dict.fromkeys(b.camera_id for b in blocks):
        image_id = model.num_images() + len(images) + 1
        points: list[Any] = []
        for block in (b for b in blocks if b.camera_id == camera_id):
            for key, x, uv in _seen(export, block, moving):
                point = export.points.setdefault(key, len(export.points) + 1)
                export.xyz[point] = x
                export.tracks.setdefault(point, []).append((image_id, len(points)))
                points.append(pycolmap.Point2D(uv + HALF_PIXEL))
            export.sigmas.append(np.sqrt(np.diagonal(block.cov, axis1=1, axis2=2)).ravel())
        image = pycolmap.Image(name=f"{camera_id}/{epoch}.png", points2D=points, image_id=image_id,
                               camera_id=export.cameras[camera_id])  # fmt: skip
        image.frame_id = frame.frame_id
        frame.add_data_id(image.data_id)
        images.append(image)
    frame.rig_from_world = rigid3d(world_from_rig.inverse())
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(frame.frame_id)


def _seen(
    export: _Export, block: ImageBlock, moving: str | None
) -> Iterator[tuple[tuple[str, ...], FloatArray, FloatArray]]:
    """Of every image point of a block: the key of its 3-D point, that point in the model's world, and uv."""
    values = export.values
    if block.target_id is None:
        for i, uv in zip(block.point_idx.tolist(), block.uv, strict=True):
            name = values.survey.points[i].point_id
            x = values.point(name)
            if x is None:
                export.unknown += 1
            else:
                yield (name,), x, uv
        return
    target = values.survey.targets_by_id[str(block.target_id)]
    pose = Pose3() if moving else values.world_from(FrameRef("target", target.target_id, block.epoch_id))
    stands = moving or (target.motion == "fixed" and target.station_id is None)
    x_all = values.x_in_target(target)
    for i, uv in zip(block.point_idx.tolist(), block.uv, strict=True):
        key: tuple[str, ...] = (target.target_id, target.point_ids[i])
        yield key if stands else (*key, block.epoch_id), np.asarray(pose.transformFrom(x_all[i])), uv


def names_csv(names: dict[int, str]) -> str:
    """The table that keeps the names of points, which COLMAP has no place for."""
    return csv_text([("point3D_id", "name"), *sorted(names.items())])


def write_colmap(values: CameraValues, folder: Path, text: bool = False) -> tuple[dict[str, int], tuple[str, ...]]:
    """Write the model and the names of its points into a folder that is there; counts, and what is to be known."""
    model, names, notes = reconstruction(values)
    (model.write_text if text else model.write_binary)(str(folder))
    # last: pycolmap says nothing where the disk is full, but then this file finds no room either
    atomic_write(folder / NAMES_FILE, names_csv(names))
    counts = {"cameras": model.num_cameras(), "frames": model.num_frames(), "images": model.num_images(),
              "points": model.num_points3D(), "image_points": model.compute_num_observations()}  # fmt: skip
    return counts, notes
