"""What could be measured beside what is there, where no plan.toml says: views by hand, table angles, sights, pairs."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, islice, product

import numpy as np
from gtsam import Pose3

from adjust.design import Candidate, Seeing
from adjust.model.observations import FrameRef, Pair, Reading
from adjust.model.result import Adjustment
from adjust.model.survey import Camera, FloatArray, Survey, Target
from survey.planning.plan_file import ByHand, Measurements, Moment, Moments, Plan
from survey.planning.plan_readings import sights
from survey.project import Project
from survey.solution.frames import AdjustedFrames

_CELLS = ("middle", "top left", "bottom right", "top right", "bottom left", "top", "bottom", "left", "right")
"""Of an image, in the order in which views by hand take them."""
_TILT = np.radians(45.0)
_MOST = 60
"""Candidates of a kind: they are compared in seconds."""


def usual_plan(project: Project, expected: Adjustment) -> Plan:
    """A plan that measures nothing and has candidates of the kinds of which the survey has observations.

    A target before every camera with a free lens, tilted, in nine parts of its image, at the distances at which it was
    seen; axes of tables at the ends and in the middle of their ranges; every set-up's kinds of readings to the points
    that it does not sight; pairs between stations that have none.
    """
    survey = expected.survey
    epochs = (*_by_hand(survey, expected), *_by_table(survey))
    pairs = [Candidate(p.pair_id, "pair", pairs=(p,)) for p in islice(_pairs(survey), _MOST)]
    candidates = Measurements(epochs, (*pairs, *sights(islice(_sights(survey), 3 * _MOST))))
    return Plan(project.folder / "survey.toml", None, Seeing(), Measurements(), candidates)


def with_usual_sigmas_of(project: Project) -> Project:
    """The project with the middle of the sigmas that its image points and table readings have."""
    sigmas, survey = project.sigmas, project.survey
    px = [np.sqrt(np.trace(b.cov, axis1=1, axis2=2) / 2.0) for b in survey.image_blocks]
    tables: dict[str, list[FloatArray]] = {}
    for r in survey.table_readings:
        tables.setdefault(r.table_id, []).append(np.sqrt(np.diag(r.cov)))
    usual = {t: np.median(found, axis=0) for t, found in tables.items()}
    image_px = float(np.median(np.concatenate(px))) if px else None
    return replace(project, sigmas=replace(sigmas, image_px=image_px or sigmas.image_px, scale={},
                                           tables={**sigmas.tables, **usual}))  # fmt: skip


def _by_hand(survey: Survey, expected: Adjustment) -> Iterator[Moments]:
    frames, cameras = AdjustedFrames(expected), tuple(c.camera_id for c in survey.cameras)
    for number, camera in enumerate(c for c in survey.cameras if c.lens.free):
        target = next((t for t in survey.targets if _can_be_held(survey, camera, t)), None)
        if target is None:
            continue
        poses = [(frames.world_from(FrameRef("camera", camera.camera_id, b.epoch_id)),
                  frames.world_from(FrameRef("target", target.target_id, b.epoch_id))) for b in survey.image_blocks
                 if (b.camera_id, b.target_id) == (camera.camera_id, target.target_id)]  # fmt: skip
        far = [float(np.linalg.norm(a.between(b).translation())) for a, b in poses if a is not None and b is not None]
        if far:
            hand = ByHand(camera.camera_id, target.target_id, len(_CELLS),
                          (float(np.min(far)), float(np.max(far))), _TILT, number)  # fmt: skip
            moments = [Moment(f"{target.target_id} at the {cell} of {camera.camera_id}, tilted", cameras,
                              (target.target_id,), False) for cell in _CELLS]  # fmt: skip
            yield Moments(tuple(moments), hand)


def _can_be_held(survey: Survey, camera: Camera, target: Target) -> bool:
    """Whether either moves between epochs, and not both; and the camera has seen it."""
    station = survey.stations_by_id[camera.station_id]
    seen = any((b.camera_id, b.target_id) == (camera.camera_id, target.target_id) for b in survey.image_blocks)
    return seen and target.station_id is None and (target.motion == "epoch") != (station.motion != "fixed")


def _by_table(survey: Survey) -> Iterator[Moments]:
    targets, cameras = tuple(t.target_id for t in survey.targets), tuple(c.camera_id for c in survey.cameras)
    for table in survey.tables:
        read = np.array([r.angles for r in survey.table_readings if r.table_id == table.table_id])
        if not len(read) or not cameras:
            continue
        ends = [sorted({lo, 0.5 * (lo + hi), hi}) for lo, hi in zip(read.min(axis=0), read.max(axis=0), strict=True)]
        moments = [Moment(f"{table.table_id} {i + 1}", cameras, targets, bool(survey.points), table.table_id,
                          np.array(angles)) for i, angles in enumerate(product(*ends))]  # fmt: skip
        yield Moments(tuple(moments))


def _sights(survey: Survey) -> Iterator[Reading]:
    """Of every set-up, its kinds of readings with their usual sigmas, to the points that it does not sight."""
    for setup in dict.fromkeys(r.setup_id for r in survey.readings):
        mine = [r for r in survey.readings if r.setup_id == setup and r.used and r.second is None]
        known = {x.point_id for r in mine for x in (r.at, r.to) if x.frame is None}
        first = {r.kind: r for r in mine}
        for point in (p for p in survey.points if p.point_id not in known and first):
            for kind, r in first.items():
                sigma = float(np.median([x.sigma for x in mine if x.kind == kind]))
                yield replace(r, reading_id=f"{setup} {kind} {point.point_id}", to=replace(r.to, frame=None, point_id=(
                    point.point_id)), sigma=sigma)  # fmt: skip


def _pairs(survey: Survey) -> Iterator[Pair]:
    """Between stations that stay, each of which has pairs already, with the covariance of the middle one of them."""
    ends = {frozenset((p.a.frame_id, p.b.frame_id)) for p in survey.pairs}
    fixed = {s.station_id for s in survey.stations if s.motion == "fixed"}
    names = sorted({x for pair in ends for x in pair if x in fixed})
    usual = sorted(survey.pairs, key=lambda p: float(np.trace(p.cov)))
    for a, b in combinations(names, 2):
        if frozenset((a, b)) not in ends:
            yield Pair(f"{a}-{b}", FrameRef("station", a), FrameRef("station", b), Pose3(), usual[len(usual) // 2].cov)
