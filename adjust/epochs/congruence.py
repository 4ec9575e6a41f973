"""Congruence of two epochs: did anything move, what stayed, and how far the rest went (Pelzer 1971, Niemeier 2008, 13).

Both epochs are brought to one datum over the points held for stable (S-transformation, Baarda 1973), for all motions
that either of them does not determine; ``d' Q_d^+ d`` of these points is the test. While it fails, the point that
contributes most is taken out of the datum, until what is left is congruent.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from gtsam import Pose3

from adjust.epochs.congruence_result import Congruence, CongruenceStep, CongruenceTest, Motion
from adjust.epochs.states import MOTIONS, EpochState, aligned, differences, epoch_state, gauge_rows
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.precision.s_transformation import transformed
from adjust.statistics.relative_precision import ellipsoid
from adjust.statistics.result import Ellipsoid
from adjust.testing.criteria import LevelOptions, noncentrality, sidak
from adjust.testing.distributions import chi2, fisher
from adjust.testing.quadratic_forms import pseudo_precision, pseudo_square, pseudo_square_beside


@dataclass(frozen=True)
class CongruenceOptions:
    """alpha: of the global test, and of all single tests together.

    scaled: sigma0 is pooled from both epochs, else the a priori sigmas hold. reference: names to begin with as stable
    (all common ones, where None). search: whether unstable ones are looked for among them. levels: only the power of
    ``Motion.smallest``. names: of the epochs.
    """

    alpha: float = 0.05
    scaled: bool = True
    reference: tuple[ParameterName, ...] | None = None
    search: bool = True
    levels: LevelOptions = field(default_factory=LevelOptions)
    names: tuple[str, str] = ("first", "second")


DEFAULT_CONGRUENCE = CongruenceOptions()


@dataclass(frozen=True, eq=False)
class _Change:
    """Differences d (n,), their covariance Q (n, n), the motions G (n, k) that do not count, and whose rows are whose.

    owner: (n,) number of the name. component: (n,) of rx ry rz x y z, 0 to 5. weight: (n,) in the datum. held: (n, k)
    what the datum holds, held' d = 0. nowhere: names of which an epoch knows the rotation alone.
    """

    names: tuple[ParameterName, ...]
    d: FloatArray
    Q: FloatArray
    G: FloatArray
    owner: IntArray
    component: IntArray
    weight: FloatArray
    held: FloatArray
    nowhere: frozenset[ParameterName]

    def rows(self, stable: Sequence[int]) -> IntArray:
        """Components of these names."""
        return np.flatnonzero(np.isin(self.owner, stable))

    def transformed(self, stable: Sequence[int]) -> "_Change":
        """In the datum of these names: S = I - G (G'EG)^-1 G'E."""
        if not self.G.shape[1]:
            return self
        E = np.zeros(len(self.d))
        E[self.rows(stable)] = self.weight[self.rows(stable)]
        if np.linalg.matrix_rank(np.sqrt(E)[:, None] * self.G) < self.G.shape[1]:
            raise SurveyError(
                f"{len(stable)} stable points cannot carry the {self.G.shape[1]} motions that the epochs leave open; "
                "name more, or hold something in both"
            )
        d, Q = transformed(self.d, self.Q, self.G, E)
        return replace(self, d=d, Q=Q, held=E[:, None] * self.G)


def congruence(
    first: Adjustment, second: Adjustment, options: CongruenceOptions = DEFAULT_CONGRUENCE
) -> Congruence:
    """Compare two adjustments of independent observations. Points and fixed stations are matched by their ids.

    Raises SurveyError where nothing is common, or the reference is too small.
    """
    both = common(first, second, options)
    after = aligned(both.before, both.after, both.directions, _numbers(both.names, options.reference))
    return compare(both.names, both.before, after, both.directions, both.pooled, options)


@dataclass(frozen=True, eq=False)
class Common:
    """What two epochs have in common, not aligned; directions and pooled as :func:`compare` takes them."""

    names: tuple[ParameterName, ...]
    before: EpochState
    after: EpochState
    directions: FloatArray
    pooled: tuple[float, float, float]


def common(first: Adjustment, second: Adjustment, options: CongruenceOptions = DEFAULT_CONGRUENCE) -> Common:
    """The points and fixed stations that both epochs have; raises SurveyError where there are none."""
    before, after = epoch_state(first), epoch_state(second)
    names = tuple(n for n in before.names if n in after.index)
    if not names:
        raise SurveyError("the epochs have no point and no fixed station in common; use the same ids in both")
    before, after = before.part(names), after.part(names)
    directions = _open_motions(before, after)
    return Common(names, before, after, directions, _pooled(first, second, options.scaled))


def compare(
    names: tuple[ParameterName, ...], before: EpochState, after: EpochState, directions: FloatArray,
    pooled: tuple[float, float, float], options: CongruenceOptions, cross: FloatArray | None = None,
) -> Congruence:  # fmt: skip
    """Of two states of the same names, aligned. directions (7, k): motions that do not count.

    pooled: sigma0, its redundancy, p of the test of equal variances. cross: covariance (n, n) of the first with the
    second state where they are not independent.
    """
    change = _change(names, before, after, directions, cross)
    begin = _numbers(names, options.reference)
    kept = [i for i in begin if (change.owner == i).any()]
    if not kept:
        raise SurveyError("no point of the reference is free in either epoch; there is nothing to test")
    first_test = _global(change, kept, pooled, options.alpha)
    steps, stable, last = _search(change, kept, first_test, pooled, options)
    motions = _motions(change, before, stable, pooled, options)
    moved = tuple(m.name for m in motions if m.significant)
    return Congruence(
        options.names, options.alpha, options.scaled, pooled[0], pooled[1], pooled[2], first_test, last, tuple(steps),
        tuple(names[i] for i in stable), moved, _named(directions), motions, _warnings(pooled, last, options),
    )  # fmt: skip


def _numbers(names: Sequence[ParameterName], reference: Sequence[ParameterName] | None) -> list[int]:
    if reference is None:
        return list(range(len(names)))
    lost = [n for n in reference if n not in names]
    if lost:
        raise SurveyError(f"{' '.join(lost[0])} of the reference is not common to both epochs")
    return [names.index(n) for n in reference]


def _pooled(first: Adjustment, second: Adjustment, scaled: bool) -> tuple[float, float, float]:
    """Sigma0, redundancy, and p of the two-sided F-test of equal variance factors."""
    f1, f2 = first.redundancy, second.redundancy
    p = float("nan")
    if f1 > 0 and f2 > 0:
        a, b = np.float64(first.omega / f1), np.float64(second.omega / f2)
        with np.errstate(divide="ignore", invalid="ignore"):
            p = float(2.0 * min(fisher.sf(b / a, f2, f1), fisher.sf(a / b, f1, f2)))
    if not scaled or f1 + f2 <= 0:
        return 1.0, float("inf"), p
    return float(np.sqrt((first.omega + second.omega) / (f1 + f2))), float(f1 + f2), p


def _open_motions(before: EpochState, after: EpochState) -> FloatArray:
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


def _change(
    names: tuple[ParameterName, ...], before: EpochState, after: EpochState, directions: FloatArray,
    cross: FloatArray | None,
) -> _Change:  # fmt: skip
    d, Q = differences(before, after), before.cov + after.cov
    if cross is not None:
        Q = Q - cross - cross.T
    G = gauge_rows(before) @ directions
    known = np.isfinite(d) & (np.diag(before.cov) + np.diag(after.cov) > 0.0)
    owner = np.repeat(np.arange(len(names)), before.sizes)
    component = np.concatenate([before.components(n) for n in names])
    nowhere = frozenset(names[int(i)] for i in owner[~np.isfinite(d)])
    Q_known = Q if known.all() else Q[np.ix_(known, known)]
    change = _Change(names, d[known], Q_known, G[known], owner[known], component[known],
                     np.ones(int(known.sum())), np.zeros((int(known.sum()), 0)), nowhere)  # fmt: skip
    return replace(change, weight=_weights(change))


def _weights(change: _Change) -> FloatArray:
    """One weight for all positions, one for all rotations: the mean precision of a component if all others are known.

    With points alone, or a datum that both epochs have, they do not matter; metres and radians need them.
    """
    position, G = change.component >= 3, change.G
    if position.all() or not position.any() or not G.shape[1]:
        return np.ones(len(position))
    precision = pseudo_precision(transformed(change.d, change.Q, G, np.ones(len(G)))[1], G)
    return np.asarray(np.where(position, precision[position].mean(), precision[~position].mean()))


def _test(statistic: float, freedom: int, pooled: tuple[float, float, float], level: float) -> CongruenceTest:
    sigma0, f, _ = pooled
    if freedom == 0:
        return CongruenceTest(float("nan"), 0, f, float("nan"), True)
    F = statistic / freedom / sigma0**2
    p = float(fisher.sf(F, freedom, f) if np.isfinite(f) else chi2.sf(F * freedom, freedom))
    return CongruenceTest(F, freedom, f, p, p >= level)


def _global(
    change: _Change, stable: Sequence[int], pooled: tuple[float, float, float], alpha: float
) -> CongruenceTest:
    here = change.transformed(stable)
    rows = here.rows(stable)
    statistic, rank = pseudo_square_beside(here.d[rows], here.Q[np.ix_(rows, rows)], here.held[rows])
    # what the datum takes away is no information, whatever rounding leaves of it
    rank = min(rank, max(0, len(rows) - change.G.shape[1]))
    return _test(statistic, rank, pooled, alpha)


def _search(
    change: _Change, begin: list[int], test: CongruenceTest, pooled: tuple[float, float, float],
    options: CongruenceOptions,
) -> tuple[list[CongruenceStep], list[int], CongruenceTest]:  # fmt: skip
    """Take out the worst until the rest is congruent, and back what then fits.

    No search for gross errors: not single points are judged but what is left, as a whole and by F, and every step is
    told with the test after it (Niemeier 2008, 13.3).
    """
    stable, steps = list(begin), list[CongruenceStep]()
    while options.search and not test.passed:
        shares = _shares(change, stable)
        worst = max(shares, key=lambda i: shares[i])
        rest = [i for i in stable if i != worst]
        try:
            now = _global(change, rest, pooled, options.alpha) if rest else None
        except SurveyError:
            now = None
        if now is None or now.freedom == 0:
            break
        stable, test = rest, now
        steps.append(CongruenceStep(change.names[worst], shares[worst], test))
    return _readmitted(change, begin, stable, test, steps, pooled, options)


def _readmitted(
    change: _Change, begin: list[int], stable: list[int], test: CongruenceTest, steps: list[CongruenceStep],
    pooled: tuple[float, float, float], options: CongruenceOptions,
) -> tuple[list[CongruenceStep], list[int], CongruenceTest]:  # fmt: skip
    level = sidak(options.alpha, len(begin))
    for i in [i for i in begin if i not in stable] if test.passed else []:
        single = _single(change.transformed(stable), i, pooled, level)
        more = sorted([*stable, i])
        together = _global(change, more, pooled, options.alpha)
        if single.passed and together.passed:
            stable, test = more, together
            steps = [s for s in steps if s.name != change.names[i]]
    return steps, stable, test


def _shares(change: _Change, stable: Sequence[int]) -> dict[int, float]:
    """What each name adds to d' Q^+ d of the others alone: (P d)_j' P_jj^-1 (P d)_j (Niemeier 2008, 13.3)."""
    here = change.transformed(stable)
    rows = here.rows(stable)
    d = here.d[rows]
    _, _, P = pseudo_square(d, here.Q[np.ix_(rows, rows)])
    gradient, owner, out = P @ d, here.owner[rows], {}
    for i in stable:
        mine = np.flatnonzero(owner == i)
        if len(mine):
            out[i] = float(gradient[mine] @ np.linalg.pinv(P[np.ix_(mine, mine)], hermitian=True) @ gradient[mine])
    return out


def _single(here: _Change, i: int, pooled: tuple[float, float, float], level: float) -> CongruenceTest:
    rows = here.rows([i])
    statistic, rank, _ = pseudo_square(here.d[rows], here.Q[np.ix_(rows, rows)])
    return _test(statistic, rank, pooled, level)


def _motions(
    change: _Change, before: EpochState, stable: list[int], pooled: tuple[float, float, float],
    options: CongruenceOptions,
) -> tuple[Motion, ...]:  # fmt: skip
    here = change.transformed(stable)
    present = [i for i in range(len(change.names)) if (change.owner == i).any()]
    level = sidak(options.alpha, len(present))
    out = [_motion(here, before, i, i in stable, pooled, level, options) for i in present]
    return tuple(sorted(out, key=lambda m: (m.stable, m.test.p if np.isfinite(m.test.p) else 2.0)))


def _motion(
    here: _Change, before: EpochState, i: int, stable: bool, pooled: tuple[float, float, float], level: float,
    options: CongruenceOptions,
) -> Motion:  # fmt: skip
    name = here.names[i]
    rows = here.rows([i])
    d, Q = here.d[rows], here.Q[np.ix_(rows, rows)]
    place, axes = here.component[rows], before.axes(name)
    full, cov = np.zeros(6), np.zeros((6, 6))
    full[place] = d
    cov[np.ix_(place, place)] = Q
    shift, cov_shift = axes @ full[3:], axes @ cov[3:, 3:] @ axes.T
    test = _single(here, i, pooled, level)
    turn, rotation_test = np.zeros(3), None
    if isinstance(before.value(name), Pose3):
        turning = np.flatnonzero(place < 3)
        statistic, rank, _ = pseudo_square(d[turning], Q[np.ix_(turning, turning)])
        turn, rotation_test = full[:3], _test(statistic, rank, pooled, level)
    if name in here.nowhere:
        nan = np.full((3, 3), np.nan)
        region = Ellipsoid(np.zeros(0), np.zeros((3, 0)), 1.0 - options.alpha, np.isfinite(pooled[1]))
        return Motion(name, nan[0], nan, region, test, turn, cov[:3, :3], rotation_test, stable, bool(test.p < level),
                      float("nan"))  # fmt: skip
    q = max(1, test.freedom)
    size = noncentrality(level, options.levels.power, q) * float(np.linalg.eigvalsh(cov_shift)[-1])
    scale = (pooled[0], int(pooled[1])) if np.isfinite(pooled[1]) else (None, 0)
    return Motion(
        name, shift, cov_shift, ellipsoid(cov_shift, 1.0 - options.alpha, *scale), test,
        turn if rotation_test else None, cov[:3, :3] if rotation_test else None, rotation_test, stable,
        bool(test.p < level), pooled[0] * float(np.sqrt(max(0.0, size))),
    )  # fmt: skip


def _warnings(pooled: tuple[float, float, float], last: CongruenceTest, options: CongruenceOptions) -> tuple[str, ...]:
    out = []
    if pooled[2] < options.alpha:
        out.append(
            f"the epochs have different variance factors (p {pooled[2]:.2g}); estimate variance components or look for "
            "gross errors before believing the tests"
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
    both = [{n[1][: -len(end)] for n in state.names if n[0] == "point" and n[1].endswith(end)} for end in ends]
    ids = sorted(both[0] & both[1])
    if not ids:
        raise SurveyError(f"no point was adjusted for both epochs {epochs[0]} and {epochs[1]}; see adjust.epochs.joint")
    named = [[("point", f"{i}{end}") for i in ids] for end in ends]
    joined = state.part([*named[0], *named[1]])
    n = 3 * len(ids)
    names: tuple[ParameterName, ...] = tuple(("point", i) for i in ids)
    first, second = (replace(state.part(part), names=names, directions=np.zeros((7, 0))) for part in named)
    sigma0 = adjustment.sigma0 if options.scaled and adjustment.redundancy > 0 else 1.0
    freedom = float(adjustment.redundancy) if options.scaled and adjustment.redundancy > 0 else float("inf")
    return compare(names, first, second, np.zeros((7, 0)), (sigma0, freedom, float("nan")),
                   replace(options, names=epochs), joined.cov[:n, n:])  # fmt: skip
