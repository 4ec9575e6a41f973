"""What a session finds when it starts in a folder: which epochs are recorded and whole."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from capture.plan.plan import CapturePlan, Shot
from capture.session.folder import damaged, journal_path
from capture.session.journal import Journal, Record, clocks, read_journal
from capture.session.recorded import require_recorded

_SAME = np.radians(1e-7)  # rad; two planned angles that differ by less are the same pose


def verified_sets(plan: CapturePlan, journal: Journal, note: Callable[[str], None]) -> dict[str, Record]:
    """Recorded epochs whose images are there with the right hash; the others are struck off in the journal.

    Raises SurveyError for a damaged journal, and where the plan now wants another pose under the name of one in it.
    """
    require_recorded(journal.path, journal.records)
    planned = {shot.epoch_id: shot for shot in plan.shots}
    camera_ids = {camera.camera_id for camera in plan.cameras}
    valid = {}
    for epoch_id, record in journal.taken().items():
        shot = planned.get(epoch_id)
        if shot is not None:
            _require_same(plan, shot, record, camera_ids)
        problem = damaged(plan.project, record)
        if problem is None:
            valid[epoch_id] = record
            continue
        note(f"{epoch_id}: {problem}; it is taken again")
        journal.append("lost", epoch_id=epoch_id, message=problem, **clocks())
    return valid


def _require_same(plan: CapturePlan, shot: Shot, record: Record, camera_ids: set[str]) -> None:
    was: FloatArray = np.radians(record["planned_deg"])
    if was.shape != shot.angles.shape or (np.abs(was - shot.angles) > _SAME).any():
        raise SurveyError(
            f"{plan.file}: {shot.epoch_id} is at {np.degrees(shot.angles).tolist()} deg now, but {plan.project} holds "
            f"it at {record['planned_deg']} deg; name another project, or put the pose back"
        )
    if set(record["images"]) != camera_ids:
        raise SurveyError(
            f"{plan.file}: {shot.epoch_id} was taken with the cameras {', '.join(sorted(record['images']))}, the plan "
            f"now names {', '.join(sorted(camera_ids))}; name another project"
        )


def last_readback(folder: Path) -> FloatArray | None:
    """(n,) rad: where the table was at the last recorded set, for readbacks that lose turns."""
    records = read_journal(journal_path(folder))[0]
    require_recorded(journal_path(folder), records)
    sets = [record for record in records if record["kind"] == "set"]
    return np.radians(sets[-1]["after"]["readback_deg"]) if sets else None
