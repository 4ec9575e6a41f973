"""A start from nothing: rotations first (averaging over the whole network), then positions by one linear system.

Carlone, Tron, Daniilidis and Dellaert, Initialization techniques for 3D SLAM (ICRA 2015). The rotations come from the
chordal problem with orthogonality relaxed, solved directly: R_a = R_b R_ba is linear in the rows of R_a and R_b, which
do not meet each other. It needs isotropic weights, and so do the positions; one elimination serves both.
"""

import heapq
from collections.abc import Iterable, Mapping

import numpy as np
from gtsam import Pose3

from adjust.graph.elimination import pose_cliques
from adjust.model.errors import IndeterminateError
from adjust.model.observations import Pair
from adjust.model.survey import FloatArray, IntArray
from adjust.native.elimination import PoseFactor, pair_gradient
from adjust.pose_network.network import PoseNetwork
from adjust.spatial.rigid import nearest_rotation

_TIGHT = 1e4
"""Weight that ties given rotations to each other, that of the median pair being 1."""
_EVENED = (1.0, 0.5, 0.25, 0.0)
"""Powers of the weights that are tried in turn, where so uneven ones cost a station its pivot."""


def find_network_start(network: PoseNetwork) -> tuple[FloatArray, FloatArray]:
    """``world_from_station`` of all stations, (N, 3, 3) and (N, 3), from the pairs in use alone.

    The held stations, the stations with a prior, or the given poses of a free network (else its first station at the
    identity) say where it lies. Raises IndeterminateError for pairs that do not tie all stations together.
    """
    for power in _EVENED:
        average = _Average(network, power)
        if average.lost < 0:
            R = average.rotations()
            return R, np.zeros((network.n_stations, 3)) if network.rotation_only else average.positions(R)
    lost = (network.station_ids[average.lost],)
    raise IndeterminateError(f"the pairs in use do not tie station {lost[0]!r} to the others; measure one more", lost)


def datum_stations(network: PoseNetwork) -> IntArray:
    """Stations whose given pose says where the network lies, (k,)."""
    if len(network.held):
        return network.held
    if network.prior_cov:
        known = [i for i, c in network.prior_cov.items() if np.isfinite(np.diag(c)[:3]).all()]
        return np.array(sorted(known), dtype=np.int64)
    all_given = bool(np.isfinite(network.station_rotations[network.inner]).all())
    return network.inner if all_given else np.zeros(0, dtype=np.int64)


class _Average:
    """Rows of rotations, and positions, by least squares over pairs: six unknowns a station, and one factor for all.

    Three of the six never meet the other three. lost: a station without a pivot, or -1.
    """

    def __init__(self, network: PoseNetwork, power: float) -> None:
        self.network, self.datum = network, datum_stations(network)
        self.anchor = int(self.datum[0]) if len(self.datum) and network.anchor is None else network.anchor or 0
        rows = np.flatnonzero(network.used)
        ties = self.datum[self.datum != self.anchor] if network.anchor is None else np.zeros(0, dtype=np.int64)
        self.rows = rows
        self.a = np.concatenate([network.a_idx[rows], np.full(len(ties), self.anchor)])
        self.b = np.concatenate([network.b_idx[rows], ties])
        given = network.station_rotations
        self.b_from_a = np.concatenate([network.rotations[rows], np.swapaxes(given[ties], 1, 2) @ given[[self.anchor]]])
        variance = np.trace(network.cov[rows][:, :3, :3], axis1=1, axis2=2) / 3.0
        # only ratios matter: a common scale keeps tests of pivots away from rounding
        turn = np.concatenate([np.median(variance) / variance, np.full(len(ties), _TIGHT)])
        known = 1.0 / translation_sigmas(network)[rows]  # zero of rotations
        typical = np.median(known[known > 0.0]) if known.any() else 1.0
        shift = np.concatenate([(known / typical) ** 2, np.zeros(len(ties))])
        self.turn, self.shift = (np.sqrt(np.where(w > 0.0, w**power, 0.0)) for w in (turn, shift))
        self.fixed = np.zeros(network.n_stations, dtype=np.bool_)
        self.fixed[self.datum if len(self.datum) else self.anchor] = True
        self._eliminate()

    def _eliminate(self) -> None:
        n, a, b = self.network.n_stations, self.a, self.b
        self.by_a, self.by_b = np.zeros((2, len(a), 6, 6))
        for i in range(3):
            self.by_a[:, i, i], self.by_a[:, 3 + i, 3 + i] = self.turn, self.shift
            self.by_b[:, 3 + i, 3 + i] = -self.shift
        self.by_b[:, :3, :3] = -self.turn[:, None, None] * np.swapaxes(self.b_from_a, 1, 2)
        own = np.zeros((n, 6, 6))
        known = np.arange(n) == self.anchor, self.fixed
        for half, weight, constant in zip((slice(0, 3), slice(3, 6)), (self.turn, self.shift), known, strict=True):
            self.by_a[constant[a], :, half], self.by_b[constant[b], :, half] = 0.0, 0.0
            alone = constant | (np.bincount(a, weight, n) + np.bincount(b, weight, n) == 0.0)
            own[alone, half, half] = np.eye(3)
        self.keys, pattern = pose_cliques(np.setdiff1d(np.arange(n), np.union1d(a, b)).tolist(), b, a)
        self.place = np.argsort(self.keys)
        self.factor = PoseFactor(pattern)
        lost = self.factor.eliminate(self.place[a], self.place[b], self.by_a, self.by_b, own[self.keys])
        self.lost = int(self.keys[lost]) if lost >= 0 else -1

    def _solved(self, misfit: FloatArray) -> FloatArray:
        """Six unknowns of every station (N, 6) for weighted misfits (E, 6) where all unknowns are zero."""
        x = np.zeros((self.network.n_stations, 6))
        pair_gradient(self.place[self.a], self.place[self.b], misfit, self.by_a, self.by_b, x)
        self.factor.solve(x)
        return x[self.place]

    def rotations(self) -> FloatArray:
        """(N, 3, 3), turned onto the given ones."""
        network, M = self.network, np.zeros((self.network.n_stations, 3, 3))
        for i in range(3):
            misfit = np.zeros((len(self.a), 6))
            misfit[self.a == self.anchor, i] = self.turn[self.a == self.anchor]
            of_b = self.b == self.anchor
            misfit[of_b, :3] = -self.turn[of_b, None] * self.b_from_a[of_b, i]
            M[:, i] = self._solved(misfit)[:, :3]
        M[self.anchor] = np.eye(3)
        out = nearest_rotation(M)
        if len(self.datum):
            turn = nearest_rotation(np.einsum("nij,nkj->ik", network.station_rotations[self.datum], out[self.datum]))
            out = turn @ out
        out[network.held] = network.station_rotations[network.held]
        return np.asarray(out)

    def positions(self, R: FloatArray) -> FloatArray:
        """(N, 3) m with the rotations taken as true: t_a - t_b = R_b t_ba for every pair."""
        network, t, k = self.network, np.zeros((self.network.n_stations, 3)), len(self.rows)
        if len(self.datum):
            t[self.datum] = network.station_translations[self.datum]
        a, b = self.a[:k], self.b[:k]
        observed = np.einsum("nij,nj->ni", R[b], network.arrays.shifts[self.rows])
        misfit = np.zeros((len(self.a), 6))
        misfit[:k, 3:] = self.shift[:k, None] * (t[a] - t[b] - observed)
        return np.where(self.fixed[:, None], t, self._solved(misfit)[:, 3:])


def translation_sigmas(network: PoseNetwork) -> FloatArray:
    """Standard deviation (E,) m of a pair's shift, one number: its own and what its turn does over its length."""
    shift = np.trace(network.cov[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    turn = np.trace(network.cov[:, :3, :3], axis1=1, axis2=2) / 3.0
    length = np.nan_to_num((network.translations**2).sum(axis=1))
    return np.asarray(np.sqrt(np.where(network.is_pose, shift + turn * length, np.inf)))


def carried(known: Mapping[str, Pose3], pairs: Iterable[Pair]) -> dict[str, Pose3]:
    """``world_from_station`` of stations that pairs reach from known ones, each by the best pair that reaches it."""
    every, near, poses = list(pairs), dict[str, list[tuple[float, int]]](), dict(known)
    for i, pair in enumerate(every):
        for end in (pair.a, pair.b):
            near.setdefault(end.frame_id, []).append((float(np.trace(pair.cov)), i))
    waiting = [x for station, mine in near.items() if station in known for x in mine]
    heapq.heapify(waiting)
    while waiting:
        pair = every[heapq.heappop(waiting)[1]]
        a, b, motion = pair.a.frame_id, pair.b.frame_id, pair.b_from_a
        if (a in poses) == (b in poses):
            continue
        b_from_a = motion if isinstance(motion, Pose3) else Pose3(motion, np.zeros(3))
        new, pose = (b, poses[a].compose(b_from_a.inverse())) if a in poses else (a, poses[b].compose(b_from_a))
        poses[new] = pose
        for x in near[new]:
            heapq.heappush(waiting, x)
    return {station: pose for station, pose in poses.items() if station not in known}
