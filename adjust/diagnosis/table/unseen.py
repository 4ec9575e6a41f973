"""Table readings at epochs at which nothing else was observed: often the name of an epoch that is mistyped."""

from collections.abc import Iterator
from difflib import get_close_matches
from typing import Any

from adjust.diagnosis.hypothesis import Finding
from adjust.model.errors import listed
from adjust.model.observations import FrameRef, PositionRef
from adjust.model.survey import Survey


def unseen_readings(survey: Survey, misspelt: bool = False) -> Iterator[Finding]:
    """All of them as one, with the nearest name of an epoch that has images of the table's cameras and no reading.

    misspelt: only where there is such a name; else nothing may have been in view.
    """
    read = {r.epoch_id for r in survey.table_readings}
    seen = {b.epoch_id for b in survey.image_blocks}
    others = {e for name, kind in survey.others.items() if name != "table_readings" for o in kind for e in _epochs(o)}
    alone = tuple(dict.fromkeys(r.epoch_id for r in survey.table_readings if r.epoch_id not in seen | others))
    if not alone or not seen | others:
        return
    mounted = {s.station_id for s in survey.stations if s.motion == "table"}
    cameras = {c.camera_id for c in survey.cameras if c.station_id in mounted}
    waiting = sorted({b.epoch_id for b in survey.image_blocks if b.camera_id in cameras} - read)
    near = (get_close_matches(e, waiting, 1) for e in alone[: len(waiting)])
    meant = "; ".join(f"for {e} perhaps {name}" for e, names in zip(alone, near, strict=False) for name in names)
    if misspelt and not meant:
        return
    yield Finding(
        "weak", "epochs without partners", alone,
        f"{len(alone)} of {len(read)} table readings without images of their epoch, or anything else: "
        f"{listed(alone, 6)}",
        "check the names of epochs in table_angles.csv and of the image files" + f" ({meant})" * bool(meant),
    )  # fmt: skip


def _epochs(o: Any) -> Iterator[str]:
    """Those that an observation of any kind names."""
    for name in o.__dataclass_fields__:
        value = getattr(o, name)
        for ref in value if isinstance(value, tuple) else (value,):
            frame = ref.frame if isinstance(ref, PositionRef) else ref
            if isinstance(frame, FrameRef) and frame.epoch_id:
                yield frame.epoch_id
