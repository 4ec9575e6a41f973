"""How every name moved between two epochs, and whether that is significant: all of a kind at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from adjust.epochs.change import Change, Displaced
from adjust.epochs.congruence_result import CongruenceTest, Motion
from adjust.epochs.states import Epoch
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.statistics.relative_precision import ellipsoids
from adjust.statistics.result import Ellipsoid
from adjust.testing.criteria import noncentrality
from adjust.testing.distributions import chi2, fisher
from adjust.testing.quadratic_forms import squares_in_sigmas


class Pooled(NamedTuple):
    """Sigma0 of both epochs together, its redundancy (infinite where known), p of equal variance factors."""

    sigma0: float
    redundancy: float
    ratio_p: float


def tests_of(statistic: FloatArray, freedom: IntArray, pooled: Pooled, level: float) -> list[CongruenceTest]:
    """Of quadratic forms (p,) with their ranks (p,)."""
    sigma0, f, _ = pooled
    k = np.maximum(freedom, 1)
    F = statistic / k / sigma0**2
    p = fisher.sf(F, k, f) if np.isfinite(f) else chi2.sf(F * k, k)
    rows = zip(F.tolist(), freedom.tolist(), p.tolist(), strict=True)
    nan = float("nan")
    return [CongruenceTest(x, n, f, q, q >= level) if n else CongruenceTest(nan, 0, f, nan, True) for x, n, q in rows]


@frozen(eq=False)
class _Kind:
    """Names (p,) of which the same is known: components (k,) of rx ry rz x y z, in rows (p, k); or no position."""

    names: IntArray
    known: IntArray
    rows: IntArray
    is_pose: bool
    nowhere: bool


@frozen(eq=False)
class Judging:
    """What every motion is judged by. level: of a single test, alpha of all, power: of :attr:`Motion.smallest`."""

    change: Change
    before: Epoch
    stable: frozenset[int]
    pooled: Pooled
    level: float
    alpha: float
    power: float

    def of(self, displaced: Displaced) -> tuple[Motion, ...]:
        """Of all names, those that moved most clearly first, stable ones last."""
        out = [m for kind in self._kinds() for m in self._motions(kind, *displaced(kind.rows))]
        order = self.before.index
        return tuple(sorted(out, key=lambda m: (m.stable, m.test.p if np.isfinite(m.test.p) else 2.0, order[m.name])))

    def _kinds(self) -> list[_Kind]:
        owner, out = self.change.owner, list[_Kind]()
        first = np.flatnonzero(np.diff(owner, prepend=-1))
        names = owner[first]
        nowhere = np.array([n in self.change.nowhere for n in self.change.names], dtype=np.bool_)[names]
        kind = np.add.reduceat(1 << self.change.component, first) + 64 * (self.before.sizes[names] == 6) + 128 * nowhere
        for k in np.unique(kind).tolist():
            known = np.flatnonzero(k >> np.arange(6) & 1)
            rows = first[kind == k, None] + np.arange(len(known))
            out.append(_Kind(names[kind == k], known, rows, bool(k & 64), bool(k & 128)))
        return out

    def _motions(self, kind: _Kind, d: FloatArray, Q: FloatArray) -> list[Motion]:
        """Of displacements (p, k) with covariances (p, k, k)."""
        n, turns = len(d), kind.known < 3
        full, cov = np.zeros((n, 6)), np.zeros((n, 6, 6))
        full[:, kind.known], cov[:, kind.known[:, None], kind.known] = d, Q
        axes = np.array([self.before.axes(self.change.names[i]) for i in kind.names.tolist()])
        shift, cov_shift = (axes @ full[:, 3:, None])[..., 0], axes @ cov[:, 3:, 3:] @ np.swapaxes(axes, 1, 2)
        tests, turned = self.tests(d, Q), list[CongruenceTest | None]([None] * n)
        if kind.is_pose:
            turned[:] = self.tests(d[:, turns], Q[:, turns][:, :, turns])
        regions, smallest = self._regions(cov_shift), self._smallest(cov_shift, tests)
        if kind.nowhere:
            nowhere = Ellipsoid(np.zeros(0), np.zeros((3, 0)), 1.0 - self.alpha, np.isfinite(self.pooled[1]))
            shift, cov_shift, regions = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), [nowhere] * n
            smallest = np.full(n, np.nan)
        rows = zip(kind.names.tolist(), shift, cov_shift, regions, tests, full[:, :3], cov[:, :3, :3], turned,
                   smallest.tolist(), strict=True)  # fmt: skip
        return [
            Motion(self.change.names[i], x, of_x, region, test, turn if about else None, of_turn if about else None,
                   about, i in self.stable, bool(test.p < self.level), least)
            for i, x, of_x, region, test, turn, of_turn, about, least in rows
        ]  # fmt: skip

    def tests(self, d: FloatArray, Q: FloatArray) -> list[CongruenceTest]:
        """Of displacements (p, k) with covariances (p, k, k), each by itself."""
        return tests_of(*squares_in_sigmas(d, Q), self.pooled, self.level)

    def _regions(self, cov: FloatArray) -> list[Ellipsoid]:
        scale = (self.pooled[0], int(self.pooled[1])) if np.isfinite(self.pooled[1]) else (None, 0)
        return ellipsoids(cov, 1.0 - self.alpha, *scale)

    def _smallest(self, cov: FloatArray, tested: Sequence[CongruenceTest]) -> FloatArray:
        """Displacements (p,) m that would be found in the worst direction."""
        q = np.maximum(1, [test.freedom for test in tested])
        per_variance = {k: noncentrality(self.level, self.power, k) for k in np.unique(q).tolist()}
        size = np.array([per_variance[k] for k in q.tolist()]) * np.linalg.eigvalsh(cov)[:, -1]
        return np.asarray(self.pooled[0] * np.sqrt(np.maximum(0.0, size)))
