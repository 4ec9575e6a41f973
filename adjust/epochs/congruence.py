"""Congruence of two epochs: did anything move, what stayed, and how far the rest went (Pelzer 1971, Niemeier 2008, 13).

Both epochs are brought to one datum over the points held for stable (S-transformation, Baarda 1973), for all motions
that either of them does not determine; ``d' Q_d^+ d`` of these points is the test. While it fails, the point that
contributes most is taken out of the datum, until what is left is congruent.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.epochs.change import Change, MatrixChange
from adjust.epochs.congruence_result import Congruence, CongruenceStep, CongruenceTest
from adjust.epochs.joined import JoinedChange
from adjust.epochs.judging import Judging, Pooled, tests_of
from adjust.epochs.states import (
    MOTIONS,
    Epoch,
    EpochNormals,
    EpochState,
    aligned,
    epoch_normals,
    epoch_state,
    known,
)
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray
from adjust.testing.criteria import sidak
from adjust.testing.distributions import fisher
from adjust.testing.quadratic_forms import squares_in_sigmas

MOST_IN_MATRIX = 600
"""Components up to which epochs are compared by one covariance matrix; more, by their normal equations."""


@frozen
class CongruenceOptions:
    """alpha: of the global test, and of all single tests together.

    scaled: sigma0 is pooled from both epochs, else the a priori sigmas hold. reference: names to begin with as stable
    (all common ones, where None). search: whether unstable ones are looked for among them. power: of
    ``Motion.smallest``. names: of the epochs.
    """

    alpha: float = 0.05
    scaled: bool = True
    reference: tuple[ParameterName, ...] | None = None
    search: bool = True
    power: float = 0.80
    names: tuple[str, str] = ("first", "second")


DEFAULT_CONGRUENCE = CongruenceOptions()


def congruence(
    first: Adjustment, second: Adjustment, options: CongruenceOptions = DEFAULT_CONGRUENCE
) -> Congruence:
    """Compare two adjustments of independent observations. Points and fixed stations are matched by their ids.

    Raises SurveyError where nothing is common, or the reference is too small.
    """
    both = common(first, second, options)
    after = aligned(both.before, both.after, both.directions, _numbers(both.before, options.reference))
    return compare(replace(both, after=after), options)


@frozen(eq=False)
class Common:
    """What two epochs have in common; directions (7, k): motions that do not count."""

    before: Epoch
    after: Epoch
    directions: FloatArray
    pooled: Pooled

    @property
    def names(self) -> tuple[ParameterName, ...]:
        """The points and stations."""
        return self.before.names


def common(first: Adjustment, second: Adjustment, options: CongruenceOptions = DEFAULT_CONGRUENCE) -> Common:
    """The points and fixed stations that both epochs have, not aligned; raises SurveyError where there are none."""
    epoch = epoch_state if min(map(_size, (first, second))) <= MOST_IN_MATRIX else epoch_normals
    before, after = epoch(first), epoch(second)
    names = tuple(n for n in before.names if n in after.index)
    if not names:
        raise SurveyError("the epochs have no point and no fixed station in common; use the same ids in both")
    before, after = before.part(names), after.part(names)
    return Common(before, after, _open_motions(before, after), _pooled(first, second, options.scaled))


def _size(adjustment: Adjustment) -> int:
    """Components of its points and fixed stations."""
    return sum(6 if isinstance(v, Pose3) else 3 for v in known(adjustment)[1])


def compare(both: Common, options: CongruenceOptions, cross: FloatArray | None = None) -> Congruence:
    """Of two states of the same names, aligned.

    cross: covariance (n, n) of the first with the second state where they are not independent.
    """
    names, pooled = both.names, both.pooled
    change = _change(both.before, both.after, both.directions, cross)
    tests = _Tests(change, pooled, options)
    numbers = np.array(_numbers(both.before, options.reference), dtype=np.int64)
    begin = numbers[np.isin(numbers, change.owner)].tolist()
    if not begin:
        raise SurveyError("no point of the reference is free in either epoch; there is nothing to test")
    first_test = tests.of_all(begin)
    steps, stable, last = tests.search(begin, first_test)
    level = sidak(options.alpha, len(np.unique(change.owner)))
    judging = Judging(change, both.before, frozenset(stable), pooled, level, options.alpha, options.power)
    motions = judging.of(change.displaced(stable))
    moved = tuple(m.name for m in motions if m.significant)
    return Congruence(
        options.names, options.alpha, options.scaled, *pooled, first_test, last, tuple(steps),
        tuple(names[i] for i in stable), moved, _named(both.directions), motions, _warnings(pooled, last, options),
    )  # fmt: skip


def _numbers(epoch: Epoch, reference: Sequence[ParameterName] | None) -> list[int]:
    if reference is None:
        return list(range(len(epoch.names)))
    lost = [n for n in reference if n not in epoch.index]
    if lost:
        raise SurveyError(f"{' '.join(lost[0])} of the reference is not common to both epochs")
    return [epoch.index[n] for n in reference]


def _pooled(first: Adjustment, second: Adjustment, scaled: bool) -> Pooled:
    f1, f2 = first.redundancy, second.redundancy
    p = float("nan")
    if f1 > 0 and f2 > 0:
        a, b = np.float64(first.omega / f1), np.float64(second.omega / f2)
        with np.errstate(divide="ignore", invalid="ignore"):
            p = float(2.0 * min(fisher.sf(b / a, f2, f1), fisher.sf(a / b, f1, f2)))
    if not scaled or f1 + f2 <= 0:
        return Pooled(1.0, float("inf"), p)
    return Pooled(float(np.sqrt((first.omega + second.omega) / (f1 + f2))), float(f1 + f2), p)


def _open_motions(before: Epoch, after: Epoch) -> FloatArray:
    """Motions (7, k) that either epoch leaves open, orthonormal in units of the extent."""
    both = np.hstack([before.directions, after.directions])
    if not both.shape[1]:
        return both
    scale = np.array([1.0] * 3 + [before.extent] * 4)
    U, s, _ = np.linalg.svd(scale[:, None] * both / np.linalg.norm(scale[:, None] * both, axis=0), full_matrices=False)
    return np.asarray(U[:, s > 1e-6 * s.max()] / scale[:, None])


def _named(directions: FloatArray) -> tuple[str, ...]:
    if not directions.shape[1]:
        return ()
    size = np.abs(directions)
    return tuple(MOTIONS[i] for i in range(7) if size[i].max() > 1e-6 * size.max())


def _change(before: Epoch, after: Epoch, directions: FloatArray, cross: FloatArray | None) -> Change:
    if isinstance(before, EpochState) and isinstance(after, EpochState):
        return MatrixChange.of(before, after, directions, cross)
    if isinstance(before, EpochNormals) and isinstance(after, EpochNormals) and cross is None:
        return JoinedChange.of(before, after, directions)
    raise TypeError("both epochs are known by their covariance matrices, or independent and by their normal equations")


@frozen(eq=False)
class _Tests:
    """Tests of what lies between two epochs."""

    change: Change
    pooled: Pooled
    options: CongruenceOptions

    def of_all(self, stable: Sequence[int]) -> CongruenceTest:
        """The global test of these names."""
        statistic, rank = self.change.square(stable)
        # what the datum takes away is no information, whatever rounding leaves of it
        rank = min(rank, max(0, len(self.change.rows(stable)) - self.change.G.shape[1]))
        return tests_of(np.array([statistic]), np.array([rank]), self.pooled, self.options.alpha)[0]

    def search(
        self, begin: list[int], test: CongruenceTest
    ) -> tuple[list[CongruenceStep], list[int], CongruenceTest]:
        """Take out the worst until the rest is congruent, and back what then fits.

        No search for gross errors: not single points are judged but what is left, as a whole and by F, and every step
        is told with the test after it (Niemeier 2008, 13.3).
        """
        stable, steps = list(begin), list[CongruenceStep]()
        while self.options.search and not test.passed:
            shares = self.change.shares(stable)
            worst = max(shares, key=lambda i: shares[i])
            rest = [i for i in stable if i != worst]
            try:
                now = self.of_all(rest) if rest else None
            except SurveyError:
                now = None
            if now is None or now.freedom == 0:
                break
            stable, test = rest, now
            steps.append(CongruenceStep(self.change.names[worst], shares[worst], test))
        level, kept = sidak(self.options.alpha, len(begin)), frozenset(stable)
        for i in [i for i in begin if i not in kept] if test.passed else []:
            more = sorted([*stable, i])
            square = squares_in_sigmas(*self.change.displaced(stable)(self.change.rows([i])[None]))
            alone = tests_of(*square, self.pooled, level)[0]
            together = self.of_all(more)
            if alone.passed and together.passed:
                stable, test = more, together
                steps = [s for s in steps if s.name != self.change.names[i]]
        return steps, stable, test


def _warnings(pooled: Pooled, last: CongruenceTest, options: CongruenceOptions) -> tuple[str, ...]:
    out = []
    if pooled.ratio_p < options.alpha:
        out.append(
            f"the epochs have different variance factors (p {pooled.ratio_p:.2g}); estimate variance components or "
            "look for gross errors before believing the tests"
        )
    if not last.passed:
        out.append("no set of stable points was found; what is shown as motion depends on the datum")
    return tuple(out)


def joint_congruence(
    adjustment: Adjustment, epochs: tuple[str, str], options: CongruenceOptions = DEFAULT_CONGRUENCE
) -> Congruence:
    """Two epochs of one joint adjustment (:func:`~adjust.epochs.joint.joint_survey`): points that each has for itself.

    Their covariance with each other counts; the shared points are the datum. Raises SurveyError where none is common.
    """
    state = epoch_state(adjustment)
    ends = tuple(f"@{e}" for e in epochs)
    there = [{n[1][: -len(end)] for n in state.names if n[0] == "point" and n[1].endswith(end)} for end in ends]
    ids = sorted(there[0] & there[1])
    if not ids:
        raise SurveyError(f"no point was adjusted for both epochs {epochs[0]} and {epochs[1]}; see adjust.epochs.joint")
    named = [[("point", f"{i}{end}") for i in ids] for end in ends]
    joined = state.part([*named[0], *named[1]])
    n = 3 * len(ids)
    names: tuple[ParameterName, ...] = tuple(("point", i) for i in ids)
    first, second = (replace(state.part(part), names=names, directions=np.zeros((7, 0))) for part in named)
    pooled = Pooled(1.0, float("inf"), float("nan"))
    if options.scaled and adjustment.redundancy > 0:
        pooled = pooled._replace(sigma0=adjustment.sigma0, redundancy=float(adjustment.redundancy))
    both = Common(first, second, np.zeros((7, 0)), pooled)
    return compare(both, replace(options, names=epochs), joined.cov[:n, n:])
