"""Boards that look the same after a turn: which way each image names their corners, as far as the survey tells.

A checkerboard with inner corners of both numbers even, or both odd, shows the same colours after half a turn. A
detector then names the corner nearest the upper left of the image r0c0 (:mod:`survey.detection.checkerboard`), a
person or another program has a rule of its own: a camera mounted upside down names them from the other end.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Unknowns
from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.spatial.rigid import align
from adjust.start import Start, find_start, turns_of_views
from survey.project.targets import Checkerboard, TargetKind

_WORSE = 3.0  # times the misfit of the start that a wrong turn has at least
_LEAST_PX = 1.0  # ... and at least this much


@frozen(eq=False)
class _Symmetric:
    """Turns of the targets that have any: new point indices (n,) and motions (m, 4, 4), by target id."""

    turns: Mapping[str, tuple[IntArray, ...]]
    motions: Mapping[str, FloatArray]


def consistent_turns(survey: Survey, kinds: Mapping[str, TargetKind]) -> tuple[Survey, tuple[str, ...]]:
    """The survey with the corners of symmetric boards named alike in all images, and what there is to say about it.

    Both ways to name them are tried where the images of other cameras, other epochs or a table tell: the survey comes
    back unchanged where the names agree, or where nothing tells. One line for every camera and target whose names were
    turned, and for those that stay ambiguous in a way that results depend on.
    """
    symmetric = _symmetric(survey, kinds)
    if not symmetric.turns:
        return survey, ()
    notes: tuple[str, ...] = ()
    try:
        turn = _settled(survey, turns_of_views(survey, symmetric.motions))
        if any(turn.values()):
            renamed = _renamed(survey, symmetric, turn)
            if _better(find_start(renamed), _start(survey)):
                notes = tuple(_told(survey, turn))
                survey = renamed
        notes += _undecided(survey, symmetric)
    except SurveyError:  # said by the adjustment, about the survey as it was given
        return survey, notes
    return survey, notes


def _symmetric(survey: Survey, kinds: Mapping[str, TargetKind]) -> _Symmetric:
    seen = {b.target_id for b in survey.image_blocks}
    boards = {t: k for t, k in kinds.items() if isinstance(k, Checkerboard) and t in seen}
    turns = {t: board.turns() for t, board in boards.items() if board.turns()}
    x = {t.target_id: t.x_in_target for t in survey.targets}
    motions = {t: np.stack([align(x[t], x[t][where]) for where in turns[t]]) for t in turns}
    return _Symmetric(turns, motions)


def _settled(survey: Survey, turn: Mapping[int, int]) -> dict[int, int]:
    """The same turns with as few images renamed as can be: a board that is free may be turned as a whole."""
    free = {t.target_id: t.motion == "epoch" or t.carrier_from_target.treatment == "free" for t in survey.targets}
    moves = {t.target_id for t in survey.targets if t.motion == "epoch"}
    together: dict[tuple[str, str | None], list[int]] = {}
    for i in turn:
        block = survey.image_blocks[i]
        name = str(block.target_id)
        together.setdefault((name, block.epoch_id if name in moves else None), []).append(i)
    out = dict(turn)
    for (name, _), mine in together.items():
        count = Counter(turn[i] for i in mine)
        # of half turns only: with quarter turns what is turned back is another of them
        if free[name] and max(count) <= 1 and count[1] > count[0]:
            out.update({i: 1 - turn[i] for i in mine})
    return out


def _renamed(survey: Survey, symmetric: _Symmetric, turn: Mapping[int, int]) -> Survey:
    blocks = list(survey.image_blocks)
    for i, k in turn.items():
        if k:
            where = symmetric.turns[str(blocks[i].target_id)][k - 1]
            blocks[i] = replace(blocks[i], point_idx=where[blocks[i].point_idx])
    return replace(survey, image_blocks=tuple(blocks))


def _start(survey: Survey) -> Start | None:
    try:
        return find_start(survey)
    except SurveyError:
        return None


def _better(new: Start, old: Start | None) -> bool:
    """Whether a start leaves out fewer images, or fits those that it has decisively better."""
    if old is None or len(new.excluded_blocks) < len(old.excluded_blocks):
        return True
    return len(new.excluded_blocks) == len(old.excluded_blocks) and _misfit(old) > max(_WORSE * _misfit(new), _LEAST_PX)


def _misfit(start: Start) -> float:
    rms = np.array(start.block_rms_px)
    return float(np.sqrt(np.nanmean(rms**2))) if np.isfinite(rms).any() else np.inf


def _told(survey: Survey, turn: Mapping[int, int]) -> Iterable[str]:
    seen: dict[tuple[str, str], list[int]] = {}
    for i, k in turn.items():
        block = survey.image_blocks[i]
        seen.setdefault((block.camera_id, str(block.target_id)), []).append(k)
    for (camera, target), ks in seen.items():
        if any(ks):
            how = "half a turn" if max(ks) == 1 else "a turn"
            yield (
                f"camera {camera!r}, target {target!r}: the board looks the same after {how}; its corners are named "
                f"the other way round in {sum(k > 0 for k in ks)} of {len(ks)} images, as the other images require"
            )


def _undecided(survey: Survey, symmetric: _Symmetric) -> tuple[str, ...]:
    """Cameras that may be turned against others, and stations whose pose at an epoch may be."""
    notes = []
    base: Start | None = None
    for target in symmetric.turns:
        mine = [i for i, b in enumerate(survey.image_blocks) if b.target_id == target]
        cameras = list(dict.fromkeys(survey.image_blocks[i].camera_id for i in mine))
        for camera in cameras[1:]:
            base = base or find_start(survey)
            turned = _renamed(survey, symmetric, {i: 1 for i in mine if survey.image_blocks[i].camera_id == camera})
            other = _start(turned)
            if other is not None and not _better(base, other):
                notes.append(
                    f"camera {camera!r}, target {target!r}: the board looks the same after half a turn, and the images "
                    f"fit either way; if the camera is mounted upside down against {cameras[0]!r}, turn its names"
                )
        notes += _stations_undecided(survey, target, mine)
    return tuple(notes)


def _stations_undecided(survey: Survey, target: str, mine: list[int]) -> list[str]:
    """A line where poses of stations rest on a symmetric board alone that stands still: each may be turned with it."""
    if survey.pairs or survey.levels or survey.targets_by_id[target].motion == "epoch":
        return []
    unknowns = Unknowns()
    frames = FrameTree(survey, unknowns)
    slots = [{link.slot for link in frames.of_image(block)} for block in survey.image_blocks]
    alone = []
    for name, slot in unknowns.slot_of.items():
        if name[0] != "world_from_station" or len(name) < 3 or unknowns.parameters[name].treatment != "free":
            continue
        users = {i for i, have in enumerate(slots) if slot in have}
        alone += [f"{name[1]} at {name[2]}"] if users and users <= set(mine) else []
    if not alone:
        return []
    return [
        f"target {target!r}: the board looks the same after half a turn, and nothing else tells which way round these "
        f"stations saw it: {listed(alone, 3)}; r0c0 is taken as named"
    ]
