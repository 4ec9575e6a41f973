"""Measured poses and rotations written in another convention than they were read in: all, of a group, single ones.

In a network of pairs the loops tell; of a robot's poses the camera on its hand, or one that sees its hand, does: turns
and shifts of both sides must be those of one rigid body. Inverting both sides of a hand and its eye changes no residual
(eye-in-hand taken for eye-to-hand): only the lengths of the result tell.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.screen import Screen, at_best, improvement, screen
from adjust.diagnosis.sequences import Link, fitted, hand, links, typical
from adjust.diagnosis.units.conventions import Scope, shrinking
from adjust.diagnosis.units.motions import CONVENTIONS, Convention, Motion, edits_of, mended, miss, rotation_of
from adjust.model.errors import listed
from adjust.model.frozen import frozen
from adjust.model.memory import remembered
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.spatial.rigid_motions import Motions

_CLEARLY = 3.0
_SURE = 20.0
"""Evidence that hardly leaves more than noise: what is tried at the robust start is bounded."""
_MOST, _SINGLE = 5, 8
_MISSED = 25.0
"""Mean square over sigmas at the start that the typical one of several pairs that are misread has at least."""
_ROUNDS = 5
"""Turns in which those of the pairs are found that are misread."""
_FEW = 150
"""Pairs up to which those are looked for that are misread among others."""
_LARGE = 500
"""Pairs up to which start values are found anew for every convention."""

_Found = tuple[float, Scope, Convention]


def misread_pairs(case: Case) -> Iterator[Hypothesis]:
    """The conventions for which loops, or what the pairs join, speak; the clearest first."""
    survey = case.survey
    if not survey.pairs:
        return
    hands = [link for link in links(case) if link.kind == "hand_eye"]
    judge = _by_hands(survey, hands) if hands else _by_start(case)
    if judge is None:
        return
    found, looked_at = _found(case, judge)
    found.sort(key=lambda f: (not _sure(f), -f[0], -len(f[1].rows)))
    for evidence, scope, convention in found[:_MOST]:
        changed = mended(survey, scope.rows, convention, case.written) if evidence > _CLEARLY else None
        if changed is not None:
            cause = f"{scope.text} {convention.said}{_lengths(changed, hands)}"
            yield Hypothesis(convention.name, cause, f"in pairs.csv {convention.remedy}", scope.place, changed,
                             edits_of(survey, scope.rows, convention), evidence, 1, looked_at,
                             penalty=shrinking(convention.shifts, 3 * len(scope.rows)))  # fmt: skip


def _found(case: Case, judge: "_Judge") -> tuple[list[_Found], int]:
    """What there is evidence for, and how much was looked at; what is wrong with many is not looked for in a few."""
    survey, found, looked_at, last = case.survey, list[_Found](), 0, ""
    meant = [(c, {i: m for i, p in enumerate(survey.pairs) if (m := c.meant(p, case.written)) is not None})
             for c in CONVENTIONS]  # fmt: skip
    for scope in _scopes(survey, judge.worst):
        if scope.place.kind != last and any(_sure(f) for f in found):
            break
        last = scope.place.kind
        rows = scope.rows.tolist()
        ways = [(c, {i: motions[i] for i in rows}) for c, motions in meant if all(i in motions for i in rows)]
        looked_at += len(ways)
        judged = judge.evidence([new for _, new in ways]) if ways else []
        found += [(e, scope, c) for e, (c, _) in zip(judged, ways, strict=True)]
    few = survey.is_pose_network and case.few("some of the pairs in another convention", len(survey.pairs), _FEW)
    if few and not any(_sure(f) for f in found):
        parts = [_part(case, c, motions) for c, motions in meant if c.by_hand and motions]
        looked_at += len(parts)
        found += [part for part in parts if len(part[1].rows) > 1]
    return found, looked_at


def _sure(found: _Found) -> bool:
    """Whether several fit so: that of single pairs is of each alone, which many misread ones have as well.

    What makes all of them smaller than their sigmas fits any.
    """
    return found[0] > _SURE and len(found[1].rows) > 1 and found[2].shifts >= 1.0


def _lengths(survey: Survey, hands: list[Link]) -> str:
    """How far camera and target are from hand and base: what no residual shows, a person sees."""
    out = []
    for link in hands[:1]:
        fit = fitted(link.kind, link.first, hand(survey, *link.names, link.pairs, {}))
        if fit is not None:
            left, right = (float(np.linalg.norm(x[:3, 3])) for x in (fit.left, fit.right))
            out.append(f" (then the camera is {left:.3f} m from the hand and the target {right:.3f} m from the base; "
                       "with the robot's poses the other way round and the camera beside the robot, as well: "
                       f"{left:.3f} m from the base and {right:.3f} m from the hand)")  # fmt: skip
    return "".join(out)


def _with(survey: Survey, new: Mapping[int, Motion]) -> Survey:
    return with_rows(survey, "pairs", {i: replace(survey.pairs[i], b_from_a=m) for i, m in new.items()})


def _scopes(survey: Survey, worst: IntArray) -> Iterator[Scope]:
    every = np.array([i for i, p in enumerate(survey.pairs) if p.used], dtype=np.int64)
    yield Scope(every, "all measured pairs", Place("pair", ("all",)))
    groups = list(dict.fromkeys(survey.pairs[i].group for i in every))
    for group in groups if len(groups) > 1 else []:
        rows = np.array([i for i in every if survey.pairs[i].group == group])
        yield Scope(rows, f"the pairs of group {group}", Place("group", (group,)))
    ends = {r.frame_id for i in every for r in (survey.pairs[i].a, survey.pairs[i].b)}
    for frame_id in sorted(ends) if 2 < len(ends) < 40 else []:
        rows = np.array([i for i in every if frame_id in (survey.pairs[i].a.frame_id, survey.pairs[i].b.frame_id)])
        if 1 < len(rows) < len(every):
            yield Scope(rows, f"the pairs of {frame_id}", Place("station", (frame_id,)))
    for i in worst[:_SINGLE].tolist():
        pair = survey.pairs[i]
        yield Scope(np.array([i]), f"pair {pair.pair_id}: its values", Place("pair", (pair.pair_id,)))


def _part(case: Case, convention: Convention, meant: Mapping[int, Motion]) -> _Found:
    """Those pairs that fit better as they were perhaps meant; found in turn with where that puts all stations."""
    now, survey, rows = at_best(case), case.survey, frozenset[int]()
    read = {i: survey.pairs[i].b_from_a for i in meant}
    for _ in range(_ROUNDS):
        if now is None:
            break
        better = frozenset(np.array(list(meant))[_read_as(now, meant) < _read_as(now, read)].tolist())
        if better == rows:
            break
        rows, now = better, screen(_with(survey, {i: meant[i] for i in better}))
    evidence, rows = _by_loops(survey, meant, rows)
    ids = tuple(survey.pairs[i].pair_id for i in sorted(rows))
    where = Scope(np.array(sorted(rows), dtype=np.int64), f"pairs {listed(ids, 6)}", Place("pair", ids))
    return evidence, where, convention


def _by_loops(survey: Survey, meant: Mapping[int, Motion], rows: frozenset[int]) -> tuple[float, frozenset[int]]:
    """With one or two pairs of a station after the others in their other way, as long as that closes loops.

    How many times less loops then miss.
    """
    loops, ends = remembered(_loop_tests, survey), [{p.a.frame_id, p.b.frame_id} for p in survey.pairs]
    turns = [frozenset({i, j}) for i, j in combinations_with_replacement(meant, 2) if ends[i] & ends[j]]

    def misses(sets: Sequence[frozenset[int]]) -> FloatArray:
        each = loops([{i: meant[i] for i in some} for some in sets])
        return np.asarray(np.minimum(each, CAP).sum(axis=1))

    first, now = misses([frozenset(), rows]).tolist()
    while True:
        left = misses([rows ^ turn for turn in turns])
        best = int(np.argmin(left))
        if left[best] > now - 0.5 * CAP:
            return improvement(first, now, len(survey.pairs)), rows
        rows, now = rows ^ turns[best], float(left[best])


@frozen(eq=False)
class _Judge:
    """worst: pairs that fit least, first. evidence: of other motions of some pairs, how much less these miss."""

    worst: IntArray
    evidence: Callable[[Sequence[Mapping[int, Motion]]], list[float]]


def _by_hands(survey: Survey, hands: list[Link]) -> _Judge:
    """The motions that join most poses stay what they are where fewer than half of these change: they are robust."""
    joined = [link.fit for link in hands]

    def misses(new: Mapping[int, Motion]) -> FloatArray:
        parts = []
        for link, fit in zip(hands, joined, strict=True):
            second = hand(survey, *link.names, link.pairs, new)
            if 2 * len(new.keys() & set(link.pairs)) >= len(link.pairs):
                fit = fitted(link.kind, link.first, second)
            parts.append(np.full(len(link.epochs), np.inf) if fit is None else fit.misses(link.first, second))
        return np.concatenate(parts)

    base = misses({})
    rows = np.concatenate([np.array(link.pairs, dtype=np.int64) for link in hands])

    def evidence(new: Mapping[int, Motion]) -> float:
        some = np.isin(rows, list(new))
        return typical(base[some]) / typical(misses(new)[some]) if some.any() else 0.0

    return _Judge(rows[np.argsort(-base, kind="stable")], lambda sets: [evidence(new) for new in sets])


def _by_start(case: Case) -> _Judge | None:
    """Poses that all pairs together say: those of most of them anew, where most are others."""
    survey = case.survey
    if not case.few("pairs in another convention", len(survey.pairs), _LARGE):
        return None
    before = at_best(case)
    if before is None:
        return None
    squares, loops = before.pairs_of(survey), remembered(_loop_tests, survey)
    worst = np.argsort(-squares, kind="stable")
    ends = np.array([[p.a.frame_id, p.b.frame_id] for p in survey.pairs])
    ends = np.unique(ends, return_inverse=True)[1].reshape(-1, 2)
    degree = np.bincount(ends.ravel())
    opened = float(np.minimum(loops([{}]), CAP).sum())

    def told(rows: IntArray) -> bool:
        """Whether they told the pose of an end, which is to be found anew then."""
        return bool((2 * np.bincount(ends[rows].ravel(), minlength=len(degree)) > degree).any())

    def evidence(sets: Sequence[Mapping[int, Motion]]) -> list[float]:
        rows = np.array(list(sets[0]))
        if len(rows) > 1 and np.median(squares[rows]) < _MISSED:
            return [0.0] * len(sets)
        lost = told(rows)
        there = [gain(rows, _read_as(before, new)) for new in sets] if survey.image_blocks or not lost else []
        if not lost:
            return there
        still = np.minimum(loops(sets), CAP).sum(axis=1) > max(2.0 * len(squares), 0.5 * opened)
        if there:  # where images tell the poses too, what is meant fits them better than what is read
            still |= np.array(there) <= 1.0
        after = (None if x else screen(_with(survey, new)) for x, new in zip(still, sets, strict=True))
        return [0.0 if x is None else gain(np.arange(len(squares)), x.pairs_of(survey)) for x in after]

    def gain(rows: IntArray, after: FloatArray) -> float:
        now = squares.copy()
        now[rows] = after
        scale = max(1.0, min(float(np.median(now)), float(np.median(squares))) / 2.0)
        old, left = (np.minimum(s[rows] / scale, CAP).sum() for s in (squares, now))
        return float(old / (left + 0.1 * len(rows)))

    return _Judge(worst, evidence)


def _loop_tests(survey: Survey) -> Callable[[Sequence[Mapping[int, Motion]]], FloatArray]:
    """By n sets of other motions of some pairs (n, p) squares over sigmas of a loop through each, 1 without one."""
    if not survey.is_pose_network:
        return lambda sets: np.ones((len(sets), len(survey.pairs)))
    from adjust.pose_network.agreement import loop_tests, pair_loops  # here: a survey without pairs starts without it
    from adjust.pose_network.from_survey import network_from_survey

    network = network_from_survey(survey, any_datum=True)
    loops = pair_loops(network)

    def tests(sets: Sequence[Mapping[int, Motion]]) -> FloatArray:
        number: dict[tuple[int, int], int] = {}
        known = [np.array([number.setdefault((i, id(m)), len(number)) for i, m in new.items()], dtype=np.int64)
                 for new in sets]  # fmt: skip
        meant = {(i, id(m)): m for new in sets for i, m in new.items()}
        R = np.array([rotation_of(m) for m in meant.values()]).reshape(-1, 3, 3)
        read = network.arrays.motions.shifts
        t = np.array([m.translation() if isinstance(m, Pose3) else read[i] for (i, _), m in meant.items()])
        pairs = np.array([i for i, _ in meant], dtype=np.int64)
        return np.nan_to_num(loop_tests(network, loops, pairs, Motions(R, t.reshape(-1, 3)), known), nan=1.0)

    return tests


def _read_as(found: Screen, new: Mapping[int, Motion]) -> FloatArray:
    """(n,) mean squares over sigmas of pairs with other motions, where everything else is."""
    out = []
    for i, motion in new.items():
        pair = found.graph.survey.pairs[i]
        v = miss(motion, found.motions[pair.pair_id])
        out.append(float(v @ np.linalg.solve(pair.cov, v)) / len(v))
    return np.array(out)
