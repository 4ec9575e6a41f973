"""What is told of a survey before it is adjusted."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """One thing to mend or to measure. level: ``problem`` spoils or stops the adjustment, ``weak`` weakens it.

    kind: short and constant, for programs. ids: what it concerns. found: what is the matter. remedy: what to do.
    """

    level: Literal["problem", "weak"]
    kind: str
    ids: tuple[str, ...]
    found: str
    remedy: str
