"""What an adjustment gives back. Every estimated quantity is one ``Estimate`` under its ``ParameterName``."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Literal, Protocol, overload

import numpy as np
from gtsam import Pose3

from adjust.model.errors import Explanation
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray, PoseParameter, Survey, VectorParameter

# ("lens", camera) ("station_from_camera", camera) ("world_from_station", station[, epoch])
# ("mount_from_station", station) ("world_from_table", table) ("table_geometry", table) ("table_angles", table, epoch)
# ("carrier_from_target", target[, epoch]) ("warp", target) ("point", point) ("vertical",) ("instrument", instrument)
# ("orientation", setup) ("centring", setup) ("beam", beam) ("surface", surface) ("camera_clock", camera)
# ("table_clock", table) ("pose_clock", station)
ParameterName = tuple[str, ...]


@frozen(eq=False)
class Estimate:
    """The adjusted value of one parameter.

    value: Pose3, or (n,) for lens, table, warp and point parameters.
    components: names of the n (6 for a pose) components: rx ry rz tx ty tz, x y z, fx fy ...
    units: unit inside, one per component (rad, m, px, mm, 1, ...).
    cov: (n, n) in the tangent, zero rows for held components, *a priori* (not scaled by sigma0).
    status: per component "free", "held", "prior" or "tied".
    """

    name: ParameterName
    value: Pose3 | FloatArray
    components: tuple[str, ...]
    units: tuple[str, ...]
    cov: FloatArray
    status: tuple[str, ...]


class Estimated(Protocol):
    """What has estimates by name: an adjustment, or what is kept of one."""

    @property
    def estimates(self) -> Mapping[ParameterName, Estimate]:
        """Every parameter."""


def adjusted_pose(
    estimates: Mapping[ParameterName, Estimate], name: ParameterName, parameter: PoseParameter
) -> Pose3 | None:
    """The estimate of a pose; where it is no unknown its value, the identity where it is held without one."""
    if name in estimates:
        value = estimates[name].value
        return value if isinstance(value, Pose3) else None
    return Pose3() if parameter.value is None and parameter.treatment == "held" else parameter.value


def adjusted_numbers(
    estimates: Mapping[ParameterName, Estimate], name: ParameterName, parameter: VectorParameter
) -> dict[str, float]:
    """The components by name: those that are unknowns as estimated, the others as they are given."""
    found = estimates.get(name)
    if found is None or isinstance(found.value, Pose3):
        return parameter.by_name
    return parameter.by_name | dict(zip(found.components, map(float, found.value), strict=True))


@frozen(eq=False)
class ImageResiduals:
    """Residuals of all image points, block after block in the order of ``Survey.image_blocks``.

    block_ptr: (B + 1,) row ranges. residuals: (N, 2) px, predicted minus observed. redundancy: (N, 2) of the whitened
    components. standardized: (N, 2) px-direction residual over its own sigma. test: (N,) v' inv(Q_vv) v, chi-square
    with 2 degrees of freedom. used: (N,).
    """

    block_ptr: IntArray
    residuals: FloatArray
    redundancy: FloatArray
    standardized: FloatArray
    test: FloatArray
    used: BoolArray


@frozen(eq=False)
class ReadingResiduals:
    """Residuals of all readings (N,), in the order of ``Survey.readings``; rad or m.

    sigma: a priori, with the target's centring. residual: adjusted minus observed.
    redundancy: diag(Q_vv P). test: w^2 with w = (P v)_i / sqrt((P Q_vv P)_ii), chi-square with one degree of freedom,
    the square of ``standardized`` but for readings with a joint covariance. weighted_square: shares of v'Pv.
    influence: diag(A Q A'), whitened.
    """

    observed: FloatArray
    adjusted: FloatArray
    residual: FloatArray
    sigma: FloatArray
    redundancy: FloatArray
    standardized: FloatArray
    test: FloatArray
    weighted_square: FloatArray
    used: BoolArray
    influence: FloatArray


@frozen(eq=False)
class ObservationResidual:
    """One observation that is not an image point: (k,) components in SI units.

    kind: table, pair, distance, coordinates, prior, a kind of reading, coordinate_difference, level, alignment, laser,
    surface. ids: what it joins, for people.
    """

    kind: str
    group: str
    ids: tuple[str, ...]
    components: tuple[str, ...]
    units: tuple[str, ...]
    observed: FloatArray
    adjusted: FloatArray
    residual: FloatArray
    sigma: FloatArray
    redundancy: FloatArray
    standardized: FloatArray
    test: float
    used: bool


Named = tuple[str, str, tuple[str, ...], tuple[str, ...], tuple[str, ...]]
"""Kind, group, ids, components and units of an observation."""
_OF_COMPONENTS = ("observed", "adjusted", "residual", "sigma", "redundancy", "standardized")


@frozen(eq=False)
class OtherArrays:
    """What ``Adjustment.other_residuals`` (M) say, as arrays: n_components, used, test, most redundancy of a component.

    All (M,); of every component (K,), one observation after the other, the rest.
    """

    n_components: IntArray
    used: BoolArray
    test: FloatArray
    redundancy: FloatArray
    observed: FloatArray
    adjusted: FloatArray
    residual: FloatArray
    sigma: FloatArray
    redundancies: FloatArray
    standardized: FloatArray

    @cached_property
    def observation(self) -> IntArray:
        """Of every component (K,)."""
        return np.repeat(np.arange(len(self.n_components)), self.n_components)

    @property
    def largest(self) -> FloatArray:
        """Largest standardized residual (M,) in size; 0 where there is none."""
        out = np.zeros(len(self.used))
        np.maximum.at(out, self.observation, np.where(np.isnan(self.standardized), 0.0, np.abs(self.standardized)))
        return out


_KEPT = 10_000  # some 10 MB


class Residuals(Sequence[ObservationResidual]):
    """Observations of which the ``arrays`` (M) are known; each is made when it is asked for, the first ones once.

    n_kept: so many first ones at least.
    """

    def __init__(self, arrays: OtherArrays, named: Callable[[int], Named], n_kept: int) -> None:
        self.arrays, self.named = arrays, named
        self._ptr = np.concatenate([[0], np.cumsum(arrays.n_components)])
        self._made: list[ObservationResidual | None] = [None] * max(n_kept, min(len(self), _KEPT))

    def __len__(self) -> int:
        return len(self.arrays.used)

    @overload
    def __getitem__(self, index: int) -> ObservationResidual: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[ObservationResidual]: ...

    def __getitem__(self, index: int | slice) -> ObservationResidual | Sequence[ObservationResidual]:
        if isinstance(index, slice):
            mine = range(len(self))[index]
            return self if len(mine) == len(self) and mine.step == 1 else tuple(map(self._one, mine))
        return self._one(range(len(self))[index])

    def __iter__(self) -> Iterator[ObservationResidual]:
        return map(self._one, range(len(self)))

    def _one(self, i: int) -> ObservationResidual:
        found = self._made[i] if i < len(self._made) else None
        if found is None:
            a, of = self.arrays, slice(self._ptr[i], self._ptr[i + 1])
            found = ObservationResidual(
                *self.named(i), a.observed[of], a.adjusted[of], a.residual[of], a.sigma[of], a.redundancies[of],
                a.standardized[of], a.test[i].item(), a.used[i].item(),
            )  # fmt: skip
            if i < len(self._made):
                self._made[i] = found
        return found


@lru_cache(2)
def names_of(residuals: Sequence[ObservationResidual]) -> tuple[Named, ...]:
    """What each is called; none of ``Residuals`` is made for that."""
    if isinstance(residuals, Residuals):
        return _every_name(residuals.named, len(residuals))
    return tuple((o.kind, o.group, o.ids, o.components, o.units) for o in residuals)


@lru_cache(2)  # those of other sigmas are called the same
def _every_name(named: Callable[[int], Named], n: int) -> tuple[Named, ...]:
    return tuple(map(named, range(n)))


@lru_cache(2)  # those of an adjustment that is given another warning are the same
def arrays_of(residuals: Sequence[ObservationResidual]) -> OtherArrays:
    """Observations as arrays; none of ``Residuals`` is made for that."""
    if isinstance(residuals, Residuals):
        return residuals.arrays
    n = np.array([len(o.components) for o in residuals], dtype=np.int64)
    columns = [np.concatenate([np.zeros(0), *(getattr(o, name) for o in residuals)]) for name in _OF_COMPONENTS]
    redundancy = np.maximum.reduceat(columns[4], np.cumsum(n) - n) if len(n) else np.zeros(0)
    used = np.array([o.used for o in residuals], dtype=np.bool_)
    return OtherArrays(n, used, np.array([o.test for o in residuals]), redundancy, *columns)


@frozen
class GroupSummary:
    """Redundancy and weighted square sum of one group; ``factor`` is its variance component Omega / r."""

    group: str
    n_observations: int
    redundancy: float
    omega: float

    @property
    def factor(self) -> float:
        """Estimated variance factor of the group, nan where the group has no redundancy."""
        return self.omega / self.redundancy if self.redundancy > 1e-9 else float("nan")


CAUTIOUS_SIGMAS = "cautious sigmas"
"""How the warning begins that residuals are smaller than their sigmas: nobody is misled by these."""


@frozen
class GlobalTest:
    """Chi-square test of sigma0 (two-sided): passed when ``lower <= omega <= upper``."""

    omega: float
    redundancy: int
    alpha: float
    lower: float
    upper: float

    @property
    def passed(self) -> bool:
        """Whether the weighted square sum agrees with the a priori sigmas."""
        return self.lower <= self.omega <= self.upper

    @property
    def status(self) -> Literal["passed", "cautious", "failed"]:
        """``cautious``: residuals are smaller than the sigmas say; ``failed``: larger, something does not fit."""
        if self.omega > self.upper:
            return "failed"
        return "cautious" if self.omega < self.lower else "passed"

    @property
    def said(self) -> str:
        """The status in words."""
        return "passed with cautious sigmas" if self.status == "cautious" else self.status

    def warning(self, sigma0: float) -> str:
        """For people: what is not as the sigmas say; "" where all is."""
        if self.passed:
            return ""
        larger = self.status == "failed"
        what, side = ("global test failed", "larger") if larger else (CAUTIOUS_SIGMAS, "smaller")
        return (
            f"{what}: sigma0 = {sigma0:.3f}, the residuals are {side} than the a priori sigmas say "
            f"(v'Pv = {self.omega:.1f}, expected {self.lower:.1f} to {self.upper:.1f})"
        )


@frozen
class Component:
    """The variance component of one group.

    factor: estimated variance factor, on top of the a priori variances (1: they were right); sigma: its standard
    deviation. n: observed components. redundancy, omega: of the group, with the estimated factors. freedom: equivalent
    degrees of freedom 2 factor^2 / sigma^2. p: of a factor as far from 1 where the a priori variances are right;
    lower, upper: confidence limits. status: "estimated", "fixed" (not asked for, or a prior), "vanished" (its residuals
    are smaller than any variance explains), "unseparable", "no redundancy".
    """

    group: str
    factor: float
    sigma: float
    n: int
    redundancy: float
    omega: float
    status: str
    freedom: float = math.nan
    p: float = math.nan
    lower: float = math.nan
    upper: float = math.nan


@frozen(eq=False)
class VarianceComponents:
    """Variance components of all groups. correlation: (k, k) between those in ``estimated``, in that order.

    unseparable: sets of groups of which the observations tell only a mixture. iterations: solutions of the survey.
    """

    components: tuple[Component, ...]
    estimated: tuple[str, ...]
    correlation: FloatArray
    unseparable: tuple[tuple[str, ...], ...]
    iterations: int
    converged: bool
    method: str


@frozen
class Decision:
    """One step of an outlier search: what was left out or taken back, why and when.

    kind, ids: as ``ObservationResidual``; of image points kind "image", ids (camera, epoch, target or "points",
    point). statistic, freedom, p, limit: the test that decided. error: estimated gross error in sigmas of the
    observation. round: of the non-linear solutions, counted from 1. how: "test", "robust", "exchange".
    """

    action: Literal["rejected", "readmitted"]
    kind: str
    group: str
    ids: tuple[str, ...]
    statistic: float
    freedom: int
    p: float
    limit: float
    error: float
    round: int
    how: str

    def text(self) -> str:
        """For people."""
        did = "left out" if self.action == "rejected" else "taken back"
        return (
            f"{did}: {self.kind} {' '.join(self.ids)}: off by {self.error:.1f} sigma, test {self.statistic:.1f} "
            f"(limit {self.limit:.1f}), p {self.p:.2g}"
        )


class JointCovariances(Protocol):
    """Covariances of the adjusted unknowns, a priori (sigma0 = 1), in the survey's datum."""

    def joint(self, names: Sequence[ParameterName]) -> FloatArray:
        """Of several unknowns, stacked in this order (of vectors their free components); KeyError for what is none."""
        ...

    def whole(self, names: Sequence[ParameterName], sizes: Sequence[int]) -> FloatArray:
        """The same of all components, so many of each of these parameters; zero where one is held."""
        ...

    def following(self, spreads: Sequence[Mapping[int, FloatArray]], sizes: Sequence[int]) -> FloatArray:
        """Of quantities that follow from unknowns: each (n, dim) by key; n of each in ``sizes``."""
        ...

    def whole_pairs(self, pairs: Sequence[tuple[ParameterName, ParameterName]], size: int) -> FloatArray:
        """As ``whole`` of many pairs of parameters of so many components each, (p, 2 size, 2 size)."""
        return np.array([self.whole(pair, (size, size)) for pair in pairs]).reshape(-1, 2 * size, 2 * size)

    def bring_together(self, pairs: Iterable[tuple[ParameterName, ParameterName]]) -> None:
        """Work out many pairs at once, before they are asked for one by one; nothing where that is no cheaper."""
        return None


@frozen(eq=False)
class Adjustment:
    """A solved survey with its precision.

    sigma0: a posteriori standard deviation of unit weight (a priori is 1). omega: v'Pv. iterations: steps taken.
    max_step: the last step in sigmas of the unknowns. warnings: for people, worst first. doubtful: those of them that
    say of a value that it cannot be right, whatever the residuals say.
    other_residuals: of all that are not image points, the readings last, also as arrays in ``reading_residuals``.
    precision: gives joint covariances, ``precision.joint([name, ...])``.
    variance_components: where they were estimated. decisions: the log of the search for gross errors. n_screened: image
    points and other observations that were in use and that this adjustment left out, where that was counted. diagnosis:
    where something does not fit and is explained.
    """

    survey: Survey
    estimates: Mapping[ParameterName, Estimate]
    image_residuals: ImageResiduals
    other_residuals: Sequence[ObservationResidual]
    groups: tuple[GroupSummary, ...]
    n_observations: int
    n_unknowns: int
    datum_defect: int
    redundancy: int
    omega: float
    sigma0: float
    global_test: GlobalTest | None
    iterations: int
    max_step: float
    converged: bool
    warnings: tuple[str, ...]
    precision: JointCovariances
    reading_residuals: ReadingResiduals | None = None
    variance_components: VarianceComponents | None = None
    decisions: tuple[Decision, ...] = ()
    n_screened: int = 0
    diagnosis: Explanation | None = None
    doubtful: tuple[str, ...] = ()

    @cached_property
    def single_residuals(self) -> Sequence[ObservationResidual]:
        """``other_residuals`` without the readings, of which none is made for that."""
        n_readings = 0 if self.reading_residuals is None else len(self.reading_residuals.used)
        return self.other_residuals[: len(self.other_residuals) - n_readings]

    @cached_property
    def other_arrays(self) -> OtherArrays:
        """``other_residuals`` as arrays; of readings none is made for that."""
        return arrays_of(self.other_residuals)

    def joint(self, names: Sequence[ParameterName]) -> FloatArray:
        """Joint covariance (n, n), a priori, of all components of these estimates in this order; zero of held ones."""
        return self.precision.whole(names, [len(self.estimates[name].components) for name in names])

    def __repr__(self) -> str:
        """The key figures in one line."""
        said = "" if self.global_test is None else f", global test {self.global_test.said}"
        return (
            f"Adjustment(sigma0 {self.sigma0:.4f}, {self.n_observations} observations, {self.n_unknowns} unknowns, "
            f"redundancy {self.redundancy}{said})"
        )
