"""From sequences of poses or motions to conditions between eyes, with start values."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.pose_network.cycles import connected_parts
from adjust.relay.eyes.sequences import KnownWorlds, MotionSequence, PoseSequence
from adjust.relay.eyes.solver import EyeConditions, EyeProblem, KnownMotion
from adjust.spatial.rigid_motions import Motions, identities
from adjust.start.closed_forms.hand_eye import relative_motions, solve_ax_xb


@dataclass(frozen=True, eq=False)
class EyeSetup:
    """problem: ready to be solved. epoch_ids: of each condition (m,). motions: whether motions were observed.

    world_idx: unknown of each named world. scaled_eyes: eyes with a scale of their own, in the order of the scales.
    """

    eyes: tuple[FrameRef, ...]
    problem: EyeProblem
    epoch_ids: tuple[str, ...]
    motions: bool
    world_idx: dict[str, int]
    scaled_eyes: tuple[int, ...] = ()


def motion_setup(sequences: Sequence[MotionSequence], free_scales: bool) -> EyeSetup:
    """Conditions between the first eye that moved over an interval and every other one."""
    eyes = _eyes([s.eye for s in sequences])
    rows = _joined([s.interval_ids for s in sequences], [s.eye.frame_id for s in sequences], "interval")
    k, other, eye_k, eye_l, names = _star(rows)
    observed, cov = _observed([s.before_from_after for s in sequences], [s.cov for s in sequences])
    scaled = tuple(range(1, len(eyes))) if free_scales else ()
    conditions = EyeConditions(
        k, other, eye_k, eye_l, eye_k, eye_l, _scale_idx(eye_k, free_scales), _scale_idx(eye_l, free_scales)
    )
    _refuse_unlinked(len(eyes), conditions.eye_k, conditions.eye_l, [e.frame_id for e in eyes])
    start = identities(len(eyes), 6)
    for a, b in _walk(eye_k, eye_l):
        mine: BoolArray = ((eye_k == a) & (eye_l == b)) | ((eye_k == b) & (eye_l == a))
        of_a, of_b = np.where(eye_k == a, k, other)[mine], np.where(eye_k == a, other, k)[mine]
        X = _hand_eye(observed[of_a].matrices(), observed[of_b].matrices(), eyes[a], eyes[b])
        start = _placed(start, b, start[np.array([a])] @ X)
    free = np.arange(len(eyes)) > 0
    return EyeSetup(eyes, EyeProblem(observed, cov, conditions, start, free, (), len(scaled)), names, True, {}, scaled)


def _scale_idx(eye: IntArray, free_scales: bool) -> IntArray:
    """Every eye but the first has a scale of its own, where scales are free."""
    return eye - 1 if free_scales else np.full_like(eye, -1)


def pose_setup(sequences: Sequence[PoseSequence], known: Sequence[KnownWorlds]) -> EyeSetup:
    """Conditions between the first eye that saw anything at an epoch and every other one."""
    eyes = _eyes([s.eye for s in sequences])
    rows = _joined([s.epoch_ids for s in sequences], [s.eye.frame_id for s in sequences], "epoch")
    k, other, eye_k, eye_l, names = _star(rows)
    observed, cov = _observed([s.world_from_eye for s in sequences], [s.cov for s in sequences])
    world_ids = [w for s in sequences for w in s.world_ids]
    used = dict.fromkeys([world_ids[i] for i in np.stack([k, other], axis=1).ravel()])
    world_idx = {w: len(eyes) + i for i, w in enumerate(used)}
    of_obs = np.array([world_idx.get(w, -1) for w in world_ids], dtype=np.int64)
    none = np.full(len(k), -1, dtype=np.int64)
    conditions = EyeConditions(k, other, eye_k, eye_l, of_obs[k], of_obs[other], none, none)
    relations = [r for r in known if r.a_id in world_idx and r.b_id in world_idx]
    free = np.ones(len(eyes) + len(world_idx), dtype=np.bool_)
    free[0] = False
    start, free = _pose_start(
        conditions, observed, free, len(eyes), [(world_idx[r.a_id], world_idx[r.b_id], r) for r in relations], eyes
    )
    problem_known = tuple(_known(world_idx[r.a_id], world_idx[r.b_id], r, free) for r in relations)
    problem = EyeProblem(observed, cov, conditions, start, free, problem_known)
    return EyeSetup(eyes, problem, names, False, world_idx)


def _known(a: int, b: int, relation: KnownWorlds, free: BoolArray) -> KnownMotion:
    """A relation to the held world; between two free ones there is no datum that makes it one unknown's."""
    motion = _one(relation.a_from_b)
    if not free[a]:
        return KnownMotion(b, motion, np.asarray(relation.cov))
    if not free[b]:
        Ad = motion.adjoint()[0]
        return KnownMotion(a, motion.inverse(), np.asarray(Ad @ relation.cov @ Ad.T))
    raise SurveyError(
        f"the relation of the worlds {relation.a_id!r} and {relation.b_id!r} does not touch the world that the others "
        "refer to; give relations to one and the same world"
    )


def _pose_start(
    c: EyeConditions, observed: Motions, free: BoolArray, n_eyes: int,
    known: list[tuple[int, int, KnownWorlds]], eyes: tuple[FrameRef, ...],
) -> tuple[Motions, BoolArray]:  # fmt: skip
    """Start values of eyes and worlds, one eye after the other; holds one world of each part that hangs together."""
    _refuse_unlinked(n_eyes, c.eye_k, c.eye_l, [e.frame_id for e in eyes])
    U = identities(len(free), 6)
    free = free.copy()
    links = [(int(a), int(b)) for a, b in zip(c.world_k, c.world_l, strict=True)] + [(a, b) for a, b, _ in known]
    for first in _first_of_parts(len(free), links, n_eyes, [a for a, _, _ in known]):
        free[first] = False
    for a, b in _walk(c.eye_k, c.eye_l):
        mine: BoolArray = ((c.eye_k == a) & (c.eye_l == b)) | ((c.eye_k == b) & (c.eye_l == a))
        turned = (c.eye_k == b)[mine]
        of_a, of_b = np.where(turned, c.l_idx[mine], c.k_idx[mine]), np.where(turned, c.k_idx[mine], c.l_idx[mine])
        wa, wb = np.where(turned, c.world_l[mine], c.world_k[mine]), np.where(turned, c.world_k[mine], c.world_l[mine])
        U = _placed(
            U, b, U[np.array([a])] @ _eye_from_eye(observed[of_a], observed[of_b], wa, wb, known, (eyes[a], eyes[b]))
        )
    set_worlds = {int(i) for i in np.flatnonzero(~free) if i >= n_eyes}
    for a, b, relation in known:
        if a in set_worlds and b not in set_worlds:
            U = _placed(U, b, U[np.array([a])] @ _one(relation.a_from_b))
            set_worlds.add(b)
        elif b in set_worlds and a not in set_worlds:
            U = _placed(U, a, U[np.array([b])] @ _one(relation.a_from_b).inverse())
            set_worlds.add(a)
    return _worlds_started(c, observed, U, set_worlds), free


def _hand_eye(a: FloatArray, b: FloatArray, eye_a: FrameRef, eye_b: FrameRef) -> Motions:
    """``a_from_b`` from motions (n, 4, 4); what is undetermined is named with the eyes."""
    try:
        return Motions.of(solve_ax_xb(a, b)[0][None])
    except SurveyError as error:
        raise SurveyError(f"eyes {eye_a.frame_id} and {eye_b.frame_id}: {error}") from None


def _eye_from_eye(
    A: Motions,
    B: Motions,
    wa: IntArray,
    wb: IntArray,
    known: list[tuple[int, int, KnownWorlds]],
    eyes: tuple[FrameRef, FrameRef],
) -> Motions:
    """``a_from_b`` of two eyes: directly where their worlds are the same or known, else from the motions."""
    relation = {(a, b): _one(r.a_from_b) for a, b, r in known}
    relation |= {(b, a): m.inverse() for (a, b), m in relation.items()}
    direct = []
    for i in range(len(A)):
        key = (int(wa[i]), int(wb[i]))
        Z = identities(1, 6) if key[0] == key[1] else relation.get(key)
        if Z is not None:
            one = np.array([i])
            direct.append(A[one].inverse() @ Z @ B[one])
    if direct:
        return medoid(Motions.joined(direct))
    motions = []
    for key in dict.fromkeys(zip(wa.tolist(), wb.tolist(), strict=True)):
        rows = np.flatnonzero((wa == key[0]) & (wb == key[1]))
        if len(rows) > 1:
            motions.append(relative_motions(A[rows].matrices(), B[rows].matrices()))
    if not motions:
        raise SurveyError(
            "two eyes never saw the same two worlds twice: nothing turns; take several epochs before unmoved targets"
        )
    a, b = (np.concatenate([m[j] for m in motions]) for j in (0, 1))
    return _hand_eye(a, b, *eyes)


def _worlds_started(c: EyeConditions, observed: Motions, U: Motions, done: set[int]) -> Motions:
    """Worlds one after the other through the epochs that join them."""
    while True:
        reach: dict[int, list[Motions]] = {}
        for i in range(len(c)):
            one = np.array([i])
            k_from_l = (
                observed[c.k_idx[one]] @ U[c.eye_k[one]].inverse() @ U[c.eye_l[one]] @ observed[c.l_idx[one]].inverse()
            )
            a, b = int(c.world_k[i]), int(c.world_l[i])
            if a in done and b not in done:
                reach.setdefault(b, []).append(U[np.array([a])] @ k_from_l)
            elif b in done and a not in done:
                reach.setdefault(a, []).append(U[np.array([b])] @ k_from_l.inverse())
        if not reach:
            return U
        for world, found in reach.items():
            U = _placed(U, world, medoid(Motions.joined(found)))
            done.add(world)


def medoid(motions: Motions) -> Motions:
    """The one whose rotations and shifts are nearest to all others, lengths taken in their own spread."""
    between = np.einsum("nij,mij->nm", motions.rotation, motions.rotation)
    angle = np.arccos(np.clip((between - 1.0) / 2.0, -1.0, 1.0))
    shift = np.linalg.norm(motions.shifts[:, None] - motions.shifts[None], axis=-1)
    cost = np.median(angle, axis=1) / (np.median(angle) + 1e-12) + np.median(shift, axis=1) / (np.median(shift) + 1e-12)
    return motions[np.array([int(np.argmin(cost))])]


def _eyes(eyes: Sequence[FrameRef]) -> tuple[FrameRef, ...]:
    ids = [eye.frame_id for eye in eyes]
    twice = [i for i in ids if ids.count(i) > 1]
    if len(ids) < 2 or twice:
        what = f"eye {twice[0]!r} is there twice" if twice else f"{len(ids)} eye(s) make no pair"
        raise SurveyError(f"{what}; give one sequence for each of two or more eyes")
    return tuple(eyes)


def _joined(ids: Sequence[tuple[str, ...]], owners: Sequence[str], what: str) -> dict[str, list[tuple[int, int]]]:
    """Of each epoch the eyes and the observations there."""
    rows: dict[str, list[tuple[int, int]]] = {}
    at = 0
    for eye, (names, owner) in enumerate(zip(ids, owners, strict=True)):
        twice = next((n for n in names if names.count(n) > 1), None) if len(set(names)) < len(names) else None
        if twice is not None:
            raise SurveyError(f"eye {owner!r} has two poses at {what} {twice!r}; keep one")
        for name in names:
            rows.setdefault(name, []).append((eye, at))
            at += 1
    return rows


def _star(rows: dict[str, list[tuple[int, int]]]) -> tuple[IntArray, IntArray, IntArray, IntArray, tuple[str, ...]]:
    found = [(name, first, other) for name, seen in rows.items() for first in seen[:1] for other in seen[1:]]
    if not found:
        raise SurveyError("no epoch is common to two eyes; the eyes of a station are joined by epochs of the same id")
    table = np.array([(f[1], o[1], f[0], o[0]) for _, f, o in found], dtype=np.int64)
    k, other, eye_k, eye_l = table.T.copy()
    return k, other, eye_k, eye_l, tuple(name for name, _, _ in found)


def _observed(parts: Sequence[Motions], covs: Sequence[FloatArray]) -> tuple[Motions, FloatArray]:
    """All observations, their covariances as blocks where no sequence has a joint one."""
    if all(c.ndim == 3 for c in covs):
        return Motions.joined(parts), np.concatenate(covs)
    full = [c if c.ndim == 2 else scipy.linalg.block_diag(*c) for c in covs]
    return Motions.joined(parts), np.asarray(scipy.linalg.block_diag(*full))


def _walk(a: IntArray, b: IntArray) -> list[tuple[int, int]]:
    """Tree from eye 0 through all eyes that share epochs, as (from, to)."""
    out, done = [], {0}
    links = sorted(
        {(int(x), int(y)) for x, y in zip(a, b, strict=True)} | {(int(y), int(x)) for x, y in zip(a, b, strict=True)}
    )
    queue = [0]
    while queue:
        here = queue.pop(0)
        for x, y in links:
            if x == here and y not in done:
                out.append((x, y))
                done.add(y)
                queue.append(y)
    return out


def _refuse_unlinked(n: int, a: IntArray, b: IntArray, ids: list[str]) -> None:
    reached = {0} | {y for _, y in _walk(a, b)}
    lost = [ids[i] for i in range(n) if i not in reached]
    if lost:
        raise SurveyError(
            f"the eyes {', '.join(lost)} share no epoch with {ids[0]}; take epochs in which both see something"
        )


def _first_of_parts(n: int, links: list[tuple[int, int]], n_eyes: int, preferred: list[int]) -> list[int]:
    """One world of each part that hangs together; those with known relations first."""
    a, b = (np.array([link[i] for link in links], dtype=np.int64) for i in (0, 1))
    part = connected_parts(n, a, b).tolist()
    first = {part[i]: i for i in reversed([*preferred, *range(n_eyes, n)])}
    return list(first.values())


def _one(pose: Pose3) -> Motions:
    return Motions.of(pose.matrix()[None])


def _placed(motions: Motions, idx: int, one: Motions) -> Motions:
    return motions.where(np.asarray(np.arange(len(motions)) != idx), one)
