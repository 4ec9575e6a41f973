"""Time-stamped trajectories of eyes: brought to one clock, interpolated, cut into motions.

Clocks are compared by what is the same for all points of a rigid body and needs no calibration: the speed at which it
turns. Motions over an interval do not know in which world an eye counts, so trackers whose worlds drift can be used.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.optimize import minimize_scalar

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.observations.between_epochs import weights
from adjust.spatial.rigid import rotation_exp, rotation_log
from adjust.spatial.rigid_motions import Motions

_STEP_S = 0.02  # of the comparison of clocks
_HALF_S = 0.1  # turning speed over twice this time
_FEWEST = 50  # steps in common
_PARTS = 8  # of the time in common, each with an offset of its own
_GAP = 5.0  # usual times between poses
_PEAKS = 5  # shifts that are looked at closely
_AS_WELL = 1.5  # mean square misfit of another offset, in that of the best
_MOST_NOISE = 2.0  # variance of a pose in between, in those of the poses around it


@frozen(eq=False)
class Trajectory:
    """world_from_eye (n,) at times_s (n,), increasing, on the eye's own clock."""

    eye: FrameRef
    times_s: FloatArray
    world_from_eye: Motions

    def at(self, times_s: FloatArray) -> Motions:
        """Poses (k,) in between, by the cubic through the four around. Raises SurveyError outside.

        Straight between the two around where times are so uneven that the cubic would enlarge the errors of poses.
        """
        self._refuse_outside(times_s)
        i, share = self._shares(times_s)
        x = self.world_from_eye.shifts[self._nodes[0][i]]
        return Motions(self._attitudes(i, share), np.einsum("kj,kji->ki", share, x))

    def _refuse_outside(self, times_s: FloatArray) -> None:
        t = self.times_s
        if len(t) < 4:
            raise SurveyError(f"eye {self.eye.frame_id}: {len(t)} poses are too few; record about ten a second")
        if times_s.min(initial=t[0]) < t[0] or times_s.max(initial=t[0]) > t[-1]:
            raise SurveyError(
                f"eye {self.eye.frame_id}: poses are asked for {times_s.min():.3f} to {times_s.max():.3f} s, its "
                f"trajectory has {t[0]:.3f} to {t[-1]:.3f} s; check the time offset"
            )

    @cached_property
    def _nodes(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Of each interval the four poses around, Lagrange's denominators of them, and turns (4, 3) to them."""
        t, R, i = self.times_s, self.world_from_eye.rotation, np.arange(len(self.times_s) - 1)
        around = np.clip(i, 1, len(t) - 3)[:, None] + np.arange(-1, 3)
        apart = t[around][:, :, None] - t[around][:, None] + np.eye(4)
        return around, apart.prod(axis=2), rotation_log(np.swapaxes(R[i], -1, -2)[:, None] @ R[around])

    def _shares(self, times_s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Intervals (k,) in which times are, and the shares (k, 4) of the poses around in what is there."""
        t = self.times_s
        i = np.clip(np.searchsorted(t, times_s, side="right") - 1, 0, len(t) - 2)
        around, below, _ = self._nodes
        d = (times_s[:, None] - t[around[i]]).T
        share = np.stack([d[1] * d[2] * d[3], d[0] * d[2] * d[3], d[0] * d[1] * d[3], d[0] * d[1] * d[2]], axis=1)
        share /= below[i]
        uneven = np.flatnonzero(np.einsum("ki,ki->k", share, share) > _MOST_NOISE)
        j, at = i[uneven], times_s[uneven]
        after = ((at - t[j]) / (t[j + 1] - t[j]))[:, None]
        share[uneven] = (around[j] == j[:, None]) * (1.0 - after) + (around[j] == j[:, None] + 1) * after
        return i, share

    def _attitudes(self, i: IntArray, share: FloatArray) -> FloatArray:
        """(k, 3, 3) from what :meth:`_shares` says."""
        return self.world_from_eye.rotation[i] @ rotation_exp(np.einsum("kj,kji->ki", share, self._nodes[2][i]))

    def missed_between(self) -> FloatArray:
        """(2,) root mean square of what the cubic misses halfway between two poses, rad and m; 0 of too few poses.

        It grows with the fourth derivative of the motion (the remainder of Lagrange's form). That is told apart from
        the noise of poses by how each pose misses the cubics through two of its neighbours on either side, and through
        every second one: noise is missed alike, a motion sixteen times as much.
        """
        t, R, x = self.times_s, self.world_from_eye.rotation, self.world_from_eye.shifts
        i = np.arange(4, len(t) - 4)
        span = t[i + 4] - t[i - 4]
        i = i[span < 2.0 * np.median(span)] if len(i) else i  # no gaps
        if len(i) < _FEWEST:
            return np.zeros(2)
        factors, squares = [], []
        for step in (1, 2):
            around = i[:, None] + step * np.array([-2, -1, 1, 2])
            share, _ = weights(t[around], t[i])
            turn = np.einsum("kj,kji->ki", share, rotation_log(np.swapaxes(R[i], -1, -2)[:, None] @ R[around]))
            shift = np.einsum("kj,kji->ki", share, x[around])
            factors.append([1.0 + (share**2).sum(axis=1).mean(), np.square(_remainder(t[around], t[i])).mean()])
            squares.append([np.square(turn).mean(), np.square(shift - x[i]).mean()])
        _, fourth = np.linalg.solve(factors, squares)
        around = i[:, None] + np.arange(-1, 3)
        halfway = np.square(_remainder(t[around], (t[i] + t[i + 1]) / 2.0)).mean()
        return np.asarray(np.sqrt(np.maximum(fourth, 0.0) * halfway))

    def recorded(self, times_s: FloatArray) -> BoolArray:
        """Whether times (k,) are no part of a gap: poses around are not much farther apart than usually."""
        apart = np.diff(self.times_s)
        i = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(apart) - 1)
        return np.asarray(apart[i] <= _GAP * np.median(apart))

    def turning_speed(self, times_s: FloatArray) -> FloatArray:
        """(k,) rad/s."""
        both = np.concatenate([times_s - _HALF_S, times_s + _HALF_S])
        self._refuse_outside(both)
        before, after = np.split(self._attitudes(*self._shares(both)), 2)
        chord = (after - before).reshape(-1, 9)  # of a turn by w its square is 8 sin^2(w/2)
        square = np.minimum(np.einsum("ki,ki->k", chord, chord) / 8.0, 1.0)
        return np.asarray(2.0 * np.arcsin(np.sqrt(square)) / (2.0 * _HALF_S))


@frozen(eq=False)
class TimeOffset:
    """Clock b shows ``offset_s`` more than clock a. sigma_s: from the scatter of the offsets of separate parts.

    correlation: of the turning speeds. drift_per_s: of the offset, with its sigma, from the same parts.
    """

    offset_s: float
    sigma_s: float
    correlation: float
    drift_per_s: float
    drift_sigma_per_s: float


def _remainder(nodes: FloatArray, at: FloatArray) -> FloatArray:
    """(k,) times the fourth derivative / 24 what the cubic through four nodes (k, 4) misses at (k,)."""
    return np.asarray((at[:, None] - nodes).prod(axis=1))


def time_offset(a: Trajectory, b: Trajectory) -> TimeOffset:
    """Offset of b's clock against a's by the turning speeds of both, over all shifts with half the time in common.

    Raises SurveyError where the turning speeds do not agree at any shift, or at several as well.
    """
    speed = [x.turning_speed(_grid(x.times_s[0], x.times_s[-1])) for x in (a, b)]
    _refuse_short(a, b, min(map(len, speed)))
    first = b.times_s[0] - a.times_s[0]
    tried = sorted((_fit(a, b, first + shift * _STEP_S) for shift in _coarse(*speed)), key=lambda fit: fit[1])
    best, miss, times = tried[0]
    speeds = a.turning_speed(times), b.turning_speed(times + best)
    correlation = float(np.corrcoef(*speeds)[0, 1]) if min(map(np.ptp, speeds)) > 0.0 else 0.0
    if correlation < 0.8:
        raise SurveyError(
            f"eyes {a.eye.frame_id} and {b.eye.frame_id}: their turning speeds agree at no time offset (correlation "
            f"{correlation:.2f}); they are not on one rigid body, or it hardly turned"
        )
    other = next((x for x, m, _ in tried[1:] if m < _AS_WELL * miss and abs(x - best) > 2 * _HALF_S), None)
    if other is not None:
        raise SurveyError(
            f"eyes {a.eye.frame_id} and {b.eye.frame_id}: their turning speeds agree at a time offset of {best:.2f} s "
            f"and at {other:.2f} s as well, since the motion repeats itself or is too quick for the rate of poses; "
            "turn the station irregularly, and record about ten poses a second"
        )
    parts = np.array([_refined(a, b, part, best)[0] for part in np.array_split(times, _PARTS)])
    centre = np.array([part.mean() for part in np.array_split(times, _PARTS)])
    line, cov = np.polyfit(centre - centre.mean(), parts, 1, cov=True)
    return TimeOffset(
        best, float(parts.std(ddof=1) / np.sqrt(_PARTS)), correlation, float(line[0]), float(np.sqrt(cov[0, 0]))
    )


def _fit(a: Trajectory, b: Trajectory, offset: float) -> tuple[float, float, FloatArray]:
    """The offset nearby that fits best, its mean square misfit, and the times (k,) of both in common."""
    lo = max(a.times_s[0], b.times_s[0] - offset) + 3 * _HALF_S
    hi = min(a.times_s[-1], b.times_s[-1] - offset) - 3 * _HALF_S
    times = np.arange(lo, hi, _STEP_S)
    kept = [x.recorded(times + o + d) for x, o in ((a, 0.0), (b, offset)) for d in (-_HALF_S, _HALF_S)]
    times = times[np.logical_and.reduce(kept)]
    _refuse_short(a, b, len(times))
    return *_refined(a, b, times, offset), times


def _refuse_short(a: Trajectory, b: Trajectory, n: int) -> None:
    """Raise SurveyError for fewer than enough steps in common."""
    if n < _FEWEST:
        raise SurveyError(
            f"eyes {a.eye.frame_id} and {b.eye.frame_id}: their trajectories are together for {_STEP_S * n:.2f} s "
            f"outside of gaps; record {_STEP_S * _FEWEST:g} s or more, ten poses a second"
        )


def _grid(first: float, last: float) -> FloatArray:
    return np.arange(first + 2 * _HALF_S, last - 2 * _HALF_S, _STEP_S)


def _coarse(a: FloatArray, b: FloatArray) -> list[int]:
    """Shifts in steps with the largest correlations around, among those with half of the shorter series in common."""
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
    peaks = np.flatnonzero(np.r_[True, r[1:] > r[:-1]] & np.r_[r[:-1] >= r[1:], True])
    return [int(x) for x in shifts[peaks[np.argsort(-r[peaks], kind="stable")]][:_PEAKS]]


def _refined(a: Trajectory, b: Trajectory, times: FloatArray, offset: float) -> tuple[float, float]:
    """The offset near this one with the least mean square misfit over times (k,), and that."""
    speed = a.turning_speed(times)

    def miss(more: float) -> float:
        return float(np.mean((speed - b.turning_speed(times + offset + more)) ** 2))

    found = minimize_scalar(miss, bounds=(-2.5 * _STEP_S, 2.5 * _STEP_S), method="bounded", options={"xatol": 1e-6})
    return offset + float(found.x), float(found.fun)


@frozen(eq=False)
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
        raise SurveyError(
            f"the trajectories have only {max(hi - lo, 0.0):.1f} s in common, too little for two motions of "
            f"{interval_s:g} s; record longer ones, or check the time offsets"
        )
    begin = lo + step * np.arange(int((hi - lo - interval_s) / step) + 1)
    ends = [x.recorded(begin + o + d) for x, o in zip(trajectories, offsets_s, strict=True) for d in (0.0, interval_s)]
    begin = begin[np.logical_and.reduce(ends)]
    poses = tuple((x.at(begin + o), x.at(begin + interval_s + o)) for x, o in zip(trajectories, offsets_s, strict=True))
    motions = tuple(before.inverse() @ after for before, after in poses)
    return CommonMotions(
        tuple(x.eye for x in trajectories), np.stack([begin, begin + interval_s], axis=1), poses, motions
    )
