"""All measured pairs between two bodies with a pose of their own: native factors and statistics of all at once.

A pair with a held end is exactly a prior on the other: with a held, Log(Z^-1 B^-1 A) = -Ad(Z^-1) Log(Z A^-1 B). Of a
pair of which only the rotation was measured the rows of the translation weigh nothing.

Redundancy numbers and tests as in :mod:`adjust.precision.precision`: v' Q_vv^-1 v of a whole pair is
chi-square with the rank of Q_vv degrees of freedom (Baarda 1968; Koch 1999, section 4.2).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import gtsam
import numpy as np
from gtsam import Pose3

from adjust.frames.state import State
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import POSE_COMPONENTS, POSE_UNITS, Link, Unknowns
from adjust.model.frozen import frozen
from adjust.model.observations import Pair
from adjust.model.result import Named, OtherArrays, Residuals
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.native.pairs import pair_jacobians, pair_rows, pair_spread, sure_forms
from adjust.native.trees import KeyCovariances
from adjust.observations.factors import ObservationFactor, pair_item
from adjust.observations.pair_arrays import PairArrays
from adjust.spatial.rigid_motions import Motions, exp
from adjust.testing.distributions import chi2

UNCONTROLLED = 1e-4
"""Share of a pair's direction that others must control for it to be tested; weak covariances lose digits."""
MOST_ROUNDING = 0.02
"""Of a whitened covariance of a residual: a pair is not tested where rounding may be more."""
_HELD = -1


def _ids(pair: Pair) -> tuple[str, str, str]:
    return pair.pair_id, pair.a.text, pair.b.text


class NoiseCache:
    """GTSAM noise models of square roots of information, each made once."""

    def __init__(self) -> None:
        self._made: dict[bytes, gtsam.noiseModel.Gaussian] = {}

    def __call__(self, whitening: FloatArray) -> gtsam.noiseModel.Gaussian:
        """The model that whitens by this matrix (k, k)."""
        name = whitening.tobytes()
        if name not in self._made:
            # never "smart": GTSAM would turn small sigmas into constraints
            self._made[name] = gtsam.noiseModel.Gaussian.SqrtInformation(whitening, False)
        return self._made[name]


def native_factor(
    a: int | Pose3, b: int | Pose3, b_from_a: Pose3, W: FloatArray, noise: NoiseCache
) -> gtsam.NonlinearFactor | None:
    """GTSAM's own factor of one pair between two ends, each a key or the pose where it is held; None where both are."""
    if isinstance(a, Pose3):
        if isinstance(b, Pose3):
            return None
        turned = np.asarray(np.linalg.qr(W @ b_from_a.inverse().AdjointMap(), mode="r"))
        return gtsam.PriorFactorPose3(b, a.compose(b_from_a.inverse()), noise(turned))
    if isinstance(b, Pose3):
        return gtsam.PriorFactorPose3(a, b.compose(b_from_a), noise(W))
    return gtsam.BetweenFactorPose3(b, a, b_from_a, noise(W))


@frozen(eq=False)
class PairStatistics:
    """Of every pair (E,): residual (E, dim) Log(measured^-1 adjusted), in frame a, and what the rest says of it.

    whitened: (E, dim). redundancy: (E, dim) numbers of the whitened components, zero for pairs out of use. test,
    freedom, p_value: of the whole pair; freedom 0 and nan where nothing controls it. A pair out of use is tested
    against its prediction from the others. adjusted_cov: (E, dim, dim) of the adjusted ``b_from_a``. residual_cov:
    (E, dim, dim), zero where it is not known. too_far: (E,) from the datum to be tested: rounding is all that is left.
    """

    residual: FloatArray
    whitened: FloatArray
    redundancy: FloatArray
    test: FloatArray
    freedom: IntArray
    p_value: FloatArray
    adjusted_cov: FloatArray
    residual_cov: FloatArray
    too_far: BoolArray


@dataclass(eq=False)
class PairBatch:
    """Pairs of a survey as one batch. rows: (E,) in ``Survey.pairs``. a_slot, b_slot: (E,) of their ends.

    a_key, b_key: (E,) of GTSAM's variables, ``-1`` where that end is held.
    """

    arrays: PairArrays
    rows: IntArray
    a_slot: IntArray
    b_slot: IntArray
    unknowns: Unknowns
    state: State
    noise: NoiseCache = field(default_factory=NoiseCache)
    _here: tuple[int, tuple[FloatArray, FloatArray, FloatArray]] | None = None

    def __post_init__(self) -> None:
        keys = np.array([_HELD if k is None else k for k in self.unknowns.slot_key], dtype=np.int64)
        self.a_key, self.b_key = keys[self.a_slot], keys[self.b_slot]

    def __len__(self) -> int:
        return len(self.rows)

    def _ends(self, e: int) -> tuple[int | Pose3, int | Pose3]:
        keys, slots = (int(self.a_key[e]), int(self.b_key[e])), (self.a_slot[e], self.b_slot[e])
        a, b = (k if k != _HELD else self.unknowns.slot_pose[int(s)] for k, s in zip(keys, slots, strict=True))
        return a, b

    @cached_property
    def factors(self) -> list[gtsam.NonlinearFactor | None]:
        """GTSAM's own factor of every pair, None between two held bodies."""
        W, noise, poses = self.arrays.whitening, self.noise, self.arrays.poses
        free = ((self.a_key != _HELD) & (self.b_key != _HELD)).tolist()
        between = gtsam.BetweenFactorPose3
        ends = zip(self.a_key.tolist(), self.b_key.tolist(), free, strict=True)
        return [between(b, a, poses[e], noise(W[e])) if both else native_factor(*self._ends(e), poses[e], W[e], noise)
                for e, (a, b, both) in enumerate(ends)]  # fmt: skip

    def add_factors(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """Put the factors of the pairs in use into ``graph``."""
        for factor, used in zip(self.factors, self.arrays.used.tolist(), strict=True):
            if used and factor is not None:
                graph.push_back(factor)

    @cached_property
    def both_held(self) -> BoolArray:
        """Pairs (E,) between two held bodies."""
        return np.asarray((self.a_key == _HELD) & (self.b_key == _HELD), dtype=np.bool_)

    @cached_property
    def active(self) -> IntArray:
        """Which pairs are in use and have a free end."""
        return np.flatnonzero(self.arrays.used & ~self.both_held)

    @cached_property
    def _measured(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotations, translations and whitening of these."""
        rows, arrays = self.active, self.arrays
        return arrays.rotations[rows], arrays.shifts[rows], arrays.whitening[rows]

    def rows_here(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the active pairs: whitened residuals (k, 6), derivatives (k, 6, 6) by b and by a, at the state of now."""
        state = self.state
        if self._here is None or self._here[0] != state.evaluation:
            poses = self.a_slot[self.active], self.b_slot[self.active], state.slot_R, state.slot_t
            self._here = state.evaluation, pair_rows(*poses, *self._measured)
        return self._here[1]

    def seen(self) -> set[int]:
        """The variables of the active pairs."""
        return set(np.concatenate([self.a_key[self.active], self.b_key[self.active]]).tolist()) - {_HELD}

    def keys(self) -> set[int]:
        """The variables of all pairs, used or not."""
        return set(np.concatenate([self.a_key, self.b_key]).tolist()) - {_HELD}

    def next_to_held(self) -> set[int]:
        """The variables that a pair in use joins with something held."""
        a, b, used = self.a_key, self.b_key, self.arrays.used
        return {*b[used & (a == _HELD)].tolist(), *a[used & (b == _HELD)].tolist()} - {_HELD}

    def item(self, e: int, pairs: Sequence[Pair]) -> ObservationFactor:
        """What a report needs to know of one; ``pairs`` are those of the survey."""
        chain = Link(int(self.b_slot[e]), inverse=True), Link(int(self.a_slot[e]))
        return pair_item(pairs[int(self.rows[e])], self.unknowns, self.state, chain)

    def jacobians(self, values: gtsam.Values) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Residuals (E, 6), derivatives (E, 6, 6) by b and by a, and Ad(b_from_a^-1) (E, 6, 6), unweighted."""
        self.state.load(values)
        state = self.state
        measured = self.arrays.rotations, self.arrays.shifts
        return pair_jacobians(self.a_slot, self.b_slot, state.slot_R, state.slot_t, *measured)

    def whitened_rows(self, values: gtsam.Values) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of all pairs, in use or not: whitened residuals (E, 6), derivatives (E, 6, 6) by b and by a."""
        W, (residual, by_b, by_a, _) = self.arrays.whitening, self.jacobians(values)
        return np.einsum("nij,nj->ni", W, residual), W @ by_b, W @ by_a

    def statistics(self, tree: KeyCovariances, values: gtsam.Values) -> PairStatistics:
        """Statistics of all pairs, in use or not; they do not depend on the datum of ``tree``."""
        arrays, a, b, held = self.arrays, self.a_key, self.b_key, self.both_held
        used = np.asarray(arrays.used, dtype=np.bool_)
        residual, _, by_a, turn = self.jacobians(values)
        Q = np.zeros((len(self), 12, 12))
        near = np.flatnonzero(used & ~held)
        Q[near] = tree.pairs(b[near], a[near], 6)
        for e in np.flatnonzero(~used & ~held).tolist():
            keys = [int(b[e]), int(a[e])]
            free = [i for i, k in enumerate(keys) if k != _HELD]
            at = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in free])
            Q[e][np.ix_(at, at)] = tree.joint([keys[i] for i in free])
        W, sign = arrays.whitening, np.where(used, -1.0, 1.0)[:, None, None]
        # the covariance of a pair is the difference of those of its far ends, which share nearly all of their errors
        own, scatter, white_scatter, apart = pair_spread(Q, turn, by_a, W)
        # a row of the whitening that is zero was not measured
        Qvv = sign * white_scatter + np.any(W, axis=2)[..., None] * np.eye(6)
        white = np.einsum("nij,nj->ni", W, residual)
        redundancy = np.where(used[:, None], np.diagonal(Qvv, axis1=1, axis2=2), 0.0)
        test, freedom, p = pair_tests(Qvv, white, UNCONTROLLED)
        residual_cov = arrays.cov + sign * scatter
        far = 4.0 * np.finfo(float).eps * apart.max(axis=1, initial=0.0) > MOST_ROUNDING
        test[far], freedom[far], p[far], residual_cov[far] = np.nan, 0, np.nan, 0.0
        return PairStatistics(residual, white, redundancy, test, freedom, p, own, residual_cov, far)

    def residuals(self, stats: PairStatistics, pairs: Sequence[Pair]) -> Residuals:
        """As reports take them; ``pairs`` are those of the survey."""
        v, cov = stats.residual, self.arrays.cov
        adjusted = (self.arrays.motions @ exp(v)).log()
        sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        spread = np.diagonal(stats.residual_cov, axis1=1, axis2=2)
        with np.errstate(invalid="ignore"):
            seen = spread > UNCONTROLLED * sigma**2
            standardized = np.where(seen, v / np.sqrt(np.where(seen, spread, 1.0)), np.nan)
        turned = Motions(self.arrays.rotations @ exp(v[:, :3]).rotation).log()
        adjusted[~self.arrays.is_pose, :3] = turned[~self.arrays.is_pose]
        sizes = np.where(self.arrays.is_pose, 6, 3)
        measured = np.arange(6) < sizes[:, None]
        columns = self.arrays.logs, adjusted, v, sigma, stats.redundancy, standardized
        most = np.where(measured, stats.redundancy, -np.inf).max(axis=1)
        arrays = OtherArrays(sizes, self.arrays.used, stats.test, most, *(x[measured] for x in columns))
        return Residuals(arrays, partial(_named, [pairs[row] for row in self.rows.tolist()], sizes.tolist()), len(self))


def _named(pairs: Sequence[Pair], sizes: Sequence[int], e: int) -> Named:
    return "pair", pairs[e].group, _ids(pairs[e]), POSE_COMPONENTS[: sizes[e]], POSE_UNITS[: sizes[e]]


def pair_tests(Q: FloatArray, v: FloatArray, least: float) -> tuple[FloatArray, IntArray, FloatArray]:
    """The forms v' Q^+ v (E,), the rank of Q, and p: whitened residuals v (E, k) with their covariances Q (E, k, k).

    Eigenvalues below ``least`` count as zero; nan where all do.
    """
    n, k = v.shape
    test, freedom = sure_forms(Q, v, least) if k == 6 else np.full(n, -1.0), np.full(n, k, dtype=np.int64)
    rest = np.flatnonzero(test < 0.0)
    w, U = np.linalg.eigh(Q[rest])
    kept = w > least
    y = np.einsum("nij,ni->nj", U, v[rest])
    test[rest] = (np.where(kept, y * y, 0.0) / np.where(kept, w, 1.0)).sum(axis=1)
    freedom[rest] = kept.sum(axis=1)
    test = np.where(freedom > 0, test, np.nan)
    with np.errstate(invalid="ignore"):
        return test, freedom, np.where(freedom > 0, chi2.sf(test, np.maximum(freedom, 1)), np.nan)


def simple_pairs(survey: Survey, frames: FrameTree) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs between two fixed stations: their rows in ``Survey.pairs``, and the slots of their ends a and b."""
    fixed = {s.station_id: s.world_from_station for s in survey.stations if s.motion == "fixed"}
    rows = [row for row, p in enumerate(survey.pairs) if p.a.kind == p.b.kind == "station" and p.a != p.b
            and p.a.frame_id in fixed and p.b.frame_id in fixed]  # fmt: skip
    ends = [(survey.pairs[row].b.frame_id, survey.pairs[row].a.frame_id) for row in rows]
    joined = dict.fromkeys(s for both in ends for s in both)
    slot = {s: frames.unknowns.slot(("world_from_station", s), fixed[s]) for s in joined}
    of_b, of_a = np.array([(slot[b], slot[a]) for b, a in ends], dtype=np.int64).reshape(-1, 2).T
    return np.array(rows, dtype=np.int64), of_a, of_b
