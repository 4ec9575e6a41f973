"""Cameras that do not even fit by themselves, where the values of all are lost: nothing else tells so clearly."""

from collections.abc import Iterator

from adjust.diagnosis.bodies.cameras import changed_camera
from adjust.diagnosis.bodies.lens_steps import by_themselves, lens_steps
from adjust.diagnosis.bodies.split import epochs_from
from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis


def hypotheses(case: Case) -> Iterator[Hypothesis]:
    """Those whose images two lenses explain; none where scores at values that are near say what changed."""
    if by_themselves(case):
        for step in lens_steps(case):
            epochs = epochs_from(case.survey, "camera_id", step.name[1], step.first)
            if epochs:
                yield changed_camera(case.survey, step, epochs)
