"""Two stations, or one at two epochs, that are called by each other's names in some of the measured pairs.

The names throughout are a matter of taste where nothing else names them. Evidence: the other pairs join what they
measure; from there each pair with either of the two says where one of them is. These places are two, and a pair that
says the other one's has the wrong name.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, Rename
from adjust.diagnosis.screen import Screen, at_best, improvement, screen
from adjust.model.observations import FrameRef, Pair, frame_text
from adjust.model.survey import FloatArray, Survey
from adjust.spatial.averaging import pose_distance
from adjust.spatial.rigid import inverse

_CLEARLY = 3.0
_SUSPECTS, _TRIED, _LARGE = 10, 3, 500
_NOISE = 2.0
"""Mean square over sigma of pairs at a start that fits."""
_Found = tuple[float, FrameRef, FrameRef, list[int]]


def exchanged_stations(case: Case) -> Iterator[Hypothesis]:
    """The exchanges after which most pairs fit, at the survey's own start."""
    survey = case.survey
    if not survey.pairs or survey.image_blocks or not case.few("stations exchanged", len(survey.pairs), _LARGE):
        return
    before = at_best(case)
    if before is None:
        return
    misses = _misses(survey, before)
    both = list(combinations(_suspects(survey, misses), 2))
    some = [f for a, b in both if (f := _misnamed(survey, a, b)) is not None]
    for _, a, b, rows in sorted(some, key=lambda f: -f[0])[:_TRIED]:
        changed = _exchanged(survey, a, b, rows)
        after = screen(changed)
        left = np.inf if after is None else float(_misses(changed, after).sum())
        gain = improvement(float(misses.sum()), left, len(misses))
        if gain > _CLEARLY:
            yield _hypothesis(survey, changed, (a, b), rows, gain, len(both))
        if left < _NOISE * len(misses):
            return  # what no other one can explain better


def _misses(survey: Survey, found: Screen) -> FloatArray:
    """(p,) mean squares over sigmas of the pairs at a start of the survey, bounded."""
    at = {o.ids[0]: found.others[i] for i, o in enumerate(found.graph.others) if o.kind == "pair"}
    return np.array([min(at.get(p.pair_id, 0.0), CAP) for p in survey.pairs])


def _suspects(survey: Survey, misses: FloatArray) -> list[FrameRef]:
    """Ends of several pairs, those first whose pairs miss most."""
    of: dict[FrameRef, list[float]] = {}
    for pair, square in zip(survey.pairs, misses.tolist(), strict=True):
        for end in (pair.a, pair.b):
            of.setdefault(end, []).append(square)
    several = {end: float(np.sum(squares)) for end, squares in of.items() if len(squares) > 1 and end.frame_id}
    return sorted(several, key=lambda end: -several[end])[:_SUSPECTS]


def _misnamed(survey: Survey, a: FrameRef, b: FrameRef) -> _Found | None:
    """Evidence, the two, and the rows of pairs whose names are wrong; None where none are."""
    rows = [i for i, p in enumerate(survey.pairs) if p.used and {p.a, p.b} & {a, b}]
    poses = _joined([p for p in survey.pairs if p.used and not {p.a, p.b} & {a, b}])
    said = [(i, p.a in (a, b), p) for i in rows for p in [survey.pairs[i]] if (p.b if p.a in (a, b) else p.a) in poses]
    if len(said) < 4:
        return None
    W = np.array([poses[p.b] @ _matrix(p) if of_a else poses[p.a] @ inverse(_matrix(p)) for _, of_a, p in said])
    lever = float(np.median([np.linalg.norm(_matrix(p)[:3, 3]) for _, _, p in said])) or 1.0
    apart = np.array([pose_distance(W, w, lever) for w in W])
    costs = np.minimum(apart[:, None], apart[None]).sum(axis=2)
    one, other = np.unravel_index(int(np.argmin(costs)), costs.shape)
    first = apart[one] <= apart[other]
    named = np.array([(p.a if of_a else p.b) == a for _, of_a, p in said])
    if (first & named).sum() + (~first & ~named).sum() < len(said) / 2.0:
        first = ~first
    wrong = [i for (i, _, _), is_first, is_named in zip(said, first, named, strict=True) if is_first != is_named]
    as_named = sum(float(apart[np.ix_(of, of)].sum(axis=1).min()) for of in (named, ~named) if of.any())
    if not wrong:
        return None
    A, B = (W[k] for k in ((one, other) if first[one] else (other, one)))
    for i in rows:
        p = survey.pairs[i]
        if {p.a, p.b} == {a, b}:
            expected = inverse(B) @ A if p.a == a else inverse(A) @ B
            off = [float(pose_distance(_matrix(p)[None], x, lever)[0]) for x in (expected, inverse(expected))]
            wrong += [i] * (off[1] < off[0])
    return as_named / max(float(costs[one, other]), 1e-12), a, b, sorted(wrong)


def _joined(pairs: Sequence[Pair]) -> dict[FrameRef, FloatArray]:
    """Poses (4, 4) of the largest set of frames that pairs join, in that of one of them, along the shortest ways."""
    near: dict[FrameRef, list[tuple[FrameRef, FloatArray]]] = {}
    for p in pairs:
        near.setdefault(p.b, []).append((p.a, _matrix(p)))
        near.setdefault(p.a, []).append((p.b, inverse(_matrix(p))))
    best: dict[FrameRef, FloatArray] = {}
    left = set(near)
    while left:
        begin = next(end for end in near if end in left)
        found, queue = {begin: np.eye(4)}, [begin]
        for here in queue:
            for there, motion in near[here]:
                if there not in found:
                    found[there] = found[here] @ motion
                    queue.append(there)
        left -= set(found)
        best = max(best, found, key=len)
    return best


def _matrix(pair: Pair) -> FloatArray:
    """(4, 4) ``b_from_a``, without a shift where none is measured."""
    m = pair.b_from_a
    return np.asarray((m if isinstance(m, Pose3) else Pose3(m, np.zeros(3))).matrix())


def _exchanged(survey: Survey, a: FrameRef, b: FrameRef, rows: Sequence[int]) -> Survey:
    other, chosen = {a: b, b: a}, set(rows)
    pairs = tuple(replace(p, a=other.get(p.a, p.a), b=other.get(p.b, p.b)) if i in chosen else p
                  for i, p in enumerate(survey.pairs))  # fmt: skip
    return replace(survey, pairs=pairs)


def _hypothesis(
    survey: Survey, changed: Survey, ends: tuple[FrameRef, FrameRef], rows: Sequence[int], evidence: float, number: int
) -> Hypothesis:
    a, b = map(frame_text, ends)
    ids = tuple(survey.pairs[i].pair_id for i in rows)
    where = f"in pair {ids[0]}" if len(ids) == 1 else f"in {len(ids)} pairs, the first {ids[0]}"
    return Hypothesis(
        "stations exchanged", f"{a} and {b} are called by each other's names {where}",
        "exchange them in a_id and b_id of pairs.csv", Place(ends[0].kind, tuple(e.frame_id for e in ends), "a_id"),
        changed, tuple(Rename("pairs", column, {a: b, b: a}, {"pair_id": ids}) for column in ("a_id", "b_id")),
        evidence, 1, number,
    )  # fmt: skip
