"""A camera or a target that is another one from some epoch on: the survey with both, and a target that was moved."""

from collections.abc import Collection
from dataclasses import replace

from gtsam import Pose3

from adjust.diagnosis.bodies.series import Step
from adjust.diagnosis.hypothesis import Hypothesis, LeaveOut, Place, motion_text
from adjust.model.result import Adjustment
from adjust.model.rewriting import Fields, with_rows
from adjust.model.survey import Camera, PoseParameter, Survey, Target


def epochs_from(survey: Survey, field: str, owner_id: str, first: int) -> tuple[str, ...]:
    """The epochs of an owner's images from block ``first`` on that have none before it."""
    mine = [(i, b.epoch_id) for i, b in enumerate(survey.image_blocks) if getattr(b, field) == owner_id]
    earlier = {e for i, e in mine if i < first}
    return tuple(dict.fromkeys(e for i, e in mine if i >= first and e not in earlier))


def split_camera(survey: Survey, camera_id: str, epochs: Collection[str], new_id: str) -> Survey:
    """The images of a camera at some epochs as those of a camera of its own: lens and place on the station are free."""
    camera = survey.cameras_by_id[camera_id]
    pose = camera.station_from_camera
    own = PoseParameter(pose.value if pose.treatment == "free" else None)
    return _split(survey, "camera", camera_id, epochs, replace(camera, camera_id=new_id, station_from_camera=own))


def split_target(survey: Survey, target_id: str, epochs: Collection[str], new_id: str) -> Survey:
    """A target with a place of its own at some epochs."""
    target = survey.targets_by_id[target_id]
    other = replace(target, target_id=new_id, carrier_from_target=PoseParameter())
    return _split(survey, "target", target_id, epochs, other)


def _split(survey: Survey, kind: str, owner_id: str, epochs: Collection[str], other: Camera | Target) -> Survey:
    key, things = f"{kind}_id", f"{kind}s"
    name: Fields = {key: getattr(other, key)}
    both: Fields = {things: (*getattr(survey, things), other)}
    blocks = enumerate(survey.image_blocks)
    mine = {i: replace(b, **name) for i, b in blocks if getattr(b, key) == owner_id and b.epoch_id in epochs}
    return replace(with_rows(survey, "image_blocks", mine), **both)


def moved_target(survey: Survey, step: Step, epochs: tuple[str, ...]) -> Hypothesis:
    """The target at a place of its own from some epoch on."""
    target, new = step.name[1], f"{step.name[1]} from {epochs[0]}"
    images = dict.fromkeys(
        f"target:{b.camera_id}/{b.epoch_id}/{target}"
        for b in survey.image_blocks
        if b.target_id == target and b.epoch_id in epochs
    )
    cause = f"target {target} was moved before epoch {epochs[0]}"

    def told(result: Adjustment) -> str:
        found = (result.estimates.get(("carrier_from_target", name)) for name in (target, new))
        before, after = (None if e is None else e.value for e in found)
        if not isinstance(before, Pose3) or not isinstance(after, Pose3):  # its images were left out
            return ""
        return f"{cause} {motion_text(before.between(after))}"

    return Hypothesis(
        "target moved",
        cause,
        f"give it a name of its own from epoch {epochs[0]} on, or leave these {len(images)} images of it out",
        Place("target", (target,), epochs=epochs),
        split_target(survey, target, epochs, new),
        (LeaveOut(tuple(images)),),
        evidence=step.gain, parameters=7, looked_at=step.cuts,
    ).told(told)  # fmt: skip
