"""What a report needs to know of a factor that is not an image batch."""

from dataclasses import dataclass

import gtsam

from adjust.model.observations import FrameRef, PositionRef
from adjust.model.survey import FloatArray


@dataclass(frozen=True, eq=False)
class ObservationFactor:
    """A factor that is not an image batch, with what a report needs to know of it. ``observed``: (k,)."""

    factor: gtsam.NonlinearFactor
    kind: str
    group: str
    ids: tuple[str, ...]
    components: tuple[str, ...]
    units: tuple[str, ...]
    observed: FloatArray
    used: bool = True


def frame_text(ref: FrameRef) -> str:
    """``kind:id@epoch``, as in the tables of the project folder."""
    return f"{ref.kind}:{ref.frame_id}" + (f"@{ref.epoch_id}" if ref.epoch_id else "")


def position_text(ref: PositionRef) -> str:
    """A position as people write it."""
    if ref.frame is None:
        return str(ref.point_id)
    return frame_text(ref.frame) + (f"/{ref.point_id}" if ref.point_id else "")
