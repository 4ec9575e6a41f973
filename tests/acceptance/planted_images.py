"""Mistakes of images, bodies, targets and clocks, planted into surveys with cameras."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.observations import ImageBlock
from adjust.model.survey import FloatArray, Survey
from survey.simulate.scene import Scene, Truth
from tests.acceptance.planted_surveys import board_path, hand_path, seen, sweep_angles

Plant = Callable[[Survey, Truth, float], Survey]


@dataclass(frozen=True)
class Mistake:
    """name: of the cause that must be named; about: an id that must be named with it, "" for any; sizes by kinds.

    alike: other names, and other ids, of the same, where observations cannot tell them apart. title: where several have
    a name.
    """

    name: str
    about: Callable[[Survey], str]
    kinds: tuple[str, ...]
    sizes: tuple[float, ...]
    plant: Plant
    alike: tuple[str, ...] = ()
    title: str = ""


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
        targets=tuple(replace(t, x_in_target=sag(t.x_in_target)) if t.target_id == name else t for t in survey.targets),
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
            lambda b: replace(b, uv=b.uv + seen(after, b) - seen(before, b)),
        )

    return plant


def second_camera(survey: Survey) -> tuple[str, ...]:
    """The name of the pose of the camera that is spoilt."""
    return ("station_from_camera", camera_of(survey))


def second_target(survey: Survey) -> tuple[str, ...]:
    """The name of the pose of a target that stands in the world, a free one where there are several."""
    return ("carrier_from_target", board_of(survey))


def scaled(x: float, y: float = 1.0) -> FloatArray:
    """Of the coordinates of a target."""
    return np.diag([x, y, 1.0])


def anything(_: Survey) -> str:
    """Whatever is named with it."""
    return ""


def of(name: str) -> Callable[[Survey], str]:
    """This id."""
    return lambda _: name


def copied(survey: Survey, _: Truth, size: float) -> Survey:
    """The second camera's last images are those of the first one, stored under its name."""
    first, camera = (c.camera_id for c in survey.cameras[:2])
    epochs = later(survey, camera, size)
    other = {(b.epoch_id, b.target_id): b for b in survey.image_blocks if b.camera_id == first}
    return in_images(survey, lambda b: b.camera_id == camera and b.epoch_id in epochs,
                     lambda b: replace(other[b.epoch_id, b.target_id], camera_id=camera))  # fmt: skip


def exchanged(survey: Survey, _: Truth, size: float) -> Survey:
    """The two cameras have each other's last images."""
    one, two = (c.camera_id for c in survey.cameras[:2])
    epochs, other = later(survey, two, size), {one: two, two: one}
    return in_images(survey, lambda b: b.epoch_id in epochs, lambda b: replace(b, camera_id=other[b.camera_id]))


def drifting(survey: Survey, _: Truth, size: float) -> Survey:
    """The lens of the camera warms up: its image grows by ``size`` per thousand over the session."""
    camera = camera_of(survey)
    width, height = next(c.image_size for c in survey.cameras if c.camera_id == camera)
    middle = np.array([width - 1.0, height - 1.0]) / 2.0
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks if b.camera_id == camera))
    share = {e: i / (len(epochs) - 1) for i, e in enumerate(epochs)}
    return in_images(survey, lambda b: b.camera_id == camera,
                     lambda b: replace(b, uv=b.uv + 1e-3 * size * share[b.epoch_id] * (b.uv - middle)))  # fmt: skip


def origin(of_what: Callable[[Survey, ImageBlock], bool]) -> Plant:
    """Pixels are counted from the corner of the first one, in some images; ``size`` px."""
    return lambda survey, _, size: in_images(survey, lambda b: of_what(survey, b), lambda b: replace(b, uv=b.uv + size))


def interlaced(survey: Survey, _: Truth, size: float) -> Survey:
    """Points of the camera that lie on odd rows are taken from a half image of another moment, ``size`` px away."""
    camera, by = camera_of(survey), size * np.array([0.5, 0.1])
    return in_images(survey, lambda b: b.camera_id == camera,
                     lambda b: replace(b, uv=b.uv + np.cos(np.pi * b.uv[:, 1])[:, None] * by))  # fmt: skip


def of_points(_: Survey, block: ImageBlock) -> bool:
    """Whether it shows points of the world."""
    return block.target_id is None


def _board_at(survey: Survey, truth: Truth, camera: str, offset: Callable[[int, FloatArray], FloatArray]) -> Survey:
    """What a camera sees of the board on its path when every point is taken at another time; offset: (n,) intervals."""
    scene = Scene(survey, truth)
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks))
    points = survey.targets[0].x_in_target

    def at(block: ImageBlock) -> ImageBlock:
        i, now = epochs.index(block.epoch_id), seen(scene, block)
        out = now.copy()
        for k, (row, dt) in enumerate(zip(block.point_idx, offset(i, now), strict=True)):
            x = board_path(i + dt).matrix()
            out[k] = scene.project(camera, block.epoch_id, (x[:3, :3] @ points[row] + x[:3, 3])[None])[0]
        return replace(block, uv=block.uv + out - now)

    return in_images(survey, lambda b: b.camera_id == camera, at)


def late(survey: Survey, truth: Truth, size: float) -> Survey:
    """The second camera is late by ``size`` intervals."""
    return _board_at(survey, truth, camera_of(survey), lambda _, uv: np.full(len(uv), size))


def drifting_clock(survey: Survey, truth: Truth, size: float) -> Survey:
    """The second camera is ever later, ``size`` intervals at the end."""
    n = len({b.epoch_id for b in survey.image_blocks})
    return _board_at(survey, truth, camera_of(survey), lambda i, uv: np.full(len(uv), size * (i / (n - 1) - 0.5)))


def rolling(survey: Survey, truth: Truth, size: float) -> Survey:
    """The second camera reads its rows one after the other, within ``size`` intervals."""
    camera = camera_of(survey)
    height = next(c.image_size[1] for c in survey.cameras if c.camera_id == camera)
    return _board_at(survey, truth, camera, lambda _, uv: size * ((uv[:, 1] + 0.5) / height - 0.5))


def table_late(drift: bool) -> Plant:
    """The table is read ``size`` intervals after the images; or ever later, so much at the end."""

    def plant(survey: Survey, truth: Truth, size: float) -> Survey:
        n = len(survey.table_readings)
        middle = np.asarray(truth["table_angles", "turntable", survey.table_readings[0].epoch_id])
        middle = middle - (sweep_angles(0, middle) - middle)
        dt = [size * (i / (n - 1) - 0.5) if drift else size for i in range(n)]
        return replace(survey, table_readings=tuple(
            replace(r, angles=r.angles + sweep_angles(i + dt[i], middle) - sweep_angles(i, middle))
            for i, r in enumerate(survey.table_readings)))  # fmt: skip

    return plant


def robot_late(drift: bool) -> Plant:
    """The robot's poses are read ``size`` intervals after the images; or ever later."""

    def plant(survey: Survey, truth: Truth, size: float) -> Survey:
        first, n = truth["world_from_station", "hand", "p01"], len(survey.pairs)
        eye = truth["station_from_camera", "C"]

        def pose(t: float) -> Pose3:
            on_hand = survey.cameras[0].station_id == "hand"
            return hand_path(t) if on_hand else eye * (hand_path(t) * (first.inverse() * eye)).inverse() * first

        new = []
        for i, p in enumerate(survey.pairs):
            dt = size * (i / (n - 1) - 0.5) if drift else size
            off = pose(i).inverse() * pose(i + dt)
            new.append(replace(p, b_from_a=off.inverse() * p.b_from_a))
        return replace(survey, pairs=tuple(new))

    return plant


def geared(survey: Survey, _: Truth, size: float) -> Survey:
    """Readings of the first axis are too small by ``size``."""
    factor = np.array([1.0 - size, 1.0])
    return replace(survey, table_readings=tuple(replace(r, angles=factor * r.angles) for r in survey.table_readings))


def still(what: str) -> Plant:
    """``motion = "epoch"`` forgotten for a target or a station."""

    def plant(survey: Survey, _: Truth, size: float) -> Survey:
        epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks))[: int(size)]
        survey = replace(survey, image_blocks=tuple(b for b in survey.image_blocks if b.epoch_id in epochs))
        if what == "target":
            return replace(survey, targets=tuple(replace(t, motion="fixed") for t in survey.targets))
        return replace(survey, stations=tuple(replace(s, motion="fixed") for s in survey.stations))

    return plant


def bumped(name: tuple[str, ...], share: float, chosen: Callable[[Survey, ImageBlock], bool]) -> Plant:
    """A pose of the truth knocked by ``size`` mm and hundredths of a degree for the last share of these images."""

    def plant(survey: Survey, truth: Truth, size: float) -> Survey:
        knock = Pose3(Rot3.Rodrigues(np.radians(size / 100.0) * np.array([0.3, 1.0, -0.5])),
                      size / 1e3 * np.array([1.0, 0.4, -0.3]))  # fmt: skip
        before, after = Scene(survey, truth), Scene(survey, {**truth, name: truth[name] * knock})
        epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks if chosen(survey, b)))
        last = set(epochs[round((1.0 - share) * len(epochs)) :])
        return in_images(survey, lambda b: b.epoch_id in last and chosen(survey, b),
                         lambda b: replace(b, uv=b.uv + seen(after, b) - seen(before, b)))  # fmt: skip

    return plant


def on_table(survey: Survey, block: ImageBlock) -> bool:
    """Whether it was taken from the table."""
    return block.epoch_id in {r.epoch_id for r in survey.table_readings}


def of_post(_: Survey, block: ImageBlock) -> bool:
    """Whether it was taken from the second tripod."""
    return block.camera_id == "right"


def point_moved(survey: Survey, truth: Truth, size: float) -> Survey:
    """The beacon that is seen most was moved by ``size`` mm half way through."""
    name = beacon(survey)
    x = np.asarray(truth["point", name]) + size / 1e3 * np.array([0.6, -0.5, 0.6])
    before, after = Scene(survey, truth), Scene(survey, {**truth, ("point", name): x})
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks if b.target_id is None))
    last = set(epochs[len(epochs) // 2 :])
    return in_images(survey, lambda b: b.target_id is None and b.epoch_id in last,
                     lambda b: replace(b, uv=b.uv + seen(after, b) - seen(before, b)))  # fmt: skip


def _seen_most(survey: Survey) -> list[str]:
    count: dict[int, int] = {}
    for b in survey.image_blocks:
        for i in b.point_idx if b.target_id is None else ():
            count[int(i)] = count.get(int(i), 0) + 1
    return [survey.points[i].point_id for i in sorted(count, key=lambda i: (-count[i], i))]


def beacon(survey: Survey) -> str:
    """The beacon that is seen most."""
    return _seen_most(survey)[0]


def beacons_exchanged(survey: Survey, _: Truth, size: float) -> Survey:
    """The two beacons that are seen most are called by each other's names in the last share of the images."""
    ids = [p.point_id for p in survey.points]
    a, b = (ids.index(n) for n in _seen_most(survey)[:2])
    other = np.arange(len(ids))
    other[[a, b]] = b, a
    epochs = list(dict.fromkeys(x.epoch_id for x in survey.image_blocks if x.target_id is None))
    last = set(epochs[round((1.0 - size) * len(epochs)) :])
    return in_images(survey, lambda x: x.target_id is None and x.epoch_id in last,
                     lambda x: replace(x, point_idx=other[x.point_idx]))  # fmt: skip


def targets_exchanged(survey: Survey, _: Truth, size: float) -> Survey:
    """Plates G2 and G3 are called by each other's names in the last share of the images."""
    other = {"G2": "G3", "G3": "G2"}
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks if b.target_id in other))
    last = set(epochs[round((1.0 - size) * len(epochs)) :])
    return in_images(survey, lambda b: b.target_id in other and b.epoch_id in last,
                     lambda b: replace(b, target_id=other[str(b.target_id)]))  # fmt: skip


def counted(survey: Survey, _: Truth, size: float) -> Survey:
    """The points of a board, in the order of its rows, are numbered for a board with ``size`` more columns."""
    name = board_of(survey)
    target = next(t for t in survey.targets if t.target_id == name)
    square = np.linalg.norm(target.x_in_target[1] - target.x_in_target[0])
    columns = round(np.ptp(target.x_in_target[:, 0]) / square) + 1
    wrong = columns + int(size) if size else len(target.point_ids) // columns
    i = np.arange(len(target.point_ids))
    x = square * np.column_stack([i % wrong, i // wrong, 0 * i])
    return replace(survey, targets=tuple(replace(t, x_in_target=x) if t is target else t for t in survey.targets))


def shifted_epochs(survey: Survey, _: Truth, size: float) -> Survey:
    """From the middle on the second camera's images are called ``size`` epochs later; a negative size: throughout."""
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks))
    by, begin = abs(int(size)), 0 if size < 0 else len(epochs) // 2
    out = []
    for b in survey.image_blocks:
        i = epochs.index(b.epoch_id)
        if b.camera_id != camera_of(survey) or i < begin:
            out.append(b)
        elif i + by < len(epochs):
            out.append(replace(b, epoch_id=epochs[i + by]))
    return replace(survey, image_blocks=tuple(out))


def epochs_exchanged(survey: Survey, _: Truth, size: float) -> Survey:
    """Two images of the second camera, ``size`` epochs apart, changed places."""
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks))
    a, b = epochs[2], epochs[2 + int(size)]
    other = {a: b, b: a}
    return in_images(survey, lambda x: x.camera_id == camera_of(survey) and x.epoch_id in other,
                     lambda x: replace(x, epoch_id=other[x.epoch_id]))  # fmt: skip


MIRROR, HALF, QUARTER = np.diag([-1.0, 1.0]), -np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])
_MOUNT, _TABLE = ("mount_from_station", "head"), ("world_from_table", "turntable")

IMAGE_MISTAKES = (
    Mistake("images mirrored", camera_of, ("stereo", "head"), (1.0, 0.6, 0.3), mapped(MIRROR)),
    Mistake("images mirrored", camera_of, ("relay", "lab"), (1.0, 0.6, 0.3), mapped(MIRROR), title="in a laboratory"),
    Mistake("images turned", camera_of, ("stereo", "head"), (0.6, 0.4, 0.2), mapped(HALF), title="half a turn"),
    Mistake("images turned", camera_of, ("stereo", "relay"), (0.6, 0.4, 0.2), mapped(QUARTER), title="a quarter turn"),
    Mistake("images shifted", camera_of, ("stereo", "head"), (12.0, 40.0, 160.0), shifted),
    Mistake("images resized", camera_of, ("stereo", "head"), (0.5, 0.8, 1.5), resized),
    Mistake("images copied", camera_of, ("stereo", "rig"), (0.1, 0.3, 0.6), copied),
    Mistake("pixel origin", of("points"), ("beacons", "lab"), (0.5, -0.5), origin(of_points), ("board",),
            title="of a second detector"),
    Mistake("interlaced", camera_of, ("stereo", "rig"), (0.1, 0.4, 2.0), interlaced),
    Mistake("focus touched", camera_of, ("stereo", "head"), (0.004, 0.01, 0.03), zoomed),
    Mistake("lens drifts", camera_of, ("stereo", "head"), (1.0, 3.0, 10.0), drifting),
    Mistake("camera moved", camera_of, ("stereo", "head"), (2.0, 6.0, 20.0), moved(second_camera, 0.5),
            ("station moved", "head")),
    Mistake("cameras exchanged", camera_of, ("stereo", "rig"), (0.1, 0.2, 0.4), exchanged),
    Mistake("target moved", board_of, ("relay", "head"), (3.0, 10.0, 40.0), moved(second_target, 0.4)),
    Mistake("target scaled", board_of, ("relay", "lab"), (25.0 / 25.4, 0.8, 2.0),
            target_geometry(board_of, lambda s: scaled(s, s))),
    Mistake("target stretched", board_of, ("stereo", "head"), (1.003, 1.01, 1.05),
            target_geometry(board_of, lambda s: scaled(s))),
    Mistake("target sheared", board_of, ("stereo", "head"), (0.003, 0.01, 0.05),
            target_geometry(board_of, lambda s: np.array([[1.0, s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))),
    Mistake("target bent", board_of, ("stereo", "head"), (0.5, 1.5, 5.0), bent),
    Mistake("rows and columns", board_of, ("stereo", "head"), (0.0, 1.0, -1.0), counted),
    Mistake("targets exchanged", of("G3"), ("relay", "lab"), (0.3, 0.5, 0.8), targets_exchanged),
    Mistake("points exchanged", beacon, ("beacons", "lab"), (0.2, 0.4, 0.6), beacons_exchanged, title="in images"),
    Mistake("point moved", beacon, ("beacons", "lab"), (4.0, 10.0, 30.0), point_moved),
    Mistake("station moved", of("head"), ("head", "lab"), (1.0, 5.0, 20.0), bumped(_MOUNT, 0.5, on_table),
            ("camera moved", "Y"), "on its table"),
    Mistake("target moved", anything, ("head", "sweep"), (1.0, 5.0, 20.0), bumped(_TABLE, 0.4, on_table),
            ("table moved",), "or the table"),
    Mistake("station moved", of("post"), ("tripods",), (1.0, 5.0, 20.0),
            bumped(("world_from_station", "post"), 0.5, of_post), ("camera moved", "right"), "a tripod"),
    Mistake("motion forgotten", of("board"), ("stereo", "rig"), (12.0, 8.0, 5.0), still("target"), title="of a target"),
    Mistake("motion forgotten", of("relay"), ("relay",), (12.0, 11.0, 10.0), still("station"), title="of a station"),
    Mistake("epochs shifted", anything, ("stereo", "rig"), (1.0, 2.0, -1.0), shifted_epochs),
    Mistake("epochs exchanged", anything, ("stereo", "rig"), (1.0, 3.0, 6.0), epochs_exchanged),
    Mistake("cameras not simultaneous", camera_of, ("rig",), (0.03, 0.1, 0.3), late),
    Mistake("clock drift", camera_of, ("rig",), (0.1, 0.3, 0.8), drifting_clock, title="of a camera"),
    Mistake("rolling shutter", camera_of, ("rig",), (0.03, 0.1, 0.3), rolling),
    Mistake("clock offset", of("turntable"), ("sweep",), (0.01, 0.05, 0.3), table_late(False), title="of a table"),
    Mistake("clock drift", of("turntable"), ("sweep",), (0.03, 0.1, 0.5), table_late(True), title="of a table"),
    Mistake("clock offset", of("hand"), ("hand", "base"), (0.01, 0.05, 0.2), robot_late(False), title="of a robot"),
    Mistake("clock drift", of("hand"), ("hand", "base"), (0.03, 0.1, 0.4), robot_late(True), title="of a robot"),
    Mistake("gear ratio", of("turntable"), ("head", "lab"), (3e-4, 1e-3, 5e-3), geared),
)  # fmt: skip
