"""What a capture session leaves in a project's folder besides images and observations.

``capture/status.json``: how far it is. ``capture/quality.jsonl``: a line for every image, with the targets seen in it.
Both may come from anywhere: what is not as a session writes it is not taken.
"""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.folder.shapes import NUMBER, WHOLE, Each, Either, misfit
from survey.folder.text import id_problem

CAPTURE_FOLDER = "capture"
_SIZE = 2**16  # px; larger sensors there are none


def is_size(value: object) -> bool:
    """Whether a value can be the width or height of an image."""
    return WHOLE(value) and 0 < value < _SIZE


def is_id(value: object) -> bool:
    """Whether a value can be an id."""
    return isinstance(value, str) and id_problem(value) is None


def _is_uv(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(NUMBER, value))


LOCATION = {"readback_deg": [NUMBER], "setpoint_deg": [Either((NUMBER, None))]}
_STATUS = {
    "state": str, "message?": str, "done?": WHOLE, "total?": WHOLE, "seconds_left?": NUMBER, "epoch_id?": is_id,
    "after?": LOCATION, "images?": Each(str, is_id), "quality?": Each(dict),
}  # fmt: skip
_ROW = {"camera_id": is_id, "epoch_id": is_id, "width": is_size, "height": is_size, "points": Each([_is_uv])}


def status_path(folder: Path) -> Path:
    """Where a session says how far it is."""
    return folder / CAPTURE_FOLDER / "status.json"


def quality_path(folder: Path) -> Path:
    """Where the qualities of a project's images are."""
    return folder / CAPTURE_FOLDER / "quality.jsonl"


@frozen
class Coverage:
    """Which cells of a camera's image have had a target point so far; ``cells`` across and down."""

    image_size: tuple[int, int]
    cells: tuple[int, int] = (10, 8)
    hit: frozenset[tuple[int, int]] = frozenset()

    def with_points(self, uv: FloatArray) -> "Coverage":
        """The coverage with the cells of image points (n, 2) px; points outside the image count for none."""
        size, cells = np.array(self.image_size, float), np.array(self.cells, float)
        columns_rows = np.floor((np.asarray(uv, float).reshape(-1, 2) + 0.5) / size * cells).astype(int)
        inside = np.all((columns_rows >= 0) & (columns_rows < cells), axis=1)
        return replace(self, hit=self.hit | {(int(i), int(j)) for i, j in columns_rows[inside]})

    @property
    def share(self) -> float:
        """Covered share of the cells, 0 to 1."""
        return len(self.hit) / (self.cells[0] * self.cells[1])


class Qualities:
    """The lines of ``capture/quality.jsonl``; only what was added since is read again.

    rows: by camera and epoch, the last of each image. coverage: of every camera, by the target points of its images.
    """

    def __init__(self, folder: Path) -> None:
        self.rows: dict[tuple[str, str], dict[str, Any]] = {}
        self.coverage: dict[str, Coverage] = {}
        self._path, self._file, self._at = quality_path(folder), 0, 0

    def read(self) -> None:
        """What there is now: all lines that are whole."""
        try:
            with self._path.open("rb") as stream:
                status = os.fstat(stream.fileno())
                if status.st_ino != self._file or status.st_size < self._at:
                    self.rows, self.coverage, self._file, self._at = {}, {}, status.st_ino, 0
                stream.seek(self._at)
                added = stream.read()
        except OSError:
            return
        whole = added[: added.rfind(b"\n") + 1]
        self._at += len(whole)
        for line in whole.split(b"\n"):
            with suppress(ValueError, RecursionError):
                row = json.loads(line)
                if misfit(row, _ROW) is None:
                    self._add(row)

    def _add(self, row: dict[str, Any]) -> None:
        key = row["camera_id"], row["epoch_id"]
        again = key in self.rows
        self.rows[key] = row
        if again:  # what was seen in the image of before counts no more
            self.coverage.pop(key[0], None)
        for one in [r for k, r in self.rows.items() if k[0] == key[0]] if again else [row]:
            covered = self.coverage.get(key[0], Coverage((one["width"], one["height"])))
            self.coverage[key[0]] = covered.with_points(points_of(one))


def points_of(row: Mapping[str, Any]) -> FloatArray:
    """The target points (n, 2) px of a line."""
    return np.concatenate([np.zeros((0, 2)), *(np.array(uv, float).reshape(-1, 2) for uv in row["points"].values())])


def session_status(folder: Path) -> dict[str, Any]:
    """What a session says of itself in ``capture/status.json``; nothing where it says what no session says."""
    with suppress(OSError, ValueError, RecursionError):
        said = json.loads(status_path(folder).read_text(encoding="utf-8"))
        return dict(said) if misfit(said, _STATUS) is None else {}
    return {}
