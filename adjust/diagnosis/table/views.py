"""What the images of targets say about a table's motions: one pose per view, from that image alone."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from adjust.diagnosis.alone import single_views, view_covariance
from adjust.diagnosis.case import Case
from adjust.frames.tables import table_poses
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock
from adjust.model.survey import FloatArray, IntArray, Survey, Table, Target
from adjust.spatial.rigid import adjoint, inverse, rigid, rotation_exp
from adjust.start.views import View, untrustworthy


@frozen(eq=False)
class TableViews:
    """All views between something carried by a table (*inner*) and something in the world (*outer*).

    inner, outer: (n,) positions in ``inner_ids`` and ``outer_ids``, ("camera" or "target", id) each. epoch: (n,)
    position in ``epoch_ids``. poses: (n, 4, 4) inner_from_outer, from one image each. cov: (n, 6, 6), rotation and
    translation of a small motion on the left of the pose, from the noise of the image points. angles: (e, k) rad read.
    """

    table: Table
    inner_ids: tuple[tuple[str, str], ...]
    outer_ids: tuple[tuple[str, str], ...]
    epoch_ids: tuple[str, ...]
    inner: IntArray
    outer: IntArray
    epoch: IntArray
    poses: FloatArray
    cov: FloatArray
    angles: FloatArray
    targets: Mapping[str, Target]

    def motions(self, angles: FloatArray | None = None, geometry: FloatArray | None = None) -> FloatArray:
        """``table_from_mount`` (e, 4, 4) of the readings, or of other angles (e, k) rad.

        geometry: (2,) non-orthogonality (rad) and axis offset (m), where they are not those given.
        """
        a = self.angles if angles is None else angles
        given = self.table.geometry.by_name
        if geometry is not None and len(self.table.axes) > 1:
            given |= dict(zip(("non_orthogonality", "axis_offset"), geometry.tolist(), strict=True))
        return rigid(*table_poses(self.table.axes, given, a))

    def by_geometry(self) -> FloatArray:
        """(e, 6, 2): how non-orthogonality and axis offset move the mount, a small motion on the left in the mount."""
        if len(self.table.axes) == 1:
            return np.zeros((len(self.angles), 6, 2))
        p, q = ("xyz".index(x) for x in self.table.axes)
        zero = self.table.geometry.by_name.get("zero_2", 0.0)
        back = rotation_exp(-(self.angles[:, 1] + zero)[:, None] * np.eye(3)[q])
        out = np.zeros((len(self.angles), 6, 2))
        out[:, :3, 0] = out[:, 3:, 1] = back[:, :, 3 - p - q]
        return out

    def only(self, rows: IntArray) -> "TableViews":
        """The same with some of the views."""
        return replace(
            self, inner=self.inner[rows], outer=self.outer[rows], epoch=self.epoch[rows], poses=self.poses[rows],
            cov=self.cov[rows],
        )  # fmt: skip


def given_geometry(table: Table) -> FloatArray:
    """Non-orthogonality (rad) and axis offset (m) as they are given, (2,)."""
    given = table.geometry.by_name
    return np.array([given.get("non_orthogonality", 0.0), given.get("axis_offset", 0.0)])


@lru_cache(maxsize=2)
def table_views(case: Case) -> tuple[TableViews, ...]:
    """The views of every table that carries cameras before fixed targets, or targets before fixed cameras.

    With the lenses that each camera's own images give: tables and other cameras have no say.
    """
    survey = case.survey
    carried = {s.station_id: s.table_id for s in survey.stations if s.motion == "table"}
    readings = {(r.table_id, r.epoch_id) for r in survey.table_readings}
    blocks = [b for b in survey.image_blocks if b.target_id is not None]
    if not readings or not carried or not blocks:
        return ()
    cameras, targets = survey.cameras_by_id, survey.targets_by_id
    still = {s.station_id for s in survey.stations if s.motion == "fixed"}
    sides: list[tuple[str, bool] | None] = []
    for block in blocks:
        target = targets[str(block.target_id)]
        by_camera, by_target = carried.get(cameras[block.camera_id].station_id), carried.get(target.station_id or "")
        table_id = by_camera or by_target
        fixed = target.motion == "fixed" and (by_camera is None or target.station_id is None)
        fixed = fixed and (by_camera is not None or cameras[block.camera_id].station_id in still)
        usable = (by_camera is None) != (by_target is None) and (table_id, block.epoch_id) in readings and fixed
        sides.append((str(table_id), by_target is not None) if usable else None)
    if not any(sides):
        return ()
    views = _poses(case, replace(survey, image_blocks=tuple(blocks)))
    out = []
    for table in survey.tables:
        mine = {i: s[1] for i, s in enumerate(sides) if s is not None and s[0] == table.table_id and i in views}
        rows, turned = list(mine), list(mine.values())
        if len(rows) >= 3:
            out.append(_gathered(survey, table, [blocks[i] for i in rows], [views[i] for i in rows], turned))
    return tuple(out)


def _poses(case: Case, survey: Survey) -> dict[int, View]:
    """Every block of a target that a pose explains, as rays and poses, each from its own image alone."""
    found = single_views(survey, case.lenses)
    reasons, _ = untrustworthy(found, survey)
    return {view.block_idx: view for view in found if view.block_idx not in reasons}


def _gathered(
    survey: Survey, table: Table, blocks: list[ImageBlock], views: list[View], turned: list[bool]
) -> TableViews:
    ends = [(("camera", b.camera_id), ("target", str(b.target_id))) for b in blocks]
    ends = [(outer, inner) if t else (inner, outer) for (inner, outer), t in zip(ends, turned, strict=True)]
    inner_ids, outer_ids = (tuple(sorted({e[k] for e in ends})) for k in (0, 1))
    readings = {r.epoch_id: r for r in survey.table_readings if r.table_id == table.table_id}
    seen = {b.epoch_id for b in blocks}
    epoch_ids = tuple(e for e in readings if e in seen)
    poses = np.array([v.poses[0] for v in views])
    cov = np.array([view_covariance(b, v) for b, v in zip(blocks, views, strict=True)])
    other_way = np.array(turned)
    poses[other_way] = inverse(poses[other_way])
    A = adjoint(poses[other_way])
    cov[other_way] = A @ cov[other_way] @ A.swapaxes(1, 2)
    return TableViews(
        table, inner_ids, outer_ids, epoch_ids,
        np.array([inner_ids.index(e[0]) for e in ends]), np.array([outer_ids.index(e[1]) for e in ends]),
        np.array([epoch_ids.index(b.epoch_id) for b in blocks]), poses, cov,
        np.array([readings[e].angles for e in epoch_ids]), survey.targets_by_id,
    )  # fmt: skip
