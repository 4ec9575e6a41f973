"""Eyes from images: poses of every camera before its targets, and of marker blocks before a camera that stands still.

Each eye is adjusted by itself; its poses come with their joint covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.adjustment import adjust
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.result import Adjustment
from adjust.model.survey import Camera, PoseParameter, Station, Survey, Target
from adjust.relay.eyes.eyes import symmetric
from adjust.relay.eyes.sequences import EyeSequence
from adjust.spatial.rigid_motions import Motions

ROOM = "room"  # the world of targets that the survey holds


def camera_sequence(survey: Survey, camera_id: str) -> EyeSequence:
    """Poses of one camera before the targets it saw, adjusted by itself, with the joint covariance of all epochs.

    Targets seen together in an epoch make one world, named after the first of them; targets that the survey holds stand
    in the world "room". The lens is treated as in the survey. Raises SurveyError for targets that move.
    """
    camera = survey.cameras_by_id.get(camera_id)
    if camera is None:
        raise SurveyError(f"camera {camera_id!r} is not part of the survey; correct the id")
    blocks = _before_targets(survey, camera)
    if not blocks:
        raise SurveyError(f"camera {camera_id!r} has no image of a target that it could be an eye before")
    targets = _unmoved(survey, blocks)
    world_of = _worlds(blocks, targets)
    epochs = tuple(dict.fromkeys(b.epoch_id for b in blocks))
    alone = adjust(_alone(camera, blocks, targets, world_of))
    first = {b.epoch_id: world_of[b.target_id] for b in blocks if b.target_id}
    return _sequence(alone, FrameRef("camera", camera_id), "world_from_station", epochs, first)


def _sequence(
    alone: Adjustment, eye: FrameRef, kind: str, epochs: Sequence[str], world_of: Mapping[str, str]
) -> EyeSequence:
    """The poses of an eye out of its own adjustment; world_of: by epoch."""
    every = [(kind, eye.frame_id, epoch) for epoch in epochs]
    names = [name for name in every if name in alone.estimates]
    if alone.precision is None or not names:
        raise SurveyError(f"{eye.kind} {eye.frame_id!r}: no epoch is left after adjusting it by itself")
    poses = [alone.estimates[name].value for name in names]
    found = Motions.of(np.array([p.matrix() for p in poses if isinstance(p, Pose3)]))
    ids = tuple(name[2] for name in names)
    cov = symmetric(alone.precision.joint(names))
    return EyeSequence(eye, ids, found, cov, tuple(world_of[e] for e in ids))


def target_sequence(survey: Survey, target_id: str) -> EyeSequence:
    """Poses of a marker block that a station carries, before a camera that stands still, with their joint covariance.

    Of several such cameras the one that saw the block at most epochs counts; it is the world, by its id, and its lens
    is treated as in the survey. Raises SurveyError where no such camera saw the block.
    """
    target = survey.targets_by_id.get(target_id)
    if target is None:
        raise SurveyError(f"target {target_id!r} is not part of the survey; correct the id")
    watched = _watched(survey, target)
    if not watched:
        raise SurveyError(
            f"target {target_id!r}: no camera of another station that stands still has seen it; it cannot be an eye"
        )
    camera, blocks = max(watched, key=lambda x: len(x[1]))
    still = PoseParameter(Pose3(), "held")
    moving = replace(target, station_id=None, motion="epoch", carrier_from_target=PoseParameter(), epochs={})
    own = replace(camera, station_id=camera.camera_id, station_from_camera=still)
    alone = adjust(
        Survey(
            cameras=(own,), stations=(Station(camera.camera_id, "fixed", still),), targets=(moving,),
            image_blocks=blocks,
        )
    )  # fmt: skip
    epochs = tuple(dict.fromkeys(b.epoch_id for b in blocks))
    world = dict.fromkeys(epochs, f"camera {camera.camera_id}")
    return _sequence(alone, FrameRef("target", target_id), "carrier_from_target", epochs, world)


def _watched(survey: Survey, target: Target) -> list[tuple[Camera, tuple[ImageBlock, ...]]]:
    """The cameras that stand still on other stations than the target's, with their images of it."""
    still = {s.station_id for s in survey.stations if s.motion == "fixed"} - {target.station_id}
    cameras = {c.camera_id: c for c in survey.cameras if c.station_id in still}
    seen: dict[str, list[ImageBlock]] = {}
    for b in survey.image_blocks:
        if b.target_id == target.target_id and b.camera_id in cameras and len(b.uv):
            seen.setdefault(b.camera_id, []).append(b)
    return [(cameras[c], tuple(blocks)) for c, blocks in seen.items()]


def _before_targets(survey: Survey, camera: Camera) -> tuple[ImageBlock, ...]:
    """Images of targets, but for marker blocks that stations carry: those are eyes themselves."""
    carried = {t.target_id for t in survey.targets if t.station_id is not None}
    return tuple(
        b for b in survey.image_blocks
        if b.camera_id == camera.camera_id and b.target_id and b.target_id not in carried and len(b.uv)
    )  # fmt: skip


def _unmoved(survey: Survey, blocks: tuple[ImageBlock, ...]) -> dict[str, Target]:
    seen = {b.target_id for b in blocks}
    targets = {t.target_id: t for t in survey.targets if t.target_id in seen}
    moving = [t.target_id for t in targets.values() if t.motion == "epoch" or t.station_id is not None]
    if moving:
        raise SurveyError(
            f"target {moving[0]!r} moves between epochs; pairs from station motions need targets that stand still"
        )
    return targets


def _worlds(blocks: tuple[ImageBlock, ...], targets: Mapping[str, Target]) -> dict[str, str]:
    """World of each target: those seen together hang together."""
    world = {t: t for t in targets}
    held = [t for t, target in targets.items() if target.carrier_from_target.treatment == "held"]
    by_epoch: dict[str, list[str]] = {}
    for b in blocks:
        if b.target_id:
            by_epoch.setdefault(b.epoch_id, []).append(b.target_id)
    for group in [held, *by_epoch.values()]:
        for other in group[1:]:
            old, new = world[other], world[group[0]]
            world = {t: new if w == old else w for t, w in world.items()}
    rooms = {world[t] for t in held}
    return {t: ROOM if w in rooms else w for t, w in world.items()}


def _alone(
    camera: Camera, blocks: tuple[ImageBlock, ...], targets: Mapping[str, Target], world_of: Mapping[str, str]
) -> Survey:
    """The camera as a station of its own; the first target of each world stands at its origin."""
    free = PoseParameter()
    origins = {w for w in world_of.values() if w != ROOM}
    placed = []
    for target_id, target in targets.items():
        if world_of[target_id] == ROOM:
            placed.append(target)
            continue
        origin = world_of[target_id] in origins
        origins.discard(world_of[target_id])
        parameter = PoseParameter(Pose3(), "held") if origin else free
        placed.append(replace(target, carrier_from_target=parameter))
    own = replace(camera, station_id=camera.camera_id, station_from_camera=PoseParameter(Pose3(), "held"))
    return Survey(
        cameras=(own,), stations=(Station(camera.camera_id, "epoch"),), targets=tuple(placed), image_blocks=blocks
    )


def eye_sequences(survey: Survey | Adjustment, station_id: str | None = None) -> tuple[EyeSequence, ...]:
    """One sequence for each eye of a station (None: of the one station with two or more), cameras before blocks.

    Eyes are the station's cameras, and the marker blocks it carries that a camera of another station, which stands
    still, has seen. Raises SurveyError for an unknown station, and where it is not named and there are several.
    """
    found = survey.survey if isinstance(survey, Adjustment) else survey
    eyes: dict[str, list[FrameRef]] = {}
    for camera in found.cameras:
        eyes.setdefault(camera.station_id, []).append(FrameRef("camera", camera.camera_id))
    for target in found.targets:
        if target.station_id is not None and _watched(found, target):
            eyes.setdefault(target.station_id, []).append(FrameRef("target", target.target_id))
    if station_id is None:
        several = [s for s, of in eyes.items() if len(of) > 1]
        if not several:
            raise SurveyError("no station has two eyes (cameras, or marker blocks that another camera saw) for a pair")
        if len(several) != 1:
            raise SurveyError(f"stations with two or more eyes: {', '.join(several)}; name one of them")
        station_id = several[0]
    if station_id not in eyes:
        raise SurveyError(f"station {station_id!r} has no camera; those with cameras are {', '.join(eyes)}")
    return tuple(
        camera_sequence(found, eye.frame_id) if eye.kind == "camera" else target_sequence(found, eye.frame_id)
        for eye in eyes[station_id]
    )
