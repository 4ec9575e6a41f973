"""What the images of targets say about a table's motions: one pose per view, from that image alone."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from gtsam import Pose3

from adjust.adjustment import adjust
from adjust.diagnosis.alone import own_lens, single_views
from adjust.frames.tables import table_motions
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.result import Estimate, ParameterName
from adjust.model.rewriting import with_rows
from adjust.model.survey import BoolArray, FloatArray, IntArray, PoseParameter, Station, Survey, Table, Target
from adjust.spatial.rigid import adjoint, inverse, rigid, rotation_exp, skew
from adjust.start.views import View, untrustworthy


@dataclass(frozen=True, eq=False)
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
        return rigid(*table_motions(self.table.axes, given, a)[:2])

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

    def shows(self, kind: str, thing_id: str) -> BoolArray:
        """Which views (n,) are those of one thing, a camera or a target."""
        inner = np.array([name == (kind, thing_id) for name in self.inner_ids])
        outer = np.array([name == (kind, thing_id) for name in self.outer_ids])
        return np.asarray(inner[self.inner] | outer[self.outer])

    def without(self, kind: str, thing_id: str) -> "TableViews":
        """The same without the views of one thing, and without what only these show."""
        rest = self.only(np.flatnonzero(~self.shows(kind, thing_id)))
        (left, inner), (right, outer) = (np.unique(x, return_inverse=True) for x in (rest.inner, rest.outer))
        shown = tuple(self.inner_ids[i] for i in left), tuple(self.outer_ids[i] for i in right)
        return replace(rest, inner=inner, outer=outer, inner_ids=shown[0], outer_ids=shown[1])


def given_geometry(table: Table) -> FloatArray:
    """Non-orthogonality (rad) and axis offset (m) as they are given, (2,)."""
    given = table.geometry.by_name
    return np.array([given.get("non_orthogonality", 0.0), given.get("axis_offset", 0.0)])


def table_views(survey: Survey) -> tuple[TableViews, ...]:
    """The views of every table that carries cameras before fixed targets, or targets before fixed cameras.

    The cameras' lenses are those given, or found from the images. Raises SurveyError where there are none.
    """
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
    views = poses_of_views(_calibrated(replace(survey, image_blocks=tuple(blocks))))
    out = []
    for table in survey.tables:
        mine = {i: s[1] for i, s in enumerate(sides) if s is not None and s[0] == table.table_id and i in views}
        rows, turned = list(mine), list(mine.values())
        if len(rows) >= 3:
            out.append(_gathered(survey, table, [blocks[i] for i in rows], [views[i] for i in rows], turned))
    return tuple(out)


def _calibrated(survey: Survey) -> Survey:
    """With the lens of each camera from its own images alone: tables and other cameras have no say."""
    found = dict[ParameterName, Estimate]()
    for camera in (c for c in survey.cameras if c.lens.free):
        alone = single_camera_survey(survey, camera.camera_id)
        try:
            found |= adjust(alone).estimates if alone.image_blocks else {}
        except SurveyError:  # too few images: the lens that the search for start values finds will do
            continue
    return with_lenses(survey, found)


def with_lenses(survey: Survey, estimates: Mapping[ParameterName, Estimate]) -> Survey:
    """The survey whose lenses start from those of adjustments, as far as there are any."""
    known = {i: c for i, c in enumerate(survey.cameras) if ("lens", c.camera_id) in estimates}
    values = {i: np.asarray(estimates["lens", c.camera_id].value) for i, c in known.items()}
    new = {i: replace(c, lens=replace(c.lens, values=values[i])) for i, c in known.items()}
    return with_rows(survey, "cameras", new)


def single_camera_survey(survey: Survey, camera_id: str) -> Survey:
    """The calibration of one camera alone: every image of a target has a pose of its own."""
    held = PoseParameter(Pose3(), "held")
    camera = survey.cameras_by_id[camera_id]
    blocks = [b for b in survey.image_blocks if b.camera_id == camera_id and b.target_id is not None]
    alone = tuple(replace(b, epoch_id=f"{b.epoch_id}/{b.target_id}") for b in blocks)
    targets = [t for t in survey.targets if t.target_id in {b.target_id for b in blocks}]
    return Survey(
        cameras=(replace(camera, station_id="alone", station_from_camera=held),),
        stations=(Station("alone", "epoch"),),
        targets=tuple(
            replace(t, station_id=None, motion="fixed", carrier_from_target=held, epochs={}) for t in targets
        ),
        image_blocks=alone,
    )


def poses_of_views(survey: Survey) -> dict[int, View]:
    """Every block of a target that a pose explains, as rays and poses, each from its own image alone.

    Raises SurveyError where a camera has no lens and its images give none.
    """
    seen = dict.fromkeys(b.camera_id for b in survey.image_blocks)
    # those without a pose are named by the search for start values
    found = single_views(survey, {camera_id: own_lens(survey, survey.cameras_by_id[camera_id]) for camera_id in seen})
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


def view_covariance(block: ImageBlock, view: View) -> FloatArray:
    """Covariance (6, 6) of camera_from_target, a small motion on its left, from the points' noise."""
    p = view.x @ view.poses[0][:3, :3].T + view.poses[0][:3, 3]
    depth = np.linalg.norm(p, axis=1)
    across = np.eye(3) - p[:, :, None] * p[:, None, :] / (depth**2)[:, None, None]
    J = np.concatenate([-across @ skew(p), across], axis=2) * (view.focal_px / depth)[:, None, None]
    variance = float(np.mean(np.trace(block.cov, axis1=1, axis2=2))) / 2.0
    N = np.einsum("nij,nik->jk", J, J) / variance
    d = 1.0 / np.sqrt(np.diag(N))
    return np.asarray(np.linalg.inv(N * np.outer(d, d) + 1e-10 * np.eye(6)) * np.outer(d, d))
