"""Two sequences of poses over the same epochs that a constant motion, or two, should join: a rig, a hand and its eye.

``first = left * second * right`` at every epoch. Two cameras that see the same moving target: ``right`` is the
identity. A camera on a robot's hand and the robot's own poses: ``left`` is the camera in the hand, ``right`` the target
in the base (closed form: Shah 2013, in :mod:`adjust.start.closed_forms.hand_eye`).
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Literal

import numpy as np
from gtsam import Pose3, Rot3

from adjust.diagnosis.case import Case
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.spatial.averaging import mean_pose, mean_poses, pose_distance, typical_distance
from adjust.spatial.rigid import inverse
from adjust.start.closed_forms.hand_eye import solve_ax_zb

_FEWEST = 5
MOST = 3
"""Epochs that sequences are shifted by."""
_POSE = 10.0
"""How many times less sure a pose is than the directions of its points."""
_JOINED = 30.0
"""Times the error of single poses that two sequences miss each other at most where they belong together."""


@frozen(eq=False)
class Link:
    """Poses (n, 4, 4) of two things at n epochs. kind: "rig" or "hand_eye". names: of first and second.

    pairs: positions in ``Survey.pairs`` of the second, where it is measured by pairs; target_id: seen by the first.
    error: rad, by which single images typically miss their own best poses, with the sigma of measured turns.
    """

    kind: Literal["rig", "hand_eye"]
    names: tuple[str, str]
    epochs: tuple[str, ...]
    first: FloatArray
    second: FloatArray
    target_id: str
    error: float
    pairs: tuple[int, ...] = ()

    @cached_property
    def lever(self) -> float:
        """m: the target's distance."""
        return typical_distance(self.first)

    def joins(self, misses: FloatArray) -> bool:
        """Whether sequences that miss each other by so much (n,) m may belong together."""
        return typical(misses) < _JOINED * _POSE * self.error * self.lever

    @cached_property
    def fit(self) -> "Fit | None":
        """As the epochs stand."""
        return fitted(self.kind, self.first, self.second)


@frozen(eq=False)
class Fit:
    """The constant motions (4, 4) of a link."""

    left: FloatArray
    right: FloatArray

    def misses(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """(n,) m: how far first and second are apart, a turn counted at the target's distance."""
        return pose_distance(inverse(self.left @ second @ self.right) @ first, np.eye(4), typical_distance(first))


def fitted(kind: str, first: FloatArray, second: FloatArray) -> Fit | None:
    """The motions that join most of the epochs; None where they do not determine any."""
    if len(first) < 3:
        return None
    if kind == "rig":
        return Fit(mean_pose(first @ inverse(second), typical_distance(first))[0], np.eye(4))
    try:
        right, left, _ = solve_ax_zb(first, second)
    except (SurveyError, np.linalg.LinAlgError):
        return None
    return Fit(left, inverse(right))


def typical(misses: FloatArray) -> float:
    """m: what nearly all epochs stay within."""
    return float(np.quantile(misses, 0.9)) + 1e-9 if len(misses) else float("inf")


@lru_cache(maxsize=2)
def links(case: Case) -> tuple[Link, ...]:
    """The rigs and hands of a survey that have five epochs or more in common."""
    seen = {key: {e: v.poses[0] for e, v in views.items()} for key, views in case.views_of.items()}
    error = float(np.median([v.error_px[0] / v.focal_px for v in case.views.values() if len(v.poses)] or [0.0]))
    return *_rigs(case.survey, seen, error), *_hands(case.survey, seen, error)


_Views = Mapping[tuple[str, str], Mapping[str, FloatArray]]
"""``camera_from_target`` by camera and target, then by epoch."""


def _rigs(survey: Survey, seen: _Views, error: float) -> Iterator[Link]:
    rigid = {s.station_id for s in survey.stations if s.motion == "fixed"}
    bodies = {c.camera_id: "world" if c.station_id in rigid else c.station_id for c in survey.cameras}
    moving = {t.target_id for t in survey.targets if t.station_id is None}
    for (camera, target), (other, its) in combinations(seen, 2):
        if its == target and target in moving and bodies[camera] == bodies[other]:
            a, b = seen[camera, target], seen[other, target]
            epochs = tuple(e for e in a if e in b)
            if len(epochs) >= _FEWEST:
                first, second = (np.array([x[e] for e in epochs]) for x in (a, b))
                yield Link("rig", (camera, other), epochs, first, second, target, error)


def _hands(survey: Survey, seen: _Views, error: float) -> Iterator[Link]:
    station_of = {c.camera_id: c.station_id for c in survey.cameras}
    carrier_of = {t.target_id: t.station_id for t in survey.targets}
    for station, poses in hand_poses(survey).items():
        for (camera, target), views in seen.items():
            on_hand, held = station_of[camera] == station, carrier_of[target] == station
            epochs = tuple(e for e in views if e in poses)
            if on_hand != held and len(epochs) >= _FEWEST:
                rows, first = tuple(poses[e][0] for e in epochs), np.array([views[e] for e in epochs])
                turns = [np.diag(survey.pairs[i].cov)[:3].max() for i in rows]
                own = float(np.hypot(error, np.sqrt(np.median(turns))))
                second = hand(survey, camera, station, rows, {})
                yield Link("hand_eye", (camera, station), epochs, first, second, target, own, rows)


def hand(survey: Survey, camera: str, station: str, rows: Sequence[int], new: Mapping[int, Pose3 | Rot3]) -> FloatArray:
    """Poses (n, 4, 4) of the hand by these pairs: in its base where the camera is on it, else of the base in it.

    new: other motions of some of them.
    """
    on_hand, out = any((c.camera_id, c.station_id) == (camera, station) for c in survey.cameras), []
    for i in rows:
        pair, motion = survey.pairs[i], new.get(i, survey.pairs[i].b_from_a)
        pose = motion.matrix() if isinstance(motion, Pose3) else np.eye(4)
        forwards = pair.b.frame_id == station and bool(pair.b.epoch_id)
        out.append(pose if forwards == on_hand else inverse(pose))
    return np.array(out)


def hand_poses(survey: Survey) -> dict[str, dict[str, tuple[int, Pose3]]]:
    """By moving station and epoch: the position of its measured pose among the pairs, and station_from_base."""
    out: dict[str, dict[str, tuple[int, Pose3]]] = {}
    for i, pair in enumerate(survey.pairs):
        if isinstance(pair.b_from_a, Rot3) or not pair.used:
            continue
        if pair.b.epoch_id and not pair.a.epoch_id:
            out.setdefault(pair.b.frame_id, {})[pair.b.epoch_id] = (i, pair.b_from_a)
        elif pair.a.epoch_id and not pair.b.epoch_id:
            out.setdefault(pair.a.frame_id, {})[pair.a.epoch_id] = (i, pair.b_from_a.inverse())
    return out


@frozen
class Shift:
    """From epoch number ``begin`` on the second is that of ``by`` epochs later; evidence: ratio of misfits."""

    begin: int
    by: int
    evidence: float


def shifts(link: Link, most: int = MOST) -> Sequence[Shift]:
    """Shifts of the second sequence that join it with the first, everywhere or from an epoch on; the best first.

    The motions are those that most epochs give as they stand, or shifted throughout; the border is where the sum of
    misses is least.
    """
    fits = _shifted_fits(link, most)
    plain = fits[0]
    base = typical(plain.misses(link.first, link.second)) if plain is not None else float("inf")
    found = []
    for by, own in fits.items():
        if by == 0:
            continue
        for fit in (own, plain):
            if fit is not None:
                found.append(_best_border(link, fit, by, base))
    return sorted((s for s in found if s is not None), key=lambda s: -s.evidence)


def _shifted_fits(link: Link, most: int) -> dict[int, Fit | None]:
    """The motions of a link at every shift; those of a rig all together."""
    inside = {by: _inside(len(link.epochs), by) for by in range(-most, most + 1) if by}
    if link.kind != "rig":
        return {0: link.fit} | {
            by: fitted(link.kind, link.first[i], link.second[i + by]) for by, i in inside.items()
        }
    motions = np.concatenate([link.first[i] @ inverse(link.second[i + by]) for by, i in inside.items()])
    means = mean_poses(motions, link.lever, np.cumsum([0, *map(len, inside.values())]))
    return {0: link.fit} | {
        by: Fit(mean, np.eye(4)) if len(i) >= 3 else None for (by, i), mean in zip(inside.items(), means, strict=True)
    }


def _inside(n: int, by: int) -> IntArray:
    return np.arange(max(0, -by), n - max(0, by))


def costs_of_cuts(before: FloatArray, after: FloatArray) -> FloatArray:
    """(n + 1,): what is left where the first so many of n cost what ``before`` (n,) says, the others as ``after``."""
    whole = np.concatenate([[0.0], np.cumsum(before)]) + np.concatenate([np.cumsum(after[::-1])[::-1], [0.0]])
    return np.asarray(whole)


def _best_border(link: Link, fit: Fit, by: int, base: float) -> Shift | None:
    n, inside = len(link.epochs), _inside(len(link.epochs), by)
    as_is = fit.misses(link.first, link.second)
    moved = np.zeros(n)
    moved[inside] = fit.misses(link.first[inside], link.second[inside + by])
    bound = 50.0 * max(float(np.median(np.minimum(as_is, moved))), 1e-6)
    before, after = np.minimum(as_is, bound), np.minimum(moved, bound)
    begin = int(np.argmin(costs_of_cuts(before, after)))
    rest = np.concatenate([as_is[:begin], moved[inside[inside >= begin]]])
    return Shift(begin, by, base / typical(rest)) if begin < n - 1 and link.joins(rest) else None
