"""A pose network as a GTSAM graph of native factors. Key of a station: its position. Held stations are no variables.

A pair with one held end is exactly a prior on the other: with a held, Log(Z^-1 B^-1 A) = -Ad(Z^-1) Log(Z A^-1 B).
"""

from typing import Any

import gtsam
import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.pose_network.network import PoseNetwork
from adjust.relay.motions import Motions


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


def to_motions(rotations: FloatArray, translations: FloatArray, rotation_only: bool) -> list[Any]:
    """Rot3s, or Pose3s, of arrays; translations that were not measured count as zero."""
    if rotation_only:
        return [Rot3(R) for R in rotations]
    t = np.nan_to_num(translations)
    return [Pose3(Rot3(R), x) for R, x in zip(rotations, t, strict=True)]


def pair_factors(
    network: PoseNetwork, rows: IntArray, rotations: FloatArray, translations: FloatArray,
    weights: FloatArray | None = None, noise: NoiseCache | None = None,
) -> list[gtsam.NonlinearFactor]:  # fmt: skip
    """Factors of the pairs ``rows``; held stations stand at ``rotations`` (N, 3, 3), ``translations`` (N, 3).

    weights: (rows,) factors on the information. Pairs between two held stations get none.
    """
    noise = noise or NoiseCache()
    flat = network.rotation_only
    W = network.whitening[rows]
    if weights is not None:
        W = W * np.sqrt(weights)[:, None, None]
    fixed = network.constants
    between: Any = gtsam.BetweenFactorRot3 if flat else gtsam.BetweenFactorPose3
    prior: Any = gtsam.PriorFactorRot3 if flat else gtsam.PriorFactorPose3
    motions = to_motions(network.rotations[rows], network.translations[rows], flat)
    a, b = network.a_idx[rows].tolist(), network.b_idx[rows].tolist()
    at = {
        i: to_motions(rotations[i : i + 1], translations[i : i + 1], flat)[0]
        for i in np.flatnonzero(fixed).tolist()
    }
    out: list[gtsam.NonlinearFactor] = []
    for n, (i, j) in enumerate(zip(a, b, strict=True)):
        if i not in at and j not in at:
            out.append(between(j, i, motions[n], noise(W[n])))
        elif i not in at:
            out.append(prior(i, at[j].compose(motions[n]), noise(W[n])))
        elif j not in at:
            out.append(prior(j, at[i].compose(motions[n].inverse()), noise(_seen_from_a(network, rows[n], W[n]))))
    return out


def _seen_from_a(network: PoseNetwork, row: int, W: FloatArray) -> FloatArray:
    """Whitening of a pair's residual as a prior on b: W Ad(Z^-1), made upper triangular."""
    t = None if network.rotation_only else np.nan_to_num(network.translations[row : row + 1])
    a_from_b = Motions(network.rotations[row : row + 1], t).inverse()
    return np.asarray(np.linalg.qr(W @ a_from_b.adjoint()[0], mode="r"))


def prior_factors(network: PoseNetwork, noise: NoiseCache) -> list[gtsam.NonlinearFactor]:
    """Factors of the stations with a prior."""
    out: list[gtsam.NonlinearFactor] = []
    for i, W in prior_whitening(network).items():
        R, t = network.station_rotations[i : i + 1], network.station_translations[i : i + 1]
        mean = to_motions(R, t, network.rotation_only)
        make: Any = gtsam.PriorFactorRot3 if network.rotation_only else gtsam.PriorFactorPose3
        out.append(make(i, mean[0], noise(W)))
    return out


def prior_whitening(network: PoseNetwork) -> dict[int, FloatArray]:
    """W (dim, dim) of every prior, zero where its variance is infinite."""
    out = {}
    for i, cov in network.prior_cov.items():
        d = network.dim
        known = np.flatnonzero(np.isfinite(np.diag(cov)[:d]))
        W = np.zeros((d, d))
        W[np.ix_(known, known)] = np.linalg.cholesky(np.linalg.inv(cov[np.ix_(known, known)])).T
        out[i] = W
    return out


def network_graph(
    network: PoseNetwork, rotations: FloatArray, translations: FloatArray, weights: FloatArray | None = None
) -> gtsam.NonlinearFactorGraph:
    """The whole graph of the pairs in use; ``weights`` (E,) on their information."""
    noise, graph = NoiseCache(), gtsam.NonlinearFactorGraph()
    rows = np.flatnonzero(network.used if weights is None else network.used & (weights > 0.0))
    chosen = None if weights is None else weights[rows]
    for factor in pair_factors(network, rows, rotations, translations, chosen, noise):
        graph.push_back(factor)
    for factor in prior_factors(network, noise):
        graph.push_back(factor)
    return graph


def network_values(network: PoseNetwork, rotations: FloatArray, translations: FloatArray) -> gtsam.Values:
    """GTSAM's values of all stations that are unknowns."""
    values = gtsam.Values()
    free = np.flatnonzero(~network.constants)
    for i, motion in zip(free.tolist(), to_motions(rotations[free], translations[free], network.dim == 3), strict=True):
        values.insert(i, motion)
    return values


def values_arrays(
    network: PoseNetwork, values: gtsam.Values, rotations: FloatArray, translations: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotations (N, 3, 3) and translations (N, 3) of all stations; the held ones are taken from the arrays given."""
    R, t = rotations.copy(), translations.copy()
    free = np.flatnonzero(~network.constants)
    if network.rotation_only:
        R[free] = rotations_of(values, free)
    elif len(free):
        rows = gtsam.utilities.extractPose3(values)
        R[free], t[free] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    return R, t


def rotations_of(values: gtsam.Values, keys: IntArray) -> FloatArray:
    """Rotations (k, 3, 3) of these keys."""
    return np.array([values.atRot3(k).matrix() for k in keys.tolist()]).reshape(-1, 3, 3)


def network_ordering(network: PoseNetwork, graph: gtsam.NonlinearFactorGraph, used: BoolArray) -> gtsam.Ordering:
    """Fill-reducing order with the neighbours of the datum last.

    Far stations eliminated last would have lost nearly all of their information by then, which GTSAM's Cholesky takes
    for a singular system.
    """
    fixed = network.constants
    a, b = network.a_idx[used], network.b_idx[used]
    near = set(b[fixed[a]].tolist()) | set(a[fixed[b]].tolist()) | set(network.prior_cov)
    last = sorted(i for i in near if not fixed[i])
    if not last or len(last) == int((~fixed).sum()):
        return gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    return gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, last)
