"""A target that was moved during the session."""

import numpy as np
from gtsam import Pose3, Rot3

from adjust.diagnosis.bodies.series import Step
from adjust.diagnosis.bodies.split import split_target
from adjust.diagnosis.hypothesis import Hypothesis, LeaveOut, Place
from adjust.model.result import Adjustment
from adjust.model.survey import Survey


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


def motion_text(motion: Pose3) -> str:
    """By how many millimetres and degrees, in its own axes."""
    shift = ", ".join(f"{1e3 * v:.2f}" for v in motion.translation())
    angle = np.degrees(np.linalg.norm(Rot3.Logmap(motion.rotation())))
    return f"by ({shift}) mm and {angle:.3f} deg in its own axes"
