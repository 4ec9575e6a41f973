"""All pairs of a station's eyes, each from its two eyes alone, and what pairs share because they share an eye."""

from collections.abc import Sequence
from dataclasses import field
from itertools import combinations

import numpy as np
import scipy.linalg

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import Pair
from adjust.model.survey import FloatArray
from adjust.pose_network.loops import evaluate_loops
from adjust.relay.conditions import ConditionAdjustment, adjust_conditions
from adjust.relay.eyes.eyes import EyeAdjustment, EyeOptions, adjust_eyes, symmetric
from adjust.relay.eyes.sequences import EyeSequence
from adjust.relay.network import network_from_pairs
from adjust.relay.normal_equations import condition_matrix

_EYES = EyeOptions()


@frozen(eq=False)
class EyePairs:
    """pairs: with their own covariances. joint_cov: (6p, 6p) with what they share. refused: pairs that cannot be found.

    adjustments: of each pair, in the same order.
    """

    pairs: tuple[Pair, ...]
    joint_cov: FloatArray
    refused: tuple[str, ...]
    adjustments: tuple[EyeAdjustment, ...] = field(repr=False)


@frozen(eq=False)
class LoopedPairs:
    """Pairs after their loops were closed as if they were independent.

    claimed_cov: (p, 6, 6) of that adjustment. actual_cov: (p, 6, 6) that the same estimate really has, since pairs of
    one eye share its errors.
    """

    adjusted: ConditionAdjustment
    claimed_cov: FloatArray
    actual_cov: FloatArray


def pairs_of(sequences: Sequence[EyeSequence], options: EyeOptions = _EYES) -> EyePairs:
    """Every two eyes by themselves. Raises SurveyError where no pair can be found."""
    found: list[tuple[Pair, EyeAdjustment, FloatArray]] = []
    refused = []
    size = [6 * len(s.epoch_ids) for s in sequences]
    at = np.cumsum([0, *size])
    for i, j in combinations(range(len(sequences)), 2):
        a, b = sequences[i], sequences[j]
        try:
            adjusted = adjust_eyes((a, b), options)
        except SurveyError as error:
            refused.append(f"pair {a.eye.frame_id}-{b.eye.frame_id}: {error}")
            continue
        ids = (a.eye.frame_id, b.eye.frame_id)
        by = adjusted.pair_jacobian(*ids) @ adjusted.by_observation()
        row = np.zeros((6, int(at[-1])))
        row[:, at[i] : at[i + 1]], row[:, at[j] : at[j + 1]] = by[:, : size[i]], by[:, size[i] :]
        found.append((adjusted.pair(*ids), adjusted, row))
    if not found:
        raise SurveyError("no two eyes make a pair: " + "; ".join(refused))
    Q = scipy.linalg.block_diag(*(s.joint_cov for s in sequences))
    G = np.concatenate([row for _, _, row in found])
    return EyePairs(
        tuple(p for p, _, _ in found), symmetric(G @ Q @ G.T), tuple(refused), tuple(x for _, x, _ in found)
    )


def close_loops(found: EyePairs) -> LoopedPairs:
    """Adjust the pairs with their loops as a network, each pair independent of the others, as measured pairs are."""
    network = network_from_pairs(found.pairs)
    adjusted = adjust_conditions(network)
    p, Q = network.topology.n_pairs, scipy.linalg.block_diag(*network.cov)
    B = condition_matrix(adjusted.basis, evaluate_loops(adjusted.basis, adjusted.pairs.b_from_a)[1]).toarray()
    H = np.eye(6 * p) - Q @ B.T @ np.linalg.solve(B @ Q @ B.T, B)
    at = np.arange(p)
    cut = [C.reshape(p, 6, p, 6)[at, :, at, :] for C in (H @ Q, H @ found.joint_cov @ H.T)]
    return LoopedPairs(adjusted, cut[0], cut[1])


def triangle_misclosure(found: EyePairs, a_id: str, b_id: str, c_id: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Misclosure (6,) of c-a, b-c, a-b in frame a, its covariance as if the pairs were independent, and the true one.

    Raises SurveyError where a pair is missing.
    """
    ids = [p.pair_id for p in found.pairs]
    names = (f"{a_id}-{b_id}", f"{b_id}-{c_id}", f"{a_id}-{c_id}")
    for name in names:
        if name not in ids:
            raise SurveyError(f"pair {name} is missing; the triangle is not closed")
    at = [ids.index(name) for name in names]
    ab, bc, ac = (network_from_pairs([found.pairs[i]]).b_from_a for i in at)
    f = ac.inverse() @ bc @ ab
    J = np.zeros((6, 6 * len(ids)))
    for i, D in zip(at, (np.eye(6), ab.inverse().adjoint()[0], -f.inverse().adjoint()[0]), strict=True):
        J[:, 6 * i : 6 * i + 6] = D
    own = scipy.linalg.block_diag(*(p.cov for p in found.pairs))
    return f.log()[0], J @ own @ J.T, J @ found.joint_cov @ J.T
