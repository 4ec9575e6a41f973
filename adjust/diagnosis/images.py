"""Images turned or mirrored as a whole, as the camera did not see them. Changes from some epoch on begin in ``bodies``.

Mirrored ones show a flat target from behind, from where nobody could have read it. Of a half turn where nothing else
contradicts their lens does, which is not symmetric.
"""

from collections.abc import Container, Iterator
from dataclasses import replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from adjust.diagnosis.alone import squares_alone
from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import ChangeColumns, Edit, Hypothesis, Place
from adjust.model.frozen import frozen
from adjust.model.names import numbered
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2


class _Seen(Protocol):
    """A dataclass of image points: blocks of a survey, spots."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def uv(self) -> FloatArray:
        """(n, 2) px."""
        ...

    @property
    def cov(self) -> FloatArray:
        """(n, 2, 2) px^2."""
        ...


Seen = TypeVar("Seen", bound=_Seen)
_FLAT, _LEAST = 0.02, 2
_ALPHA, _HALF = 1e-6, 180


@frozen(eq=False)
class ImageMap:
    """``matrix`` (2, 2) about the middle of the image, of entries 0, 1 and -1; a quarter turn exchanges its sides."""

    text: str
    matrix: FloatArray

    def offset(self, image_size: tuple[int, int]) -> FloatArray:
        """(2,) px: uv of what became of an image of this size is mapped back to matrix @ uv + offset."""
        middle = (np.array(image_size, dtype=float) - 1.0) / 2.0
        return np.asarray(middle - self.matrix @ np.abs(self.matrix) @ middle)

    def back(self, seen: Seen, image_size: tuple[int, int]) -> Seen:
        """Image points mapped back, with their covariances."""
        A = self.matrix
        return replace(seen, uv=seen.uv @ A.T + self.offset(image_size), cov=A @ seen.cov @ A.T)


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
    size, blocks = survey.cameras_by_id[camera_id].image_size, enumerate(survey.image_blocks)
    mine = {i: how.back(b, size) for i, b in blocks if b.camera_id == camera_id and b.epoch_id in epochs}
    return with_rows(survey, "image_blocks", mine)


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
    """The same as a change of the rows of ``image_points.csv``, by which sigmas are changed too."""
    offset = how.offset(survey.cameras_by_id[camera_id].image_size)
    where = {"camera_id": (camera_id,), "epoch_id": epochs}
    return (ChangeColumns("image_points", ("u_px", "v_px"), how.matrix, offset, where),)


def mirrored_images(case: Case) -> Iterator[Hypothesis]:
    """One hypothesis for every camera, and for either way of mirroring where only some of its images are concerned.

    The points of a flat target lie in its x and y, z pointing away from who looks at it (OpenCV's boards): in a pose
    that fits a mirrored image it is seen from its back.
    """
    behind: dict[str, list[int]] = {}
    seen: dict[str, int] = {}
    for i, view in case.views.items():
        camera = case.survey.image_blocks[i].camera_id
        if is_flat(view.x):
            seen[camera] = seen.get(camera, 0) + 1
            if from_behind(view.poses[0], view.x):
                behind.setdefault(camera, []).append(i)
    for camera, blocks in behind.items():
        if len(blocks) < _LEAST:
            continue
        whole = len(blocks) == seen[camera]
        for how in MIRRORED[:1] if whole else MIRRORED:
            yield _mirrored(case, camera, blocks, whole, how)


def _mirrored(case: Case, camera: str, blocks: list[int], whole: bool, how: ImageMap) -> Hypothesis:
    survey, bad = case.survey, set(blocks)
    mine = [i for i, b in enumerate(survey.image_blocks) if b.camera_id == camera]
    first = min(blocks)
    # images of other things than flat targets are as those around them
    onwards = all(i in bad for i in mine if i >= first and i in case.views and is_flat(case.views[i].x))
    chosen = [i for i in mine if whole or i in bad or (onwards and i >= first)]
    epochs = tuple(dict.fromkeys(survey.image_blocks[i].epoch_id for i in chosen))
    which = "all its images" if whole else f"{len(epochs)} of its {len(mine)} images ({epochs[0]} ... {epochs[-1]})"
    return Hypothesis(
        "images mirrored",
        f"camera {camera}: {which} are mirrored, {how.text}: they show the front of flat targets from behind",
        f"mirror the images of camera {camera} back and detect them again",
        Place("camera", (camera,), epochs=() if whole else epochs),
        mapped(case.survey, camera, set(epochs), how),
        edits_of(case.survey, camera, epochs, how),
        evidence=1e6 * len(blocks),
    )


def is_flat(x: FloatArray) -> bool:
    """Whether points (n, 3) of a target lie in its x and y."""
    s = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    across = float(np.ptp(x[:, :2], axis=0).max())
    return len(x) >= 4 and s[2] < _FLAT * s[1] and float(np.ptp(x[:, 2])) < _FLAT * across


def from_behind(camera_from_target: FloatArray, x: FloatArray) -> bool:
    """Whether a camera (4, 4) looks at points (n, 3) of a flat target against its z: at its back."""
    R, t = camera_from_target[:3, :3], camera_from_target[:3, 3]
    return float(R[:, 2] @ (R @ x.mean(axis=0) + t)) < 0.0


def turned_alone(case: Case) -> Iterator[Hypothesis]:
    """By camera, the last images that fit their own best poses better once they are turned back, with its lens."""
    if case.values is None:
        return
    lenses = {n[1]: np.asarray(v) for n, v in case.values.items() if n[0] == "lens"}
    alone = replace(case.survey, image_blocks=tuple(b for b in case.survey.image_blocks if b.target_id is not None))
    every, back = {b.epoch_id for b in alone.image_blocks}, alone
    for camera in lenses:
        back = mapped(back, camera, every, TURNED[_HALF])
    now, then = squares_alone(alone, lenses), squares_alone(back, lenses)
    for camera in lenses:
        rows = [i for i, b in enumerate(alone.image_blocks) if b.camera_id == camera]
        epochs, at = numbered(alone.image_blocks[i].epoch_id for i in rows)
        gain = np.bincount(at, weights=now[rows] - then[rows], minlength=len(epochs))
        since = np.cumsum(gain[::-1])[::-1][1:]
        if len(since) and since.max() > float(chi2.isf(sidak(_ALPHA, len(since)), 1)):
            later = tuple(epochs[int(np.argmax(since)) + 1 :])
            ratio = 1.0 + float(since.max() / max(then[rows][-len(later) :].sum(), 1.0))
            yield turned(case.survey, camera, later, TURNED[_HALF], ratio, len(since))
