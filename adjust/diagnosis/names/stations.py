"""Two stations, or one at two epochs, that are called by each other's names in some of the measured pairs.

The names throughout are a matter of taste where nothing else names them. Evidence: the other pairs join what they
measure; from there each pair with either of the two says where one of them is. These places are two, and a pair that
says the other one's has the wrong name.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from heapq import heappop, heappush
from itertools import combinations

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, Rename
from adjust.diagnosis.screen import Screen, at_best, improvement, screen
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.observations import FrameRef, Pair, frame_text
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.spatial.averaging import pose_distance
from adjust.spatial.rigid import inverse

_CLEARLY = 3.0
_SUSPECTS, _TRIED, _LARGE = 10, 3, 500
_NOISE = 2.0
"""Mean square over sigma of pairs at a start that fits."""
_JOINED = 30.0
"""Typical sigmas by which pairs miss the places of two frames at most, in the mean, where the names explain it."""
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
    ways = _Ways.of(survey.pairs, misses)
    both = list(combinations(_suspects(survey, misses), 2))
    some = [f for a, b in both if (f := ways.misnamed(a, b)) is not None and f[0] > _CLEARLY]
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
    return np.minimum(found.pairs_of(survey), CAP)


def _suspects(survey: Survey, misses: FloatArray) -> list[FrameRef]:
    """Ends of several pairs, those first whose pairs miss most."""
    each = zip(survey.pairs, misses.tolist(), strict=True)
    of = grouped((end, square) for pair, square in each for end in (pair.a, pair.b))
    several = {end: float(np.sum(squares)) for end, squares in of.items() if len(squares) > 1 and end.frame_id}
    return sorted(several, key=lambda end: -several[end])[:_SUSPECTS]


@frozen(eq=False)
class _Ways:
    """From every frame, by each of its pairs in use, that which misses least first: to another one.

    number: of a frame. near: by that of a frame, how much each pair misses, its row, whether it leads to the first end
    of the pair. ends: by row the numbers of the second end and of the first one. motions: of that row, (4, 4), to the
    first end and to the second one. lever: m, the typical length of a pair; sigma: m, of it.
    """

    pairs: Sequence[Pair]
    number: Mapping[FrameRef, int]
    near: Sequence[Sequence[tuple[float, int, bool]]]
    ends: Mapping[int, tuple[int, int]]
    motions: Mapping[int, tuple[FloatArray, FloatArray]]
    lever: float
    sigma: float

    @classmethod
    def of(cls, pairs: Sequence[Pair], misses: FloatArray) -> "_Ways":
        """misses: (p,) of the pairs at a start."""
        used, number = {i: p for i, p in enumerate(pairs) if p.used}, dict[FrameRef, int]()
        ends = {i: (number.setdefault(p.b, len(number)), number.setdefault(p.a, len(number))) for i, p in used.items()}
        near: list[list[tuple[float, int, bool]]] = [[] for _ in number]
        for i, (b, a) in ends.items():
            near[b].append((float(misses[i]), i, True))
            near[a].append((float(misses[i]), i, False))
        motions = {i: _matrix(p) for i, p in used.items()}
        lever = float(np.median([np.linalg.norm(m[:3, 3]) for m in motions.values()])) or 1.0
        variances = np.array([np.diag(p.cov).reshape(-1, 3).max(axis=1) for p in used.values() if len(p.cov) == 6])
        turn, shift = np.median(variances, axis=0) if len(variances) else (np.inf, np.inf)
        both = {i: (m, inverse(m)) for i, m in motions.items()}
        sigma = float(np.sqrt(lever**2 * turn + shift))
        return cls(pairs, number, [sorted(ways) for ways in near], ends, both, lever, sigma)

    def joined(self, without: Collection[int]) -> dict[int, FloatArray]:
        """Poses (4, 4) of the largest set of other frames that pairs join, by the tree of those that miss least."""
        best: dict[int, FloatArray] = {}
        left = dict.fromkeys(end for end in range(len(self.near)) if end not in without)
        while left:
            begin = next(iter(left))
            found, queue = {begin: np.eye(4)}, [*self.near[begin]]
            while queue:
                _, i, first = heappop(queue)
                there = self.ends[i][first]
                if there not in found and there not in without:
                    found[there] = found[self.ends[i][not first]] @ self.motions[i][not first]
                    for way in self.near[there]:
                        heappush(queue, way)
            left = dict.fromkeys(end for end in left if end not in found)
            best = max(best, found, key=len)
        return best

    def misnamed(self, a: FrameRef, b: FrameRef) -> _Found | None:
        """Evidence, the two, and the rows of pairs whose names are wrong; None where none are."""
        both = self.number[a], self.number[b]
        poses = self.joined(both)
        said = [(i, named == both[0], poses[other] @ self.motions[i][first]) for named in both
                for _, i, first in self.near[named] if (other := self.ends[i][first]) in poses]  # fmt: skip
        if len(said) < 4:
            return None
        W, named = np.array([pose for *_, pose in said]), np.array([is_a for _, is_a, _ in said])
        apart = pose_distance(W[:, None], W[None], self.lever)
        costs = np.minimum(apart[:, None], apart[None]).sum(axis=2)
        one, two = np.unravel_index(int(np.argmin(costs)), costs.shape)
        if not costs[one, two] <= _JOINED * self.sigma * len(said):
            return None
        first = apart[one] <= apart[two]
        if (first & named).sum() + (~first & ~named).sum() < len(said) / 2.0:
            first = ~first
        wrong = [i for (i, *_), is_first, is_named in zip(said, first, named, strict=True) if is_first != is_named]
        if not wrong:
            return None
        as_named = sum(float(apart[np.ix_(of, of)].sum(axis=1).min()) for of in (named, ~named) if of.any())
        A, B = (W[k] for k in ((one, two) if first[one] else (two, one)))
        for i in [row for _, row, to_first in self.near[both[0]] if self.ends[row][to_first] == both[1]]:
            expected, m = inverse(B) @ A, self.motions[i][0]
            expected = expected if self.pairs[i].a == a else inverse(expected)
            off = [float(pose_distance(m[None], x, self.lever)[0]) for x in (expected, inverse(expected))]
            wrong += [i] * (off[1] < off[0])
        return as_named / max(float(costs[one, two]), 1e-12), a, b, sorted(wrong)


def _matrix(pair: Pair) -> FloatArray:
    """(4, 4) ``b_from_a``, without a shift where none is measured."""
    m = pair.b_from_a
    return np.asarray((m if isinstance(m, Pose3) else Pose3(m, np.zeros(3))).matrix())


def _exchanged(survey: Survey, a: FrameRef, b: FrameRef, rows: Sequence[int]) -> Survey:
    other, pairs = {a: b, b: a}, {i: survey.pairs[i] for i in rows}
    renamed = {i: replace(p, a=other.get(p.a, p.a), b=other.get(p.b, p.b)) for i, p in pairs.items()}
    return with_rows(survey, "pairs", renamed)


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
