"""A survey as a sparse model of COLMAP, built with pycolmap; what frames and points are: ``cameras.colmap``."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.survey import Camera, FloatArray
from survey.folder.text import atomic_write, csv_text
from survey.interop.cameras.colmap import HALF_PIXEL, NAMES_FILE, PARAMETERS
from survey.interop.cameras.rig import quaternion_xyzw
from survey.interop.cameras.values import BROWN_8, FISHEYE_4, CameraValues, MappedLens, mapped_lens

CHOICES = {"brown": BROWN_8, "fisheye": FISHEYE_4}


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

    return pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion_xyzw(pose)), np.asarray(pose.translation()))


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
    model = "OPENCV_FISHEYE"
    if lens.model != "fisheye":
        brown = ("PINHOLE", "OPENCV", "FULL_OPENCV")
        needed = {n for n in PARAMETERS[brown[-1]][1] if lens.values[n]}
        model = next(name for name in brown if needed <= set(PARAMETERS[name][1]))
    values = lens.array(*PARAMETERS[model][1])
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
