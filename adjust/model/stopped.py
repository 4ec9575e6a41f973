"""Where an adjustment stopped that found no minimum."""


from gtsam import Pose3

from adjust.model.arrays import FloatArray
from adjust.model.frozen import frozen


@frozen
class GroupFit:
    """A group of n observations: root mean square over sigmas at the start and where it stopped; its worst owners."""

    group: str
    n: int
    at_start: float
    where_stopped: float
    worst: tuple[tuple[str, float], ...]


@frozen
class Pull:
    """What the gradient of v'Pv asks of the unknowns of a kind: how many of its own sigmas each would go by itself.

    largest: the unknown that is pulled most, and by how much; rms: over all n components.
    """

    kind: str
    n: int
    rms: float
    largest: tuple[str, float]


@frozen(eq=False)
class UnknownState:
    """An unknown at the start and where it stopped: a Pose3, or (n,) free components in ``units``."""

    name: tuple[str, ...]
    components: tuple[str, ...]
    units: tuple[str, ...]
    start: Pose3 | FloatArray
    value: Pose3 | FloatArray


@frozen(eq=False)
class Stopped:
    """Where an adjustment stopped that found no minimum. last_step: of any unknown, in its sigmas."""

    iterations: int
    omega: float
    last_step: float
    groups: tuple[GroupFit, ...]
    gradient: tuple[Pull, ...]
    unknowns: tuple[UnknownState, ...]
