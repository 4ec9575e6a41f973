"""A survey in which a camera or a target is another one from some epoch on."""

from collections.abc import Iterable
from dataclasses import replace

from adjust.model.observations import ImageBlock
from adjust.model.survey import PoseParameter, Survey


def epochs_from(survey: Survey, field: str, owner_id: str, first: int) -> tuple[str, ...]:
    """The epochs of an owner's images from block ``first`` on that have none before it."""
    mine = [(i, b.epoch_id) for i, b in enumerate(survey.image_blocks) if getattr(b, field) == owner_id]
    earlier = {e for i, e in mine if i < first}
    return tuple(dict.fromkeys(e for i, e in mine if i >= first and e not in earlier))


def split_camera(survey: Survey, camera_id: str, epochs: Iterable[str], new_id: str) -> Survey:
    """The images of a camera at some epochs as those of a camera of its own: lens and place on the station are free."""
    camera = survey.cameras_by_id[camera_id]
    pose = camera.station_from_camera
    own = PoseParameter(pose.value if pose.treatment == "free" else None)
    other = replace(camera, camera_id=new_id, station_from_camera=own)
    return replace(
        survey, cameras=(*survey.cameras, other), image_blocks=_renamed(survey, "camera_id", camera_id, epochs, new_id)
    )


def split_target(survey: Survey, target_id: str, epochs: Iterable[str], new_id: str) -> Survey:
    """A target with a place of its own at some epochs."""
    target = survey.targets_by_id[target_id]
    other = replace(target, target_id=new_id, carrier_from_target=PoseParameter())
    return replace(
        survey, targets=(*survey.targets, other), image_blocks=_renamed(survey, "target_id", target_id, epochs, new_id)
    )


def _renamed(survey: Survey, field: str, owner_id: str, epochs: Iterable[str], new_id: str) -> tuple[ImageBlock, ...]:
    chosen = set(epochs)
    return tuple(
        b if getattr(b, field) != owner_id or b.epoch_id not in chosen
        else replace(b, camera_id=new_id) if field == "camera_id" else replace(b, target_id=new_id)
        for b in survey.image_blocks
    )  # fmt: skip
