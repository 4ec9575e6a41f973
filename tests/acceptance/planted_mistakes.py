"""Mistakes of images, targets and bodies planted into simulated surveys, each in two kinds of survey and three sizes.

``python -m tests.acceptance.planted_mistakes`` prints the whole table: named first, among three, silent.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from gtsam import Pose3, Rot3

import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import Diagnosis, diagnose
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.survey import FloatArray, Survey
from survey.simulate import LabSize, full_lab, head_on_table, relay, stereo
from survey.simulate.scene import Scene, Truth

Plant = Callable[[Survey, Truth, float], Survey]
SMALL_LAB = LabSize(7, 4, 4, 4, 5)


@dataclass(frozen=True)
class Mistake:
    """name: of the cause that must be named; about: an id that must be named with it; three sizes, two kinds."""

    name: str
    about: str
    kinds: tuple[str, str]
    sizes: tuple[float, float, float]
    plant: Plant


def survey_of(kind: str, seed: int) -> tuple[Survey, Truth]:
    """A good survey of a kind, with its truth."""
    made: Mapping[str, Callable[[], tuple[Survey, Truth]]] = {
        "stereo": lambda: stereo(seed),
        "head": lambda: head_on_table(seed, n_table_epochs=9, n_free_epochs=5),
        "lab": lambda: full_lab(seed, size=SMALL_LAB),
        "relay": lambda: relay(seed),
    }
    return made[kind]()


def in_images(
    survey: Survey, chosen: Callable[[ImageBlock], bool], change: Callable[[ImageBlock], ImageBlock]
) -> Survey:
    """The survey with some image blocks changed."""
    return replace(survey, image_blocks=tuple(change(b) if chosen(b) else b for b in survey.image_blocks))


def later(survey: Survey, camera_id: str, share: float) -> set[str]:
    """The last epochs of a camera, this share of them."""
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks if b.camera_id == camera_id))
    return set(epochs[round((1.0 - share) * len(epochs)) :])


def camera_of(survey: Survey) -> str:
    """The camera that is spoilt: the second one, which is free in every kind."""
    return survey.cameras[1].camera_id


def mapped(A: FloatArray) -> Plant:
    """Image coordinates about the middle of the image times A, in the last images of the camera, a share of them."""

    def plant(survey: Survey, _: Truth, size: float) -> Survey:
        camera = camera_of(survey)
        width, height = next(c.image_size for c in survey.cameras if c.camera_id == camera)
        middle = np.array([width - 1.0, height - 1.0]) / 2.0
        epochs = later(survey, camera, size)
        out = middle if A[0, 0] else middle[::-1]
        return in_images(
            survey,
            lambda b: b.camera_id == camera and b.epoch_id in epochs,
            lambda b: replace(b, uv=(b.uv - middle) @ A.T + out, cov=A @ b.cov @ A.T),
        )

    return plant


def shifted(survey: Survey, _: Truth, size: float) -> Survey:
    """A crop of the sensor that was changed after two fifths of the images."""
    camera = camera_of(survey)
    epochs = later(survey, camera, 0.6)
    return in_images(
        survey,
        lambda b: b.camera_id == camera and b.epoch_id in epochs,
        lambda b: replace(b, uv=b.uv + (size, -size / 2)),
    )


def resized(survey: Survey, _: Truth, size: float) -> Survey:
    """Images stored at another size from some epoch on."""
    camera = camera_of(survey)
    epochs = later(survey, camera, 0.4)
    return in_images(
        survey,
        lambda b: b.camera_id == camera and b.epoch_id in epochs,
        lambda b: replace(b, uv=(b.uv + 0.5) * size - 0.5),
    )


def zoomed(survey: Survey, _: Truth, size: float) -> Survey:
    """The focus touched: the image grows about its middle."""
    camera = camera_of(survey)
    width, height = next(c.image_size for c in survey.cameras if c.camera_id == camera)
    middle, epochs = np.array([width - 1.0, height - 1.0]) / 2.0, later(survey, camera, 0.5)
    return in_images(
        survey,
        lambda b: b.camera_id == camera and b.epoch_id in epochs,
        lambda b: replace(b, uv=(b.uv - middle) * (1.0 + size) + middle),
    )


def target_geometry(target_of: Callable[[Survey], str], A: Callable[[float], FloatArray]) -> Plant:
    """Points of a target as its owner believes them: the true ones times A."""

    def plant(survey: Survey, _: Truth, size: float) -> Survey:
        name = target_of(survey)
        return replace(
            survey,
            targets=tuple(
                replace(t, x_in_target=t.x_in_target @ A(size).T) if t.target_id == name else t for t in survey.targets
            ),
        )

    return plant


def board_of(survey: Survey) -> str:
    """A board that other observations check: not the one that is held, where there are several."""
    return survey.targets[1 if len(survey.targets) > 1 else 0].target_id


def bent(survey: Survey, _: Truth, size: float) -> Survey:
    """The board is believed to sag by ``size`` mm, and is flat."""

    def sag(x: FloatArray) -> FloatArray:
        u = (x[:, 0] - x[:, 0].min()) / np.ptp(x[:, 0])
        return x + np.outer(4.0 * size / 1e3 * u * (1.0 - u), [0.0, 0.0, 1.0])

    name = board_of(survey)
    return replace(
        survey,
        targets=tuple(
            replace(t, x_in_target=sag(t.x_in_target)) if t.target_id == name else t for t in survey.targets
        ),
    )


def moved(name_of: Callable[[Survey], tuple[str, ...]], share: float) -> Plant:
    """A pose of the truth knocked by ``size`` mm and hundredths of a degree, before the last images were taken."""

    def plant(survey: Survey, truth: Truth, size: float) -> Survey:
        name = name_of(survey)
        pose = truth[name]
        knock = Pose3(
            Rot3.Rodrigues(np.radians(size / 100.0) * np.array([0.3, 1.0, -0.5])),
            size / 1e3 * np.array([1.0, 0.4, -0.3]),
        )
        before, after = Scene(survey, truth), Scene(survey, {**truth, name: pose * knock})
        field = "camera_id" if name[0] == "station_from_camera" else "target_id"
        mine = [b for b in survey.image_blocks if getattr(b, field) == name[1]]
        epochs = list(dict.fromkeys(b.epoch_id for b in mine))
        last = set(epochs[round((1.0 - share) * len(epochs)) :])
        return in_images(
            survey,
            lambda b: b.epoch_id in last and getattr(b, field) == name[1] and b.target_id is not None,
            lambda b: replace(b, uv=b.uv + _seen(after, b) - _seen(before, b)),
        )

    return plant


def _seen(scene: Scene, block: ImageBlock) -> FloatArray:
    points = scene.target_points(str(block.target_id), block.epoch_id)
    return scene.project(block.camera_id, block.epoch_id, points[block.point_idx])


def second_camera(survey: Survey) -> tuple[str, ...]:
    """The name of the pose of the camera that is spoilt."""
    return ("station_from_camera", camera_of(survey))


def second_target(survey: Survey) -> tuple[str, ...]:
    """The name of the pose of a target that stands in the world, a free one where there are several."""
    return ("carrier_from_target", board_of(survey))


def scaled(x: float, y: float = 1.0) -> FloatArray:
    """Of the coordinates of a target."""
    return np.diag([x, y, 1.0])


MIRROR, HALF, QUARTER = np.diag([-1.0, 1.0]), -np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])

MISTAKES = (
    Mistake("images mirrored", "camera", ("stereo", "head"), (1.0, 0.6, 0.3), mapped(MIRROR)),
    Mistake("images mirrored", "camera", ("relay", "lab"), (1.0, 0.6, 0.3), mapped(MIRROR)),
    Mistake("images turned", "camera", ("stereo", "head"), (0.6, 0.4, 0.2), mapped(HALF)),
    Mistake("images turned", "camera", ("stereo", "relay"), (0.6, 0.4, 0.2), mapped(QUARTER)),
    Mistake("images shifted", "camera", ("stereo", "head"), (12.0, 40.0, 160.0), shifted),
    Mistake("images resized", "camera", ("stereo", "head"), (0.5, 0.8, 1.5), resized),
    Mistake("focus touched", "camera", ("stereo", "head"), (0.004, 0.01, 0.03), zoomed),
    Mistake("camera moved", "camera", ("stereo", "head"), (2.0, 6.0, 20.0), moved(second_camera, 0.5)),
    Mistake("target moved", "target", ("relay", "head"), (3.0, 10.0, 40.0), moved(second_target, 0.4)),
    Mistake("target scaled", "target", ("relay", "lab"), (25.0 / 25.4, 0.8, 2.0),
            target_geometry(board_of, lambda s: scaled(s, s))),
    Mistake("target stretched", "target", ("stereo", "head"), (1.003, 1.01, 1.05),
            target_geometry(board_of, lambda s: scaled(s))),
    Mistake("target sheared", "target", ("stereo", "head"), (0.003, 0.01, 0.05),
            target_geometry(board_of, lambda s: np.array([[1.0, s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))),
    Mistake("target bent", "target", ("stereo", "head"), (0.5, 1.5, 5.0), bent),
)  # fmt: skip


def table() -> list[tuple[str, str, float, str]]:
    """(name, kind, size, outcome) of all mistakes; outcome: first, among three, another first, silent."""
    rows = []
    for mistake in MISTAKES:
        for kind in mistake.kinds:
            survey, truth = survey_of(kind, 3)
            about = camera_of(survey) if mistake.about == "camera" else board_of(survey)
            for size in mistake.sizes:
                found = diagnosed(mistake.plant(survey, truth, size)).candidates
                names = [(c.hypothesis.name, c.hypothesis.place.ids[0]) for c in found[:3]]
                place = names.index((mistake.name, about)) if (mistake.name, about) in names else -1
                outcome = "first" if place == 0 else "among three" if place > 0 else "another" if names else "silent"
                rows.append((mistake.name, kind, size, outcome))
                print(f"{mistake.name:18} {kind:8} {size:10.4g}  {outcome}", flush=True)
    return rows


def diagnosed(survey: Survey) -> Diagnosis:
    """The diagnosis of a survey, whether it can be adjusted or not."""
    try:
        return diagnose(Case(survey, adjust.solve(survey)))
    except SurveyError as error:
        return diagnose(Case(survey, None, error))


if __name__ == "__main__":
    outcomes = [row[3] for row in table()]
    print({name: outcomes.count(name) for name in dict.fromkeys(outcomes)})
