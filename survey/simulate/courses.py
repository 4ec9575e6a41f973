"""Where moving things truly are between the epochs: cubic splines of their places and turns, by SciPy."""

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from gtsam import Pose3
from scipy.spatial.transform import Rotation, RotationSpline

from adjust.model.clocks import EpochTimes, epoch_times
from adjust.model.result import ParameterName
from adjust.model.survey import Camera, Clock, FloatArray, Survey

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Late = float | FloatArray
"""A time after an epoch, or (n,) times, at each of which something is somewhere else."""


class Courses:
    """The true courses of a survey, and the true times of its clocks."""

    def __init__(self, survey: Survey, truth: Mapping[ParameterName, Pose3 | FloatArray]) -> None:
        self.survey, self.truth = survey, truth
        self._places: dict[ParameterName, CubicSpline] = {}
        self._turns: dict[ParameterName, RotationSpline] = {}

    @cached_property
    def times(self) -> EpochTimes:
        """Of all epochs."""
        return epoch_times(self.survey)

    def late(self, name: ParameterName, clock: Clock | None, epoch_id: str, row: Late = 0.0) -> Late:
        """By how much later than an epoch something with this clock is observed; row: below the middle of the image."""
        if clock is None:
            return 0.0
        values: dict[str, float] = dict(zip(clock.parameters.names, np.asarray(self.truth[name]).tolist(), strict=True))
        own = self.truth.get((*name, epoch_id), np.zeros(1))
        since = self.times.of[epoch_id] - self.times.middle
        late: Late = values.get("offset", 0.0) + values.get("drift", 0.0) * since + values.get("line_time", 0.0) * row
        return late + (0.0 if isinstance(own, Pose3) else float(own[0]))

    def pose(self, name: ParameterName, dt: Late) -> FloatArray:
        """(4, 4) of a body, named with an epoch, a time after it; (n, 4, 4) at n times."""
        self._lay(name)
        t = self.times.of[name[2]] + dt
        out = np.tile(np.eye(4), (*np.shape(t), 1, 1))
        out[..., :3, :3], out[..., :3, 3] = self._turns[name[:2]](t).as_matrix(), self._places[name[:2]](t)
        return out

    def angles(self, name: ParameterName, dt: Late) -> FloatArray:
        """(k,) rad of a table, named with an epoch, a time after it; (n, k) at n times."""
        self._lay(name)
        return np.asarray(self._places[name[:2]](self.times.of[name[2]] + dt))

    def _lay(self, name: ParameterName) -> None:
        body = name[:2]
        if body in self._places:
            return
        mine = sorted(
            (self.times.of[n[2]], n) for n in self.truth if n[:2] == body and len(n) == 3 and n[2] in self.times.of
        )
        t, values = np.array([t for t, _ in mine]), [self.truth[n] for _, n in mine]
        poses = [v for v in values if isinstance(v, Pose3)]
        if poses:
            self._turns[body] = RotationSpline(t, Rotation.from_matrix([p.rotation().matrix() for p in poses]))
            values = [p.translation() for p in poses]
        from scipy.interpolate import CubicSpline  # here: it takes long to load, and most examples have no clocks

        self._places[body] = CubicSpline(t, np.array(values))


def rolls(camera: Camera) -> bool:
    """Whether the rows of a camera are read one after the other."""
    return camera.clock is not None and "line_time" in camera.clock.parameters.names
