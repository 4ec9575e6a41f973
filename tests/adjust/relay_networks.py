"""Networks of stations for tests, simulated by GTSAM's own rotations and poses, one pair at a time."""

from dataclasses import dataclass

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.observations import FrameRef, Pair
from adjust.relay.network import MeasuredPairs, topology
from adjust.spatial.rigid_motions import Motions

ARCMIN = np.pi / 180 / 60


@dataclass(frozen=True, eq=False)
class Simulated:
    network: MeasuredPairs
    true: list  # b_from_a
    world: list  # world_from_station


def grid(nx, ny):
    rows = []
    for i in range(nx):
        for j in range(ny):
            if j + 1 < ny:
                rows.append((f"h{i}.{j}", f"{i}.{j}", f"{i}.{j + 1}"))
            if i + 1 < nx:
                rows.append((f"v{i}.{j}", f"{i}.{j}", f"{i + 1}.{j}"))
    return topology(rows)


def complete(n):
    """Every camera measured with every other, in the order (1, 2), (1, 3), ..., (2, 3), ...; ids are ``a-b``."""
    ids = [f"C{i + 1}" for i in range(n)]
    return topology([(f"{a}-{b}", a, b) for i, a in enumerate(ids) for b in ids[i + 1 :]], ids)


def chain_with_chords(n, chords, seed=0):
    """A chain 1-2-3-..., its pairs first, and random chords."""
    rng = np.random.default_rng(seed)
    rows = [(f"t{i}", f"S{i}", f"S{i + 1}") for i in range(n - 1)]
    for k in range(chords):
        a, b = rng.choice(n, 2, replace=False)
        rows.append((f"c{k}", f"S{a}", f"S{b}"))
    return topology(rows)


def anisotropic(rng, n, dim, sigma_rad=5 * ARCMIN, sigma_m=0.01):
    """Covariances (n, dim, dim) with random axes, sizes and correlations."""
    A = rng.normal(size=(n, dim, dim))
    C = (A @ A.transpose(0, 2, 1) / dim + 0.1 * np.eye(dim)) * rng.uniform(0.2, 4.0, (n, 1, 1))
    scale = np.r_[np.full(3, sigma_rad), np.full(dim - 3, sigma_m)]
    return C * np.outer(scale, scale)


def simulate(top, dim=3, seed=0, noise=1.0):
    rng = np.random.default_rng(seed)
    if dim == 3:
        world = [Rot3.Expmap(rng.normal(size=3)) for _ in range(top.n_stations)]
    else:
        world = [Pose3.Expmap(rng.normal(size=6) * [1, 1, 1, 3, 3, 3]) for _ in range(top.n_stations)]
    cov = anisotropic(rng, top.n_pairs, dim)
    errors = noise * (np.linalg.cholesky(cov) @ rng.normal(size=(top.n_pairs, dim, 1)))[..., 0]
    true = [world[b].between(world[a]) for a, b in zip(top.a_idx, top.b_idx, strict=True)]
    expmap = Rot3.Expmap if dim == 3 else Pose3.Expmap
    measured = [motion * expmap(e) for motion, e in zip(true, errors, strict=True)]
    return Simulated(MeasuredPairs(top, motions(measured), cov), true, world)


def motions(items):
    if isinstance(items[0], Rot3):
        return Motions(np.array([m.matrix() for m in items]))
    return Motions(np.array([m.rotation().matrix() for m in items]), np.array([m.translation() for m in items]))


def as_gtsam(found, i):
    rotation = Rot3(found.rotation[i])
    return rotation if found.translation is None else Pose3(rotation, found.translation[i])


def differences(found, true):
    """Log(true^-1 found), one by one, by GTSAM."""
    if isinstance(true[0], Rot3):
        return np.array([Rot3.Logmap(t.between(as_gtsam(found, i))) for i, t in enumerate(true)])
    return np.array([Pose3.Logmap(t.between(as_gtsam(found, i))) for i, t in enumerate(true)])


def ends(top, pair_idx):
    """Ids of the two stations of a pair."""
    return top.station_ids[top.a_idx[pair_idx]], top.station_ids[top.b_idx[pair_idx]]


def pairs_of(simulated):
    """The network as observations of a survey."""
    network, top = simulated.network, simulated.network.topology
    return tuple(
        Pair(
            top.pair_ids[e],
            *(FrameRef("station", s) for s in ends(top, e)),
            as_gtsam(network.b_from_a, e),
            network.cov[e],
        )
        for e in range(top.n_pairs)
    )


def suspects(pairs, alpha=0.001):
    """Positions of the pairs that do not fit, worst first, at one level for the whole network (Sidak)."""
    tested = np.flatnonzero(pairs.freedom > 0)
    single = 1.0 - (1.0 - alpha) ** (1.0 / len(tested))
    order = tested[np.argsort(-pairs.test[tested] / pairs.freedom[tested], kind="stable")]
    return order[pairs.p_value[order] < single].tolist()
