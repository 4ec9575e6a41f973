"""Images turned or mirrored as a whole, as maps of image coordinates and of the rows of a table."""

from collections.abc import Container
from dataclasses import dataclass, replace

import numpy as np

from adjust.diagnosis.hypothesis import ChangeColumns, Edit, Hypothesis, Place
from adjust.model.survey import FloatArray, Survey


@dataclass(frozen=True, eq=False)
class ImageMap:
    """``matrix`` (2, 2) about the middle of the image, of entries 0, 1 and -1; a quarter turn exchanges its sides."""

    text: str
    matrix: FloatArray

    def offset(self, image_size: tuple[int, int]) -> FloatArray:
        """(2,) px: uv of what became of an image of this size is mapped back to matrix @ uv + offset."""
        middle = (np.array(image_size, dtype=float) - 1.0) / 2.0
        return np.asarray(middle - self.matrix @ np.abs(self.matrix) @ middle)


MIRRORED = (
    ImageMap("left and right exchanged", np.diag([-1.0, 1.0])),
    ImageMap("top and bottom exchanged", np.diag([1.0, -1.0])),
)
TURNED = {
    90: ImageMap("a quarter turn clockwise", np.array([[0.0, -1.0], [1.0, 0.0]])),
    180: ImageMap("half a turn", -np.eye(2)),
    270: ImageMap("a quarter turn counter-clockwise", np.array([[0.0, 1.0], [-1.0, 0.0]])),
}


def mapped(survey: Survey, camera_id: str, epochs: Container[str], how: ImageMap) -> Survey:
    """The survey with the image coordinates of a camera mapped at some epochs."""
    A = how.matrix
    b = how.offset(_size(survey, camera_id))
    blocks = tuple(
        replace(x, uv=x.uv @ A.T + b, cov=A @ x.cov @ A.T) if x.camera_id == camera_id and x.epoch_id in epochs else x
        for x in survey.image_blocks
    )
    return replace(survey, image_blocks=blocks)


def turned(
    survey: Survey, camera: str, epochs: tuple[str, ...], how: ImageMap, evidence: float, looked_at: int
) -> Hypothesis:
    """The images of a camera at some epochs turned back."""
    return Hypothesis(
        "images turned", f"camera {camera}: its images are turned from epoch {epochs[0]} on",
        f"turn them by {how.text}, and detect them again", Place("camera", (camera,), epochs=epochs),
        mapped(survey, camera, set(epochs), how), edits_of(survey, camera, epochs, how), evidence, looked_at=looked_at,
    )  # fmt: skip


def edits_of(survey: Survey, camera_id: str, epochs: tuple[str, ...], how: ImageMap) -> tuple[Edit, ...]:
    """The same as a change of the rows of ``image_points.csv``."""
    where = {"camera_id": (camera_id,), "epoch_id": epochs}
    return (ChangeColumns("image_points", ("u_px", "v_px"), how.matrix, how.offset(_size(survey, camera_id)), where),)


def _size(survey: Survey, camera_id: str) -> tuple[int, int]:
    return survey.cameras_by_id[camera_id].image_size
