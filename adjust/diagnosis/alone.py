"""What single images say by themselves: lenses of cameras, poses of targets; start values of what is new from these."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.prediction import Prediction, started_values
from adjust.frames.lens_times import whole_images
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.names import grouped
from adjust.model.observations import ImageBlock
from adjust.model.survey import Camera, FloatArray, PoseParameter, Station, Survey
from adjust.spatial.averaging import mean_pose
from adjust.spatial.rigid import inverse, skew
from adjust.start.lens.start import start_lens
from adjust.start.views import Sighting, View, Views, make_views, sightings, sights_of


def own_lens(survey: Survey, camera: Camera, near: FloatArray | None = None) -> FloatArray:
    """Start values (n,) of a lens from the camera's images of targets alone; SurveyError where they give none.

    near: see :func:`adjust.start.lens.start.start_lens`.
    """
    seen = _of_targets(survey, (camera.camera_id,)).get(camera.camera_id, ())
    return start_lens(camera, [s for s in seen if len(s.x)], near=near).values


def _of_targets(survey: Survey, cameras: Collection[str]) -> dict[str, list[Sighting]]:
    """What these cameras' blocks of targets show, by camera, in whole images."""
    survey = whole_images(survey)
    seen, blocks = sightings(survey, np.full((len(survey.points), 3), np.nan)), survey.image_blocks
    return {c: [s for s in seen[c] if blocks[s.block_idx].target_id is not None] for c in seen if c in cameras}


def own_lenses(survey: Survey, near: Mapping[str, FloatArray] = MappingProxyType({})) -> dict[str, FloatArray]:
    """:func:`own_lens` of every camera whose images give one."""
    found = {}
    for camera in survey.cameras:
        try:
            found[camera.camera_id] = own_lens(survey, camera, near.get(camera.camera_id))
        except SurveyError:
            continue
    return found


def single_views(survey: Survey, lenses: Mapping[str, FloatArray]) -> Views:
    """Every block of a target with three used points or more that has a pose."""
    sights, _ = sights_of(survey.cameras_by_id, lenses, _of_targets(survey, lenses))
    return make_views(sights.only(np.diff(sights.ptr) >= 3))[0]


def squares_alone(survey: Survey, lenses: Mapping[str, FloatArray]) -> FloatArray:
    """(b,) sums of squares over sigmas of each block at its own best pose; zero where it has none."""
    return squares_of(survey, single_views(survey, lenses))


def squares_of(survey: Survey, views: Iterable[View]) -> FloatArray:
    """The same of views that are known."""
    out = np.zeros(len(survey.image_blocks))
    for view in views:
        block = survey.image_blocks[view.block_idx]
        out[view.block_idx] = len(view.x) * float(view.error_px[0]) ** 2 / _variance(block)
    return out


def _variance(block: ImageBlock) -> float:
    """px^2, of a coordinate of the typical point."""
    return float(np.mean(np.trace(block.cov, axis1=1, axis2=2))) / 2.0


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


def view_covariance(block: ImageBlock, view: View) -> FloatArray:
    """Covariance (6, 6) of camera_from_target, a small motion on its left, from the points' noise."""
    p = view.x @ view.poses[0][:3, :3].T + view.poses[0][:3, 3]
    depth = np.linalg.norm(p, axis=1)
    across = np.eye(3) - p[:, :, None] * p[:, None, :] / (depth**2)[:, None, None]
    J = np.concatenate([-across @ skew(p), across], axis=2) * (view.focal_px / depth)[:, None, None]
    N = np.einsum("nij,nik->jk", J, J) / _variance(block)
    d = 1.0 / np.sqrt(np.diag(N))
    return np.asarray(np.linalg.inv(N * np.outer(d, d) + 1e-10 * np.eye(6)) * np.outer(d, d))


def completed(survey: Survey, start: StartValues) -> StartValues:
    """Start values with the lenses of new cameras and the poses of what is new, as single images tell them."""
    new = {c.camera_id: own_lens(survey, c) for c in survey.cameras if c.camera_id not in start.lenses}
    start = replace(start, lenses={**start.lenses, **new})
    prediction = Prediction(survey, started_values(start))
    seen = [(i, b) for i, b in enumerate(survey.image_blocks) if b.target_id is not None]
    missing = grouped((n, i) for i, b in seen for n, _ in prediction.links(b) if prediction.link(n) is None)
    if not missing:
        return start
    chosen = sorted({i for of in missing.values() for i in of})
    some = replace(survey, image_blocks=tuple(survey.image_blocks[i] for i in chosen))
    views = {chosen[v.block_idx]: v for v in single_views(some, start.lenses)}
    poses = dict(start.poses)
    for name, of in missing.items():
        found = []
        for i in of:
            said = prediction.implied(survey.image_blocks[i], views[i].poses[0], name) if i in views else None
            if said is not None:
                inverted = dict(prediction.links(survey.image_blocks[i]))[name]
                found.append(inverse(said[0]) if inverted else said[0])
        if found:
            poses[name] = Pose3(mean_pose(np.array(found), 1.0)[0])
    return replace(start, poses=poses)
