"""Time-stamped trajectories of eyes: brought to one clock, interpolated, cut into motions.

Clocks are compared by what is the same for all points of a rigid body and needs no calibration: the speed at which it
turns. Motions over an interval do not know in which world an eye counts, so trackers whose worlds drift can be used.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.spatial.rigid import rotation_exp, rotation_log
from adjust.spatial.rigid_motions import Motions

_STEP_S = 0.02  # of the comparison of clocks
_HALF_S = 0.1  # turning speed over twice this time
_PARTS = 8  # of the time in common, each with an offset of its own


@dataclass(frozen=True, eq=False)
class Trajectory:
    """world_from_eye (n,) at times_s (n,), increasing, on the eye's own clock."""

    eye: FrameRef
    times_s: FloatArray
    world_from_eye: Motions

    def at(self, times_s: FloatArray) -> Motions:
        """Poses (k,) in between: straight in position, at constant turning speed. Raises SurveyError outside."""
        t = self.times_s
        if times_s.min(initial=t[0]) < t[0] or times_s.max(initial=t[0]) > t[-1]:
            raise SurveyError(
                f"eye {self.eye.frame_id}: poses are asked for {times_s.min():.3f} to {times_s.max():.3f} s, its "
                f"trajectory has {t[0]:.3f} to {t[-1]:.3f} s; check the time offset"
            )
        i = np.clip(np.searchsorted(t, times_s, side="right") - 1, 0, len(t) - 2)
        share = (times_s - t[i]) / (t[i + 1] - t[i])
        R, x = self.world_from_eye.rotation, self.world_from_eye.shifts
        turn = rotation_log(np.swapaxes(R[i], -1, -2) @ R[i + 1])
        return Motions(R[i] @ rotation_exp(share[:, None] * turn), x[i] + share[:, None] * (x[i + 1] - x[i]))

    def turning_speed(self, times_s: FloatArray) -> FloatArray:
        """(k,) rad/s."""
        before, after = self.at(times_s - _HALF_S), self.at(times_s + _HALF_S)
        turn = rotation_log(np.swapaxes(before.rotation, -1, -2) @ after.rotation)
        return np.asarray(np.linalg.norm(turn, axis=1) / (2.0 * _HALF_S))


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """Clock b shows ``offset_s`` more than clock a. sigma_s: from the scatter of the offsets of separate parts.

    correlation: of the turning speeds. drift_per_s: of the offset, with its sigma, from the same parts.
    """

    offset_s: float
    sigma_s: float
    correlation: float
    drift_per_s: float
    drift_sigma_per_s: float


def time_offset(a: Trajectory, b: Trajectory) -> TimeOffset:
    """Offset of b's clock against a's by the turning speeds of both, over all shifts with half the time in common.

    Raises SurveyError where the turning speeds do not agree at any shift.
    """
    speed = [x.turning_speed(_grid(x.times_s[0], x.times_s[-1])) for x in (a, b)]
    first = _coarse(*speed)
    offset = b.times_s[0] - a.times_s[0] + first[0] * _STEP_S
    lo = max(a.times_s[0], b.times_s[0] - offset) + 3 * _HALF_S
    hi = min(a.times_s[-1], b.times_s[-1] - offset) - 3 * _HALF_S
    times = np.arange(lo, hi, _STEP_S)
    best = _refined(a, b, times, offset)
    correlation = float(np.corrcoef(a.turning_speed(times), b.turning_speed(times + best))[0, 1])
    if correlation < 0.8:
        raise SurveyError(
            f"eyes {a.eye.frame_id} and {b.eye.frame_id}: their turning speeds agree at no time offset (correlation "
            f"{correlation:.2f}); they are not on one rigid body, or it hardly turned"
        )
    parts = np.array([_refined(a, b, part, best) for part in np.array_split(times, _PARTS)])
    centre = np.array([part.mean() for part in np.array_split(times, _PARTS)])
    line, cov = np.polyfit(centre - centre.mean(), parts, 1, cov=True)
    return TimeOffset(
        best, float(parts.std(ddof=1) / np.sqrt(_PARTS)), correlation, float(line[0]), float(np.sqrt(cov[0, 0]))
    )


def _grid(first: float, last: float) -> FloatArray:
    return np.arange(first + 2 * _HALF_S, last - 2 * _HALF_S, _STEP_S)


def _coarse(a: FloatArray, b: FloatArray) -> tuple[int, float]:
    """Shift in steps with the largest correlation among those with half of the shorter series in common."""
    least = min(len(a), len(b)) // 2
    shifts = np.arange(least - len(a), len(b) - least + 1)
    size = 1 << int(np.ceil(np.log2(len(a) + len(b))))

    def correlated(x: FloatArray, y: FloatArray) -> FloatArray:
        full = np.fft.irfft(np.conj(np.fft.rfft(x, size)) * np.fft.rfft(y, size), size)
        return np.asarray(full[shifts % size])

    one_a, one_b = np.ones_like(a), np.ones_like(b)
    n = correlated(one_a, one_b)
    sa, sb = correlated(a, one_b), correlated(one_a, b)
    saa, sbb, sab = correlated(a * a, one_b), correlated(one_a, b * b), correlated(a, b)
    r = (n * sab - sa * sb) / np.sqrt(np.maximum((n * saa - sa**2) * (n * sbb - sb**2), 1e-30))
    best = int(np.argmax(r))
    return int(shifts[best]), float(r[best])


def _refined(a: Trajectory, b: Trajectory, times: FloatArray, offset: float) -> float:
    speed = a.turning_speed(times)

    def miss(more: float) -> float:
        return float(np.sum((speed - b.turning_speed(times + offset + more)) ** 2))

    found = minimize_scalar(miss, bounds=(-2.5 * _STEP_S, 2.5 * _STEP_S), method="bounded", options={"xatol": 1e-6})
    return offset + float(found.x)


@dataclass(frozen=True, eq=False)
class CommonMotions:
    """Motions of several eyes over the same intervals: times_s (n, 2) on the first clock; motions: per eye (n,)."""

    eyes: tuple[FrameRef, ...]
    times_s: FloatArray
    poses: tuple[tuple[Motions, Motions], ...]
    motions: tuple[Motions, ...]

    def __getitem__(self, rows: IntArray | BoolArray | slice) -> "CommonMotions":
        poses = tuple((a[rows], b[rows]) for a, b in self.poses)
        return CommonMotions(self.eyes, self.times_s[rows], poses, tuple(m[rows] for m in self.motions))

    @property
    def interval_ids(self) -> tuple[str, ...]:
        """By their first time."""
        return tuple(f"{t:.3f}" for t in self.times_s[:, 0])


def common_motions(
    trajectories: Sequence[Trajectory], offsets_s: Sequence[float], interval_s: float, step_s: float | None = None
) -> CommonMotions:
    """Motions ``before_from_after`` over intervals that begin every ``step_s`` (None: one after the other).

    offsets_s: of every clock against the first (its own is 0). Raises SurveyError without a common time.
    """
    step = interval_s if step_s is None else step_s
    lo = max(x.times_s[0] - o for x, o in zip(trajectories, offsets_s, strict=True)) + 2 * _HALF_S
    hi = min(x.times_s[-1] - o for x, o in zip(trajectories, offsets_s, strict=True)) - 2 * _HALF_S
    if hi - lo < 2 * interval_s:
        raise SurveyError(f"the trajectories have only {hi - lo:.1f} s in common; check the time offsets")
    begin = lo + step * np.arange(int((hi - lo - interval_s) / step) + 1)
    poses = tuple((x.at(begin + o), x.at(begin + interval_s + o)) for x, o in zip(trajectories, offsets_s, strict=True))
    motions = tuple(before.inverse() @ after for before, after in poses)
    return CommonMotions(
        tuple(x.eye for x in trajectories), np.stack([begin, begin + interval_s], axis=1), poses, motions
    )
