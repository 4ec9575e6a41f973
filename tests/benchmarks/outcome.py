"""What a competitor gives."""

from collections.abc import Callable
from dataclasses import dataclass, field

from adjust.model.survey import FloatArray


@dataclass(frozen=True, eq=False)
class Outcome:
    """stages: seconds by name, whose sum is what counts. solution: arrays. numbers: what else is to be compared.

    A competitor that works in processes of its own gives their processor time and size in numbers, as ``child_cpu``
    (s) and ``child_mb``.
    """

    stages: dict[str, float]
    solution: dict[str, FloatArray]
    note: str = ""
    numbers: dict[str, float] = field(default_factory=dict)


Competitor = Callable[[], Outcome]
