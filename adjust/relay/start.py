"""Start values of all stations from the measured pairs alone: rotations first, then translations, which are linear.

Rotations by GTSAM's fast synchronisation (a linear relaxation over the whole network), which does not drift along
corridors as a spanning tree does; with rotations known, ``t_a = t_b + R_b t`` of every pair is linear in the positions.
"""

import gtsam
import numpy as np
import scipy.sparse as sp
from gtsam import Rot3
from scipy.sparse.linalg import splu

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from adjust.relay.counts import count
from adjust.relay.motions import Motions, identities
from adjust.relay.network import Network


def start_from_pairs(network: Network, held_idx: int) -> Motions:
    """``world_from_station`` (n,), the held station at identity. Raises SurveyError naming the parts that are apart."""
    refuse_parts(network)
    n = network.topology.n_stations
    rotation = _rotations(network, held_idx)
    if network.b_from_a.translation is None:
        return Motions(rotation)
    return Motions(rotation, _translations(network, rotation, held_idx) if n > 1 else np.zeros((n, 3)))


def refuse_parts(network: Network) -> None:
    """Raises SurveyError for a network that falls into parts."""
    counts = count(network.topology, network.dim)
    if counts.n_parts == 1:
        return
    named = [", ".join(part[:8]) + (" ..." if len(part) > 8 else "") for part in counts.parts[:6]]
    more = f" and {counts.n_parts - 6} more" if counts.n_parts > 6 else ""
    raise SurveyError(
        f"the network falls into {counts.n_parts} parts: {' | '.join(named)}{more}; measure a pair between them, or "
        "adjust each part by itself"
    )


def _rotations(network: Network, held_idx: int) -> FloatArray:
    n = network.topology.n_stations
    if n == 1:
        return identities(1, 3).rotation
    graph = gtsam.NonlinearFactorGraph()
    # equal weights: the relaxation only has to come near
    noise = gtsam.noiseModel.Isotropic.Sigma(3, float(np.median(network.dispersion)))
    a, b = network.topology.a_idx.tolist(), network.topology.b_idx.tolist()
    for e, rotation in enumerate(network.b_from_a.rotation):
        graph.add(gtsam.BetweenFactorRot3(b[e], a[e], Rot3(rotation), noise))
    found = gtsam.fastSyncRot3(graph)
    rotations = np.array([found.atRot3(i).matrix() for i in range(n)])
    return np.asarray(rotations[held_idx].T @ rotations)


def _translations(network: Network, rotation: FloatArray, held_idx: int) -> FloatArray:
    top, t = network.topology, network.b_from_a.translation
    if t is None:
        raise ValueError("a network of rotations has no translations")
    weight = 1.0 / np.trace(network.cov[:, 3:, 3:], axis1=1, axis2=2)
    m, n = top.n_pairs, top.n_stations
    rows, root = np.arange(m), np.sqrt(weight)
    A = sp.csr_array((root, (rows, top.a_idx)), shape=(m, n)) - sp.csr_array((root, (rows, top.b_idx)), shape=(m, n))
    free = np.delete(np.arange(n), held_idx)
    A = A.tocsc()[:, free]
    right = A.T @ (root[:, None] * (rotation[top.b_idx] @ t[..., None])[..., 0])
    out = np.zeros((n, 3))
    out[free] = splu((A.T @ A).tocsc()).solve(right)
    return out
