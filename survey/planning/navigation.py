"""Precision of navigated poses before anything is measured, what each part may contribute, and where beacons go."""

from dataclasses import replace
from fnmatch import fnmatchcase
from itertools import count, islice

import numpy as np
import scipy.linalg
from gtsam import Pose3

from adjust.design.placement import Placement, PlacementOptions, place_beacons
from adjust.design.pose_budget import PoseBudget, PoseTolerance, pose_budget, pose_tolerances, simulate_poses
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray
from adjust.navigation import Beacons, Expected, Head, expected_precision, head_and_beacons, head_of
from survey.planning.plan_file import Plan
from survey.planning.plan_navigation import NavigationPlan
from survey.solution.frames import AdjustedFrames

_TRIALS = 1000


@frozen(eq=False)
class NavigationOutcome:
    """Navigation from the planned beacons, and from beacons placed for it.

    precision: per pose. beacons: those it was made with, the placed ones last. placement: None where none were asked
    for; places (k, 3) m of the chosen ones. budget, tolerances: of the poses that are determined; simulated: (6,)
    largest over the poses of RMS error over its prediction with the shared tolerances, simulated anew.
    """

    station_id: str
    plan: NavigationPlan
    head: Head
    beacons: Beacons
    precision: tuple[Expected, ...]
    placement: Placement | None
    places: FloatArray
    budget: PoseBudget | None
    tolerances: tuple[PoseTolerance, ...]
    simulated: FloatArray

    @property
    def placed_ids(self) -> tuple[str, ...]:
        """(k,) names of the placed beacons."""
        return self.beacons.beacon_ids[len(self.beacons.beacon_ids) - len(self.places) :]

    @property
    def sigmas(self) -> FloatArray:
        """(q, 6) rad and m, in the head; infinite where a pose is open."""
        return np.asarray(np.sqrt([np.diag(e.cov) for e in self.precision]))


def plan_navigation(plan: Plan, expected: Adjustment, n_place: int) -> NavigationOutcome:
    """Predict the poses of [navigation] with the calibration as planned. Raises SurveyError."""
    nav = plan.navigation
    if nav is None:
        raise SurveyError(f"{plan.path}: there is no table [navigation]; say in it where the head will be")
    station = nav.station_id or _station(plan, expected)
    nav = replace(nav, poses=nav.poses + _at_epochs(plan, nav, expected, station))
    head, there = _head(expected, station)
    placement, places = None, np.zeros((0, 3))
    beacons = there
    if n_place:
        if not len(nav.places):
            raise SurveyError(f"{plan.path}: [navigation] has no places for beacons; give room_mm and places")
        options = PlacementOptions(
            nav.criterion, nav.required_rotation, nav.required_translation, nav.at_least, sigma_px=nav.sigma_px,
            spacing=nav.spacing,
        )  # fmt: skip
        placement = place_beacons(head, nav.poses, nav.places, nav.beacon_sigma, n_place, options, there)
        places = nav.places[list(placement.chosen)]
        beacons = _with_new(head, there, places, nav.beacon_sigma)
    if beacons is None:
        raise SurveyError(f"{plan.path}: there are no beacons to navigate from; list [points], or --place some")
    precision = expected_precision(head, beacons, nav.poses, nav.sigma_px)
    found, allowed, ratio = _tolerances(nav, head, beacons, precision)
    return NavigationOutcome(station, nav, head, beacons, precision, placement, places, found, allowed, ratio)


def _with_new(head: Head, there: Beacons | None, places: FloatArray, sigma: float) -> Beacons:
    """The beacons that are there, and after them new ones at places (k, 3) m with names that are free."""
    k = len(places)
    old = there or Beacons((), np.zeros((0, 3)), np.zeros((0, 0)))
    free = (f"N{i}" for i in count(1) if f"N{i}" not in old.beacon_ids)
    cov = scipy.linalg.block_diag(old.cov, sigma**2 * np.eye(3 * k))
    cross = None if old.cross_cov is None else np.hstack([old.cross_cov, np.zeros((len(head.cov), 3 * k))])
    ids = (*old.beacon_ids, *islice(free, k))
    return Beacons(ids, np.vstack([old.x_in_world, places]), cov, cross)


def _station(plan: Plan, expected: Adjustment) -> str:
    found = head_of(expected.survey)
    if found is not None:
        return found
    raise SurveyError(f"{plan.path}: several stations carry cameras; name one as station under [navigation]")


def _at_epochs(plan: Plan, nav: NavigationPlan, expected: Adjustment, station: str) -> tuple[Pose3, ...]:
    """Poses of the station at the epochs that [navigation] names by pattern."""
    survey, frames, out = expected.survey, AdjustedFrames(expected), []
    epochs = [r.epoch_id for r in survey.table_readings] + [b.epoch_id for b in survey.image_blocks]
    for pattern in nav.epochs:
        found = [e for e in dict.fromkeys(epochs) if fnmatchcase(e, pattern)]
        poses = [frames.world_from(FrameRef("station", station, e)) for e in found]
        if not any(p is not None for p in poses):
            raise SurveyError(f"{plan.path}: [navigation] epochs: {pattern!r} is no epoch at which {station} is placed")
        out += [p for p in poses if p is not None]
    return tuple(out)


def _head(expected: Adjustment, station: str) -> tuple[Head, Beacons | None]:
    if expected.survey.points:
        return head_and_beacons(expected, station)
    none = Beacons(("-",), np.zeros((1, 3)), np.zeros((3, 3)))
    return head_and_beacons(expected, station, known=none)[0], None


def _tolerances(
    nav: NavigationPlan, head: Head, beacons: Beacons, precision: tuple[Expected, ...]
) -> tuple[PoseBudget | None, tuple[PoseTolerance, ...], FloatArray]:
    good: list[Pose3] = [e.world_from_station for e in precision if not e.undetermined]
    if not good:
        return None, (), np.full(6, np.nan)
    found = pose_budget(head, beacons, good)
    required = np.array([nav.required_rotation] * 3 + [nav.required_translation] * 3)
    planned = np.array([nav.sigma_px, nav.beacon_sigma, *nav.camera_sigma])
    allowed = pose_tolerances(found, required, planned)
    shared = np.array([t.shared for t in allowed])
    errors = simulate_poses(found, shared, _TRIALS)
    ratio = np.sqrt(np.mean(errors**2, axis=1) / found.variances(shared))
    return found, allowed, np.asarray(ratio[np.argmax(np.abs(ratio - 1.0), axis=0), np.arange(6)])
