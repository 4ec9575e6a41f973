"""A start from nothing: rotations first (averaging over the whole network), then positions by one linear system.

Carlone, Tron, Daniilidis and Dellaert, Initialization techniques for 3D SLAM (ICRA 2015). The rotations come from
GTSAM's fastSyncRot3: the chordal problem with orthogonality relaxed, solved directly; it needs isotropic weights.
"""

import gtsam
import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.pose_network.network import PoseNetwork
from adjust.spatial.rigid import nearest_rotation


def find_network_start(network: PoseNetwork, weights: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """``world_from_station`` of all stations, (N, 3, 3) and (N, 3), from the pairs in use alone.

    weights: (E,) on the information of the pairs, zero leaves a pair out. The held stations, the stations with a prior,
    or the given poses of a free network (else its first station at the identity) say where it lies.
    """
    R = start_rotations(network, weights)
    return R, np.zeros((network.n_stations, 3)) if network.rotation_only else start_translations(network, R, weights)


def datum_stations(network: PoseNetwork) -> IntArray:
    """Stations whose given pose says where the network lies, (k,)."""
    if len(network.held):
        return network.held
    if network.prior_cov:
        known = [i for i, c in network.prior_cov.items() if np.isfinite(np.diag(c)[:3]).all()]
        return np.array(sorted(known), dtype=np.int64)
    all_given = bool(np.isfinite(network.station_rotations[network.inner]).all())
    return network.inner if all_given else np.zeros(0, dtype=np.int64)


def start_rotations(network: PoseNetwork, weights: FloatArray | None = None) -> FloatArray:
    """Rotations (N, 3, 3) by averaging, turned onto the given ones."""
    rows = np.flatnonzero(network.used if weights is None else network.used & (weights > 1e-9))
    variance = np.trace(network.cov[rows][:, :3, :3], axis1=1, axis2=2) / 3.0
    # only ratios matter: a common scale keeps GTSAM's tests of pivots away from rounding
    variance = variance / np.median(variance)
    if weights is not None:
        variance = variance / weights[rows]
    graph = gtsam.NonlinearFactorGraph()
    noise: dict[float, gtsam.noiseModel.Isotropic] = {}
    a, b = network.a_idx[rows].tolist(), network.b_idx[rows].tolist()
    for i, j, R, v in zip(a, b, network.rotations[rows], np.sqrt(variance).tolist(), strict=True):
        if v not in noise:
            noise[v] = gtsam.noiseModel.Isotropic.Sigma(3, v)
        graph.push_back(gtsam.BetweenFactorRot3(j, i, gtsam.Rot3(R), noise[v]))
    _tie_datum(network, graph)
    out = np.tile(np.eye(3), (network.n_stations, 1, 1))
    found = gtsam.fastSyncRot3(graph, gtsam.Ordering.ColamdNonlinearFactorGraph(graph))
    keys = np.array(list(found.keys()), dtype=np.int64)
    out[keys] = np.array([found.atRot3(k).matrix() for k in keys.tolist()]).reshape(-1, 3, 3)
    datum = datum_stations(network)
    if len(datum):
        turn = nearest_rotation(np.einsum("nij,nkj->ik", network.station_rotations[datum], out[datum]))
    else:
        turn = out[network.anchor or 0].T
    out = turn @ out
    out[network.held] = network.station_rotations[network.held]
    return np.asarray(out)


def _tie_datum(network: PoseNetwork, graph: gtsam.NonlinearFactorGraph) -> None:
    """Given rotations tie parts together that no pair joins: strong pairs to the first of them."""
    datum = datum_stations(network) if network.anchor is None else np.zeros(0, dtype=np.int64)
    if len(datum) < 2:
        return
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-2)
    first = network.station_rotations[datum[0]]
    for i in datum[1:].tolist():
        relative = gtsam.Rot3(first.T @ network.station_rotations[i])
        graph.push_back(gtsam.BetweenFactorRot3(int(datum[0]), i, relative, tight))


def start_translations(network: PoseNetwork, R: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Positions (N, 3) m with the rotations taken as true: t_a - t_b = R_b t_ba for every pair, one linear system."""
    keep = network.used & network.is_pose
    if weights is not None:
        keep = keep & (weights > 1e-9)
    rows = np.flatnonzero(keep)
    a, b = network.a_idx[rows], network.b_idx[rows]
    observed = np.einsum("nij,nj->ni", R[b], network.translations[rows])
    sigma = translation_sigmas(network)[rows]
    if weights is not None:
        sigma = sigma / np.sqrt(weights[rows])
    datum = datum_stations(network)
    fixed = np.zeros(network.n_stations, dtype=np.bool_)
    t = np.zeros((network.n_stations, 3))
    if len(datum):
        fixed[datum], t[datum] = True, network.station_translations[datum]
    else:
        fixed[network.anchor or 0] = True
    graph = _position_graph(a, b, observed, sigma, fixed, t)
    last = sorted(set(b[fixed[a]].tolist()) | set(a[fixed[b]].tolist()))
    last = [i for i in last if not fixed[i]]
    graph_keys = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(graph, last) if last else None
    delta = graph.optimize(graph_keys) if graph_keys is not None else graph.optimize()
    free = np.flatnonzero(~fixed)
    t[free] = delta.vector().reshape(-1, 3)
    return t


def translation_sigmas(network: PoseNetwork) -> FloatArray:
    """Standard deviation (E,) m of a pair's shift, one number: its own and what its turn does over its length."""
    shift = np.trace(network.cov[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    turn = np.trace(network.cov[:, :3, :3], axis1=1, axis2=2) / 3.0
    length = np.nan_to_num((network.translations**2).sum(axis=1))
    return np.asarray(np.sqrt(np.where(network.is_pose, shift + turn * length, np.inf)))


def _position_graph(
    a: IntArray, b: IntArray, observed: FloatArray, sigma: FloatArray, fixed: BoolArray, t: FloatArray
) -> gtsam.GaussianFactorGraph:
    graph, one = gtsam.GaussianFactorGraph(), np.eye(3)
    noise = gtsam.noiseModel.Unit.Create(3)
    known = observed + np.where(fixed[b, None], t[b], 0.0) - np.where(fixed[a, None], t[a], 0.0)
    scale = float(np.median(sigma)) / sigma
    for i, j, z, s, fa, fb in zip(a.tolist(), b.tolist(), known, scale.tolist(), fixed[a], fixed[b], strict=True):
        if fa and fb:
            continue
        if fa or fb:
            graph.add(gtsam.JacobianFactor(j if fa else i, (-s if fa else s) * one, s * z, noise))
        else:
            graph.add(gtsam.JacobianFactor(i, s * one, j, -s * one, s * z, noise))
    return graph
