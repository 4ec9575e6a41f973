"""What an adjustment says an image block should show, also under another name or with another value of one unknown."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from gtsam import Pose3

from adjust.frames.lens_states import block_starts
from adjust.frames.tables import table_motions
from adjust.frames.unknowns import Chain, FrameTree, Unknowns
from adjust.lenses.models import LensModel, camera_constants, lens_model, project
from adjust.model.boards import deformed, warming_of
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, Survey, Target
from adjust.spatial.rigid import inverse, rigid

Altered = Mapping[ParameterName, Pose3 | FloatArray]


def chains_of(survey: Survey) -> tuple[dict[int, str | tuple[str, ...]], list[Chain]]:
    """The names of all slots, and the chain ``camera_from_target`` of every block."""
    unknowns = Unknowns()
    frames = FrameTree(survey, unknowns)
    chains = [frames.of_image(block) for block in survey.image_blocks]
    return {slot: name for name, slot in unknowns.slot_of.items()}, chains


def adjusted_pose(survey: Survey, result: Adjustment, name: ParameterName) -> FloatArray | None:
    """(4, 4) of a slot; None where the adjustment has no value of it."""
    if name[0] == "table_motion":
        angles = result.estimates.get(("table_angles", name[1], name[2]))
        geometry = result.estimates.get(("table_geometry", name[1]))
        read = next((r for r in survey.table_readings if (r.table_id, r.epoch_id) == name[1:]), None)
        if geometry is None or (angles is None and read is None):
            return None
        table = next(t for t in survey.tables if t.table_id == name[1])
        g = dict(zip(geometry.components, np.asarray(geometry.value), strict=True))
        said = np.asarray(angles.value) if angles is not None else read.angles if read is not None else np.zeros(0)
        R, t, _ = table_motions(table.axes, g, said[None].astype(float))
        return rigid(R[0], t[0])
    estimate = result.estimates.get(name)
    return estimate.value.matrix() if estimate is not None and isinstance(estimate.value, Pose3) else None


@dataclass(frozen=True, eq=False)
class Prediction:
    """Image points of the blocks of ``survey`` by the values of an adjustment, perhaps of another survey."""

    survey: Survey
    result: Adjustment

    @cached_property
    def _frames(self) -> tuple[dict[int, str | tuple[str, ...]], list[Chain], dict[int, FloatArray | None]]:
        names, chains = chains_of(self.survey)
        return names, chains, {s: adjusted_pose(self.survey, self.result, tuple(n)) for s, n in names.items()}

    @cached_property
    def _lenses(self) -> dict[str, tuple[LensModel, FloatArray]]:
        return {c.camera_id: (lens_model(c.lens.model), camera_constants(c)) for c in self.survey.cameras}

    @cached_property
    def _targets(self) -> dict[str, Target]:
        return {t.target_id: t for t in self.survey.targets}

    def _on_target(self, target: Target, epoch_id: str) -> FloatArray:
        """(n, 3) m of its points, with the warp that was found."""
        found = self.result.estimates.get(("warp", target.target_id))
        same = found is not None and target.warp is not None and found.components == target.warp.names
        values = np.asarray(found.value) if same and found is not None else None
        return deformed(target, values, warming_of(self.survey, target, epoch_id))

    @cached_property
    def _drifting(self) -> dict[str, dict[str, str | None]]:
        """Of cameras whose lens changes by blocks, by epoch where the block begins."""
        return {c.camera_id: block_starts(self.survey, c) for c in self.survey.cameras if c.lens.drift is not None}

    def _lens(self, block: ImageBlock, altered: Altered) -> FloatArray | None:
        """The lens (n,) at the epoch of a block."""
        own = self._value(("lens", block.camera_id), altered)
        starts = self._drifting.get(block.camera_id)
        if own is None or starts is None:
            return own
        camera = next(c for c in self.survey.cameras if c.camera_id == block.camera_id)
        reference = camera.lens.drift.reference_temperature if camera.lens.drift is not None else None
        start = starts.get(block.epoch_id) or ""
        name: ParameterName = ("lens_drift", block.camera_id, *(() if reference is not None else (start,)))
        found = self.result.estimates.get(name)
        if found is None:
            return own
        factor = 1.0 if reference is None else self.survey.temperatures[block.epoch_id] - reference
        names, out = self._lenses[block.camera_id][0].names, own.copy()
        change = dict(zip(found.components, factor * np.asarray(found.value), strict=True))
        change |= {tie.name: tie.factor * change[tie.to] for tie in camera.lens.ties if tie.to in change}
        out[[names.index(x) for x in change]] += list(change.values())
        return out

    def uv(self, i: int, altered: Altered | None = None) -> FloatArray | None:
        """(n, 2) px of block i; None where a value is not known, or a point lies behind the camera.

        altered: other values, by the name of the unknown: of a pose, a lens, a point. ("station_body", id) and
        ("target_body", id): motions of bodies whose poses are held, in their own frames.
        """
        block, other = self.survey.image_blocks[i], altered or {}
        pose, lens = self.pose(i, other), self._lens(block, other)
        x = self._points(block, other)
        if pose is None or lens is None or x is None:
            return None
        model, constants = self._lenses[block.camera_id]
        try:
            return project(model, lens, constants, x @ pose[:3, :3].T + pose[:3, 3])
        except SurveyError:
            return None

    def squares(self, i: int) -> FloatArray | None:
        """(n,) squares over sigmas of what block i shows against what it should show."""
        block, uv = self.survey.image_blocks[i], self.uv(i)
        return None if uv is None else np.einsum("ni,nij,nj->n", uv - block.uv, np.linalg.inv(block.cov), uv - block.uv)

    def pose(self, i: int, altered: Altered) -> FloatArray | None:
        """(4, 4) ``camera_from_target`` of block i."""
        names, chains, poses = self._frames
        out = np.eye(4)
        for link in chains[i]:
            new = altered.get(tuple(names[link.slot]))
            value = new.matrix() if isinstance(new, Pose3) else poses[link.slot]
            if value is None:
                return None
            out = out @ (inverse(value) if link.inverse else value)
        return self._moved_body(self.survey.image_blocks[i], out, altered)

    def _moved_body(self, block: ImageBlock, pose: FloatArray, altered: Altered) -> FloatArray:
        station = altered.get(("station_body", self._stations[block.camera_id]))
        if isinstance(station, Pose3):
            own = adjusted_pose(self.survey, self.result, ("station_from_camera", block.camera_id))
            own = np.eye(4) if own is None else own
            pose = inverse(own) @ inverse(station.matrix()) @ own @ pose
        target = altered.get(("target_body", block.target_id or ""))
        return pose @ target.matrix() if isinstance(target, Pose3) else pose

    @cached_property
    def _stations(self) -> dict[str, str]:
        return {c.camera_id: c.station_id for c in self.survey.cameras}

    def _value(self, name: ParameterName, altered: Altered) -> FloatArray | None:
        found = altered.get(name)
        if found is None and name in self.result.estimates:
            found = self.result.estimates[name].value
        return None if found is None or isinstance(found, Pose3) else np.asarray(found)

    def _points(self, block: ImageBlock, altered: Altered) -> FloatArray | None:
        if block.target_id is not None:
            return self._on_target(self._targets[block.target_id], block.epoch_id)[block.point_idx]
        found = [self._value(("point", self.survey.points[int(i)].point_id), altered) for i in block.point_idx]
        return None if any(x is None for x in found) else np.array(found)
