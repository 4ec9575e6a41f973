"""The parametric form: one rotation or pose per station, GTSAM's between factors, one station held or inner datum.

Gauss-Newton in our own loop with full steps. Its minimum is that of :mod:`adjust.relay.conditions`: the adjusted pairs
``b_from_a = world_from_b^-1 world_from_a`` close every loop by themselves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.model.survey import FloatArray, IntArray
from adjust.precision.tree import TreeCovariance
from adjust.relay.loops import loop_misclosures
from adjust.relay.motions import Motions
from adjust.relay.network import Network, between_factor, gtsam_motion, motions_from_values, prior_factor
from adjust.relay.result import AdjustedPairs, adjusted_pairs
from adjust.relay.start import refuse_parts, start_from_pairs
from adjust.relay.station_datum import InnerStations, inner_stations


@dataclass(frozen=True, eq=False)
class ParametricOptions:
    """held: id of the station that defines the datum, at identity (None: the first). inner: inner constraints instead.

    start: world_from_station (n,) to begin with; inner constraints then refer to it. max_step: the last step in sigmas.
    """

    held: str | None = None
    inner: bool = False
    start: Motions | None = None
    max_step: float = 1e-9
    max_iterations: int = 50


@dataclass(frozen=True, eq=False)
class ParametricAdjustment:
    """pairs: adjusted pairs and statistics. world_from_station: (n,), with ``station_cov`` (n, dim, dim)."""

    pairs: AdjustedPairs
    world_from_station: Motions
    station_cov: FloatArray
    covariance: "StationCovariance"

    def pair(self, a_id: str, b_id: str) -> tuple[Rot3 | Pose3, FloatArray]:
        """``b_from_a`` of any two stations, measured or not, and its covariance. Raises SurveyError for unknown ids."""
        a, b = (self._station_idx(station) for station in (a_id, b_id))
        X = self.world_from_station
        relative = X[np.array([b])].inverse() @ X[np.array([a])]
        return gtsam_motion(relative, 0), self.covariance.pair(relative, a, b)

    def station(self, station_id: str) -> tuple[Rot3 | Pose3, FloatArray]:
        """``world_from_station`` and its covariance in the datum. Raises SurveyError for an unknown id."""
        i = self._station_idx(station_id)
        return gtsam_motion(self.world_from_station, i), self.station_cov[i]

    def _station_idx(self, station_id: str) -> int:
        return station_index(self.pairs.network, station_id)


@dataclass(frozen=True, eq=False)
class StationCovariance:
    """Joint covariances of the stations with one of them held."""

    tree: TreeCovariance | None
    held_idx: int
    dim: int

    def joint(self, stations: Sequence[int]) -> FloatArray:
        """Joint covariance of different stations, stacked; zero for the one held."""
        free = [i for i, s in enumerate(stations) if s != self.held_idx]
        out = np.zeros((len(stations) * self.dim,) * 2)
        if free and self.tree is not None:
            index = (np.array(free)[:, None] * self.dim + np.arange(self.dim)).ravel()
            out[np.ix_(index, index)] = self.tree.joint([int(stations[i]) for i in free])
        return out

    def pair(self, b_from_a: Motions, a: int, b: int) -> FloatArray:
        """Covariance (dim, dim) of the relative motion of two stations."""
        if a == b:
            return np.zeros((self.dim, self.dim))
        J = np.hstack([np.eye(self.dim), -b_from_a.inverse().adjoint()[0]])
        return np.asarray(J @ self.joint([a, b]) @ J.T)


def station_index(network: Network, station_id: str) -> int:
    """Position of a station. Raises SurveyError for an id that is not in the network."""
    if station_id not in network.topology.station_ids:
        raise SurveyError(f"station {station_id!r} is not in the network; correct the id or measure a pair with it")
    return network.topology.station_ids.index(station_id)


def adjust_parametric(network: Network, options: ParametricOptions = ParametricOptions()) -> ParametricAdjustment:
    """Adjust the stations of a connected network.

    Raises SurveyError naming the parts of a network that is not connected, NotConvergedError naming the worst loop.
    """
    held = 0 if options.held is None else station_index(network, options.held)
    X = options.start
    if X is None:
        X = start_from_pairs(network, held)
    else:
        refuse_parts(network)
    solved = _Solution(network, held, X, options)
    inner = inner_stations(network, solved.stations, X, held) if options.inner else None
    return _finish(network, solved, inner)


class _Solution:
    """Gauss-Newton with one station held at its start."""

    def __init__(self, network: Network, held: int, start: Motions, options: ParametricOptions) -> None:
        self.network, self.held = network, held
        n = network.topology.n_stations
        self.graph = station_graph(network, held, start)
        self.values = gtsam.Values()
        for i in range(n):
            if i != held:
                self.values.insert(i, gtsam_motion(start, i))
        self.use_qr = False
        self.iterations = 0
        if n > 1:
            self._run(options)
        whole = gtsam.Values(self.values)
        whole.insert(held, gtsam_motion(start, held))
        self.stations = motions_from_values(whole, n, network.dim)

    def _run(self, options: ParametricOptions) -> None:
        ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(self.graph)
        moved = before = np.inf
        for iteration in range(1, options.max_iterations + 1):
            linear = self.graph.linearize(self.values)
            delta = self._step(linear, ordering)
            before, moved = moved, float(np.sqrt(max(0.0, -float(delta.dot(linear.gradientAtZero())))))
            if not np.isfinite(moved):
                break
            self.values = self.values.retract(delta)
            # steps shrink at least linearly near the minimum: what is left is below the next step
            if iteration > 1 and moved * min(1.0, moved / max(before, 1e-300)) < options.max_step:
                self.iterations = iteration
                return
        worst = loop_misclosures(self.network)
        where = f"; look for a wrong pair in {worst.text(int(np.argmax(worst.test)))}" if len(worst.test) else ""
        raise NotConvergedError(
            f"the stations did not settle in {options.max_iterations} steps (last step {moved:.2g} sigma){where}"
        )

    def _step(self, linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.VectorValues:
        if not self.use_qr:
            try:
                return linear.optimize(ordering)
            except RuntimeError as error:
                if "ndetermin" not in str(error):
                    raise
                # a connected network is determined: only GTSAM's Cholesky has run out of digits
                self.use_qr = True
        return linear.optimize(ordering, gtsam.EliminateQR)

    def tree(self) -> TreeCovariance | None:
        """Covariances at the solution; None where no station is free."""
        if not self.graph.size():
            return None
        linear = self.graph.linearize(self.values)
        ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(self.graph)
        how = (ordering, gtsam.EliminateQR) if self.use_qr else (ordering,)
        dim = self.network.dim
        dims = {i: dim for i in range(self.network.topology.n_stations) if i != self.held}
        return TreeCovariance(linear.eliminateMultifrontal(*how), dims)


def station_graph(network: Network, held: int, start: Motions) -> gtsam.NonlinearFactorGraph:
    """Between factors of all pairs, keys are the stations' positions; the held station is a constant.

    A pair with the held station b is a prior on a. With a held, ``Log(m^-1 B^-1 A) = -Ad(m^-1) Log((A m^-1)^-1 B)``: a
    prior on b at A m^-1 with covariance Ad(m) C Ad(m)'. Both are exact.
    """
    graph, top = gtsam.NonlinearFactorGraph(), network.topology
    of_held = start[np.full(top.n_pairs, held)]
    for_a, for_b = of_held @ network.b_from_a, of_held @ network.b_from_a.inverse()
    Ad = network.b_from_a.adjoint()
    turned = Ad @ network.cov @ np.swapaxes(Ad, -1, -2)
    for e, (a, b) in enumerate(zip(top.a_idx.tolist(), top.b_idx.tolist(), strict=True)):
        if a == held:
            graph.add(prior_factor(b, gtsam_motion(for_b, e), turned[e]))
        elif b == held:
            graph.add(prior_factor(a, gtsam_motion(for_a, e), network.cov[e]))
        else:
            graph.add(between_factor(b, a, gtsam_motion(network.b_from_a, e), network.cov[e]))
    return graph


def _finish(network: Network, solved: _Solution, inner: InnerStations | None) -> ParametricAdjustment:
    top, X, dim = network.topology, solved.stations, network.dim
    b_from_a = X[top.b_idx].inverse() @ X[top.a_idx]
    covariance = StationCovariance(solved.tree(), solved.held, dim)
    ends = np.stack([top.a_idx, top.b_idx], axis=1).tolist()
    blocks = np.array([covariance.joint(pair) for pair in ends]).reshape(-1, 2 * dim, 2 * dim)
    J = _by_ends(b_from_a)
    cov = J @ blocks @ np.swapaxes(J, -1, -2)

    def joint(pair_idx: Sequence[int]) -> FloatArray:
        return _joint_pairs(covariance, J, top.a_idx, top.b_idx, pair_idx)

    total = dim * (top.n_pairs - top.n_stations + 1)
    pairs = adjusted_pairs(network, b_from_a, cov, total, solved.iterations, joint)
    station_cov = np.array([covariance.joint([i]) for i in range(top.n_stations)])
    if inner is not None:
        X, station_cov = inner.world_from_station, inner.covariances(station_cov)
    return ParametricAdjustment(pairs, X, station_cov, covariance)


def _by_ends(b_from_a: Motions) -> FloatArray:
    """Derivatives (E, dim, 2 dim) of the relative motions by stations a and b."""
    E, dim = len(b_from_a), b_from_a.dim
    by_a = np.broadcast_to(np.eye(dim), (E, dim, dim))
    return np.concatenate([by_a, -b_from_a.inverse().adjoint()], axis=-1)


def _joint_pairs(
    covariance: StationCovariance, J: FloatArray, a_idx: IntArray, b_idx: IntArray, pair_idx: Sequence[int]
) -> FloatArray:
    dim, index = J.shape[1], np.asarray(pair_idx, dtype=np.int64)
    stations = np.unique(np.concatenate([a_idx[index], b_idx[index]]))
    whole = np.zeros((len(index) * dim, len(stations) * dim))
    for row, e in enumerate(index):
        for part, station in enumerate((a_idx[e], b_idx[e])):
            at = int(np.searchsorted(stations, station)) * dim
            whole[row * dim : (row + 1) * dim, at : at + dim] = J[e][:, part * dim : (part + 1) * dim]
    return np.asarray(whole @ covariance.joint([int(s) for s in stations]) @ whole.T)
