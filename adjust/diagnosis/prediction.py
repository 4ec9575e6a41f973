"""What an adjustment says an image block should show, also under another name or with another value of one unknown."""

from collections.abc import Container, Mapping
from functools import cached_property

import numpy as np
from gtsam import Pose3

from adjust.frames.lens_times import LensTimes
from adjust.frames.runs import MOVING
from adjust.frames.tables import table_poses
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Unknowns
from adjust.graph.assembly import StartValues
from adjust.lenses.compared import motion_derivatives
from adjust.lenses.models import MODELS, camera_constants, lens_derivatives, project
from adjust.model.boards import deformed, warming_of
from adjust.model.clocks import epoch_times
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import Clock, FloatArray, Survey, Target
from adjust.native.lenses import FISHEYE
from adjust.observations.between_epochs import between
from adjust.observations.clocks import nearest
from adjust.spatial.rigid import inverse, rigid, transform
from adjust.statistics.score import LinearScores
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

Altered = Mapping[ParameterName, Pose3 | FloatArray]
_ALPHA = 1e-4
Links = tuple[tuple[ParameterName, bool], ...]
"""A chain: of every link its name, and whether it is inverted."""


def adjusted_values(result: Adjustment) -> Altered:
    """The adjusted values of all unknowns."""
    return {n: e.value for n, e in result.estimates.items()}


def started_values(start: StartValues) -> Altered:
    """The start values of all unknowns."""
    out: dict[ParameterName, Pose3 | FloatArray] = {**start.poses, **start.vectors}
    out.update({("lens", c): v for c, v in start.lenses.items()})
    out.update({("point", p): x for p, x in start.points.items()})
    return out


@frozen(eq=False)
class Prediction:
    """Image points of the blocks of ``survey``, and of others of its things, by values of its unknowns."""

    survey: Survey
    values: Altered

    def uv(self, block: ImageBlock, altered: Altered | None = None) -> FloatArray | None:
        """(n, 2) px of a block, nan where a point is not known; None where another value is not, or one lies behind.

        altered: other values, by the name of the unknown: of a pose, a lens, a point. ("station_body", id) and
        ("target_body", id): motions of bodies whose poses are held, in their own frames.
        """
        other = altered or {}
        pose, x = self.pose(block, other), self._points(block, other)
        return None if pose is None or x is None else self._project(block, x @ pose[:3, :3].T + pose[:3, 3], other)

    def squares(self, block: ImageBlock, altered: Altered | None = None) -> FloatArray | None:
        """(n,) squares over sigmas of what a block shows against what it should show."""
        uv = self.uv(block, altered)
        return None if uv is None else np.einsum("ni,nij,nj->n", uv - block.uv, np.linalg.inv(block.cov), uv - block.uv)

    def by_motion(self, block: ImageBlock, body: ParameterName) -> FloatArray | None:
        """(n, 2, 6) px by a small motion of a body whose pose is held, as in :meth:`uv`."""
        found = self._by_place(block)
        if found is None:
            return None
        x, pose, by_x = found
        if body[0] == "target_body":
            return motion_derivatives(by_x @ pose[:3, :3], x)
        own = self.link(("station_from_camera", block.camera_id))
        own = np.eye(4) if own is None else own
        return -motion_derivatives(by_x @ own[:3, :3].T, transform(own @ pose, x))

    def by_shape(self, block: ImageBlock, change: FloatArray) -> FloatArray | None:
        """(n, 2, k) px by a change (P, 3, k) of all points of its target, in the target's axes."""
        found = self._by_place(block)
        return None if found is None else np.asarray(found[2] @ found[1][:3, :3] @ change[block.point_idx])

    def _by_place(self, block: ImageBlock) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Its points (n, 3) m on their target, ``camera_from_target``, (n, 2, 3) px/m by places in the camera."""
        if block.place not in self._places:
            pose, x, lens = self.pose(block, {}), self._points(block, {}), self._lens(block, {})
            camera, found = self.survey.cameras_by_id[block.camera_id], None
            if pose is not None and x is not None and lens is not None:
                model, q = MODELS[camera.lens.model], np.ascontiguousarray(transform(pose, x))
                if model.kind == FISHEYE or not (q[:, 2] <= 0.0).any():
                    found = x, pose, lens_derivatives(model, lens, camera_constants(camera), q, block.uv)[2]
            self._places[block.place] = found
        return self._places[block.place]

    @cached_property
    def _places(self) -> dict[tuple[str, str, str | None, str], tuple[FloatArray, FloatArray, FloatArray] | None]:
        return {}

    def pose(self, block: ImageBlock, altered: Altered) -> FloatArray | None:
        """(4, 4) ``camera_from_target`` of a block."""
        out = np.eye(4)
        for name, inverted in self.links(block):
            new = altered.get(name)
            value = new.matrix() if isinstance(new, Pose3) else self._link_of(block, name)
            if value is None:
                return None
            out = out @ (inverse(value) if inverted else value)
        return self._moved_body(block, out, altered)

    def _link_of(self, block: ImageBlock, name: ParameterName) -> FloatArray | None:
        """(4, 4) of a link of a block when its camera exposed, of which the middle of its rows is taken."""
        clock = self._clocks.get(block.camera_id)
        if clock is None or len(name) != 3 or name[0] not in MOVING:
            return self.link(name)
        times, values = epoch_times(self.survey), self._value(("camera_clock", block.camera_id), {})
        own = self._value(("camera_clock", block.camera_id, block.epoch_id), {})
        if values is None:
            return self.link(name)
        height = next(c.image_size[1] for c in self.survey.cameras if c.camera_id == block.camera_id)
        rates = {"offset": 1.0, "drift": times.of[name[2]] - times.middle,
                 "line_time": float(block.uv[:, 1].mean()) - 0.5 * (height - 1)}  # fmt: skip
        late = sum(rates[n] * v for n, v in zip(clock.parameters.names, values.tolist(), strict=True))
        late += 0.0 if own is None else float(own[0])
        near = {times.of[n[2]]: n for n in self._epochs_of(name) if n[2] in times.of}
        chosen = nearest(list(near), times.of[name[2]])
        poses = [self.link(near[t]) for t in chosen]
        known = [p for p in poses if p is not None]
        return between(known, chosen, late) if len(known) == len(poses) else self.link(name)

    def _epochs_of(self, name: ParameterName) -> list[ParameterName]:
        """Names of what a link is at all epochs."""
        if name[0] == "table_motion":
            return [(*name[:2], r.epoch_id) for r in self.survey.table_readings if r.table_id == name[1]]
        return [n for n in self.values if n[:2] == name[:2] and len(n) == 3]

    @cached_property
    def _clocks(self) -> dict[str, Clock]:
        return {c.camera_id: c.clock for c in self.survey.cameras if c.clock is not None}

    def implied(
        self, block: ImageBlock, pose: FloatArray, name: ParameterName, alone: Container[ParameterName] = ()
    ) -> tuple[FloatArray, FloatArray] | None:
        """What a block that is seen in a pose (4, 4) says of one link of its chain, (4, 4) as it stands there.

        Also the motion (4, 4) from the camera to that link. alone: links of which this block alone tells: None there.
        """
        before, after, found = np.eye(4), np.eye(4), False
        for other, inverted in self.links(block):
            if other == name:
                found = True
                continue
            value = None if other in alone else self.link(other)
            if value is None:
                return None
            value = inverse(value) if inverted else value
            before, after = (before, after @ value) if found else (before @ value, after)
        back = inverse(before)
        return (back @ pose @ inverse(after), back) if found else None

    def links(self, block: ImageBlock) -> Links:
        """The chain ``camera_from_target`` of a block."""
        place = block.camera_id, block.epoch_id, block.target_id
        if place not in self._links:
            chain = self._tree.of_image(block)
            slots = self._tree.unknowns.slot_of
            for name in list(slots)[len(self._names) :]:
                self._names.append(tuple(name))
            self._links[place] = tuple((self._names[link.slot], link.inverse) for link in chain)
        return self._links[place]

    def link(self, name: ParameterName) -> FloatArray | None:
        """(4, 4) of a link; None where there is no value of it."""
        if name not in self._poses:
            value = self.values.get(name)
            moved = self._table_motion(name) if name[0] == "table_motion" else None
            self._poses[name] = value.matrix() if isinstance(value, Pose3) else moved
        return self._poses[name]

    @cached_property
    def _tree(self) -> FrameTree:
        return FrameTree(self.survey, Unknowns())

    @cached_property
    def _names(self) -> list[ParameterName]:
        """By slot."""
        return []

    @cached_property
    def _links(self) -> dict[tuple[str, str, str | None], Links]:
        return {}

    @cached_property
    def _poses(self) -> dict[ParameterName, FloatArray | None]:
        return {}

    def _on_target(self, target: Target, epoch_id: str) -> FloatArray:
        """(n, 3) m of its points, with the warp that was found."""
        return deformed(target, self._value(("warp", target.target_id), {}), warming_of(self.survey, target, epoch_id))

    def _lens(self, block: ImageBlock, altered: Altered) -> FloatArray | None:
        """The lens (n,) at the epoch of a block."""
        camera = self.survey.cameras_by_id[block.camera_id]
        if self._value(("lens", block.camera_id), altered) is None:
            return None
        return self._times.lens(camera, block.epoch_id, lambda name: self._value(name, altered))

    @cached_property
    def _times(self) -> LensTimes:
        return LensTimes(self.survey)

    def _table_motion(self, name: ParameterName) -> FloatArray | None:
        """(4, 4) of a table at an epoch; None where its geometry or its angles are not known."""
        geometry, table = self._value(("table_geometry", name[1]), {}), self.survey.tables_by_id[name[1]]
        angles = self._value(("table_angles", *name[1:]), {})
        if angles is None:
            angles = next((r.angles for r in self.survey.table_readings if (r.table_id, r.epoch_id) == name[1:]), None)
        if geometry is None or angles is None:
            return None
        (R,), (t,) = table_poses(table.axes, dict(zip(table.geometry.names, geometry, strict=True)), angles[None])
        return rigid(R, t)

    def _moved_body(self, block: ImageBlock, pose: FloatArray, altered: Altered) -> FloatArray:
        station = altered.get(("station_body", self.survey.cameras_by_id[block.camera_id].station_id))
        if isinstance(station, Pose3):
            own = self.link(("station_from_camera", block.camera_id))
            own = np.eye(4) if own is None else own
            pose = inverse(own) @ inverse(station.matrix()) @ own @ pose
        target = altered.get(("target_body", block.target_id or ""))
        return pose @ target.matrix() if isinstance(target, Pose3) else pose

    def _project(self, block: ImageBlock, x_in_camera: FloatArray, altered: Altered) -> FloatArray | None:
        lens, camera = self._lens(block, altered), self.survey.cameras_by_id[block.camera_id]
        if lens is None:
            return None
        model, constants = MODELS[camera.lens.model], camera_constants(camera)
        known, uv = np.isfinite(x_in_camera).all(axis=1), np.full((len(x_in_camera), 2), np.nan)
        try:
            uv[known] = project(model, lens, constants, x_in_camera[known])
            return uv
        except SurveyError:
            return None

    def _value(self, name: ParameterName, altered: Altered) -> FloatArray | None:
        found = altered.get(name, self.values.get(name))
        return None if found is None or isinstance(found, Pose3) else np.asarray(found)

    def _points(self, block: ImageBlock, altered: Altered) -> FloatArray | None:
        if block.target_id is not None:
            return self._on_target(self.survey.targets_by_id[block.target_id], block.epoch_id)[block.point_idx]
        found = [self._value(("point", self.survey.points[int(i)].point_id), altered) for i in block.point_idx]
        return np.array([np.full(3, np.nan) if x is None else x for x in found])


@frozen(eq=False)
class Linear(LinearScores):
    """The adjustment that is diagnosed as a linear system: scores of changes of things whose images it predicts."""

    def clear(self, drop: float, freedom: int, looked_at: int) -> bool:
        """Whether a drop of v'Pv passes its test at a level shared by so many hypotheses (chi-square, Sidak 1967)."""
        return drop > self.scale * float(chi2.isf(sidak(_ALPHA, looked_at), freedom))

    @cached_property
    def prediction(self) -> Prediction:
        """What the adjustment says that its images show."""
        return Prediction(self.result.survey, adjusted_values(self.result))
