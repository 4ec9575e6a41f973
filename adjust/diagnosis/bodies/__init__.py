"""Bodies taken for rigid that are not: a camera or target moved, a focus touched, an image cropped or turned later."""

from collections.abc import Iterator
from dataclasses import replace

from adjust.diagnosis.bodies.cameras import changed_camera, turned_images
from adjust.diagnosis.bodies.lens_steps import by_themselves, lens_steps
from adjust.diagnosis.bodies.series import Step, series_of, step_of
from adjust.diagnosis.bodies.split import epochs_from, moved_target
from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.prediction import adjusted_values

_MOST, _FAINT = 4, 5.0


def lost_cameras(case: Case) -> Iterator[Hypothesis]:
    """Cameras that do not even fit by themselves, where the values of all are lost: nothing else tells so clearly.

    Those whose images two lenses explain; none where scores at values that are near say what changed.
    """
    for step in lens_steps(case) if by_themselves(case) else ():
        if epochs := epochs_from(case.survey, "camera_id", step.name[1], step.first):
            yield changed_camera(case.survey, step, epochs)


def changed_bodies(case: Case) -> Iterator[Hypothesis]:
    """Cameras and targets that are others from some epoch on, where single images show a step."""
    found: dict[tuple[str, int], Step] = {}
    for step in _steps(case):  # the first of a place tells the motion too
        found.setdefault((step.name[1], step.first), step)
    for step in sorted(found.values(), key=lambda s: -s.gain)[:_MOST]:
        yield from _of(case, step)


def _steps(case: Case) -> Iterator[Step]:
    alone, found = [] if by_themselves(case) else list(lens_steps(case)), []  # else they were looked at before
    if case.result is not None:
        every = series_of(case, adjusted_values(case.result))
        found = [step for series in every if (step := step_of(series)) is not None]
        if case.is_spoilt:  # what single images say against values that are far off is no measure
            found = [replace(step, gain=min(step.gain, _FAINT)) for step in found]
    if not found:
        for owner, values in (*case.without_each("target_id"), *case.without_each("camera_id")):
            steps = [step_of(s) for s in series_of(case, values) if s.name[1] == owner]
            found += [s for s in steps if s is not None]
    yield from found
    yield from alone


def _of(case: Case, step: Step) -> Iterator[Hypothesis]:
    is_camera = step.name[0] == "station_from_camera"
    epochs = epochs_from(case.survey, "camera_id" if is_camera else "target_id", step.name[1], step.first)
    if epochs and is_camera:
        yield from turned_images(case.survey, step, epochs)
    if epochs:
        yield changed_camera(case.survey, step, epochs) if is_camera else moved_target(case.survey, step, epochs)
