"""Image points that are all shifted alike: the centre of the first pixel at (1/2, 1/2), another region of the sensor.

Shows where something else than the lens tells the principal point: a lens that is held, or one of several detectors.
Interlaced images show other moments in even and in odd rows: points of a few pixels alternate with their row.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import Effect, Shifts, of_shifts, shifted_back
from adjust.diagnosis.hypothesis import ChangeColumns, Hypothesis, Place
from adjust.diagnosis.prediction import Linear
from adjust.model.observations import ImageBlock
from adjust.model.rewriting import Fields
from adjust.model.survey import FloatArray, Survey

_HALF = 0.5
_NEAR = 0.05


def pixels(case: Case, linear: Linear) -> Iterator[Effect]:
    """A shift of all images of a camera, of all of a target or of the points of the world, of a group."""
    blocks = case.survey.image_blocks
    for kind, field in (("camera", "camera_id"), ("target", "target_id"), ("group", "group")):
        owners = list(dict.fromkeys(getattr(b, field) for b in blocks))
        for owner in owners if kind == "camera" or len(owners) > 1 else ():
            yield _of(case, linear, kind, field, owner)
    for camera in dict.fromkeys(b.camera_id for b in blocks):
        yield _interlaced(case, linear, camera)


def _of(case: Case, linear: Linear, kind: str, field: str, owner: str | None) -> Effect:
    name = owner or "points"
    what = f"{kind} {name}" if owner else "the points of the world"

    def shifts(b: ImageBlock) -> FloatArray | None:
        return np.broadcast_to(np.eye(2), (len(b.uv), 2, 2)) if getattr(b, field) == owner else None

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        by = ", ".join(f"{t:+.2f} +- {s:.2f}" for t, s in zip(theta, sigmas, strict=True))
        return f"the image points of {what} are shifted by ({by}) px: another region of the sensor, or another origin"

    def known(theta: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, Fields] | None:
        half = np.full(2, np.copysign(_HALF, theta[0]))  # where two detectors differ, either may be meant
        if not (np.abs(theta - half) < _NEAR + 4.0 * sigmas).all():
            return None
        centre = "(0.5, 0.5)" if theta[0] > 0.0 else "(-0.5, -0.5)"
        cause = (f"the image points of {what} count pixels from the corner of the image: the centre of its first pixel "
                 f"is {centre}, here it is (0, 0)")  # fmt: skip
        return half, {"name": "pixel origin", "cause": cause, "parameters": 1,
                      "edits": _edits(case.survey, field, owner, half)}  # fmt: skip

    hypothesis = Hypothesis(
        "images shifted", "", "subtract that from u_px and v_px, or give the region of the sensor that was read",
        Place(kind, (name,), "u_px"), case.survey, (), 1.0, 1,
    )  # fmt: skip
    return replace(_shifted(case.survey, linear, hypothesis, shifts, said), known=known)


def _shifted(
    survey: Survey, linear: Linear, hypothesis: Hypothesis, shifts: Callable[[ImageBlock], FloatArray | None],
    said: Callable[[FloatArray, FloatArray], str],
) -> Effect:  # fmt: skip
    """shifts: (n, 2, 2) of the points of a block, as it was observed; None of others."""

    def of(blocks: Sequence[ImageBlock]) -> Shifts:
        return {i: D for i, b in enumerate(blocks) if (D := shifts(b)) is not None}

    first = of(survey.image_blocks)
    return Effect(
        hypothesis, of_shifts(linear, of(linear.result.survey.image_blocks)),
        lambda at: of_shifts(at, {i: first[i] for i in of(at.result.survey.image_blocks)}),
        lambda _, theta: shifted_back(survey, first, theta), said,
    )  # fmt: skip


def _interlaced(case: Case, linear: Linear, camera: str) -> Effect:
    """A shift that has another sign in the next row: its cosine, as of a point that one row shows most of."""

    def shifts(b: ImageBlock) -> FloatArray | None:
        return np.cos(np.pi * b.uv[:, 1])[:, None, None] * np.eye(2) if b.camera_id == camera else None

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        (u, v), (su, sv) = theta, sigmas
        return (f"camera {camera}: image points at even rows are shifted against those at odd ones by twice "
                f"({u:+.2f} +- {su:.2f}, {v:+.2f} +- {sv:.2f}) px: as of two moments")  # fmt: skip

    hypothesis = Hypothesis(
        "interlaced", "", "take every second row of its images, read apart, or whole images, and detect them again",
        Place("camera", (camera,)), case.survey, (), 1.0, 1,
    )  # fmt: skip
    return _shifted(case.survey, linear, hypothesis, shifts, said)


def _edits(survey: Survey, field: str, owner: str | None, by: FloatArray) -> tuple[ChangeColumns, ...]:
    if field == "group":
        return ()
    epochs = tuple(dict.fromkeys(b.epoch_id for b in survey.image_blocks if getattr(b, field) == owner))
    where = {field: (owner or "",), "epoch_id": epochs}
    return (ChangeColumns("image_points", ("u_px", "v_px"), np.eye(2), -by, where),)
