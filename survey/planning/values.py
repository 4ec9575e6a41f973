"""The values that a plan predicts with, and epochs with the places at which things are then."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from gtsam import Pose3

from adjust.graph.assembly import StartValues
from adjust.lenses.models import MODELS, camera_constants, unit_rays
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName
from adjust.model.rewriting import Rewriting
from adjust.model.survey import Camera, FloatArray, PointParameter, PoseParameter, Survey
from survey.planning.plan_file import ByHand, Moment, Moments


@dataclass(eq=False)
class PlannedValues(Rewriting):
    """Values as they are gathered: of poses and points by a walk over a survey, which stays as it is."""

    lenses: dict[str, FloatArray] = field(default_factory=dict)
    poses: dict[ParameterName, Pose3] = field(default_factory=dict)
    points: dict[str, FloatArray] = field(default_factory=dict)
    vectors: dict[ParameterName, FloatArray] = field(default_factory=dict)

    def start(self) -> StartValues:
        """As an adjustment begins with them."""
        return StartValues(self.lenses, self.poses, self.points, self.vectors)

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        """As it is, its value noted."""
        if given.value is not None:
            self.poses[name] = given.value
        return given

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        """As it is, its value noted."""
        if given.value is not None:
            self.points[name[1]] = np.asarray(given.value, dtype=float)
        return given


def gathered(survey: Survey, existing: Adjustment | None) -> PlannedValues:
    """Values of survey.toml, those of an adjustment before them."""
    v = PlannedValues()
    estimates = {} if existing is None else existing.estimates
    for c in survey.cameras:
        value = c.lens.values
        if (found := estimates.get(("lens", c.camera_id))) is not None:
            value = np.asarray(found.value)
        if value is None:
            raise SurveyError(
                f"camera {c.camera_id}: its lens has no values to plan with; give them under "
                f"[cameras.{c.camera_id}.lens] values, from a data sheet or an earlier calibration"
            )
        v.lenses[c.camera_id] = np.asarray(value, dtype=float)
    v(survey)
    for co in survey.coordinates:
        for ref, x in zip(co.positions, co.values, strict=True):
            if ref.frame is None and ref.point_id is not None:
                v.points.setdefault(ref.point_id, np.asarray(x))
    for beam in survey.beams:  # else it would be fitted to spots that are not measured yet
        if np.isfinite(beam.parameters.values).all():
            v.vectors["beam", beam.beam_id] = np.asarray(beam.parameters.values, dtype=float)
    for name, e in estimates.items():
        if isinstance(e.value, Pose3):
            v.poses[name] = e.value
        elif name[0] == "point":
            v.points[name[1]] = np.asarray(e.value)
        elif name[0] != "lens":
            v.vectors[name] = np.asarray(e.value)
    return v


def placed_moments(series: Sequence[Moments], survey: Survey, values: PlannedValues) -> list[Moment]:
    """All epochs of some series, those by hand with their poses."""
    out: list[Moment] = []
    for s in series:
        if s.by_hand is None:
            out += s.moments
            continue
        poses = _hand_poses(s.by_hand, survey, values)
        per = len(s.moments) // s.by_hand.count
        out += [_held_by_hand(m, s.by_hand, survey, values, poses[i // per]) for i, m in enumerate(s.moments)]
    return out


def _hand_poses(hand: ByHand, survey: Survey, values: PlannedValues) -> list[Pose3]:
    """camera_from_target: the middle of the target in nine cells of the image in turn, tilted, at any distance."""
    rng = np.random.default_rng(hand.seed)
    camera = survey.cameras_by_id[hand.camera_id]
    target = survey.targets_by_id[hand.target_id]
    middle = 0.5 * (target.x_in_target.min(axis=0) + target.x_in_target.max(axis=0))
    out = []
    for i in range(hand.count):
        cell = (4, 0, 8, 2, 6, 1, 7, 3, 5)[i % 9]
        share = (np.array([cell % 3, cell // 3]) + rng.uniform(0.2, 0.8, 2)) / 3.0
        ray = _ray(camera, values.lenses[camera.camera_id], share * np.array(camera.image_size))
        axis, tilt = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.25, 1.0) * hand.tilt
        turn = Pose3.Expmap(np.array([tilt * np.cos(axis), tilt * np.sin(axis), 0, 0, 0, 0])).rotation()
        roll = Pose3.Expmap(np.array([0, 0, rng.choice([0.0, 0.0, 0.5, 1.0]) * np.pi, 0, 0, 0])).rotation()
        R = turn.compose(roll)
        out.append(Pose3(R, ray * rng.uniform(*hand.distance) - R.matrix() @ middle))
    return out


def _ray(camera: Camera, lens: FloatArray, pixel: FloatArray) -> FloatArray:
    ray = unit_rays(MODELS[camera.lens.model], lens, camera_constants(camera), pixel[None])[0]
    return np.asarray(ray / ray[2])


def _held_by_hand(m: Moment, hand: ByHand, survey: Survey, values: PlannedValues, camera_from_target: Pose3) -> Moment:
    """Who moves: the target where it moves between epochs, else the station with its camera."""
    camera = survey.cameras_by_id[hand.camera_id]
    target = survey.targets_by_id[hand.target_id]
    station = survey.stations_by_id[camera.station_id]
    mount = _value(values, ("station_from_camera", camera.camera_id), camera.station_from_camera)
    if target.motion == "epoch":
        if station.motion != "fixed":
            raise SurveyError(
                f"target {target.target_id} and station {station.station_id} both move between epochs: give poses for "
                "one of them in plan.toml, by_hand is for one thing that moves"
            )
        world = _value(values, ("world_from_station", station.station_id), station.world_from_station)
        return replace(m, target_id=target.target_id, pose=world * mount * camera_from_target)
    if station.motion == "fixed":
        raise SurveyError(f"neither {target.target_id} nor station {station.station_id} moves; by_hand needs one")
    world = _value(values, ("carrier_from_target", target.target_id), target.carrier_from_target)
    return replace(m, station_id=station.station_id, pose=world * camera_from_target.inverse() * mount.inverse())


def _value(values: PlannedValues, name: ParameterName, parameter: PoseParameter) -> Pose3:
    if name in values.poses:
        return values.poses[name]
    if parameter.treatment == "held":
        return parameter.value or Pose3()
    raise SurveyError(f"{' '.join(name)} has no value to plan with; give translation_mm and a rotation in survey.toml")
