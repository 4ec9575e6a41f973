"""Which lens navigated images have: that of the images which calibrate it, where nothing changed in between."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from adjust.model.survey import Camera, ImageCrop, Survey


@frozen(eq=False)
class LensesTaken:
    """By camera whose lens changes: at which epoch it is taken, and the crop that is given for the navigated images."""

    epochs: Mapping[str, str]
    crops: Mapping[str, ImageCrop]


def with_images_left(before: Survey, after: Survey) -> Survey:
    """``after``, whose lenses change at the first image that is left of each block; blocks without any are none."""
    return replace(after, cameras=tuple(_with_begins(c, _epochs(before, c), _epochs(after, c)) for c in after.cameras))


def _with_begins(camera: Camera, before: Sequence[str], after: Sequence[str]) -> Camera:
    lens = camera.lens

    def begins(given: Iterable[str]) -> dict[str, str]:
        """By the first image that is left since a beginning the last beginning that it is of."""
        out = {}
        for epoch in given:
            if epoch not in before:
                out[epoch] = epoch  # a wrong name, which the adjustment tells
            elif left := [e for e in before[before.index(epoch) :] if e in after]:
                out[left[0]] = epoch
        return out

    drift = lens.drift
    if drift is not None and drift.begins:
        kept = begins(drift.begins)
        drift = replace(drift, begins=tuple(kept)) if kept else None
    crops = {epoch: lens.crops[of] for epoch, of in begins(lens.crops).items()}
    return camera if not (lens.drift or lens.crops) else replace(camera, lens=replace(lens, drift=drift, crops=crops))


def lenses_taken(project: Survey, calibrating: Survey, station_id: str, epochs: Sequence[str]) -> LensesTaken:
    """Of the cameras of a station, for the navigated epochs; the images are in the order of their names.

    Raises SurveyError where no lens is calibrated that they all have.
    """
    at, crops = dict[str, str](), dict[str, ImageCrop | None]()
    for camera in project.cameras:
        images = _epochs(calibrating, camera)
        if camera.station_id != station_id or not images or not (camera.lens.drift or camera.lens.crops):
            continue
        before = [e for e in images if natural_key(e) <= min(map(natural_key, epochs))]
        at[camera.camera_id] = taken = before[-1] if before else images[0]
        for epoch in epochs:
            low, high = sorted((taken, epoch), key=natural_key)
            since = [b for b in (*(camera.lens.drift.begins if camera.lens.drift else ()), *camera.lens.crops)
                     if natural_key(low) < natural_key(b) <= natural_key(high)]  # fmt: skip
            given = camera.lens.crops.get(since[0]) if len(since) == 1 and high == epoch else None
            was_whole = not any(natural_key(b) <= natural_key(taken) for b in camera.lens.crops)
            if since and (given is None or given.parameters.free or not was_whole):
                raise SurveyError(
                    f"camera {camera.camera_id!r}: its lens changes at epoch {since[0]!r}, between epoch {taken!r}, "
                    f"which calibrates it, and {epoch!r}; show it a target since then, or navigate with --epochs what "
                    "one lens has seen"
                )
            if crops.setdefault(camera.camera_id, given) is not given:
                raise SurveyError(f"camera {camera.camera_id!r}: its images are cropped from {epoch!r} on; navigate "
                                  "with --epochs those before and those after by themselves")  # fmt: skip
    return LensesTaken(at, {c: crop for c, crop in crops.items() if crop is not None})


def _epochs(survey: Survey, camera: Camera) -> list[str]:
    return list(dict.fromkeys(b.epoch_id for b in survey.image_blocks if b.camera_id == camera.camera_id))
