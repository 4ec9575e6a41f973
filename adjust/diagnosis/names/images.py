"""Images under another name: copies, targets or points called by each other's names, images of another camera.

Evidence: what the adjustment says such a block should show under the other name, against what it shows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import Hypothesis, LeaveOut, Place, Rename
from adjust.diagnosis.prediction import Prediction
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.observations import ImageBlock
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.statistics.score import ratio

_CLEARLY = 3.0
_MEDIAN = 1.386  # of chi-square with two degrees of freedom
POINTS = "points exchanged", "point_id", "points"
_POINTS, _TARGETS, _BLOCKS, _MOST = 6, 8, 24, 3


@frozen(eq=False)
class Now:
    """squares: of every block those over sigmas of its points (n,), over scale, bounded."""

    prediction: Prediction
    squares: list[FloatArray]
    scale: float

    def ratio(self, gain: float) -> float:
        """How many times smaller the misfit beyond noise becomes."""
        return ratio(float(sum(s.sum() for s in self.squares)), 2.0 * sum(len(s) for s in self.squares), gain)


def misnamed_images(case: Case) -> Iterator[Hypothesis]:
    """The clearest of each kind."""
    yield from _copies(case.survey)
    if case.values is not None and case.survey.image_blocks:
        prediction = Prediction(case.survey, case.values)
        squares = [prediction.squares(b) for b in case.survey.image_blocks]
        found = np.concatenate([np.ones(1), *(x for x in squares if x is not None)])
        scale = max(1.0, float(np.nanmedian(found)) / _MEDIAN)  # start values are rough
        bounded = [_bounded(x, b, scale) for x, b in zip(squares, case.survey.image_blocks, strict=True)]
        now = Now(prediction, bounded, scale)
        yield from _exchanges(now, _targets(case.survey), ("targets exchanged", "target_id", "targets"), True)
        yield from _exchanges(now, _points(case.survey, now), POINTS, False)
        yield from _cameras(now)


def _bounded(squares: FloatArray | None, block: ImageBlock, scale: float) -> FloatArray:
    """Of a block, bounded: the bound where it cannot be predicted."""
    return np.full(len(block.uv), 2.0 * CAP) if squares is None else np.fmin(squares / scale, 2.0 * CAP)


def _better(now: Now, other: dict[int, ImageBlock]) -> tuple[list[int], float]:
    """The blocks whose renamed points are clearly better under their other names, and by how much in all."""
    blocks, good, gain = now.prediction.survey.image_blocks, [], 0.0
    for i, block in other.items():
        same = block.target_id is None and block.camera_id == blocks[i].camera_id
        rows = np.flatnonzero(block.point_idx != blocks[i].point_idx) if same else np.arange(len(block.uv))
        other_way = _bounded(now.prediction.squares(block), block, now.scale)
        before, after = (float(x[rows].sum()) for x in (now.squares[i], other_way))
        gain += before - after
        if before > _CLEARLY * max(after, 2.0 * len(rows)):
            good.append(i)
    return good, gain


def _copies(survey: Survey) -> Iterator[Hypothesis]:
    """The same image points, to the last digit, in two images: either may be the copy."""
    seen = grouped((b.uv.tobytes(), i) for i, b in enumerate(survey.image_blocks) if len(b.uv) > 1)
    camera_of = [b.camera_id for b in survey.image_blocks]
    ways = grouped(((camera_of[i[0]], camera_of[i[1]]), i) for i in seen.values() if len(i) == 2)
    for (first, second), pairs in ways.items():
        for camera, other, which in ((second, first, 1), (first, second, 0)):
            gone = {p[which] for p in pairs}
            epochs = tuple(dict.fromkeys(survey.image_blocks[i].epoch_id for i in sorted(gone)))
            yield Hypothesis(
                "images copied", f"camera {camera}: at {len(epochs)} epochs ({epochs[0]} ...) its images are those of "
                f"camera {other}, to the last digit", "put its own images there, or leave these out",
                Place("camera", (camera,), epochs=epochs),
                replace(survey, image_blocks=tuple(b for i, b in enumerate(survey.image_blocks) if i not in gone)),
                (LeaveOut(tuple(f"image:{camera}/{e}" for e in epochs)),), 1e6 + which, 1, 2,
                penalty=-4.0 * sum(len(survey.image_blocks[i].uv) for i in gone),  # no accident is so exact
            )  # fmt: skip
            if first == second:
                break


_Way = tuple[str, str, dict[int, ImageBlock]]
"""Two names, and the images as they are with these exchanged."""


def _targets(survey: Survey) -> list[_Way]:
    points = {t.target_id: len(t.point_ids) for t in survey.targets if t.motion == "fixed"}
    return [
        (a, b, {i: replace(x, target_id=b if x.target_id == a else a) for i, x in enumerate(survey.image_blocks)
                if x.target_id in (a, b)})
        for a, b in combinations(list(points)[:_TARGETS], 2) if points[a] == points[b]
    ]  # fmt: skip


def _points(survey: Survey, now: Now) -> list[_Way]:
    share: dict[int, float] = {}
    for i, block in enumerate(survey.image_blocks):
        of = zip(block.point_idx.tolist(), now.squares[i].tolist(), strict=True)
        for p, square in of if block.target_id is None else ():
            share[p] = share.get(p, 0.0) + square
    worst, ids = sorted(share, key=lambda p: -share[p])[:_POINTS], [p.point_id for p in survey.points]
    world = [i for i, x in enumerate(survey.image_blocks) if x.target_id is None]
    return [
        (ids[a], ids[b], points_exchanged(survey, a, b, [
            i for i in world if bool(np.isin([a, b], survey.image_blocks[i].point_idx).any())]))
        for a, b in combinations(worst, 2)
    ]  # fmt: skip


def points_exchanged(survey: Survey, a: int, b: int, blocks: Sequence[int]) -> dict[int, ImageBlock]:
    """Images with two points of the world, by their positions, under each other's names."""
    swap = np.arange(len(survey.points))
    swap[[a, b]] = b, a
    images = {i: survey.image_blocks[i] for i in blocks}
    return {i: replace(x, point_idx=swap[x.point_idx]) for i, x in images.items()}


def _exchanges(now: Now, ways: Sequence[_Way], kind: tuple[str, str, str], onwards: bool) -> Iterator[Hypothesis]:
    """The exchanges that are clearly better in some images: in these, or also (first) in all since the first of them.

    What is spoilt itself may hide the others. kind: see :func:`exchange`.
    """
    found = []
    for a, b, blocks in ways:
        good, gain = _better(now, blocks)
        if good and onwards:
            found.append((gain, (a, b), {i: x for i, x in blocks.items() if i >= min(good)}))
        if good:
            found.append(((0.9 if onwards else 1.0) * gain, (a, b), {i: blocks[i] for i in good}))
    for gain, ids, blocks in sorted(found, key=lambda f: -f[0])[:_MOST]:
        yield exchange(now.prediction.survey, ids, blocks, kind, now.ratio(gain), len(ways))


def exchange(
    survey: Survey, ids: tuple[str, str], blocks: dict[int, ImageBlock], kind: tuple[str, str, str], evidence: float,
    looked_at: int,
) -> Hypothesis:  # fmt: skip
    """The names of two things exchanged in some images. kind: name of the mistake, column of the table, the things."""
    (name, column, things), (a, b) = kind, ids
    other = {a: b, b: a}
    where = [survey.image_blocks[i] for i in sorted(blocks)]
    epochs = tuple(dict.fromkeys(x.epoch_id for x in where))
    at = {c: tuple(dict.fromkeys(x.epoch_id for x in where if x.camera_id == c))
          for c in dict.fromkeys(x.camera_id for x in where)}  # fmt: skip
    return Hypothesis(
        name, f"{things} {a} and {b} are called by each other's names in {len(blocks)} images, the first at epoch "
        f"{epochs[0]}: wrong names, or they changed places", f"exchange them in {column} of image_points.csv",
        Place(column.removesuffix("_id"), (a, b), column, epochs), with_rows(survey, "image_blocks", blocks),
        tuple(Rename("image_points", column, other, {"camera_id": (c,), "epoch_id": e}) for c, e in at.items()),
        evidence, 1, looked_at,
    )  # fmt: skip


def _cameras(now: Now) -> Iterator[Hypothesis]:
    """All that a camera is said to show at an epoch, under the name of another one that shows nothing then."""
    survey = now.prediction.survey
    images = grouped(((b.camera_id, b.epoch_id), i) for i, b in enumerate(survey.image_blocks))
    bad = sorted(images, key=lambda k: -sum(float(now.squares[i].sum()) for i in images[k]))[:_BLOCKS]
    found: dict[tuple[str, str], tuple[float, list[str], dict[int, ImageBlock]]] = {}
    for camera, epoch in bad:
        for other in (c.camera_id for c in survey.cameras):
            if (other, epoch) not in images:
                blocks = {i: replace(survey.image_blocks[i], camera_id=other) for i in images[camera, epoch]}
                good, gain = _better(now, blocks)
                if len(good) == len(blocks):
                    before, epochs, chosen = found.get((camera, other), (0.0, [], {}))
                    found[camera, other] = before + gain, [*epochs, epoch], chosen | blocks
    for (camera, other), (gain, epochs, chosen) in sorted(found.items(), key=lambda f: -f[1][0])[:_MOST]:
        yield Hypothesis(
            "images of another camera", f"the images of camera {camera} at epochs {', '.join(epochs)} are those of "
            f"camera {other}", f"move them to images/{other}", Place("camera", (camera, other), "", tuple(epochs)),
            with_rows(survey, "image_blocks", chosen),
            (Rename("image_points", "camera_id", {camera: other}, {"epoch_id": tuple(epochs)}),), now.ratio(gain), 1,
            len(bad) * len(survey.cameras),
        )  # fmt: skip
