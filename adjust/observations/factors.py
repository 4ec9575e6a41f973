"""Factors of everything that is not an image point. GTSAM's own where it has them; the rest through one adapter.

A residual is predicted minus observed, unwhitened; the noise model alone whitens.
"""

from collections.abc import Callable, Iterable, Sequence

import gtsam
import numpy as np
from gtsam import Pose3, Rot3

from adjust.frames.state import State
from adjust.frames.unknowns import POSE_COMPONENTS, POSE_UNITS, Chain, Unknown, Unknowns, VectorMap
from adjust.model.frozen import frozen
from adjust.model.observations import Coordinates, Distance, Pair
from adjust.model.survey import BoolArray, FloatArray, IntArray, PoseParameter, VectorPrior
from adjust.observations.adapter import evaluated
from adjust.observations.images.batch import Chains
from adjust.spatial.rigid import skew

Jacobians = list[tuple[int, FloatArray]]
Residual = Callable[[gtsam.Values], tuple[FloatArray, Iterable[tuple[int, FloatArray]]]]
"""From values to a residual and its Jacobians by keys, which may be found as they are asked for."""
PoseOf = Callable[[gtsam.Values], tuple[Pose3, Jacobians]]


@frozen(eq=False)
class ObservationFactor:
    """A factor that is not an image batch, with what a report needs to know of it. ``observed``: (k,)."""

    factor: gtsam.NonlinearFactor
    kind: str
    group: str
    ids: tuple[str, ...]
    components: tuple[str, ...]
    units: tuple[str, ...]
    observed: FloatArray
    used: bool = True


def gaussian(cov: FloatArray) -> gtsam.noiseModel.Gaussian:
    """Noise of a full covariance; never turned into a constraint, however small (GTSAM's "smart" models are)."""
    return gtsam.noiseModel.Gaussian.Covariance(np.atleast_2d(cov), False)


def custom(
    keys: Sequence[int], noise: FloatArray | gtsam.noiseModel.Base, residual: Residual
) -> gtsam.CustomFactor:
    """From ``values -> (residual, [(key, jacobian)])`` to a factor.

    noise: covariance, or a model of GTSAM's. A key that comes more than once has its Jacobians added.
    """
    at = {key: i for i, key in enumerate(keys)}

    def call(values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        r, blocks = residual(values)
        if jacobians is not None:
            sums: dict[int, FloatArray] = {}
            for key, block in blocks:
                sums[key] = sums[key] + block if key in sums else block
            for key, block in sums.items():
                jacobians[at[key]] = np.ascontiguousarray(block)
        return r

    model = noise if isinstance(noise, gtsam.noiseModel.Base) else gaussian(noise)
    return evaluated(model, keys, call)


class ChainPose:
    """The pose of a chain at given values, and its derivative (tangent on the right) by every unknown in it."""

    def __init__(self, unknowns: Unknowns, state: State, chain: Chain) -> None:
        self.state, self.chains = state, Chains([chain])
        self.keys: list[int] = []
        for link in chain:
            self.keys += [k for k in unknowns.link_keys(link.slot) if k not in self.keys]

    def __call__(self, values: gtsam.Values) -> tuple[Pose3, Jacobians]:
        """Pose and Jacobians (6, dim)."""
        c = self.chains
        if not self.state.served:
            self.state.load(values, [int(s) for s in c.slot], lenses=False)
        c.evaluate(self.state)
        jacobians: Jacobians = []
        for i, slot in enumerate(c.slot):
            jacobians += self.state.by_keys(int(slot), c.C[i].copy())
        return Pose3(Rot3(c.R[0]), c.t[0]), jacobians


@frozen(eq=False)
class Position:
    """A position in the world: a world point (key or held value), or a point fixed in the frame of a chain.

    warp: of the target that the point is on; moves (3, k): how its components move the point.
    """

    chain: ChainPose | None
    x_in_frame: FloatArray
    point_key: int | None = None
    warp: VectorMap | None = None
    moves: FloatArray | None = None

    @property
    def keys(self) -> list[int]:
        """The unknowns it depends on."""
        if self.point_key is not None:
            return [self.point_key]
        warp = [self.warp.key] if self.warp is not None and self.warp.key is not None else []
        return (self.chain.keys if self.chain else []) + warp

    def __call__(self, values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        """Coordinates (3,) m in the world and Jacobians (3, dim)."""
        if self.point_key is not None:
            return np.asarray(values.atPoint3(self.point_key)), [(self.point_key, np.eye(3))]
        if self.chain is None:
            return self.x_in_frame, []
        pose, jacobians = self.chain(values)
        R = pose.rotation().matrix()
        x = self.x_in_frame
        if self.warp is not None and self.moves is not None:
            x = x + self.moves @ self.warp.full(values)
        by_pose = np.hstack([-R @ skew(x), R])
        out = [(key, by_pose @ J) for key, J in jacobians]
        if self.warp is not None and self.warp.key is not None and self.moves is not None:
            out.append((self.warp.key, R @ self.moves @ self.warp.matrix))
        return R @ x + pose.translation(), out


def distance_residual(a: Position, b: Position, value: float) -> Residual:
    """Distance between two positions minus the observed one; (1,) m."""

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        (xa, ja), (xb, jb) = a(values), b(values)
        d = xb - xa
        length = float(np.linalg.norm(d))
        u = (d / length)[None, :]
        return np.array([length - value]), [(k, -u @ J) for k, J in ja] + [(k, u @ J) for k, J in jb]

    return residual


def distance_factor(observation: Distance, a: Position, b: Position) -> gtsam.NonlinearFactor:
    """GTSAM's range between two points, or the general one."""
    cov = np.array([[observation.sigma**2]])
    if a.point_key is not None and b.point_key is not None:
        return gtsam.RangeFactor3(a.point_key, b.point_key, observation.value, gaussian(cov))
    keys = list(dict.fromkeys(a.keys + b.keys))
    return custom(keys, cov, distance_residual(a, b, observation.value))


def coordinates_factor(observation: Coordinates, positions: Sequence[Position]) -> gtsam.NonlinearFactor:
    """GTSAM's prior for one world point, or coordinates of several positions with their joint covariance."""
    cov = observation.cov
    if len(positions) == 1 and positions[0].point_key is not None and known_components(cov).all():
        return gtsam.PriorFactorPoint3(positions[0].point_key, observation.values[0], gaussian(cov))
    return positions_factor([((p, 1.0),) for p in positions], observation.values, cov)


def known_components(cov: FloatArray) -> BoolArray:
    """Which components of an observation were observed: those with a finite variance."""
    return np.asarray(np.isfinite(np.diag(cov)))


def positions_factor(
    sums: Sequence[Sequence[tuple[Position, float]]], observed: FloatArray, cov: FloatArray
) -> gtsam.CustomFactor:
    """Sums of positions with signs minus what was observed of them (n, 3), with joint covariance cov (3n, 3n)."""
    known, keys = known_components(cov), list(dict.fromkeys(k for signed in sums for p, _ in signed for k in p.keys))

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        out, blocks = -observed.ravel(), []
        for i, signed in enumerate(sums):
            rows = slice(3 * i, 3 * i + 3)
            for position, sign in signed:
                x, jacobians = position(values)
                out[rows] += sign * x
                for key, J in jacobians:
                    block = np.zeros((len(out), J.shape[1]))
                    block[rows] = sign * J
                    blocks.append((key, block[known]))
        return out[known], blocks

    return custom(keys, cov[np.ix_(known, known)], residual)


def pair_item(pair: Pair, unknowns: Unknowns, state: State, chain: Chain) -> ObservationFactor:
    """A measured relative pose or rotation: GTSAM's between factor for two fixed bodies, else the general chain."""
    measured, keys = pair.b_from_a, [unknowns.slot_key[link.slot] for link in chain]
    simple = len(chain) == 2 and chain[0].inverse and not chain[1].inverse and keys[0] != keys[1]
    factor: gtsam.NonlinearFactor
    if isinstance(measured, Rot3):
        observed, given = Rot3.Logmap(measured), Pose3(measured, np.zeros(3))
    else:
        observed, given = Pose3.Logmap(measured), measured
    n = len(observed)
    free = simple and all(unknowns.derived(link.slot) is None for link in chain) and n == 6
    if free and (b := keys[0]) is not None and (a := keys[1]) is not None:
        factor = gtsam.BetweenFactorPose3(b, a, given, gaussian(pair.cov))
    else:
        predicted = ChainPose(unknowns, state, chain)
        factor = custom(predicted.keys, pair.cov, _components_residual(predicted, given, np.arange(n)))
    ids = pair.pair_id, pair.a.text, pair.b.text
    return ObservationFactor(factor, "pair", pair.group, ids, POSE_COMPONENTS[:n], POSE_UNITS[:n],
                             np.asarray(observed, dtype=float), pair.used)  # fmt: skip


def _components_residual(predicted: PoseOf, given: Pose3, rows: IntArray) -> Residual:
    """Some components of a pose's tangent at a given one."""

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        pose, jacobians = predicted(values)
        D = np.zeros((6, 6), order="F")
        r = Pose3.Logmap(given.between(pose), D)
        return np.asarray(r)[rows], [(k, D[rows] @ J) for k, J in jacobians]

    return residual


def _unknown_pose(key: int) -> PoseOf:
    return lambda values: (values.atPose3(key), [(key, np.eye(6))])


def vector_prior_factor(prior: VectorPrior, vector: VectorMap) -> gtsam.NonlinearFactor:
    """Prior on some components of a lens, table or warp; linear in the free components."""
    index = [vector.names.index(name) for name in prior.names]
    own = [i for i in range(len(vector.free)) if i not in vector.borrowed]
    M, base, key = vector.matrix[np.ix_(index, own)], vector.base[index], vector.key
    if key is None:
        raise ValueError("a prior on a vector without free components has no unknown")

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        return base + M @ values.atVector(key) - prior.mean, [(key, M)]

    return custom([key], prior.cov, residual)


def step_factor(vector: VectorMap, before: VectorMap | None, sigmas: FloatArray) -> gtsam.NonlinearFactor:
    """A step of a random walk: the vector less the one before it (zero where there is none), with sigmas (k,)."""
    if vector.key is None or (before is not None and before.key is None):
        raise ValueError("a step is between unknowns")
    terms = [(vector.key, np.eye(len(sigmas)))]
    terms += [] if before is None or before.key is None else [(before.key, -np.eye(len(sigmas)))]

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        return np.asarray(sum(J @ values.atVector(key) for key, J in terms)), terms

    return custom([key for key, _ in terms], np.diag(sigmas**2), residual)


def pose_prior_factor(parameter: PoseParameter, key: int) -> gtsam.NonlinearFactor:
    """Prior on a pose; components with an infinite variance carry none."""
    if parameter.value is None or parameter.prior_cov is None:
        raise ValueError("a pose prior needs a value and a covariance")
    mean, cov = parameter.value, parameter.prior_cov
    known = known_components(cov)
    if known.all():
        return gtsam.PriorFactorPose3(key, mean, gaussian(cov))
    residual = _components_residual(_unknown_pose(key), mean, np.flatnonzero(known))
    return custom([key], cov[np.ix_(known, known)], residual)


HOLD = 1e-9
"""Standard deviation (m, rad) of a component that keeps its value. It is no observation: it is counted nowhere, and
its variance is reported as zero. What the observations pull it by, about 1e-12 of this, is far below rounding."""


def hold_factor(unknown: Unknown, held: Sequence[int], value: Pose3 | FloatArray) -> gtsam.NonlinearFactor:
    """Keeps some components of a pose or a point at ``value``."""
    rows = list(held)
    cov = np.eye(len(rows)) * HOLD**2
    key = unknown.key
    if isinstance(value, Pose3):
        if rows == [3, 4, 5]:
            return gtsam.PoseTranslationPrior3D(key, value, gaussian(cov))
        return custom([key], cov, _components_residual(_unknown_pose(key), value, np.array(rows)))
    wanted, select = np.asarray(value, dtype=float)[rows], np.eye(unknown.dim)[rows]

    def point_residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        return np.asarray(values.atPoint3(key))[rows] - wanted, [(key, select)]

    return custom([key], cov, point_residual)
