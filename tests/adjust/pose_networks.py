"""Simulated networks of stations, with rotations and noise by SciPy and plain lines."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import FloatArray, PoseParameter, Station, Survey
from adjust.observations.pair_arrays import PairArrays
from adjust.observations.pairs import PairStatistics
from adjust.pose_network import PoseNetwork
from adjust.pose_network.from_survey import network_from_survey
from adjust.pose_network.network import Topology, network_of
from adjust.pose_network.solve import DEFAULTS, Minimum, NetworkOptions, minimize
from adjust.precision.precision import Precision
from adjust.spatial.rigid_motions import Motions, right_jacobian_inverse
from adjust.start.given import without_starts
from survey.interop.networks.g2o import read_g2o_file


def pose_network(
    station_ids, pair_ids, a_idx, b_idx, rotations, translations, cov, *,
    held=None, start=None, prior=None, inner=None, used=None,
) -> PoseNetwork:  # fmt: skip
    """A checked network from arrays.

    translations: (E, 3), nan rows for pairs of which only the rotation was measured; None where that is all of them.
    cov: (E, 6, 6), or (E, 3, 3) without translations. held, start, prior, inner: as of ``network_of``.
    """
    n, held, start, prior = len(pair_ids), held or {}, start or {}, prior or {}
    t = np.full((n, 3), np.nan) if translations is None else np.array(translations, dtype=float)
    Q, turns = np.zeros((n, 6, 6)), ~np.isfinite(t).all(axis=1)
    Q[:, : np.shape(cov)[1], : np.shape(cov)[2]] = cov
    Q[turns, 3:, :] = Q[turns, :, 3:] = 0.0
    Q[turns, 3:, 3:] = np.diag(np.full(3, np.inf))
    R = np.array(rotations, dtype=float)
    measured = PairArrays(R, t, Q, np.ones(n, dtype=bool) if used is None else np.array(used, dtype=bool))
    a, b = (np.array(x, dtype=np.int64) for x in (a_idx, b_idx))
    frames = {i: FrameRef("station", s) for i, s in enumerate(station_ids)}
    pairs = tuple(
        Pair(name, frames.get(i), frames.get(j), m.rotation() if turn else m, q[:3, :3] if turn else q, used=use)
        for name, i, j, m, q, turn, use in zip(pair_ids, a, b, measured.poses, Q, turns, measured.used, strict=True)
    )
    given = {i: PoseParameter(Pose3(p)) for i, p in start.items()}
    given |= {i: PoseParameter(Pose3(p), "prior", q) for i, (p, q) in prior.items()}
    given |= {i: PoseParameter(Pose3(p), "held") for i, p in held.items()}
    stations = (Station(s, world_from_station=given.get(i, PoseParameter())) for i, s in enumerate(station_ids))
    who, survey = Topology(tuple(station_ids), tuple(pair_ids), a, b), Survey(stations=tuple(stations), pairs=pairs)
    return network_of(who, measured, held, start, prior, inner, survey)


def network_of_file(path, information="tangent", block_diagonal=False, start=False) -> PoseNetwork:
    """The network of a g2o file; start: with that of the file's vertices."""
    survey = read_g2o_file(path, information, block_diagonal).survey
    return network_from_survey(survey if start else without_starts(survey, points=False, poses=True))


@dataclass(frozen=True, eq=False)
class Simulated:
    network: PoseNetwork
    rotations: FloatArray
    translations: FloatArray
    wrong: tuple[str, ...]


def omega_of(minimum: Minimum) -> float:
    """V'Pv of the pairs in use and the priors."""
    batch, values = minimum.graph.pairs, minimum.solved.values
    between_held = np.flatnonzero(batch.arrays.used & batch.both_held)  # these have no factor
    white = batch.arrays.whitening[between_held] @ batch.jacobians(values)[0][between_held, :, None]
    return minimum.graph.omega(values) + float(np.sum(white**2))


@dataclass(frozen=True, eq=False)
class Solved:
    """A solved network by positions: rotations (N, 3, 3), translations (N, 3) m, and what its precision says."""

    network: PoseNetwork
    minimum: Minimum

    @property
    def rotations(self) -> FloatArray:
        return self.minimum.rotations

    @property
    def translations(self) -> FloatArray:
        return self.minimum.translations

    @property
    def omega(self) -> float:
        return omega_of(self.minimum)

    @property
    def iterations(self) -> int:
        return self.minimum.solved.iterations

    @property
    def max_step(self) -> float:
        return self.minimum.solved.max_step

    @property
    def redundancy(self) -> int:
        graph, datum = self.minimum.graph, self.minimum.solved.datum
        priors = sum(len(i.components) for i in graph.singles if i.kind == "prior")
        n = int(self.network.sizes[self.network.used].sum()) + priors
        return n - graph.unknowns.n_unknowns + (0 if datum is None else datum.defect)

    @cached_property
    def precision(self) -> Precision:
        return Precision(self.minimum.graph, self.minimum.solved)

    @cached_property
    def pairs(self) -> PairStatistics:
        p, k = self.precision.pairs, self.network.dim
        return PairStatistics(p.residual[:, :k], p.whitened[:, :k], p.redundancy[:, :k], p.test, p.freedom, p.p_value,
                              p.adjusted_cov[:, :k, :k], p.residual_cov[:, :k, :k], p.too_far)  # fmt: skip

    @property
    def world_from_station(self) -> Motions:
        return Motions(self.rotations, None if self.network.rotation_only else self.translations)

    def joint(self, stations: Sequence[int]) -> FloatArray:
        """Covariance (k dim, k dim), zero of what is held."""
        d, k = self.network.dim, len(stations)
        names = [("world_from_station", self.network.station_ids[i]) for i in stations]
        rows = (6 * np.arange(k)[:, None] + np.arange(d)).ravel()
        return self.precision.whole(names, [6] * k)[np.ix_(rows, rows)]

    @cached_property
    def station_cov(self) -> FloatArray:
        """Covariances (N, dim, dim) of all stations."""
        d, by_name = self.network.dim, self.precision.unknowns.by_name
        names = [("world_from_station", s) for s in self.network.station_ids]
        keys = np.array([by_name[n].key if n in by_name else -1 for n in names])
        out = np.zeros((len(keys), d, d))
        out[keys >= 0] = self.precision.covs(keys[keys >= 0], 6)[:, :d, :d]
        return out

    def pose(self, station_id: str) -> Pose3:
        i = self.network.index_of[station_id]
        return Pose3(Rot3(self.rotations[i]), self.translations[i])

    def relative(self, a_id: str, b_id: str) -> tuple[FloatArray, FloatArray]:
        """``b_from_a`` (4, 4) and its covariance (dim, dim) in the tangent of a."""
        d, (a, b) = self.network.dim, (self.network.index_of[i] for i in (a_id, b_id))
        out = self.pose(b_id).between(self.pose(a_id))
        J = np.hstack([np.eye(6), -out.inverse().AdjointMap()])[:d].reshape(d, 2, 6)[:, :, :d].reshape(d, 2 * d)
        return out.matrix(), (J @ self.joint([a, b]) @ J.T if a != b else np.zeros((d, d)))


def solve_network(network: PoseNetwork, start=None, options: NetworkOptions = DEFAULTS, progress=None) -> Solved:
    """From nothing or from a start (N, 3, 3), (N, 3)."""
    return Solved(network, minimize(network, start, options, progress))


def exp6(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motions of tangents (n, 6), rotation first, by the power series of the 4 x 4 matrix."""
    X = np.zeros((len(x), 4, 4))
    X[:, 0, 1], X[:, 0, 2], X[:, 1, 2] = -x[:, 2], x[:, 1], -x[:, 0]
    X[:, :3, :3] -= np.swapaxes(X[:, :3, :3], 1, 2)
    X[:, :3, 3] = x[:, 3:]
    out = term = np.tile(np.eye(4), (len(x), 1, 1))
    for k in range(1, 30):
        term = term @ X / k
        out = out + term
    return out[:, :3, :3], out[:, :3, 3]


def grid_edges(nx: int, ny: int) -> list[tuple[int, int]]:
    """A corridor of width ny that grows along x: every station to its predecessor and to the row before."""
    n = nx * ny
    return [(j - s, j) for j in range(n) for s in (1, ny) if (s == 1 and j % ny) or (s == ny and j >= ny)]


def simulate(
    nx: int, ny: int, seed: int = 0, wrong: int = 0, extra: int = 0, sigma_rad: float = 1e-3, sigma_m: float = 1e-2,
    free: bool = False, rotations_only: bool = False,
) -> Simulated:
    """A grid of stations 10 m apart with full covariances, ``extra`` random pairs and ``wrong`` gross errors."""
    rng = np.random.default_rng(seed)
    n = nx * ny
    R = Rotation.from_rotvec(rng.normal(size=(n, 3)) * 0.3).as_matrix()
    i = np.arange(n)
    t = np.column_stack([10.0 * (i // ny), 10.0 * (i % ny), rng.normal(size=n)])
    edges = grid_edges(nx, ny) + [tuple(rng.choice(n, 2, replace=False)) for _ in range(extra)]
    b, a = np.array(edges).T
    A = rng.normal(size=(6, 6))
    s = np.repeat([sigma_rad, sigma_m], 3)
    cov = (A @ A.T / 6 + 0.5 * np.eye(6)) * s[:, None] * s
    noise_R, noise_t = exp6(rng.normal(size=(len(a), 6)) @ np.linalg.cholesky(cov).T)
    back = np.swapaxes(R[b], 1, 2)
    Z_R, Z_t = back @ R[a], np.einsum("nij,nj->ni", back, t[a] - t[b])
    Z_t = np.einsum("nij,nj->ni", Z_R, noise_t) + Z_t
    Z_R = Z_R @ noise_R
    bad = rng.choice(len(a), wrong, replace=False)
    for e in bad:
        Z_R[e] = Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix() @ Z_R[e]
        Z_t[e] += rng.normal(size=3)
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = R[0], t[0]
    names = [f"p{e}" for e in range(len(a))]
    network = pose_network(
        [f"s{k}" for k in range(n)], names, a, b, Z_R, None if rotations_only else Z_t,
        np.tile(cov[:3, :3] if rotations_only else cov, (len(a), 1, 1)), held=None if free else {0: first},
    )  # fmt: skip
    return Simulated(network, R, t, tuple(names[e] for e in bad))


def network_jacobians(
    network: PoseNetwork, world_from_station: Motions
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residuals (E, dim) of all pairs, their derivatives (E, dim, dim) by b and by a, and Ad(b_from_a^-1)."""
    here, measured = world_from_station, network.arrays.motions
    b_from_a = here[network.b_idx].inverse() @ here[network.a_idx]
    return pair_jacobians(measured if network.dim == 6 else Motions(measured.rotation), b_from_a)


def pair_jacobians(measured: Motions, b_from_a: Motions) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residuals (E, dim), their derivatives (E, dim, dim) by b and by a, and Ad(b_from_a^-1) (E, dim, dim)."""
    residual = (measured.inverse() @ b_from_a).log()
    by_a, turn = right_jacobian_inverse(residual), b_from_a.inverse().adjoint()
    return residual, -by_a @ turn, by_a, turn
