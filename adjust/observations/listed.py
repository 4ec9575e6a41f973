"""What a report needs to know of a factor that is not an image batch."""

from dataclasses import dataclass

import gtsam

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
