"""Inner constraints for a network of stations: from one station held to the datum that all stations share.

The network may move as a whole without changing a pair: ``world_from_station -> Exp(g) world_from_station``, which in
the stations' tangents is ``N g`` with blocks ``Ad(world_from_station^-1)``. Inner constraints ask ``N' d = 0`` of the
differences d to the start; covariances pass by ``S = I - N (N'N)^-1 N'`` (Baarda 1973; Koch 1999, section 3.3.6).
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from adjust.model.survey import FloatArray
from adjust.relay.motions import Motions, exp, right_jacobian_inverse
from adjust.relay.network import Network
from adjust.relay.result import whitening


@dataclass(frozen=True, eq=False)
class InnerStations:
    """Stations in the inner datum. moves: N (n, dim, dim). shared: Y = Q N (N'N)^-1 (n, dim, dim), Q with one held.

    own: Z = (N'N)^-1 N' Q N (N'N)^-1 (dim, dim).
    """

    world_from_station: Motions
    moves: FloatArray
    shared: FloatArray
    own: FloatArray

    def covariances(self, held_cov: FloatArray) -> FloatArray:
        """S Q S' of each station (n, dim, dim) from that with one station held."""
        cross = self.moves @ np.swapaxes(self.shared, -1, -2)
        return np.asarray(
            held_cov - cross - np.swapaxes(cross, -1, -2) + self.moves @ self.own @ np.swapaxes(self.moves, -1, -2)
        )


def inner_stations(network: Network, solved: Motions, start: Motions, held_idx: int) -> InnerStations:
    """From the solution with one station held at its start to inner constraints about the start."""
    X = _fitted(solved, start)
    n, dim = len(X), network.dim
    moves = X.inverse().adjoint()
    flat = moves.reshape(n * dim, dim)
    gram = np.linalg.inv(flat.T @ flat)
    free = (np.delete(np.arange(n), held_idx)[:, None] * dim + np.arange(dim)).ravel()
    A = _design(network, X)[:, free]
    shared = np.zeros((n * dim, dim))
    if len(free):
        shared[free] = splu((A.T @ A).tocsc()).solve(flat[free]) @ gram
    return InnerStations(X, moves, shared.reshape(n, dim, dim), gram @ flat.T @ shared)


def _fitted(solved: Motions, start: Motions, iterations: int = 20) -> Motions:
    """The whole network moved so that its differences to the start obey the inner constraints."""
    X = solved
    for _ in range(iterations):
        flat = X.inverse().adjoint().reshape(-1, X.dim)
        g = -np.linalg.solve(flat.T @ flat, flat.T @ (start.inverse() @ X).log().ravel())
        X = exp(np.broadcast_to(g, (len(X), X.dim))) @ X
        if np.abs(g).max() < 1e-14:
            break
    return X


def _design(network: Network, X: Motions) -> sp.csc_array:
    """Whitened derivatives (E dim, n dim) of all residuals by the stations."""
    top, dim = network.topology, network.dim
    predicted = X[top.b_idx].inverse() @ X[top.a_idx]
    r = (network.b_from_a.inverse() @ predicted).log()
    by_a = whitening(network.cov) @ right_jacobian_inverse(r)
    by_b = -by_a @ predicted.inverse().adjoint()
    ptr, shape = np.arange(top.n_pairs + 1), (top.n_pairs * dim, top.n_stations * dim)
    parts = [sp.bsr_array((np.ascontiguousarray(D), i, ptr), shape=shape)
             for D, i in ((by_a, top.a_idx), (by_b, top.b_idx))]  # fmt: skip
    return (parts[0] + parts[1]).tocsc()
