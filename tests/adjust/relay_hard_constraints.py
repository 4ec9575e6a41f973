"""The conditions of a relay network by GTSAM itself, a prior per pair and a hard closure per loop: for small sets."""

import gtsam
import numpy as np

from adjust.observations.factors import custom, gaussian
from adjust.pose_network.loops import Loops, evaluate_loops
from adjust.relay.conditions import ConditionAdjustment, adjust_conditions
from adjust.relay.loops import loop_basis
from adjust.relay.result import adjusted_pairs
from adjust.spatial.rigid_motions import Motions
from tests.adjust.relay_networks import as_gtsam

MOST_LOOPS = 200
"""GTSAM loses constraints in grids of more than about 300."""


def values_of(motions):
    values = gtsam.Values()
    for i in range(len(motions)):
        values.insert(i, as_gtsam(motions, i))
    return values


def closure_factor(basis, loop, dim):
    rows = slice(basis.ptr[loop], basis.ptr[loop + 1])
    keys = basis.pair_idx[rows].tolist()
    alone = Loops(np.array([0, len(keys)]), np.arange(len(keys)), basis.sense[rows], basis.start_idx[loop : loop + 1])

    def residual(values):
        if dim == 3:
            motions = Motions(np.array([values.atRot3(key).matrix() for key in keys]))
        else:
            poses = [values.atPose3(key) for key in keys]
            turns, shifts = [p.rotation().matrix() for p in poses], [p.translation() for p in poses]
            motions = Motions(np.array(turns), np.array(shifts))
        w, blocks = evaluate_loops(alone, motions)
        return w[0], list(zip(keys, blocks, strict=True))

    return custom(keys, gtsam.noiseModel.Constrained.All(dim), residual)


def adjust_condition_factors(network):
    """Full steps until the loops close; joint covariances as the product has them."""
    dim, n, basis = network.dim, network.topology.n_pairs, loop_basis(network.topology)
    assert len(basis) <= MOST_LOOPS
    graph, prior = gtsam.NonlinearFactorGraph(), gtsam.PriorFactorRot3 if dim == 3 else gtsam.PriorFactorPose3
    for e in range(n):
        graph.add(prior(e, as_gtsam(network.b_from_a, e), gaussian(network.cov[e])))
    for loop in range(len(basis)):
        graph.add(closure_factor(basis, loop, dim))
    X, moved, iterations = network.b_from_a, np.inf, 0
    while moved > 1e-13 and iterations < 50:
        delta = graph.linearize(values_of(X)).optimize()
        d, iterations = np.array([delta.at(e) for e in range(n)]), iterations + 1
        X, moved = X.retract(d), np.abs(d).max()
    marginals = gtsam.Marginals(graph, values_of(X))
    cov = np.array([marginals.marginalCovariance(e) for e in range(n)])
    joint = adjust_conditions(network).pairs.joint
    pairs = adjusted_pairs(network, X, cov, dim * len(basis), iterations, joint)
    return ConditionAdjustment(pairs, basis, float(np.abs(evaluate_loops(basis, X)[0]).max()))
