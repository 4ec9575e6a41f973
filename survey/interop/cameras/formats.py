"""The formats of cameras by name: who reads and writes them, and which endings they have."""

from collections.abc import Callable, Mapping
from pathlib import Path

from adjust.model.clocks import clock_text, clocks_of
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.whole import whole_folder
from survey.interop.cameras import kalibr, mrcal, ros
from survey.interop.cameras import opencv_files as opencv
from survey.interop.cameras.colmap import read_colmap
from survey.interop.cameras.colmap_writer import write_colmap
from survey.interop.cameras.kalibr import kalibr_files, read_kalibr, target_text
from survey.interop.cameras.mrcal import mrcal_files, read_mrcal
from survey.interop.cameras.nerf import nerf_files, read_nerf
from survey.interop.cameras.opencv_files import mc_calib_files, opencv_files, read_mc_calib, read_opencv
from survey.interop.cameras.robots import read_sdf, read_urdf, sdf_files, urdf_files
from survey.interop.cameras.ros import industrial_files, industrial_notes, read_industrial, read_ros, ros_files
from survey.interop.cameras.values import CameraValues, RigValues, rig_values
from survey.interop.networks.foreign import ForeignNetwork
from survey.interop.scene import glb_files, ply_files
from survey.interop.trajectories import kitti_files, read_kitti, read_tum, tum_files
from survey.project import atomic_write

Files = tuple[Mapping[str, str | bytes], tuple[str, ...]]


@frozen
class CameraFormat:
    """read: None where it is only written. write: files by name ("" the one file) and notes. folder: may be one."""

    read: Callable[[Path], ForeignNetwork] | None
    write: Callable[[CameraValues, str | None], Files]
    folder: bool = False


def _rig(
    name: str, read: Callable[[Path], ForeignNetwork], files: Callable[[RigValues], Mapping[str, str]],
    choices: Mapping[str, tuple[str, ...]], folder: bool = False,
    said: Callable[[RigValues], tuple[str, ...]] = lambda _: (),
) -> CameraFormat:  # fmt: skip
    """A format of the cameras of one station, with lenses in the forms that it has; said: what is to be known."""

    def write(values: CameraValues, station: str | None) -> Files:
        found = rig_values(values, station, name, choices)
        return files(found), (*found.notes, *said(found))

    return CameraFormat(read, write, folder)


FORMATS: Mapping[str, CameraFormat] = {
    "kalibr": _rig("kalibr", read_kalibr, kalibr_files, kalibr.CHOICES),
    "opencv": _rig("opencv", read_opencv, opencv_files, opencv.CHOICES),
    "ros": _rig("ros", read_ros, ros_files, ros.CHOICES, folder=True),
    "ros-industrial": _rig("ros-industrial", read_industrial, industrial_files, ros.INDUSTRIAL_CHOICES, True,
                           industrial_notes),
    "mrcal": _rig("mrcal", read_mrcal, mrcal_files, mrcal.CHOICES, folder=True),
    "mc-calib": _rig("mc-calib", read_mc_calib, mc_calib_files, opencv.MC_CALIB_CHOICES),
    "nerf": CameraFormat(read_nerf, nerf_files),
    "urdf": CameraFormat(read_urdf, urdf_files),
    "sdf": CameraFormat(read_sdf, sdf_files),
    "tum": CameraFormat(read_tum, tum_files),
    "kitti": CameraFormat(read_kitti, kitti_files),
    "ply": CameraFormat(None, ply_files),
    "glb": CameraFormat(None, glb_files),
}  # fmt: skip
COLMAP = ("colmap", "colmap-text")
KALIBR_TARGET = "kalibr-target"
READERS: Mapping[str, Callable[[Path], ForeignNetwork]] = {
    **{name: f.read for name, f in FORMATS.items() if f.read is not None},
    **dict.fromkeys(COLMAP, read_colmap),
    KALIBR_TARGET: read_kalibr,
}
WRITERS = (*FORMATS, *COLMAP, KALIBR_TARGET)
FOLDERS = (*(name for name, f in FORMATS.items() if f.folder), *COLMAP)
ENDINGS = {".cameramodel": "mrcal", ".urdf": "urdf", ".sdf": "sdf", ".ply": "ply", ".glb": "glb"}
_YAML = ("kalibr", KALIBR_TARGET, "opencv", "ros", "ros-industrial", "mc-calib")
AMBIGUOUS: Mapping[str, tuple[str, ...]] = {
    ".yaml": _YAML,
    ".yml": _YAML,
    ".txt": ("tum", "kitti", "colmap-text"),
    ".bin": ("colmap",),
    ".json": ("opencv", "nerf", "json"),
}


def write_cameras(
    values: CameraValues, target: Path, format: str, station: str | None
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Write a survey in a camera format at ``target``, which must be new; counts and notes for people.

    None of them holds a clock of its own for every camera.
    """
    counts, notes = _written(values, target, format, station)
    clocks = (f"{clock_text(name)}: its clock ({', '.join(clock.parameters.names) or 'jitter'}) is not written: poses "
              "are those at the epochs" for name, clock in clocks_of(values.survey))  # fmt: skip
    return counts, (*notes, *clocks)


def _written(
    values: CameraValues, target: Path, format: str, station: str | None
) -> tuple[dict[str, int], tuple[str, ...]]:
    if format in COLMAP:
        with whole_folder(target) as place:
            return write_colmap(values, place, text=format == "colmap-text")
    if format == KALIBR_TARGET:
        files, notes = _target_files(values)
    elif format == "opencv" and target.suffix.lower() == ".json":
        found = rig_values(values, station, format, opencv.CHOICES)
        files, notes = opencv_files(found, json=True), found.notes
    else:
        files, notes = FORMATS[format].write(values, station)
    if "" in files:
        atomic_write(target, files[""])
        return {"files": 1, "cameras": len(values.survey.cameras)}, notes
    with whole_folder(target) as place:
        for name, content in files.items():
            atomic_write(place / name, content)
    return {"files": len(files), "cameras": len(values.survey.cameras)}, notes


def _target_files(values: CameraValues) -> Files:
    if len(values.kinds) != 1:
        found = ", ".join(values.kinds) or "none"
        raise SurveyError(f"a target file of Kalibr holds one target; the project has {found}")
    return {"": target_text(next(iter(values.kinds.values())))}, ()
