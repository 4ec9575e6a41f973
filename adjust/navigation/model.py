"""What navigation works with and what it gives back, as frozen values.

The head is a station that carries calibrated cameras; ``world_from_station`` is its pose. Lengths are metres, angles
radians, images pixels. Covariances of poses are in GTSAM's tangent: rotation, then translation, in the station frame.
"""

from collections.abc import Mapping
from dataclasses import field
from typing import Literal

import numpy as np
from gtsam import Pose3

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray

Status = Literal["fixed", "bridged", "ambiguous", "undetermined", "none"]
Bridge = Literal["", "prior", "table", "motion"]
Labels = tuple[tuple[str | None, ...], ...]
"""One tuple per ``NavigationEpoch.spots``: the beacon of each spot or None."""


@frozen(eq=False)
class HeadCamera:
    """A calibrated camera of the head: ``lens`` (n,) and ``constants`` (4,) as ``adjust.lenses.models`` has them."""

    camera_id: str
    image_size: tuple[int, int]
    model: str
    lens: FloatArray
    constants: FloatArray
    station_from_camera: Pose3


@frozen(eq=False)
class HeadTable:
    """A calibrated turntable that carries the head; with its geometry by name (:class:`adjust.model.survey.Table`)."""

    axes: tuple[str, ...]
    world_from_table: Pose3
    geometry: Mapping[str, float]
    mount_from_station: Pose3


@frozen(eq=False)
class Head:
    """The calibrated head.

    cov: joint covariance (p, p) of the calibration: camera after camera its lens (n,) and ``station_from_camera`` (6),
    then, where there is a table, ``world_from_table`` (6), its geometry in its order and ``mount_from_station`` (6).
    """

    cameras: tuple[HeadCamera, ...]
    cov: FloatArray
    table: HeadTable | None = None


@frozen(eq=False)
class Beacons:
    """Known beacons: m names, ``x_in_world`` (m, 3) m and their joint covariance (3m, 3m) m^2.

    cross_cov: (p, 3m) with the calibration of the head, where both come from one adjustment.
    """

    beacon_ids: tuple[str, ...]
    x_in_world: FloatArray
    cov: FloatArray
    cross_cov: FloatArray | None = None


@frozen(eq=False)
class Spots:
    """Spots of one camera: uv (n, 2) px, cov (n, 2, 2) px^2; beacon_ids where they are known, None where not."""

    camera_id: str
    uv: FloatArray
    cov: FloatArray
    beacon_ids: tuple[str | None, ...] | None = None


@frozen(eq=False)
class PosePrior:
    """What is known of a pose beforehand; ``np.inf`` on the diagonal of cov (6, 6): nothing of that component."""

    world_from_station: Pose3
    cov: FloatArray


@frozen(eq=False)
class NavigationEpoch:
    """What was observed at one epoch.

    time_s: None where epochs are a second apart. table_angles (k,) rad with table_cov (k, k), where they were read.
    """

    epoch_id: str
    spots: tuple[Spots, ...]
    time_s: float | None = None
    table_angles: FloatArray | None = None
    table_cov: FloatArray | None = None
    prior: PosePrior | None = None


@frozen
class Motion:
    """Constant velocity between epochs.

    White accelerations of these densities (rad/s and m/s per root second), and the sigmas of the rates at the start.
    """

    sigma_angular_acceleration: float = 0.05
    sigma_acceleration: float = 0.05
    sigma_angular_rate: float = 0.5
    sigma_speed: float = 0.5


@frozen
class NavigateOptions:
    """How poses are found.

    motion: bridges and identifies by constant velocity; None: every epoch stands alone. use_table: whether table
    angles identify and bridge.
    alpha: level of the outlier test of an epoch.
    """

    motion: Motion | None = field(default_factory=Motion)
    use_table: bool = True
    alpha: float = 1e-3


@frozen(eq=False)
class Shares:
    """The covariance (6, 6) of a pose by where it comes from; ``correlation`` between beacons and calibration."""

    spots: FloatArray
    beacons: FloatArray
    calibration: FloatArray
    prior: FloatArray
    correlation: FloatArray


@frozen(eq=False)
class Solution:
    """One pose that explains an epoch.

    score: -2 ln of its evidence; differences are what the test of solutions against each other uses.
    """

    world_from_station: Pose3
    cov: FloatArray
    labels: Labels
    chi_square: float
    redundancy: int
    score: float
    probability: float


@frozen(eq=False)
class EpochPose:
    """The pose of one epoch and how far it can be trusted.

    status: ``fixed`` by its own spots alone; ``bridged`` with the help of ``bridge``; ``ambiguous``: the best of
    several solutions that cannot be told apart, all in ``alternatives`` (where not all could be listed,
    ``undetermined`` says so); ``undetermined``: some directions are open, named in ``undetermined`` (their variances
    are infinite); ``none``: nothing is known (no pose).
    labels: None for a false spot or one that was rejected.
    rejected: (camera, spot) that had a beacon and failed the outlier test.
    """

    epoch_id: str
    status: Status
    bridge: Bridge
    world_from_station: Pose3 | None
    cov: FloatArray
    labels: Labels
    rejected: tuple[tuple[str, int], ...] = ()
    chi_square: float = float("nan")
    redundancy: int = 0
    probability: float = 1.0
    shares: Shares | None = None
    alternatives: tuple[Solution, ...] = ()
    undetermined: tuple[str, ...] = ()

    @property
    def n_beacons(self) -> int:
        """Number of different beacons that were used."""
        return len({b for labels in self.labels for b in labels if b is not None})

    @property
    def sigmas(self) -> FloatArray:
        """(6,) rad and m, in the station frame; infinite where open."""
        return np.asarray(np.sqrt(np.diag(self.cov)))


@frozen(eq=False)
class Trajectory:
    """The poses of a sequence. Errors of beacons and calibration are common to all epochs and do not average out."""

    epochs: tuple[EpochPose, ...]

    def count(self, status: Status) -> int:
        """Number of epochs of that status."""
        return sum(e.status == status for e in self.epochs)
