"""The calibration that navigation works with, kept in ``results`` as long as what it came from is the same."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.lenses.models import MODELS
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.navigation import Beacons, Head, HeadCamera, HeadTable
from survey.folder.arrays import packed_arrays, read_arrays
from survey.folder.shapes import POSITIVE, WHOLE, Either, misfit
from survey.folder.text import NOT_OURS
from survey.project import atomic_write


@frozen(eq=False)
class Calibration:
    """Head and beacons of an adjustment without the navigated epochs.

    sigma0: None without redundancy. reused: read from a file, not adjusted anew. helped_by: epochs that were not asked
    for and calibrate all the same. causes: of what contradicts in it, for people; such a one is not kept.
    """

    head: Head
    beacons: Beacons
    sigma0: float | None
    reused: bool = False
    helped_by: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()


def digest(*values: object) -> str:
    """A hash of frozen values down to the last bit of every array; the same for the same survey, read anew."""
    sha = hashlib.sha256()
    for value in values:
        _feed(sha.update, value)
    return sha.hexdigest()


def _feed(update: Callable[[bytes], None], value: object) -> None:
    if isinstance(value, Pose3):
        value = value.matrix()
    if isinstance(value, np.ndarray):
        update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value):
        update(type(value).__name__.encode())
        for field in fields(value):
            update(field.name.encode())
            _feed(update, getattr(value, field.name))
    elif isinstance(value, dict):
        _feed(update, sorted(value.items()))
    elif isinstance(value, list | tuple | set | frozenset):
        update(f"{type(value).__name__}{len(value)}".encode())
        for item in sorted(value) if isinstance(value, set | frozenset) else value:
            _feed(update, item)
    else:
        update(repr(value).encode() + b";")


def kept(path: Path, key: str) -> Calibration | None:
    """The calibration in a file, None where there is none, it cannot be read, or its key is another."""
    try:
        arrays = read_arrays(path)
        about = json.loads(str(arrays.pop("about")))
        if _problem(about, arrays) is not None or about["key"] != key:
            return None
        return _restored(about, arrays)
    except NOT_OURS:
        return None  # whatever is wrong with the file, the calibration is only made anew


def keep(path: Path, key: str, calibration: Calibration) -> None:
    """Write a calibration, whole or not at all."""
    head, beacons = calibration.head, calibration.beacons
    table = head.table
    about = {
        "key": key,
        "sigma0": calibration.sigma0,
        "beacon_ids": beacons.beacon_ids,
        "cameras": [
            {"camera_id": c.camera_id, "image_size": c.image_size, "model": c.model} for c in head.cameras
        ],
        "axes": None if table is None else table.axes,
        "geometry": [] if table is None else list(table.geometry),
    }  # fmt: skip
    arrays: dict[str, FloatArray] = {"cov": head.cov, "x": beacons.x_in_world, "cov_x": beacons.cov}
    if beacons.cross_cov is not None:
        arrays["cross"] = beacons.cross_cov
    for i, c in enumerate(head.cameras):
        arrays |= {f"lens{i}": c.lens, f"constants{i}": c.constants, f"pose{i}": c.station_from_camera.matrix()}
    if table is not None:
        arrays |= {"base": table.world_from_table.matrix(), "mount": table.mount_from_station.matrix(),
                   "geometry": np.array(list(table.geometry.values()), dtype=float)}  # fmt: skip
    atomic_write(path, packed_arrays(about=np.array(json.dumps(about)), **arrays))


_ABOUT = {
    "key": str, "sigma0": Either((POSITIVE, None)), "beacon_ids": [str], "axes": Either(([str], None)),
    "geometry": [str],
    "cameras": [{"camera_id": str, "image_size": [WHOLE], "model": lambda name: name in MODELS}],
}  # fmt: skip


def _problem(about: Any, arrays: dict[str, FloatArray]) -> str | None:
    """Why these are no calibration that this program has kept."""
    if (said := misfit(about, _ABOUT)) is not None:
        return said
    shapes: dict[str, tuple[int, ...]] = {}
    p, n = 0, 3 * len(about["beacon_ids"])
    for i, camera in enumerate(about["cameras"]):
        if len(camera["image_size"]) != 2:
            return "image_size"
        lens = len(MODELS[camera["model"]].names)
        shapes |= {f"lens{i}": (lens,), f"constants{i}": (4,), f"pose{i}": (4, 4)}
        p += lens + 6
    if about["axes"] is not None:
        shapes |= {"base": (4, 4), "mount": (4, 4), "geometry": (len(about["geometry"]),)}
        p += 12 + len(about["geometry"])
    shapes |= {"cov": (p, p), "x": (n // 3, 3), "cov_x": (n, n)} | ({"cross": (p, n)} if "cross" in arrays else {})
    fits = (k in arrays and arrays[k].shape == shape and arrays[k].dtype == float for k, shape in shapes.items())
    return None if all(fits) else "an array has not the size that its cameras and beacons say"


def _restored(about: dict[str, Any], arrays: dict[str, FloatArray]) -> Calibration:
    cameras = tuple(
        HeadCamera(
            c["camera_id"], (c["image_size"][0], c["image_size"][1]), c["model"], arrays[f"lens{i}"],
            arrays[f"constants{i}"], Pose3(arrays[f"pose{i}"]),
        )
        for i, c in enumerate(about["cameras"])
    )  # fmt: skip
    table = None
    if about["axes"] is not None:
        geometry = dict(zip(about["geometry"], arrays["geometry"].tolist(), strict=True))
        table = HeadTable(tuple(about["axes"]), Pose3(arrays["base"]), geometry, Pose3(arrays["mount"]))
    beacons = Beacons(tuple(about["beacon_ids"]), arrays["x"], arrays["cov_x"], arrays.get("cross"))
    return Calibration(Head(cameras, arrays["cov"], table), beacons, about["sigma0"], True)
