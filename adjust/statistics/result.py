"""What the statistics of an adjustment give back: tables for a report, all values in SI units, angles in radians."""

from collections.abc import Callable
from functools import cached_property
from typing import Literal

import numpy as np

from adjust.model.errors import listed
from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.testing.criteria import Criteria
from adjust.testing.distributions import norm
from adjust.testing.single_tests import p_posterior, p_prior, p_tau


@frozen(eq=False)
class TestColumns:
    """Tests and reliability of some observations, k in all, with the components ``ptr[i]`` to ``ptr[i + 1]`` of K.

    redundancy: (k,) sum of the redundancy numbers, 0 where not used. least: (k,) the smallest share of an error of
    this observation, in any direction, that shows in its own residuals (the redundancy number where it has one
    component); of what is not used how certain its prediction is, 1 / (1 + variance of the prediction / its own).
    statistic: (k,) v' inv(Q_vv) v over the controlled directions. detectable: (k,) length of the least detectable bias
    in sigmas of the observation, over the controlled directions; inf where there is none. external: (k,) lambda-bar,
    how far that bias moves the unknowns: no unknown, and no function of them, moves by more than this many of its
    sigmas; 0 where not used.

    w: (K,) Baarda's w of the single components, positive where the observed value is too large; nan where
    uncontrolled. error: (K,) estimated gross error (observed minus true) in the component's unit.
    detectable_component: (K,) minimal detectable bias of the component alone, in its unit. bias: (K,) the least
    detectable bias as a vector, in units.
    """

    ptr: IntArray
    redundancy: FloatArray
    least: FloatArray
    statistic: FloatArray
    detectable: FloatArray
    external: FloatArray
    w: FloatArray
    error: FloatArray
    detectable_component: FloatArray
    bias: FloatArray


class _Column:
    """Of tests, by its name, an array of all observations."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, tests: "ObservationTests", owner: type) -> FloatArray:
        found: FloatArray = getattr(tests.every, self._name)
        return found


@frozen(eq=False)
class ObservationTests:
    """Tests and reliability of every observation: image points first, then ``Adjustment.other_residuals``, M in all.

    n_image: rows of image points, in the order of ``ImageResiduals``. runs: of observations one after the other of the
    same group its number in group_names, and how many they are. used, n_components: (M,). freedom: (M,) controlled
    directions, the degrees of freedom of the test; 0: uncontrolled. external: (M,) as in ``TestColumns``, whose arrays
    of all observations this has by their names; they are computed when one is asked for. of: those of some
    observations, in ascending order.

    p: (M,) a priori (chi-square). p_posterior: (M,) with sigma0 estimated (F; the tau-test where there is one
    component). fails: (M,) where p is below the level of the criteria. tau: (K,) Pope's. p_w, p_tau: (K,) two-sided.
    """

    n_image: int
    runs: tuple[IntArray, IntArray]
    group_names: tuple[str, ...]
    used: BoolArray
    n_components: IntArray
    freedom: IntArray
    external: FloatArray
    of: Callable[[IntArray | None], TestColumns]
    criteria: Criteria
    omega: float
    total_redundancy: int
    sigma0: float

    redundancy, least, statistic, detectable = _Column(), _Column(), _Column(), _Column()
    w, error, detectable_component, bias = _Column(), _Column(), _Column(), _Column()

    @cached_property
    def every(self) -> TestColumns:
        """Of all observations."""
        return self.of(None)

    @property
    def ptr(self) -> IntArray:
        """(M + 1,) ranges of an observation's components in the arrays of length K."""
        return self.every.ptr

    @cached_property
    def group(self) -> IntArray:
        """(M,) into ``group_names``."""
        numbers, counts = self.runs
        return np.repeat(numbers, counts)

    @cached_property
    def p(self) -> FloatArray:
        """Of the test, a priori (M,)."""
        return p_prior(self.statistic, self.freedom)

    @cached_property
    def p_posterior(self) -> FloatArray:
        """With sigma0 estimated (M,)."""
        return p_posterior(self.statistic, self.freedom, self.used, self.omega, self.total_redundancy)

    @property
    def fails(self) -> BoolArray:
        """Where p is below the level of the criteria (M,)."""
        return np.asarray(np.nan_to_num(self.p, nan=1.0) < self.criteria.alpha[np.maximum(self.freedom, 1) - 1])

    @property
    def tau(self) -> FloatArray:
        """Pope's tau of the components (K,)."""
        return np.asarray(self.w / (self.sigma0 if self.sigma0 > 0.0 else np.nan))

    @cached_property
    def p_w(self) -> FloatArray:
        """Two-sided, of w (K,)."""
        return np.asarray(2.0 * norm.sf(np.abs(self.w)))

    @cached_property
    def p_tau(self) -> FloatArray:
        """Two-sided, of tau (K,)."""
        return p_tau(self.tau[:, None], np.repeat(self.used, self.n_components), self.total_redundancy)[:, 0]


@frozen
class Influence:
    """What an undetected bias of the least detectable size does.

    row: of ``ObservationTests``. name, component, unit: the unknown that moves most in its sigmas; shift in that unit,
    ratio = shift / sigma. position, position_shift: the point or station whose origin moves furthest, m ("" and 0.0
    where there is none). detectable, external: of the observation, as in ``TestColumns``.
    """

    row: int
    name: ParameterName
    component: str
    unit: str
    shift: float
    ratio: float
    position: ParameterName
    position_shift: float
    detectable: float = np.nan
    external: float = np.nan


@frozen(eq=False)
class Reliability:
    """Tests of all observations, what they could not find, and what is not controlled.

    influences: worst external reliability first. uncontrolled: for people, observations of which some direction shows
    in no residual. sigma0, redundancy: of the a posteriori tests.
    """

    criteria: Criteria
    tests: ObservationTests
    influences: tuple[Influence, ...]
    uncontrolled: tuple[str, ...]
    sigma0: float
    redundancy: int


@frozen
class Alternative:
    """Two explanations that the data hardly tell apart: with ``instead`` out, ``kept`` would fit.

    Both hold (kind, *ids) of observations. odds: how many times likelier the explanation is that was chosen.
    """

    kept: tuple[tuple[str, ...], ...]
    instead: tuple[tuple[str, ...], ...]
    odds: float

    def text(self) -> str:
        """For people."""
        chosen, other = (" and ".join(" ".join(x) for x in part) for part in (self.kept, self.instead))
        return (
            f"either {chosen} (left out) or {other} (kept): the first is {self.odds:.1f} times as likely; "
            "measure both again"
        )


@frozen
class Correlation:
    """Two components of unknowns with their correlation coefficient."""

    a: ParameterName
    a_component: str
    b: ParameterName
    b_component: str
    coefficient: float


@frozen
class WeakPart:
    """A component that moves in a weak direction: by ``amount`` (its unit) for one sigma of the direction."""

    name: ParameterName
    component: str
    unit: str
    amount: float


@frozen
class WeakDirection:
    """A combination of unknowns that the survey determines badly.

    inflation: how much larger the sigma along it is than if nothing else were unknown. parts: largest share first.
    """

    inflation: float
    parts: tuple[WeakPart, ...]

    def text(self, most: int = 6) -> str:
        """For people."""
        named = [f"{' '.join(p.name)} {p.component} {p.amount:+.2g} {p.unit}" for p in self.parts]
        return f"{self.inflation:.3g} times weaker together than alone: {listed(named, most)}"


@frozen(eq=False)
class Ellipsoid:
    """A confidence region: semi_axes (k,) m, largest first, axes (3, k) unit vectors in the world, at ``level``.

    dimension k: of what is not held. scaled: by sigma0 a posteriori (F), else a priori (chi-square).
    """

    semi_axes: FloatArray
    axes: FloatArray
    level: float
    scaled: bool

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return len(self.semi_axes)


@frozen(eq=False)
class RelativePrecision:
    """Precision of b relative to a, whatever the datum of position.

    difference: (3,) m, b minus a in the world; cov (3, 3) m^2. distance, sigma_distance: m. ellipsoid: relative.
    rotation_cov: (3, 3) rad^2 of b's rotation relative to a, in the tangent of b; None for points.
    """

    a: ParameterName
    b: ParameterName
    difference: FloatArray
    cov: FloatArray
    distance: float
    sigma_distance: float
    ellipsoid: Ellipsoid
    rotation_cov: FloatArray | None


@frozen
class BudgetLine:
    """What one source contributes to the standard uncertainty: u (unit of the parameter), share of the variance.

    kind: "A" (from the scatter of the residuals: its variance component was estimated) or "B" (taken from elsewhere).
    freedom: degrees of freedom of its variance, inf for type B.
    """

    source: str
    kind: Literal["A", "B"]
    u: float
    share: float
    freedom: float


@frozen
class BudgetEntry:
    """Uncertainty budget of one component of a parameter (GUM, 8.1): largest source first.

    freedom: effective (Welch-Satterthwaite). coverage: factor k at ``level``. expanded: k u.
    """

    name: ParameterName
    component: str
    unit: str
    u: float
    freedom: float
    level: float
    coverage: float
    expanded: float
    lines: tuple[BudgetLine, ...]


@frozen
class PartTest:
    """Whether the residuals of one part of a survey are as large as its sigmas say.

    kind: "group", "camera", "epoch", "target", "table", "set-up" or "instrument"; name: which. n: components in use.
    redundancy: sum of their redundancy numbers. omega: their weighted squares. factor: omega over redundancy, 1 where
    the sigmas are right. p: probability of an omega as large or larger, or an upper bound of it. fails: below the level
    of one test.
    """

    kind: str
    name: str
    n: int
    redundancy: float
    omega: float
    factor: float
    p: float
    fails: bool

    def text(self) -> str:
        """For people."""
        return (
            f"{self.kind} {self.name} does not fit: its residuals are {np.sqrt(self.factor):.2f} times what the sigmas "
            f"allow (variance factor {self.factor:.3g}, redundancy {self.redundancy:.1f}, p {self.p:.2g})"
        )


@frozen
class ChangeShift:
    """One component of a change: its amount in ``unit`` as the residuals have it, and the sigma of that."""

    component: str
    unit: str
    amount: float
    sigma: float


_IN_UNITS = {"rad": (" arcsec", 180.0 * 3600.0 / np.pi), "m": (" mm", 1e3), "1": ("", 1.0)}


@frozen
class Change:
    """What the residuals say that a camera, target or table has of its own: a score test of what was no unknown.

    kind: "camera", "target" or "table"; name: which. what: "lens", "position", "shape", "zero", "reading of" an axis.
    epoch: from which on, "" where it is the same at all epochs. statistic, freedom, p: of the test. shifts: the
    components that explain it, largest first.
    """

    kind: str
    name: str
    what: str
    epoch: str
    statistic: float
    freedom: int
    p: float
    shifts: tuple[ChangeShift, ...]

    def text(self) -> str:
        """For people."""
        said = f"{self.kind} {self.name}: its {self.what} is not the one of the other epochs from {self.epoch} on"
        if not self.epoch:
            said = f"{self.kind} {self.name}: its {self.what} is not as given"
        parts = []
        for x in self.shifts:
            unit, factor = _IN_UNITS.get(x.unit, (f" {x.unit}", 1.0))
            parts.append(f"{x.component} {x.amount * factor:+.3g} +- {x.sigma * factor:.2g}{unit}")
        return f"{said}: {', '.join(parts)} (p {self.p:.2g})"


@frozen
class Consistency:
    """Whether every part of a survey fits, and whether cameras and targets stayed the same.

    alpha: error probability of all n_tests together; level: of each. parts: all, smallest p first. changes: those
    found, the clearest first, each given the ones before it. relative: tested against the rest, because the survey as a
    whole does not fit its sigmas. n_changes: how many were asked for. left_out: what was not tested, and why.
    """

    alpha: float
    level: float
    n_tests: int
    parts: tuple[PartTest, ...]
    changes: tuple[Change, ...]
    relative: bool
    n_changes: int
    left_out: tuple[str, ...] = ()

    @property
    def failing(self) -> tuple[PartTest, ...]:
        """Parts that do not fit, worst first."""
        return tuple(x for x in self.parts if x.fails)

    @property
    def fits(self) -> bool:
        """Whether nothing was found."""
        return not self.changes and not any(x.fails for x in self.parts)
