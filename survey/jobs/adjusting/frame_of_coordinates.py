"""Coordinates of beacons in a frame of their own: where stations stand among them, told by spots without names.

A station whose place in the world is known without its spots finds itself among the beacons as in navigation: which
spot is which beacon follows from the distances between these. Both places together are the motion between the frames.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from adjust.adjustment import adjust
from adjust.diagnosis.effects.common import EXCHANGED, IN_ORDER, in_another_frame, whole_points
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, position_text
from adjust.model.result import Adjustment
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.navigation.head import head_and_beacons
from adjust.navigation.model import Beacons, NavigateOptions, NavigationEpoch, Spots
from adjust.navigation.sequence import navigate
from adjust.spatial.rigid import align, inverse
from survey.jobs.identify import identified, identify_spots, spot_views
from survey.project import Project
from survey.project.project import SpotBlock
from survey.solution.frames import AdjustedFrames

_FEWEST, _EPOCHS = 5, 3
"""Spots of a station at an epoch that are looked at, and how many epochs, those with most spots."""
_LOOSE = 1e4
"""Times their variances while image points alone tell where beacons are."""


def in_other_frames(project: Project, first: Adjustment, gate_px: float) -> Iterator[Hypothesis]:
    """The coordinates moved to where spots without names see them, also with x and y exchanged (left-handed).

    first: of the cameras and stations, without the spots.
    """
    survey, rows = project.survey, whole_points(project.survey)
    if len(rows) < _FEWEST:
        return
    views = spot_views(survey, first, project.spots)
    for columns in (IN_ORDER, EXCHANGED):
        given = {position_text(c.positions[0]): c.values[0, columns] for c in (survey.coordinates[i] for i in rows)}
        cov = block_diag(*(survey.coordinates[i].cov[np.ix_(columns, columns)] for i in rows))
        beacons = Beacons(tuple(given), np.array(list(given.values())), cov)
        for motion in _motions(project, first, beacons):
            moved = in_another_frame(survey, rows, motion, columns).changed()
            if moved is None:
                continue
            found = identify_spots(moved, views, gate_px)
            try:
                fine = _refined(identified(moved, found), rows, given)
            except SurveyError:
                continue
            yield in_another_frame(survey, rows, fine, columns)


def _motions(project: Project, first: Adjustment, beacons: Beacons) -> Iterator[FloatArray]:
    """World from the frame of the beacons (4, 4), by each of the epochs."""
    frames = AdjustedFrames(first)
    for (station_id, epoch_id), blocks in _epochs(project):
        world_from_station = frames.world_from(FrameRef("station", station_id, epoch_id))
        if world_from_station is None:
            continue
        spots = tuple(Spots(b.camera_id, b.uv, b.cov) for b in blocks)
        try:
            head, _ = head_and_beacons(first, station_id, beacons, {b.camera_id: epoch_id for b in blocks})
            found = navigate(head, beacons, [NavigationEpoch(epoch_id, spots)], NavigateOptions(None, use_table=False))
        except SurveyError:
            continue
        pose = found.epochs[0]
        if pose.status == "fixed" and pose.world_from_station is not None:
            yield world_from_station.matrix() @ inverse(pose.world_from_station.matrix())


def _epochs(project: Project) -> list[tuple[tuple[str, str], list[SpotBlock]]]:
    by_station: dict[tuple[str, str], list[SpotBlock]] = {}
    for block in project.spots:
        station = project.survey.cameras_by_id[block.camera_id].station_id
        by_station.setdefault((station, block.epoch_id), []).append(block)
    size = {key: sum(len(b.uv) for b in blocks) for key, blocks in by_station.items()}
    return sorted(((k, b) for k, b in by_station.items() if size[k] >= _FEWEST), key=lambda e: -size[e[0]])[:_EPOCHS]


def _refined(survey: Survey, rows: list[int], given: dict[str, FloatArray]) -> FloatArray:
    """World from the frame of given points (4, 4), by where the image points have them. Raises SurveyError."""
    loose = {i: replace(c, cov=_LOOSE * c.cov) for i in rows for c in [survey.coordinates[i]]}
    estimates = adjust(with_rows(survey, "coordinates", loose)).estimates
    names = [n for n in given if ("point", n) in estimates]
    return align(np.array([estimates["point", n].value for n in names]), np.array([given[n] for n in names]))
