"""What a journal must hold before anything is done by it: its folder may come from anywhere.

Paths are those that this program writes, so that no image outside of the project is read or vouched for.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from survey.folder.shapes import NUMBER, WHOLE, Each, Either, misfit
from survey.project.captured import LOCATION, is_id, is_size
from survey.project.project import IMAGES_FOLDER


def _is_time(value: object) -> bool:
    """Since 1970 in ns, in years of four digits."""
    return bool(WHOLE(value) and value >= 0)


_IMAGE = {
    "path": str, "sha256": str, "width": is_size, "height": is_size, "bits": WHOLE, "block_id": WHOLE,
    "host_time_ns": WHOLE, "features": Each(Either((bool, NUMBER, str))),
}  # fmt: skip
_SET = {
    "epoch_id": is_id, "pose_id": str,
    "planned_deg": [NUMBER], "before": LOCATION, "after": LOCATION, "time_ns": _is_time, "monotonic_ns": WHOLE,
    "images": Each(_IMAGE, is_id),
}  # fmt: skip
_SESSION = {
    "table": Either((None, {"table_id": str, "axes": [str]})), "cameras": Each(dict), "time_ns": _is_time,
}  # fmt: skip


def require_recorded(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Raise SurveyError with the line of the first record that no session has written."""
    for line, record in enumerate(records, 1):
        said = None
        if record["kind"] == "session":
            said = misfit(record, _SESSION)
        elif record["kind"] == "set":
            said = misfit(record, _SET) or _set_problem(record)
        if said is not None:
            raise SurveyError(f"{path}:{line}: not as a session writes it ({said}); restore the file from a copy, or "
                              "cut this line and all after it to take those epochs again")  # fmt: skip


def _set_problem(record: Mapping[str, Any]) -> str | None:
    if not record["images"]:
        return "images: none"
    for camera_id, image in record["images"].items():
        if image["path"] != f"{IMAGES_FOLDER}/{camera_id}/{record['epoch_id']}.png":
            return f"images.{camera_id}.path: {image['path'][:60]!r}"
    sizes = {len(record[side][key]) for side in ("before", "after") for key in LOCATION}
    return None if sizes == {len(record["planned_deg"])} else "before, after: another number of axes than planned_deg"
