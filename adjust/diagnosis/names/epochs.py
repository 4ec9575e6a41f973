"""Epochs out of order: shifted by one from somewhere on, exchanged, twice; cameras whose images changed places.

Evidence: a rig, or a hand and its eye, is rigid; see :mod:`adjust.diagnosis.sequences`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Edit, Hypothesis, LeaveOut, Place, Rename
from adjust.diagnosis.sequences import MOST, Link, Shift, links, shifts
from adjust.model.errors import listed
from adjust.model.names import grouped
from adjust.model.observations import FrameRef
from adjust.model.rewriting import Fields, with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.spatial.averaging import mean_pose
from adjust.spatial.rigid import inverse

_CLEARLY = 3.0
_SUSPECTS = 6


def misplaced_epochs(case: Case) -> Iterator[Hypothesis]:
    """Of every rig and hand: shifts, exchanged epochs, exchanged cameras; observations that are there twice."""
    yield from _twice(case.survey)
    for link in links(case):
        yield from _shifted(case.survey, link)
        yield from _exchanged(case.survey, link)
        if link.kind == "rig":
            yield from _cameras(case.survey, link)


def _moved(survey: Survey, link: Link, epoch_of: Mapping[str, str]) -> Survey:
    """The survey with the second's observations at other epochs; those that would have none are dropped."""

    def at(ref: FrameRef) -> FrameRef:
        return replace(ref, epoch_id=epoch_of.get(ref.epoch_id, ref.epoch_id)) if ref.epoch_id else ref

    if link.pairs:
        chosen = {i: survey.pairs[i] for i in link.pairs}
        moved = with_rows(survey, "pairs", {i: replace(p, a=at(p.a), b=at(p.b)) for i, p in chosen.items()})
        return replace(moved, pairs=tuple(p for p in moved.pairs if "" not in (p.a.epoch_id, p.b.epoch_id)))
    mine = {i: b for i, b in enumerate(survey.image_blocks) if b.camera_id == link.names[1]}
    new = {i: replace(b, epoch_id=epoch_of.get(b.epoch_id, b.epoch_id)) for i, b in mine.items()}
    moved = with_rows(survey, "image_blocks", new)
    return replace(moved, image_blocks=tuple(b for b in moved.image_blocks if b.epoch_id))


def _said(link: Link) -> tuple[str, str, Place]:
    """What the second is called, where its epochs stand, and its place."""
    if link.pairs:
        return f"the measured poses of {link.names[1]}", "pairs.csv", Place("station", (link.names[1],), "epoch")
    camera = link.names[1]
    return f"the images of camera {camera}", f"images/{camera}", Place("camera", (camera,), "epoch")


def _shifted(survey: Survey, link: Link) -> Iterator[Hypothesis]:
    for shift in shifts(link)[:2]:
        if shift.evidence > _CLEARLY:
            yield _shift(survey, link, shift, 2 * MOST * len(link.epochs))


def _shift(survey: Survey, link: Link, shift: Shift, looked_at: int) -> Hypothesis:
    n, epochs = len(link.epochs), link.epochs
    epoch_of = {e: epochs[i - shift.by] if shift.begin <= i - shift.by < n else "" for i, e in enumerate(epochs)
                if i >= shift.begin}  # fmt: skip
    what, file, place = _said(link)
    since = "throughout" if shift.begin == 0 else f"from epoch {epochs[shift.begin]} on"
    which = "late" if shift.by > 0 else "early"
    name = "epochs shifted"
    return Hypothesis(
        name, f"{what} are {abs(shift.by)} epoch{'s' * (abs(shift.by) > 1)} too {which} {since}: one is missing or "
        "there twice", f"rename the epochs in {file}", replace(place, epochs=epochs[shift.begin :]),
        _moved(survey, link, epoch_of), (), shift.evidence, 2, looked_at,
    )  # fmt: skip


def _exchanged(survey: Survey, link: Link) -> Iterator[Hypothesis]:
    """Two epochs of the second that changed places."""
    if (fit := link.fit) is None:
        return
    misses = fit.misses(link.first, link.second)
    suspects = np.argsort(-misses)[:_SUSPECTS].tolist()
    found, pairs = [], list(combinations(sorted(suspects), 2))
    for i, j in pairs:
        now = fit.misses(link.first[[i, j]], link.second[[j, i]])
        if link.joins(now):
            found.append((float(misses[[i, j]].min() / (now.max() + float(np.median(misses)) + 1e-9)), i, j))
    for evidence, i, j in sorted(found, reverse=True)[:1]:
        if evidence > _CLEARLY:
            a, b = link.epochs[i], link.epochs[j]
            what, file, place = _said(link)
            yield Hypothesis("epochs exchanged", f"{what} at epochs {a} and {b} changed places",
                             f"exchange them in {file}", replace(place, epochs=(a, b)),
                             _moved(survey, link, {a: b, b: a}), (), evidence, 2, len(pairs))  # fmt: skip


def _cameras(survey: Survey, link: Link) -> Iterator[Hypothesis]:
    """Images of two cameras under each other's names, at the smaller part of the epochs: one, or from one on.

    An exchange inverts the motion between the two: the one that joins all epochs either way is found first.
    """
    n = len(link.epochs)
    motions = link.first @ inverse(link.second)
    both, members = np.concatenate([motions, inverse(motions)]), np.tile(np.arange(n), 2)
    apart = mean_pose(both, link.lever, members)[1].reshape(2, n)
    wrong = apart[1] < apart[0]
    if 2 * wrong.sum() > n or (2 * wrong.sum() == n and wrong[0]):
        wrong = ~wrong
    near, far = apart.min(axis=0), apart.max(axis=0)
    ratio = float(np.min(far / (near + float(np.median(near)) + 1e-9)))
    if wrong.any() and ratio > _CLEARLY and link.joins(near):
        epochs = tuple(e for e, w in zip(link.epochs, wrong, strict=True) if w)
        a, b = link.names
        yield Hypothesis(
            "cameras exchanged", f"cameras {a} and {b} have each other's images at {_listed(epochs, link.epochs)}",
            f"exchange these images between images/{a} and images/{b}", Place("camera", (a, b), "", epochs),
            exchanged_cameras(survey, a, b, epochs),
            (Rename("image_points", "camera_id", {a: b, b: a}, {"epoch_id": epochs}),), ratio, 2, n,
        )  # fmt: skip


def _listed(some: tuple[str, ...], every: tuple[str, ...]) -> str:
    if some == every[-len(some) :] and len(some) > 1:
        return f"epoch {some[0]} and from it on"
    return f"epoch {listed(some, 6)}"


def exchanged_cameras(survey: Survey, a: str, b: str, epochs: tuple[str, ...]) -> Survey:
    """The survey with the images of two cameras exchanged at these epochs."""
    other, chosen = {a: b, b: a}, set(epochs)
    mine = {i: x for i, x in enumerate(survey.image_blocks) if x.camera_id in other and x.epoch_id in chosen}
    return with_rows(survey, "image_blocks", {i: replace(x, camera_id=other[x.camera_id]) for i, x in mine.items()})


def _twice(survey: Survey) -> Iterator[Hypothesis]:
    """Two measured poses of the same frames, or two readings of a table at one epoch, that differ: either may go."""
    pairs = grouped(((p.a, p.b, type(p.b_from_a)), i) for i, p in enumerate(survey.pairs) if p.used)
    for rows in pairs.values():
        same = [survey.pairs[i] for i in rows]
        motions: list[Any] = [p.b_from_a for p in same]  # all of one type
        if any(_far(motions[0].localCoordinates(m), p.cov) for m, p in zip(motions, same, strict=True)):
            for i, p in zip(rows, same, strict=True):
                edits = (LeaveOut((f"pairs:{p.pair_id}",)),)
                yield _without_one(survey, "pairs", i, f"pair {p.pair_id}", Place("pair", (p.pair_id,)), edits)
    readings = grouped(((r.table_id, r.epoch_id), i) for i, r in enumerate(survey.table_readings) if r.used)
    for (table, epoch), rows in readings.items():
        first, *others = (survey.table_readings[i] for i in rows)
        if any(_far(r.angles - first.angles, r.cov) for r in others):
            what = f"the reading of table {table} at epoch {epoch}"
            place = Place("table", (table,), "axis1_deg", (epoch,))
            yield from (_without_one(survey, "table_readings", i, what, place, ()) for i in rows)


def _far(difference: FloatArray, cov: FloatArray) -> bool:
    """Whether what observes the same differs by ten sigmas or more."""
    return bool(np.max(np.abs(difference) / np.sqrt(np.diag(cov))) >= 10.0)


def _without_one(survey: Survey, field: str, row: int, what: str, place: Place, edits: tuple[Edit, ...]) -> Hypothesis:
    rest: Fields = {field: tuple(o for i, o in enumerate(getattr(survey, field)) if i != row)}
    cause = f"{what} is there twice with different values, and this one (row {row + 1} of those in use) does not fit"
    return Hypothesis("the same twice", cause, "leave it out", place, replace(survey, **rest), edits, 10.0, 1, 2)
