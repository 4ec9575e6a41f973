"""A recorded run as one NeXus/HDF5 file: images, setpoints, readbacks, times, in the classes of the NeXus standard.

/entry:NXentry has instrument:NXinstrument with one NXdetector a camera and one NXpositioner an axis, sample frames in
the order in which they were taken, and data:NXdata that points to the first detector.
"""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.errors import SurveyError
from capture.session.folder import damaged, journal_path
from capture.session.journal import Record, read_journal, taken_sets
from capture.session.recorded import require_recorded
from survey.detection.gray import read_image
from survey.folder.extras import library


def export(folder: Path, file: Path) -> dict[str, Any]:
    """Write the recorded epochs of a project to a new file; counts. Raises SurveyError."""
    h5py = library("h5py", "nexus", "NeXus files need h5py")
    folder, file = Path(folder), Path(file)
    if file.exists():
        raise SurveyError(f"{file}: it exists already; name a new file, or remove it")
    records, _, _ = read_journal(journal_path(folder))
    require_recorded(journal_path(folder), records)
    sets = taken_sets(records)
    if not sets:
        raise SurveyError(f"{folder}: nothing is recorded there; run a plan first: labcapture run PLAN")
    for epoch_id, record in sets.items():
        problem = damaged(folder, record)
        if problem is not None:
            raise SurveyError(f"{folder}: {epoch_id}: {problem}; run the plan again, it takes what is damaged anew")
    started = _start_of(folder, records, list(sets.values()))
    temporary = file.with_name(f".{file.name}.tmp")
    try:
        with h5py.File(temporary, "w") as root:
            n_images = _write(root, folder, started, list(sets.values()))
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)
    return {"file": str(file), "epochs": len(sets), "images": n_images}


def _start_of(folder: Path, records: Sequence[Record], sets: Sequence[Record]) -> Record:
    """The last start of a session. Raises SurveyError where not all sets are of its cameras and axes."""
    started = next((record for record in reversed(records) if record["kind"] == "session"), None)
    if started is None:
        raise SurveyError(f"{journal_path(folder)}: no start of a session is in it; restore the file from a copy")
    axes = [] if started["table"] is None else started["table"]["axes"]
    first = sets[0]["images"]
    for record in sets:
        sizes = {c: (i["height"], i["width"], i["bits"] > 8) for c, i in record["images"].items()}
        same = sizes == {c: (i["height"], i["width"], i["bits"] > 8) for c, i in first.items()}
        if not same or len(record["planned_deg"]) != len(axes):
            raise SurveyError(f"{folder}: {record['epoch_id']} has other cameras, images or axes than the rest; a file "
                              "holds one kind of session: export a folder for each")  # fmt: skip
    return started


def _group(parent: Any, name: str, kind: str) -> Any:
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    return group


def _put(group: Any, name: str, value: Any, units: str = "") -> None:
    group[name] = value
    if units:
        group[name].attrs["units"] = units


def _write(root: Any, folder: Path, started: Record, sets: Sequence[Record]) -> int:
    root.attrs["default"] = "entry"
    entry = _group(root, "entry", "NXentry")
    entry.attrs["default"] = "data"
    _put(entry, "title", folder.resolve().name)
    times = [record["time_ns"] for record in sets]
    _put(entry, "start_time", _iso(times[0]))
    _put(entry, "end_time", _iso(times[-1]))
    _put(entry, "epoch_id", [record["epoch_id"] for record in sets])
    _put(entry, "pose_id", [record["pose_id"] for record in sets])
    _put(entry, "time_ns", np.array(times, np.int64), "ns")
    _put(entry, "monotonic_ns", np.array([record["monotonic_ns"] for record in sets], np.int64), "ns")
    instrument = _group(entry, "instrument", "NXinstrument")
    if started["table"] is not None:
        _write_axes(instrument, started["table"], sets)
    camera_ids = list(sets[0]["images"])
    for camera_id in camera_ids:
        _write_detector(instrument, folder, camera_id, started["cameras"].get(camera_id, {}), sets)
    data = _group(entry, "data", "NXdata")
    data.attrs["signal"] = "data"
    data["data"] = instrument[camera_ids[0]]["data"]
    return len(camera_ids) * len(sets)


def _iso(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat()


def _write_axes(instrument: Any, table: Mapping[str, Any], sets: Sequence[Record]) -> None:
    for i, name in enumerate(table["axes"]):
        axis = _group(instrument, f"{table['table_id']}_{name}", "NXpositioner")
        _put(axis, "name", name)
        both = np.array([[record[side]["readback_deg"][i] for side in ("before", "after")] for record in sets])
        _put(axis, "value", both.mean(axis=1), "deg")
        _put(axis, "value_before", both[:, 0], "deg")
        _put(axis, "value_after", both[:, 1], "deg")
        targets = [record["before"]["setpoint_deg"][i] for record in sets]
        _put(axis, "target_value", np.array([np.nan if t is None else t for t in targets], float), "deg")


def _write_detector(
    instrument: Any, folder: Path, camera_id: str, description: Mapping[str, Any], sets: Sequence[Record]
) -> None:
    detector = _group(instrument, camera_id, "NXdetector")
    for name in ("address", "serial"):
        _put(detector, {"address": "description", "serial": "serial_number"}[name], str(description.get(name, "")))
    images = [record["images"][camera_id] for record in sets]
    first = images[0]
    shape = (len(images), first["height"], first["width"])
    stack = detector.create_dataset(
        "data",
        shape,
        dtype=np.uint8 if first["bits"] <= 8 else np.uint16,
        chunks=(1, *shape[1:]),
        compression="gzip",
        compression_opts=1,
    )
    stack.attrs["interpretation"] = "image"
    for i, image in enumerate(images):
        pixels = read_image(folder / image["path"])
        if pixels.shape != shape[1:]:
            raise SurveyError(f"{folder / image['path']}: not an image of {shape[2]} x {shape[1]} px as the others")
        stack[i] = pixels
    exposures = [image["features"].get("ExposureTime", np.nan) for image in images]
    _put(detector, "count_time", np.array(exposures, float) / 1e6, "s")
    _put(detector, "frame_id", np.array([image["block_id"] for image in images], np.int64))
    _put(detector, "host_time_ns", np.array([image["host_time_ns"] for image in images], np.int64), "ns")
    _put(detector, "sha256", [image["sha256"] for image in images])
