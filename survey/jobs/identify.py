"""Which spot is which beacon: by predicting every beacon of roughly known position into every image.

A spot and a beacon belong together when each is the other's nearest within the gate, and no second candidate comes
half as near again; everything else is left unidentified and reported.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from gtsam import Pose3

from adjust.frames.lens_times import LensTimes
from adjust.lenses.models import MODELS, camera_constants, project
from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.result import Adjustment, ParameterName
from adjust.model.subsets import only_between, with_points
from adjust.model.survey import Camera, FloatArray, Survey
from survey.project import SpotBlock
from survey.solution.frames import AdjustedFrames

_SECOND_BEST = 1.5


@frozen
class Identification:
    """Image blocks of identified beacons, and notes about what was not identified."""

    blocks: tuple[ImageBlock, ...]
    identified: int
    unidentified: int
    notes: tuple[str, ...]


def without_points(survey: Survey, spots: Iterable[SpotBlock]) -> Survey:
    """The survey without its world points: what can be adjusted before the spots have names.

    Images that hold nothing else stay, empty, of cameras whose lenses change: one may do so there.
    """
    changing = {c.camera_id for c in survey.cameras if c.lens.drift is not None or c.lens.crops}
    blocks = tuple(b for b in survey.image_blocks if b.target_id is not None)
    known = {(b.camera_id, b.epoch_id) for b in blocks}
    images = [(b.camera_id, b.epoch_id) for b in survey.image_blocks] + [(b.camera_id, b.epoch_id) for b in spots]
    empty = [_empty(*key) for key in dict.fromkeys(images) if key not in known and key[0] in changing]
    blocks = _in_order((*blocks, *empty)) if empty else blocks
    return replace(only_between(survey, lambda ref: ref.frame is not None), points=(), image_blocks=blocks)


def _empty(camera_id: str, epoch_id: str) -> ImageBlock:
    return ImageBlock(camera_id, epoch_id, None, np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)))


def identified(survey: Survey, found: Identification) -> Survey:
    """The survey with the image points of its beacons, ordered as in a table, without beacons that nothing observes."""
    return seen_points(replace(survey, image_blocks=_in_order((*survey.image_blocks, *found.blocks))))


def _in_order(blocks: Iterable[ImageBlock]) -> tuple[ImageBlock, ...]:
    return tuple(sorted(blocks, key=lambda b: (natural_key(b.camera_id), natural_key(b.epoch_id))))


def seen_points(survey: Survey) -> Survey:
    """Leave out the beacons that nothing observes any more: a beacon may be hidden in all images."""
    observed: set[str | None] = {
        survey.points[int(i)].point_id for b in survey.image_blocks if b.target_id is None for i in b.point_idx
    }
    observed |= {r.point_id for c in survey.coordinates for r in c.positions if r.frame is None}
    refs = [r for d in survey.coordinate_differences for r in (*d.at, *d.to)]
    refs += [o.position for o in survey.on_surfaces]
    refs += [r for x in survey.readings for r in (x.at, x.to, x.second) if r is not None]
    observed |= {r.point_id for r in refs if r.frame is None}
    return with_points(survey, [
        i for i, p in enumerate(survey.points) if p.point_id in observed or p.x_in_world.treatment != "free"
    ])  # fmt: skip


def rough_positions(survey: Survey) -> dict[str, FloatArray]:
    """World points whose coordinates are known or observed, (3,) m."""
    known = {p.point_id: np.asarray(p.x_in_world.value) for p in survey.points if p.x_in_world.value is not None}
    known = {point_id: x for point_id, x in known.items() if np.isfinite(x).all()}
    for observation in survey.coordinates:
        for ref, x in zip(observation.positions, observation.values, strict=True):
            if ref.frame is None and ref.point_id is not None and np.isfinite(x).all():
                known[ref.point_id] = x
    return known


@frozen(eq=False)
class SpotView:
    """Spots of one image and what its camera is by the adjustment; pose: world_from_camera, None where not known."""

    spots: SpotBlock
    camera: Camera
    pose: Pose3 | None
    times: LensTimes
    adjustment: Adjustment

    @cached_property
    def lens(self) -> FloatArray:
        """(n,) of the epoch. Raises SurveyError where it has no values."""
        estimates = self.adjustment.estimates

        def value(name: ParameterName) -> FloatArray | None:
            return np.asarray(estimates[name].value) if name in estimates else None

        return self.times.lens(self.camera, self.spots.epoch_id, value)

    def predict(self, positions: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Image points (2,) px of the world points that are in front of the camera and inside its image."""
        if not positions or self.pose is None:
            return {}
        names = list(positions)
        R, t = self.pose.rotation().matrix(), self.pose.translation()
        q = (np.array([positions[n] for n in names]) - t) @ R
        # half the picture beyond 60 degrees off the axis says nothing about a lens that was calibrated inside its image
        front = q[:, 2] > 0.3 * np.linalg.norm(q, axis=1)
        if not front.any():
            return {}
        uv = project(MODELS[self.camera.lens.model], self.lens, camera_constants(self.camera), q[front])
        width, height = self.times.size(self.camera, self.spots.epoch_id)
        inside = np.all((uv > -0.5) & (uv < np.array([width, height]) - 0.5), axis=1)
        seen = [n for n, ok in zip(names, front, strict=True) if ok]
        return {n: x for n, x, ok in zip(seen, uv, np.atleast_1d(inside), strict=True) if ok}


def spot_views(survey: Survey, adjustment: Adjustment, spots: Sequence[SpotBlock]) -> list[SpotView]:
    """The spots with their cameras, as the adjustment of a part of the survey has them."""
    frames, times = AdjustedFrames(adjustment), LensTimes(adjustment.survey)
    return [
        SpotView(s, survey.cameras_by_id[s.camera_id], frames.world_from(FrameRef("camera", s.camera_id, s.epoch_id)),
                 times, adjustment)
        for s in spots
    ]  # fmt: skip


def identify_spots(survey: Survey, views: Sequence[SpotView], gate_px: float) -> Identification:
    """Name the spots as the beacons of the survey, with rough positions."""
    positions = rough_positions(survey)
    index = {p.point_id: i for i, p in enumerate(survey.points)}
    blocks, notes, identified, total = [], [], 0, 0
    for view in views:
        spots = view.spots
        total += len(spots.uv)
        where = f"camera {spots.camera_id} at epoch {spots.epoch_id}"
        if view.pose is None:
            notes.append(f"{where}: its pose is not known without the spots; name them in image_points")
            continue
        pairs, ambiguous = match(spots.uv, view.predict(positions), gate_px)
        if ambiguous:
            notes.append(f"{where}: {ambiguous} spots lie near more than one beacon and are left out")
        identified += len(pairs)
        if pairs:
            rows, named = [i for i, _ in pairs], np.array([index[p] for _, p in pairs])
            blocks.append(
                ImageBlock(spots.camera_id, spots.epoch_id, None, named, spots.uv[rows], spots.cov[rows])
            )  # fmt: skip
    seen = {survey.points[int(i)].point_id for b in blocks for i in b.point_idx}
    missing = sorted(set(index) - seen)
    if missing:
        notes.append(f"beacons seen by no camera: {', '.join(missing)}")
    return Identification(tuple(blocks), identified, total - identified, tuple(notes))


def match(uv: FloatArray, predicted: Mapping[str, FloatArray], gate_px: float) -> tuple[list[tuple[int, str]], int]:
    """Pairs (spot, beacon) that choose each other, and how many spots had two candidates."""
    if not predicted or not len(uv):
        return [], 0
    names = list(predicted)
    distance = np.linalg.norm(uv[:, None, :] - np.array([predicted[n] for n in names])[None], axis=2)
    pairs, ambiguous = [], 0
    for i, row in enumerate(distance):
        j = int(row.argmin())
        if row[j] > gate_px:
            continue
        rivals = np.concatenate([np.delete(row, j), np.delete(distance[:, j], i)])
        if rivals.size and rivals.min() < min(gate_px, _SECOND_BEST * row[j] + 1.0):
            ambiguous += 1
            continue
        pairs.append((i, names[j]))
    return pairs, ambiguous
