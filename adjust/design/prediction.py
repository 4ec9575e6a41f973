"""What a planned survey would observe: everything projected through the model at the planned values."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.frames.lens_times import LensTimes
from adjust.graph.assembly import StartValues
from adjust.graph.building import GraphBuilder
from adjust.lenses.models import MODELS, camera_constants, lens_residuals, project
from adjust.model.boards import deformed, warming_of
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, ImageBlock, PositionRef, Reading, TableReading
from adjust.model.survey import BoolArray, Camera, FloatArray, Point, Survey, Target
from adjust.native.lenses import FISHEYE
from adjust.observations.images.batch import Chains

_STEPS = np.linspace(1.0 / 16.0, 1.0, 16)
_NEAREST_M = 1e-3


@frozen
class Seeing:
    """When an image point counts as seen.

    margin_px: from the border of the image. nearest_m, farthest_m: depth along the optical axis. widest_incidence:
    rad between the line of sight and the normal of a flat target, which is seen from its front (z < 0) alone unless it
    is named in ``two_sided``. fewest_points: of a target in one image; with fewer it is not detected.
    """

    margin_px: float = 5.0
    nearest_m: float = 0.05
    farthest_m: float = float("inf")
    widest_incidence: float = float(np.radians(70.0))
    fewest_points: int = 4
    two_sided: tuple[str, ...] = ()


class Predictor:
    """A survey at given values: where its frames are and what its instruments would read. Built once, then read."""

    def __init__(self, survey: Survey, start: StartValues) -> None:
        builder = GraphBuilder(survey, start.lenses)
        self.survey, self.graph, self.frames = survey, builder.build(start), builder.frames
        self.values, self.times = self.graph.start, LensTimes(survey)
        self.cameras, self.targets = survey.cameras_by_id, survey.targets_by_id
        self.graph.state.load(self.values)

    def b_from_a(self, a: FrameRef, b: FrameRef) -> Pose3:
        """The motion between two frames."""
        chain = Chains([self.frames.relative(a, b)])
        chain.evaluate(self.graph.state)
        return Pose3(Rot3(chain.R[0]), chain.t[0])

    def lens(self, camera: Camera, epoch_id: str) -> FloatArray:
        """Full lens vector (n,) at an epoch."""
        states = self.graph.state.lens_states
        return states.full(states.of(camera.camera_id, epoch_id), self.values)

    def points_in_frame(self, target_id: str | None, epoch_id: str | None = None) -> FloatArray:
        """All points of a target in its frame, its warp included, or all world points; (n, 3) m."""
        if target_id is None:
            return np.array([self._point(p) for p in self.survey.points]).reshape(-1, 3)
        target = self.targets[target_id]
        vector = self.graph.unknowns.vectors.get(("warp", target_id))
        values = None if vector is None else vector.full(self.values)
        return deformed(target, values, warming_of(self.survey, target, epoch_id))

    def _point(self, point: Point) -> FloatArray:
        unknown = self.graph.unknowns.by_name.get(("point", point.point_id))
        held = self.graph.unknowns.held_points.get(point.point_id)
        return np.asarray(held if unknown is None else self.values.atPoint3(unknown.key))

    def image(self, block: ImageBlock) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Image points (n, 2) px of a block, nan where there is none; in the camera the points (n, 3) m, and z (3,)."""
        camera = self.cameras[block.camera_id]
        ref = FrameRef("target", block.target_id, block.epoch_id) if block.target_id else FrameRef("world")
        pose = self.b_from_a(ref, FrameRef("camera", block.camera_id, block.epoch_id))
        x = self.points_in_frame(block.target_id, block.epoch_id)[block.point_idx]
        R = pose.rotation().matrix()
        q = x @ R.T + pose.translation()
        return projected(camera, self.lens(camera, block.epoch_id), q), q, R[:, 2]

    def seen(self, block: ImageBlock, seeing: Seeing) -> ImageBlock | None:
        """The block with what is visible of it, at its predicted place; None where that is too little."""
        uv, q, z = self.image(block)
        camera = self.cameras[block.camera_id]
        size = self.times.size(camera, block.epoch_id)
        keep = _inside(size, uv, seeing.margin_px)
        keep &= (q[:, 2] >= seeing.nearest_m) & (q[:, 2] <= seeing.farthest_m)
        if keep.any():
            keep[keep] = grows_outwards(camera, self.lens(camera, block.epoch_id), q[keep])
        if block.target_id is not None:
            keep &= _facing(self.targets[block.target_id], q, z, seeing)
        fewest = seeing.fewest_points if block.target_id is not None else 1
        if int(keep.sum()) < fewest:
            return None
        return replace(block, uv=uv).part(keep)

    def angles(self, reading: TableReading) -> FloatArray:
        """Angles (k,) rad of a table at an epoch."""
        unknown = self.graph.unknowns.by_name.get(("table_angles", reading.table_id, reading.epoch_id))
        return reading.angles if unknown is None else np.asarray(self.values.atVector(unknown.key))

    def readings(self) -> tuple[Reading, ...]:
        """All readings as they would be read, rad and m, horizontal angles in (-pi, pi]."""
        batch = self.graph.terrestrial
        if batch is None:
            return ()
        batch.evaluate(self.values)
        misses = batch.residual.tolist()
        return tuple(replace(r, value=r.value + w) for r, w in zip(self.survey.readings, misses, strict=True))

    def reading_sigmas(self) -> FloatArray:
        """Sigmas (N,) of all readings with the centring of their targets, rad and m."""
        batch = self.graph.terrestrial
        return np.zeros(0) if batch is None else np.array(batch.with_sigmas_at(self.values)[0].sigma)

    def position(self, ref: PositionRef) -> FloatArray:
        """World coordinates (3,) m."""
        if ref.frame is None:
            index = [p.point_id for p in self.survey.points].index(str(ref.point_id))
            return self._point(self.survey.points[index])
        pose = self.b_from_a(ref.frame, FrameRef("world"))
        if ref.point_id is None:
            return np.asarray(pose.translation())
        target = self.targets[ref.frame.frame_id]
        x = self.points_in_frame(target.target_id, ref.frame.epoch_id)[target.point_ids.index(ref.point_id)]
        return np.asarray(pose.transformFrom(x))


def predict(survey: Survey, start: StartValues, wanted: Sequence[ImageBlock], seeing: Seeing) -> tuple[ImageBlock, ...]:
    """Of the blocks wanted (their points may be anywhere) what the cameras would see, with predicted image points."""
    predictor = Predictor(replace(survey, image_blocks=tuple(wanted)), start)
    found = (predictor.seen(block, seeing) for block in wanted)
    return tuple(block for block in found if block is not None)


def projected(camera: Camera, lens: FloatArray, q: FloatArray) -> FloatArray:
    """Image points (n, 2) px of points (n, 3) m in the camera; nan where there is no image."""
    model = MODELS[camera.lens.model]
    uv = np.full((len(q), 2), np.nan)
    ahead = np.ones(len(q), dtype=np.bool_) if model.kind == FISHEYE else q[:, 2] > _NEAREST_M
    if not ahead.any():
        return uv
    try:
        uv[ahead] = project(model, lens, camera_constants(camera), q[ahead])
    except SurveyError:
        if int(ahead.sum()) == 1:
            return uv
        for i in np.flatnonzero(ahead):  # some point lies outside what a backward model can reach: one by one
            uv[i] = projected(camera, lens, q[i : i + 1])[0]
    return uv


def grows_outwards(camera: Camera, lens: FloatArray, q: FloatArray) -> BoolArray:
    """Whether (n,) the image runs outwards all the way from the axis to each point: no fold of a polynomial."""
    model = MODELS[camera.lens.model]
    if model.backward or not len(q):
        return np.ones(len(q), dtype=np.bool_)
    path = np.repeat(q[None], len(_STEPS), axis=0)
    path[..., :2] *= _STEPS[:, None, None]
    constants = camera_constants(camera)
    centre = lens_residuals(model, lens, constants, np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 2)))
    uv = lens_residuals(model, lens, constants, path.reshape(-1, 3), np.zeros((path.size // 3, 2)))
    radius = np.linalg.norm(uv - centre, axis=1).reshape(len(_STEPS), -1)
    return np.asarray((np.diff(radius, axis=0) > 0.0).all(axis=0) | (radius[-1] < 1.0))


def _inside(size: tuple[int, int], uv: FloatArray, margin: float) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.all((uv >= margin) & (uv <= np.array(size) - 1.0 - margin), axis=1))


def _facing(target: Target, q: FloatArray, z: FloatArray, seeing: Seeing) -> BoolArray:
    """Which of the points q (n, 3) m of a target, whose third axis is z (3,), both in the camera, it shows to it."""
    if not _is_flat(target):
        return np.ones(len(q), dtype=np.bool_)
    cosine = q @ z / np.linalg.norm(q, axis=1)
    if target.target_id in seeing.two_sided:
        cosine = np.abs(cosine)
    return np.asarray(cosine >= np.cos(seeing.widest_incidence))


def _is_flat(target: Target) -> bool:
    extent = np.ptp(target.x_in_target, axis=0)
    return bool(extent[2] < 1e-3 * max(float(extent.max()), 1e-9))
