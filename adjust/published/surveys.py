"""From a survey to the calibration's input, and the body's frame as part of the joint adjustment's datum.

The paper defines the body's frame by how the head is mounted: its axes are parallel to the table's when both angles are
zero, and its origin is on the main axis. No image can tell either. In a survey,

- ``mount_from_station = body_on_main_axis(height)`` says both, and leaves the height free;
- the height is told by the caliper alone: a ``Distance`` from the body's origin, which is
  ``PositionRef(frame=FrameRef("station", head, epoch))`` at an epoch with the auxiliary axis at zero, to a point of the
  board's plane below or above it (a held ``Point``; its place along the plane matters only to second order).

Without the first the body's x and y (and its rotation) are not separated from the cameras', without the second its z;
the adjustment then raises IndeterminateError and names the station's frame.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.observations import TableReading
from adjust.model.result import Adjustment
from adjust.model.survey import PoseParameter, Station, Survey
from adjust.published.steps import TableImages

_EXACT_RAD, _EXACT_M = 1e-8, 1e-8  # 0.002 arcsec and 10 nm: nothing, and still well within double precision


def body_on_main_axis(height_m: float) -> PoseParameter:
    """``mount_from_station`` of a body with axes parallel to the table's and its origin on the main axis (z).

    height_m: start value of the one component that stays free, along the axis.
    """
    variances = np.array([_EXACT_RAD, _EXACT_RAD, _EXACT_RAD, _EXACT_M, _EXACT_M, np.inf]) ** 2
    return PoseParameter(Pose3(Rot3(), np.array([0.0, 0.0, height_m])), "prior", np.diag(variances))


def single_camera_survey(survey: Survey, camera_id: str) -> Survey:
    """The calibration of one camera alone (Zhang): a pose of its own for every image, and no table."""
    camera = survey.cameras_by_id.get(camera_id)
    if camera is None:
        raise SurveyError(f"the survey has no camera {camera_id!r}")
    held = PoseParameter(Pose3(), "held")
    blocks = tuple(b for b in survey.image_blocks if b.camera_id == camera_id)
    seen = {b.target_id for b in blocks}
    return Survey(
        cameras=(replace(camera, station_from_camera=held),),
        stations=(Station(camera.station_id, "epoch"),),
        targets=tuple(t for t in survey.targets if t.target_id in seen),
        image_blocks=blocks,
    )


def table_images(calibrated: Adjustment, readings: Sequence[TableReading]) -> TableImages:
    """The images on the table of a camera calibrated alone, with the joint covariance of their poses."""
    camera = calibrated.survey.cameras[0]
    angles = {r.epoch_id: r.angles for r in readings}
    epochs = [b.epoch_id for b in calibrated.survey.image_blocks if b.epoch_id in angles]
    if not epochs:
        raise SurveyError(f"camera {camera.camera_id}: none of its images was taken at an epoch with a table reading")
    names = [("world_from_station", camera.station_id, e) for e in epochs]
    poses = [calibrated.estimates[name].value for name in names]
    return TableImages(
        camera.camera_id,
        np.array([angles[e] for e in epochs]),
        np.array([p.matrix() for p in poses if isinstance(p, Pose3)]),
        calibrated.precision.joint(names),
    )
