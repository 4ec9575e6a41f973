"""Covariances of all stations and the statistics of all pairs, from one pass over the Bayes tree.

Redundancy numbers and tests as in :mod:`adjust.precision.precision`: v' Q_vv^-1 v of a whole pair is chi-square with the
rank of Q_vv degrees of freedom (Baarda 1968; Koch 1999, section 4.2). A free network is solved against one station and then
brought into its inner datum by an S-transformation (Baarda 1973), S = I - N (N_D' N_D)^-1 N_D'.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from adjust.distributions import chi2
from adjust.model.survey import FloatArray, IntArray
from adjust.pose_network.network import PoseNetwork
from adjust.pose_network.solve import Minimum
from adjust.precision.tree import TreeCovariance
from adjust.relay.motions import Motions, right_jacobian_inverse

# share of a pair's direction that others must control for it to be tested; covariances of weak networks lose digits
UNCONTROLLED = 1e-4


@dataclass(frozen=True, eq=False)
class PairStatistics:
    """Of every pair (E,): residual (E, dim) Log(measured^-1 adjusted), in frame a, and what the rest says of it.

    whitened: (E, dim). redundancy: (E, dim) numbers of the whitened components, zero for pairs out of use. test,
    freedom, p_value: of the whole pair; freedom 0 and nan where nothing controls it. A pair out of use is tested
    against its prediction from the others. adjusted_cov: (E, dim, dim) of the adjusted ``b_from_a``. residual_cov:
    (E, dim, dim).
    """

    residual: FloatArray
    whitened: FloatArray
    redundancy: FloatArray
    test: FloatArray
    freedom: IntArray
    p_value: FloatArray
    adjusted_cov: FloatArray
    residual_cov: FloatArray


class NetworkPrecision:
    """A priori covariances (sigma0 = 1) in the datum of the network, tangent on the right of ``world_from_station``."""

    def __init__(self, network: PoseNetwork, minimum: Minimum) -> None:
        self.network = network
        d = network.dim
        t = None if network.rotation_only else minimum.translations
        self.world_from_station = Motions(minimum.rotations, t)
        self._tree = TreeCovariance(_eliminated(minimum), dict.fromkeys(range(network.n_stations), d))

    @cached_property
    def _shift(self) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """N (N, d, d), Y = Q G' (N, d, d), M = G Q G' of the S-transformation; None where the datum is given."""
        network, d = self.network, self.network.dim
        if network.anchor is None:
            return None
        here = self.world_from_station
        if here.translation is not None:  # about the middle, for the sake of digits
            here = Motions(here.rotation, here.translation - here.translation[network.inner].mean(axis=0))
        N = here.inverse().adjoint()
        datum = N[network.inner]
        G = np.linalg.inv(np.einsum("nij,nik->jk", datum, datum)) @ np.swapaxes(datum, 1, 2)
        columns = np.zeros((self._tree.n, d))
        free = network.inner != network.anchor
        rows = self._tree.rows(network.inner[free].tolist()) if free.any() else np.zeros(0, dtype=np.int64)
        columns[rows] = np.swapaxes(G[free], 1, 2).reshape(-1, d)
        product = self._tree.times(columns)
        others = np.flatnonzero(~network.constants)
        Y = np.zeros((network.n_stations, d, d))
        Y[others] = product[self._tree.rows(others.tolist())].reshape(-1, d, d)
        return N, Y, np.einsum("nij,njk->ik", G, Y[network.inner])

    @cached_property
    def station_cov(self) -> FloatArray:
        """Covariances (N, dim, dim) of all stations."""
        network, d = self.network, self.network.dim
        out = np.zeros((network.n_stations, d, d))
        free = np.flatnonzero(~network.constants)
        out[free] = self._tree.pairs(free, np.full(len(free), -1), d)[:, :d, :d]
        if self._shift is not None:
            N, Y, M = self._shift
            cross = N @ np.swapaxes(Y, 1, 2)
            out += N @ M @ np.swapaxes(N, 1, 2) - cross - np.swapaxes(cross, 1, 2)
        return out

    def joint(self, stations: Sequence[int]) -> FloatArray:
        """Joint covariance (k dim, k dim) of stations by position, in the network's datum."""
        d = self.network.dim
        out = self._joint(stations)
        if self._shift is not None:
            N, Y, M = (x if x.ndim == 2 else x[list(stations)] for x in self._shift)
            for i in range(len(stations)):
                for j in range(len(stations)):
                    out[i * d : i * d + d, j * d : j * d + d] += N[i] @ M @ N[j].T - N[i] @ Y[j].T - Y[i] @ N[j].T
        return out

    def _joint(self, stations: Sequence[int]) -> FloatArray:
        d, fixed = self.network.dim, self.network.constants
        free = [n for n, i in enumerate(stations) if not fixed[i]]
        out = np.zeros((len(stations) * d,) * 2)
        if free:
            rows = np.concatenate([np.arange(n * d, n * d + d) for n in free])
            out[np.ix_(rows, rows)] = self._tree.joint([int(stations[n]) for n in free])
        return out

    def relative(self, a: int, b: int) -> tuple[FloatArray, FloatArray]:
        """``b_from_a`` (4, 4) between any two stations, and its covariance (dim, dim) in the tangent of a.

        It does not depend on the datum.
        """
        both = self.world_from_station
        ab, ba = np.array([a]), np.array([b])
        b_from_a = both[ba].inverse() @ both[ab]
        d = self.network.dim
        J = np.hstack([np.eye(d), -b_from_a.inverse().adjoint()[0]])
        out = np.eye(4)
        out[:3, :3] = b_from_a.rotation[0]
        if b_from_a.translation is not None:
            out[:3, 3] = b_from_a.translation[0]
        return out, np.asarray(J @ self._joint([a, b]) @ J.T)

    @cached_property
    def pairs(self) -> PairStatistics:
        """Statistics of all pairs, in use or not."""
        network, d = self.network, self.network.dim
        a, b, fixed = network.a_idx, network.b_idx, network.constants
        residual, by_b, by_a, turn = pair_jacobians(network, self.world_from_station)
        Q = np.zeros((network.n_pairs, 2 * d, 2 * d))
        near = np.flatnonzero(network.used)
        Q[near] = self._tree.pairs(np.where(fixed[b], -1, b)[near], np.where(fixed[a], -1, a)[near], d)
        for e in np.flatnonzero(~network.used):
            Q[e] = self._joint([int(b[e]), int(a[e])])
        W = network.whitening
        B, J = np.concatenate([by_b, by_a], axis=2), np.concatenate([-turn, np.tile(np.eye(d), (len(a), 1, 1))], axis=2)
        scatter, own = B @ Q @ np.swapaxes(B, 1, 2), J @ Q @ np.swapaxes(J, 1, 2)
        sign = np.where(network.used, -1.0, 1.0)[:, None, None]
        # a row of the whitening that is zero was not measured
        Qvv = sign * (W @ scatter @ np.swapaxes(W, 1, 2)) + np.any(W, axis=2)[..., None] * np.eye(d)
        white = np.einsum("nij,nj->ni", W, residual)
        test, freedom = _quadratic(Qvv, white)
        with np.errstate(invalid="ignore"):
            p = np.where(freedom > 0, chi2.sf(test, np.maximum(freedom, 1)), np.nan)
        redundancy = np.where(network.used[:, None], np.diagonal(Qvv, axis1=1, axis2=2), 0.0)
        return PairStatistics(
            residual, white, redundancy, test, freedom, p, own, network.cov[:, :d, :d] + sign * scatter
        )


def pair_jacobians(
    network: PoseNetwork, world_from_station: Motions
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residuals (E, dim), their derivatives (E, dim, dim) by b and by a, and Ad(b_from_a^-1) (E, dim, dim)."""
    here = world_from_station
    shifts = None if here.translation is None else np.nan_to_num(network.translations)
    b_from_a = here[network.b_idx].inverse() @ here[network.a_idx]
    residual = (Motions(network.rotations, shifts).inverse() @ b_from_a).log()
    by_a, turn = right_jacobian_inverse(residual), b_from_a.inverse().adjoint()
    return residual, -by_a @ turn, by_a, turn


def _quadratic(Q: FloatArray, v: FloatArray) -> tuple[FloatArray, IntArray]:
    """The forms v' Q^+ v (E,) and the rank of Q, eigenvalues below ``UNCONTROLLED`` counting as zero."""
    w, U = np.linalg.eigh(Q)
    kept = w > UNCONTROLLED
    y = np.einsum("nij,ni->nj", U, v)
    test = (np.where(kept, y * y, 0.0) / np.where(kept, w, 1.0)).sum(axis=1)
    freedom = kept.sum(axis=1)
    return np.where(freedom > 0, test, np.nan), freedom.astype(np.int64)


def _eliminated(minimum: Minimum) -> gtsam.GaussianBayesTree:
    if minimum.use_qr:
        return minimum.linear.eliminateMultifrontal(minimum.ordering, gtsam.EliminateQR)
    return minimum.linear.eliminateMultifrontal(minimum.ordering)
