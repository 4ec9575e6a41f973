"""The formats of cameras, each started from what its own writer makes of a small head."""

import tempfile
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from tests.fuzz.reader import Read, Reader, in_file

_EPOCHS = ("e00", "e01")
_COLMAP_FILES = ("cameras", "rigs", "frames", "images", "points3D")
_POINTS = 4  # of each block: what a mutation costs grows with the file


@cache
def _samples() -> dict[str, dict[str, bytes]]:
    """The files of every format by name; a survey of two epochs and few points, projected by OpenCV."""
    from survey.interop.cameras.formats import COLMAP, FORMATS, READERS, write_cameras
    from survey.jobs.adjusting.job import adjust_job
    from survey.jobs.converting import adjusted_values
    from survey.project import read
    from tests.survey.camera_lab import write_lab

    out = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_lab(folder / "lab")
        adjust_job(folder / "lab", progress=False)
        values = adjusted_values(read(folder / "lab"))
        blocks = tuple(
            replace(b, point_idx=b.point_idx[:_POINTS], uv=b.uv[:_POINTS], cov=b.cov[:_POINTS], used=None)
            for b in values.survey.image_blocks if b.epoch_id in _EPOCHS
        )  # fmt: skip
        values = replace(values, survey=replace(values.survey, image_blocks=blocks))
        for format in (*READERS, "opencv-json"):
            target = folder / (f"{format}.json" if format == "opencv-json" else format)
            write_cameras(values, target, format.removesuffix("-json"), None)
            files = [target] if target.is_file() else sorted(p for p in target.iterdir() if p.is_file())
            out[format] = {p.name: p.read_bytes() for p in files}
        missing = {f for f in COLMAP for n in _COLMAP_FILES if not any(k.startswith(n) for k in out[f])}
        if missing or set(FORMATS) - {"ply", "glb"} - set(out):
            raise ValueError(f"formats without a sample: {missing}, {set(FORMATS) - set(out)}")
    return out


def _network(format: str, path: Path) -> object:
    from survey.interop.cameras.formats import READERS
    from survey.interop.networks.foreign import with_safe_ids

    return with_safe_ids(READERS[format.removesuffix("-json")](path).survey)


def _one(format: str) -> Reader:
    name = "net.json" if format in ("opencv-json", "nerf") else "net"
    return Reader(lambda: list(_samples()[format].values()), in_file(name, partial(_network, format)))


def _model(format: str, name: str, folder: Path) -> Read:
    """One file of a model of COLMAP, the others whole."""
    for other, data in _samples()[format].items():
        (folder / other).write_bytes(data)
    return in_file(name, lambda path: _network(format, path.parent))(folder)


def _colmap(format: str, ending: str) -> dict[str, Reader]:
    names = [f"{stem}.{ending}" for stem in _COLMAP_FILES]
    if ending == "txt":
        names += ["point_names.csv"]
    return {
        f"{format}-{Path(name).stem}": Reader(
            lambda name=name: [_samples()[format][name]], partial(_model, format, name), is_text=ending == "txt"
        )
        for name in names
    }


def _in_folder(format: str, name: str) -> Reader:
    """One file of a folder, which the format reads as a whole."""
    return Reader(lambda: [_samples()[format][name]], partial(_model, format, name))


_SINGLE = ("kalibr", "kalibr-target", "opencv", "opencv-json", "ros-industrial", "mrcal", "mc-calib", "nerf", "urdf",
           "sdf", "tum", "kitti")  # fmt: skip
CAMERA_READERS: dict[str, Reader] = {
    **{format: _one(format) for format in _SINGLE},
    "ros": Reader(lambda: [_samples()["ros"]["left.yaml"]], in_file("net", partial(_network, "ros"))),
    "ros-folder": _in_folder("ros", "extrinsics.yaml"),
    "mrcal-folder": _in_folder("mrcal", "left.cameramodel"),
    **_colmap("colmap", "bin"),
    **_colmap("colmap-text", "txt"),
}
