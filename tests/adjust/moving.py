"""Simulated surveys in which things move smoothly: a board before two cameras, a head on a table, a robot's hand."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.observations import FrameRef, ImageBlock, Pair, TableReading
from adjust.model.survey import Clock, PoseParameter, Station, Survey, Table, Target, VectorParameter
from survey.simulate import Truth, resample, stereo
from survey.simulate.scene import Scene

STEP = 0.2  # s between epochs
TURN = 0.25  # rad of a course from epoch to epoch, 25 epochs a round


def clock(jitter: float = 0.0, held: tuple[str, ...] = (), **values: float) -> Clock:
    """A clock whose values (s, 1, s) are unknown and begin at zero, unless they are held."""
    names = tuple(values)
    start = np.array([values[n] if n in held else 0.0 for n in names])
    return Clock(VectorParameter(names, start, tuple(n for n in names if n not in held)), jitter)


def course(k: int, size: float, reach: float) -> Pose3:
    """A small smooth motion at epoch k: turns of up to ``size`` rad, ways of up to ``reach`` m."""
    a = TURN * k
    turn = size * np.array([np.sin(a), np.cos(0.8 * a), 0.7 * np.sin(0.6 * a + 1.0)])
    way = reach * np.array([np.cos(a), np.sin(1.1 * a), 0.8 * np.sin(0.7 * a)])
    return Pose3(Rot3.Expmap(turn), way)


def _epochs(n: int) -> list[str]:
    """Those observed, and before and after them three more, at which only the truth knows where things are."""
    return [f"{'x' if k < 0 or k >= n else 'e'}{k + 1:02d}" for k in range(-3, n + 3)]


def _times(epochs: Sequence[str]) -> dict[str, float]:
    return {e: STEP * int(e[1:]) for e in epochs}


def _with_images(survey: Survey, sigma_px: float) -> Survey:
    """The survey with all points of its target in every image, still without coordinates."""
    target, epochs = survey.targets[0], [e for e in survey.times if e[0] == "e"]
    n = len(target.x_in_target)
    cov = np.tile(sigma_px**2 * np.eye(2), (n, 1, 1))
    return replace(survey, image_blocks=tuple(
        ImageBlock(c.camera_id, e, target.target_id, np.arange(n), np.zeros((n, 2)), cov)
        for e in epochs for c in survey.cameras))  # fmt: skip


def board_before_cameras(
    n: int = 16, clocks: dict[str, Clock] | None = None, true: Truth | None = None, sigma_px: float = 0.1
) -> tuple[Survey, Truth]:
    """A board held by hand before two cameras on a bar, with these clocks of cameras "left" and "right"."""
    survey, truth = stereo(21, n_pairs=1)
    truth = {name: v for name, v in truth.items() if name[0] != "carrier_from_target"} | (true or {})
    half = 0.5 * np.ptp(survey.targets[0].x_in_target, axis=0)
    place = Pose3(Rot3(), [0.05, 0.0, 0.75])
    for k, e in enumerate(_epochs(n)):
        truth["carrier_from_target", "board", e] = place.compose(course(k, 0.35, 0.07)).compose(Pose3(Rot3(), -half))
    cameras = tuple(replace(c, clock=(clocks or {}).get(c.camera_id)) for c in survey.cameras)
    survey = replace(survey, cameras=cameras, times=_times(_epochs(n)))
    return _resampled(survey, truth, sigma_px)


def head_on_moving_table(
    n: int = 18, clocks: dict[str, Clock] | None = None, true: Truth | None = None, sigma_px: float = 0.1
) -> tuple[Survey, Truth]:
    """Two cameras on a table of two axes that does not stop, before a board; clocks of "left", "right", "turntable"."""
    base, truth = stereo(21, n_pairs=1)
    clocks, epochs = clocks or {}, _epochs(n)
    board = Target("board", base.targets[0].point_ids, base.targets[0].x_in_target,
                   carrier_from_target=PoseParameter(Pose3(), "held"))  # fmt: skip
    half = 0.5 * np.ptp(board.x_in_target, axis=0)
    at_board = Pose3(Rot3(), half).compose(Pose3(Rot3(), [-0.05, 0.0, -0.8]))  # the head, looking at the board's middle
    place = Pose3(Rot3.Expmap(np.array([0.02, -0.03, 0.01])), [0.01, -0.02, 0.03])
    truth = {name: v for name, v in truth.items() if name[0] in ("lens", "station_from_camera")} | (true or {})
    truth |= {("carrier_from_target", "board"): Pose3(), ("mount_from_station", "bar"): place,
              ("world_from_table", "turntable"): at_board.compose(place.inverse()),
              ("table_geometry", "turntable"): np.array([3e-4, 4e-4, 0.0, 0.0])}  # fmt: skip
    truth |= {("table_angles", "turntable", e): np.array([0.12 * np.sin(TURN * k), 0.3 * np.cos(0.8 * TURN * k)])
              for k, e in enumerate(epochs)}  # fmt: skip
    cov = (8.0 * np.pi / 648000.0) ** 2 * np.eye(2)
    survey = Survey(
        tuple(replace(c, clock=clocks.get(c.camera_id)) for c in base.cameras),
        (Station("bar", "table", table_id="turntable"),),
        (Table("turntable", ("x", "z"), clock=clocks.get("turntable")),), (board,),
        table_readings=tuple(TableReading("turntable", e, np.zeros(2), cov) for e in epochs if e[0] == "e"),
        times=_times(epochs),
    )  # fmt: skip
    return _resampled(survey, truth, sigma_px)


def camera_on_hand(
    n: int = 18, clocks: dict[str, Clock] | None = None, true: Truth | None = None, sigma_px: float = 0.1
) -> tuple[Survey, Truth]:
    """A camera on a robot's hand that does not stop before a board, with measured poses; clocks of "left", "hand"."""
    base, truth = stereo(21, n_pairs=1)
    clocks, epochs = clocks or {}, _epochs(n)
    board = Target("board", base.targets[0].point_ids, base.targets[0].x_in_target)
    camera = replace(base.cameras[0], station_id="hand", station_from_camera=PoseParameter(), clock=clocks.get("left"))
    hand_eye = Pose3(Rot3.Expmap(np.array([0.1, -0.2, 1.5])), [0.05, 0.02, 0.04])
    half = 0.5 * np.ptp(board.x_in_target, axis=0)
    truth = {name: v for name, v in truth.items() if name == ("lens", "left")} | (true or {})
    truth |= {
        ("station_from_camera", "left"): hand_eye,
        ("carrier_from_target", "board"): Pose3(Rot3(), [0.4, 0.1, 0.5]),
    }
    look = Pose3(Rot3(), [0.4, 0.1, 0.5]).compose(Pose3(Rot3(), half))
    truth |= {("world_from_station", "hand", e): look.compose(course(k, 0.4, 0.06)).compose(
        Pose3(Rot3(), [0.0, 0.0, -0.8])).compose(hand_eye.inverse()) for k, e in enumerate(epochs)}  # fmt: skip
    cov = np.diag([2e-4**2] * 3 + [2e-4**2] * 3)
    survey = Survey(
        (camera,), (Station("hand", "epoch", clock=clocks.get("hand")),), targets=(board,),
        pairs=tuple(Pair(f"p{e}", FrameRef("world"), FrameRef("station", "hand", e), Pose3(), cov)
                    for e in epochs if e[0] == "e"),
        times=_times(epochs),
    )  # fmt: skip
    return _resampled(survey, truth, sigma_px)


def _resampled(survey: Survey, truth: Truth, sigma_px: float) -> tuple[Survey, Truth]:
    made, scene = resample(_with_images(survey, sigma_px), truth, 1), Scene(survey, truth)
    for block in made.image_blocks:
        assert scene.inside(block.camera_id, block.uv, 2.0).all(), (block.camera_id, block.epoch_id)
    return made, truth
