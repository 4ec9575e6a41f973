"""From sequences of poses or motions to conditions between eyes, with start values."""

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.linalg

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.pose_network.cycles import Forest, adjacency, breadth_first, connected_parts
from adjust.relay.eyes.sequences import EyeSequence
from adjust.relay.eyes.solver import EyeConditions, EyeProblem
from adjust.spatial.averaging import mean_pose, typical_distance
from adjust.spatial.rigid import inverse
from adjust.spatial.rigid_motions import Motions
from adjust.start.closed_forms.hand_eye import relative_motions, solve_ax_xb


@frozen(eq=False)
class EyeSetup:
    """problem: ready to be solved. epoch_ids: of each condition (m,). motions: whether motions were observed.

    world_idx: unknown of each named world. scaled_eyes: eyes with a scale of their own, in the order of the scales.
    """

    eyes: tuple[FrameRef, ...]
    problem: EyeProblem
    epoch_ids: tuple[str, ...]
    motions: bool
    world_idx: dict[str, int]
    scaled_eyes: tuple[int, ...]


def eye_setup(sequences: Sequence[EyeSequence], free_scales: bool = False) -> EyeSetup:
    """Conditions between the first eye that observed anything at an epoch and every other one.

    free_scales: of motions, whether every eye but the first has a scale of its own. Raises SurveyError for eyes that
    nothing ties to the first, ValueError for motions of one eye and poses of another.
    """
    eyes, moving = _eyes([s.eye for s in sequences]), sequences[0].world_ids is None
    if any((s.world_ids is None) != moving for s in sequences):
        raise ValueError("poses of one eye and motions of the other make no pair")
    obs, eye, names = _star(_joined(sequences, "interval" if moving else "epoch"))
    tree = _tree(eyes, eye)
    observed, cov = _observed(sequences)
    world_ids = [w for s in sequences for w in s.world_ids or ()]
    world_idx, worlds = dict[str, int](), eye  # of motions the worlds are the eyes
    if not moving:
        used = dict.fromkeys(world_ids[i] for i in obs.ravel().tolist())
        world_idx = {w: len(eyes) + i for i, w in enumerate(used)}
        worlds = np.array([world_idx.get(w, -1) for w in world_ids], dtype=np.int64)[obs]
    scaled = tuple(range(1, len(eyes))) if free_scales and moving else ()
    scale = eye - 1 if scaled else np.full_like(eye, -1)
    conditions = EyeConditions(*(column.copy() for both in (obs, eye, worlds, scale) for column in both.T))
    free = np.ones(len(eyes) + len(world_idx), dtype=np.bool_)
    free[[0, *_first_of_parts(len(free), worlds, len(eyes))]] = False
    start = _started((obs, eye, worlds), observed.matrices(), tree, free, eyes)
    problem = EyeProblem(observed, cov, conditions, Motions.of(start), free, len(scaled))
    return EyeSetup(eyes, problem, names, moving, world_idx, scaled)


def _started(
    pairs: tuple[IntArray, IntArray, IntArray], P: FloatArray, tree: Forest, free: BoolArray,
    eyes: tuple[FrameRef, ...],
) -> FloatArray:  # fmt: skip
    """Start values (u, 4, 4): one eye after the other, then worlds through the epochs that join them.

    pairs: of each condition (m, 2) observations, eyes and worlds. P: (n, 4, 4) the observations.
    """
    U, (obs, eye, worlds) = np.tile(np.eye(4), (len(free), 1, 1)), pairs
    for b in tree.order[1:].tolist():
        a = int(tree.parent[b])
        rows = np.flatnonzero((np.sort(eye, axis=1) == sorted((a, b))).all(axis=1))
        order = np.where(eye[rows, :1] == a, [0, 1], [1, 0])
        A, B = P[np.take_along_axis(obs[rows], order, axis=1).T]
        seen = None if worlds is eye else np.take_along_axis(worlds[rows], order, axis=1)
        U[b] = U[a] @ _eye_from_eye(A, B, seen, (eyes[a], eyes[b]))
    (P_k, P_l), (X_k, X_l) = P[obs.T], U[eye.T]
    links = list(zip(worlds.tolist(), P_k @ inverse(X_k) @ X_l @ inverse(P_l), strict=True))
    done = {i for i in np.flatnonzero(~free).tolist() if i >= len(eyes)}
    while reach := _reached(U, links, done):
        for world, found in reach.items():
            U[world] = _mean(np.array(found))
        done |= reach.keys()
    return U


def _reached(
    U: FloatArray, links: Sequence[tuple[Sequence[int], FloatArray]], done: set[int]
) -> Mapping[int, list[FloatArray]]:
    """Worlds that links ``a_from_b`` (4, 4) join with those that are done, and where each link puts them."""
    reach: dict[int, list[FloatArray]] = {}
    for (a, b), Z in links:
        if a in done and b not in done:
            reach.setdefault(b, []).append(U[a] @ Z)
        elif b in done and a not in done:
            reach.setdefault(a, []).append(U[b] @ inverse(Z))
    return reach


def _mean(poses: FloatArray) -> FloatArray:
    """Of motions (n, 4, 4), some of which may be wrong."""
    return mean_pose(poses, typical_distance(poses) or 1.0)[0]


def _eye_from_eye(
    A: FloatArray, B: FloatArray, worlds: IntArray | None, eyes: tuple[FrameRef, FrameRef]
) -> FloatArray:
    """``a_from_b`` (4, 4) of two eyes: directly where their worlds are the same, else from motions.

    A, B: (n, 4, 4) at the same epochs: poses in worlds (n, 2), or motions where there are none.
    """
    motions = [(A, B)]
    if worlds is not None:
        at = {(a, b): np.flatnonzero((worlds == (a, b)).all(axis=1)) for a, b in np.unique(worlds, axis=0).tolist()}
        if direct := [inverse(A[rows]) @ B[rows] for (a, b), rows in at.items() if a == b]:
            return _mean(np.concatenate(direct))
        motions = [relative_motions(A[rows], B[rows]) for rows in at.values() if len(rows) > 1]
    if not motions:
        raise SurveyError(
            "two eyes never saw the same two worlds twice: nothing turns; take several epochs before unmoved targets"
        )
    of_a, of_b = (np.concatenate(x) for x in zip(*motions, strict=True))
    try:
        return solve_ax_xb(of_a, of_b)[0]
    except SurveyError as error:  # what is undetermined is named with the eyes
        raise SurveyError(f"eyes {eyes[0].frame_id} and {eyes[1].frame_id}: {error}") from None


def _eyes(eyes: Sequence[FrameRef]) -> tuple[FrameRef, ...]:
    ids = [eye.frame_id for eye in eyes]
    twice = [i for i in ids if ids.count(i) > 1]
    if len(ids) < 2 or twice:
        what = f"eye {twice[0]!r} is there twice" if twice else f"{len(ids)} eye(s) make no pair"
        raise SurveyError(f"{what}; give one sequence for each of two or more eyes")
    return tuple(eyes)


def _joined(sequences: Sequence[EyeSequence], what: str) -> dict[str, list[tuple[int, int]]]:
    """Of each epoch the observations there and their eyes."""
    rows: dict[str, list[tuple[int, int]]] = {}
    at = 0
    for eye, sequence in enumerate(sequences):
        names = sequence.epoch_ids
        if len(set(names)) < len(names):
            twice = next(n for n in names if names.count(n) > 1)
            raise SurveyError(f"eye {sequence.eye.frame_id!r} has two poses at {what} {twice!r}; keep one")
        for name in names:
            rows.setdefault(name, []).append((at, eye))
            at += 1
    return rows


def _star(rows: dict[str, list[tuple[int, int]]]) -> tuple[IntArray, IntArray, tuple[str, ...]]:
    """Conditions: observations (m, 2), their eyes (m, 2), epochs (m,)."""
    found = [(name, (first, other)) for name, seen in rows.items() for first in seen[:1] for other in seen[1:]]
    if not found:
        raise SurveyError("no epoch is common to two eyes; the eyes of a station are joined by epochs of the same id")
    table = np.array([both for _, both in found], dtype=np.int64)
    return table[:, :, 0], table[:, :, 1], tuple(name for name, _ in found)


def _observed(sequences: Sequence[EyeSequence]) -> tuple[Motions, FloatArray]:
    """All observations, their covariances as blocks where no sequence has a joint one."""
    every, covs = Motions.joined([s.reference_from_eye for s in sequences]), [s.cov for s in sequences]
    if all(c.ndim == 3 for c in covs):
        return every, np.concatenate(covs)
    return every, scipy.linalg.block_diag(*(s.joint_cov for s in sequences))


def _tree(eyes: tuple[FrameRef, ...], pairs: IntArray) -> Forest:
    """From the first eye through all that share epochs. Raises SurveyError for eyes that it does not reach."""
    n = len(eyes)
    forest = breadth_first(*adjacency(n, *np.unique(np.sort(pairs, axis=1), axis=0).T), np.arange(n))
    ids = [eye.frame_id for eye in eyes]
    if lost := [ids[i] for i in np.flatnonzero(forest.part).tolist()]:
        raise SurveyError(
            f"the eyes {', '.join(lost)} share no epoch with {ids[0]}; take epochs in which both see something"
        )
    return forest


def _first_of_parts(n: int, links: IntArray, n_eyes: int) -> list[int]:
    """One world of each part that links (l, 2) hold together."""
    part = connected_parts(n, *links.T).tolist()
    first = {part[i]: i for i in reversed(range(n_eyes, n))}
    return list(first.values())
