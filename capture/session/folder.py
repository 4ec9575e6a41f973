"""The project folder that a session fills, and the lock that keeps it for one session.

images/<camera_id>/<epoch_id>.png; observations/table_angles.csv with the readbacks, from the journal; survey.toml,
copied from the plan's template where there is none yet; capture/journal.jsonl, status.json, lock.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from capture.devices.camera import GrayImage
from capture.session.journal import Record
from survey.folder.locking import SESSION_LOCK, FileLock
from survey.folder.text import atomic_write, csv_rows, read_text
from survey.project.captured import CAPTURE_FOLDER
from survey.project.project import DEFINITION_FILE, IMAGES_FOLDER, OBSERVATIONS_FOLDER
from survey.project.tables.files import write_table

_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # lossless at any level; this one is fast


def journal_path(folder: Path) -> Path:
    """Where the journal of a project is."""
    return folder / CAPTURE_FOLDER / "journal.jsonl"


def session_lock(folder: Path) -> FileLock:
    """What keeps a folder for one session; see :func:`survey.folder.locking.FileLock`."""
    path = folder / SESSION_LOCK
    path.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(path, folder, "session")


def write_image(folder: Path, camera_id: str, epoch_id: str, image: GrayImage) -> dict[str, Any]:
    """Write an image losslessly; on return it is on disk. What the journal says of it. Raises OSError."""
    is_encoded, png = cv2.imencode(".png", image, list(_PNG))
    if not is_encoded:
        raise ValueError(f"image of {camera_id} at {epoch_id}: {image.dtype} {image.shape} is no grey image")
    data = png.tobytes()
    path = folder / IMAGES_FOLDER / camera_id / f"{epoch_id}.png"
    atomic_write(path, data, lasting=True)
    return {
        "path": path.relative_to(folder).as_posix(),
        "sha256": hashlib.sha256(data).hexdigest(),
        "bytes": len(data),
        "width": image.shape[1],
        "height": image.shape[0],
    }


def damaged(folder: Path, record: Record) -> str | None:
    """What is wrong with the images of a recorded set; None where every hash is right."""
    for camera_id, image in record["images"].items():
        path = folder / image["path"]
        if not path.is_file():
            return f"{camera_id}: {path} is missing"
        if hashlib.sha256(path.read_bytes()).hexdigest() != image["sha256"]:
            return f"{camera_id}: {path} has changed since it was recorded"
    return None


def remove_unrecorded(folder: Path, camera_ids: list[str], epoch_ids: set[str]) -> list[str]:
    """Delete what a crash left: half-written files, and images of planned epochs that no journal line vouches for."""
    removed = []
    for camera_id in camera_ids:
        images = folder / IMAGES_FOLDER / camera_id
        if not images.is_dir():
            continue
        for path in images.iterdir():
            is_half = path.name.startswith(".") and ".png." in path.name and path.name.endswith(".tmp")
            if is_half or (path.suffix == ".png" and path.stem in epoch_ids):
                path.unlink()
                removed.append(path.relative_to(folder).as_posix())
    return sorted(removed)


def prepare(folder: Path, template: Path | None) -> None:
    """The folder, with the survey.toml of the plan where it has none yet."""
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / DEFINITION_FILE
    if template is not None and not target.exists():
        atomic_write(target, template.read_bytes())


def write_table_angles(folder: Path, table_id: str, sets: Mapping[str, Record], sigma: FloatArray | None) -> Path:
    """``observations/table_angles.csv`` from the journal: the mean of the readbacks before and after each set.

    sigma: (n,) rad of one reading, None where survey.toml gives it. Rows of epochs that the journal does not know are
    kept: they were there before.
    """
    columns = ["epoch_id", "table_id", "axis1_deg", "axis2_deg"]
    names = [] if sigma is None else [f"sigma_axis{i + 1}_arcsec" for i in range(len(sigma))]
    rows = [row for row in _foreign_rows(folder) if row["epoch_id"] not in sets]
    known = [*columns, *names]
    known += [name for row in rows for name in row if name not in known]
    for epoch_id, record in sets.items():
        both = np.array([record["before"]["readback_deg"], record["after"]["readback_deg"]])
        row = {"epoch_id": epoch_id, "table_id": table_id}
        row |= {f"axis{i + 1}_deg": repr(round(float(angle), 9)) for i, angle in enumerate(both.mean(axis=0))}
        if sigma is not None:
            arcsec = np.degrees(sigma) * 3600
            row |= {name: repr(round(float(value), 9)) for name, value in zip(names, arcsec, strict=True)}
        rows.append(row)
    if not any(row.get("axis2_deg") for row in rows):
        known.remove("axis2_deg")
    known = list(dict.fromkeys(known))
    table = {name: [row.get(name) or "" for row in rows] for name in known}
    return write_table(folder / OBSERVATIONS_FOLDER, "table_angles", table)


def _foreign_rows(folder: Path) -> list[dict[str, str]]:
    path = folder / OBSERVATIONS_FOLDER / "table_angles.csv"
    if not path.is_file():
        return []
    lines = csv_rows(path, read_text(path))
    _, header = next(lines, (1, []))
    rows = []
    for line, cells in lines:
        row = dict(zip(header, cells, strict=False))
        if len(cells) != len(header) or not row.get("epoch_id"):
            raise SurveyError(f"{path}:{line}: not as long as its header, or without an epoch_id; correct the table")
        rows.append(row)
    return rows
