"""The capture plan: a TOML file that says which cameras and which table take which images, as frozen values."""

import math
from collections.abc import Mapping
from dataclasses import field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from capture.plan.given import with_given
from capture.plan.poses import Pose, check_names, read_poses
from capture.plan.table import TablePlan, read_table
from survey.project.declared.node import Node, read_toml

FORMAT = 1
_MOST_REPEATS = 10_000
_TOP = ("format", "project", "survey", "table", "cameras", "capture", "poses")
_LEAST = {"repeats": 1, "retries": 0, "wait_s": 0, "retry_pause_s": 0, "overhead_s": 0}
FeatureValue = bool | int | float | str


@frozen
class CameraPlan:
    """A camera of the project, where it is reached and how it is set; ``settings`` in the order of the file."""

    camera_id: str
    address: str
    settings: Mapping[str, FeatureValue] = field(default_factory=dict)
    options: Mapping[str, FeatureValue] = field(default_factory=dict)


@frozen
class CaptureOptions:
    """How a set of images is taken.

    wait_s: more rest after the table has settled. retries: further tries of a set, or of a move, that failed.
    drift: rad, how far the readback may differ between before and after. overhead_s: time for a set beside exposure and
    motion, for the estimate only. quality: look at every image (sharpness, saturation, target).
    """

    repeats: int = 1
    trigger: Literal["software", "hardware", "free"] = "software"
    wait_s: float = 0.0
    fetch_timeout_s: float = 5.0
    retries: int = 2
    retry_pause_s: float = 0.5
    drift: float = math.radians(0.02)
    overhead_s: float = 0.3
    quality: bool = True


@frozen(eq=False)
class Shot:
    """One epoch that is to be taken: where the table stands, and which repeat of that pose it is."""

    epoch_id: str
    pose_id: str
    repeat: int
    angles: FloatArray


@frozen(eq=False)
class CapturePlan:
    """All that a session needs to know; ``shots`` in the order in which they are taken.

    image_sizes: (width, height) px of cameras, as the survey says.
    """

    file: Path
    digest: str
    project: Path
    survey: Path | None
    table: TablePlan | None
    cameras: tuple[CameraPlan, ...]
    poses: tuple[Pose, ...]
    options: CaptureOptions
    image_sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    @property
    def shots(self) -> tuple[Shot, ...]:
        """Every pose as often as it is repeated; repeats are epochs of their own."""
        repeats = self.options.repeats
        return tuple(
            Shot(pose.pose_id if repeats == 1 else f"{pose.pose_id}-{i + 1}", pose.pose_id, i + 1, pose.angles)
            for pose in self.poses
            for i in range(repeats)
        )


def read_plan(path: Path) -> CapturePlan:
    """Read and check a plan: every key, every pose against the limits. Raises SurveyError."""
    path = Path(path)
    root, digest = read_toml(path)
    root.allow(*_TOP)
    if root.integer("format", 1) != FORMAT:
        raise root.error(f"this program reads format {FORMAT}", "format")
    base = path.parent
    survey = base / root.text("survey") if root.has("survey") else None
    if survey is not None and not survey.is_file():
        raise root.error(f"{survey}: there is no such file; it becomes the project's survey.toml", "survey")
    table = read_table(root.table("table"), base) if root.has("table") else None
    cameras = _cameras(root)
    poses = read_poses(root, table, survey)
    check_names(root, poses)
    plan = CapturePlan(
        file=path,
        digest=digest,
        project=base / root.text("project"),
        survey=survey,
        table=table,
        cameras=cameras,
        poses=poses,
        options=_options(root.table("capture")),
    )
    return replace(plan, image_sizes=_image_sizes(root, plan))


def _cameras(root: Node) -> tuple[CameraPlan, ...]:
    cameras = []
    for camera_id, node in root.tables("cameras"):
        node.allow("address", "settings", "options")
        settings, options = _features(node.table("settings")), _features(node.table("options"))
        cameras.append(CameraPlan(camera_id, node.text("address"), settings, options))
    if not cameras:
        raise root.error('there is no camera; add [cameras.NAME] with address = "driver:place"', "cameras")
    return tuple(cameras)


def _features(node: Node) -> Mapping[str, FeatureValue]:
    for key, value in node.values.items():
        if not isinstance(value, bool | int | float | str):
            raise node.error(f"found {value!r}; a feature is a number, a text, true or false", key)
    return dict(node.values)


def _options(node: Node) -> CaptureOptions:
    options = with_given(CaptureOptions(), node, _LEAST)
    if options.repeats > _MOST_REPEATS:
        raise node.error(f"found {options.repeats}; at most {_MOST_REPEATS}", "repeats")
    return options


def _image_sizes(root: Node, plan: CapturePlan) -> Mapping[str, tuple[int, int]]:
    """Of cameras, as the survey says; its names must be those of the plan, or the folder could not be adjusted."""
    if plan.survey is None:
        return {}
    survey, _ = read_toml(plan.survey)
    cameras = dict(survey.tables("cameras"))
    for camera in plan.cameras:
        root.table("cameras").references("ids", cameras, "camera", [camera.camera_id])
    if plan.table is not None:
        tables, name = survey.table("tables"), plan.table.table_id
        if name not in tables.values:
            raise root.error(f"{plan.survey} has no table {name!r} but {', '.join(tables.values) or 'none'}", "table")
        axes = tables.table(name).value("axes", ["x", "z"])
        if len(axes) != len(plan.table.axes):
            raise root.error(f"{len(plan.table.axes)} axes, but {plan.survey} says {len(axes)}", "table", "axes")
    sizes = {name: node.numbers("image_size_px", (2,)) for name, node in cameras.items() if node.has("image_size_px")}
    return {name: (int(size[0]), int(size[1])) for name, size in sizes.items()}


def check_plan_limits(plan: CapturePlan) -> None:
    """Raise LimitError for the first pose that the table cannot take, with its name."""
    if plan.table is None:
        return
    for pose in plan.poses:
        for axis, angle in zip(plan.table.axes, pose.angles, strict=True):
            try:
                axis.axis.target(float(angle), 0.0)
            except SurveyError as error:
                raise type(error)(f"{plan.file}: pose {pose.pose_id!r}: {error}") from error


@frozen
class Estimate:
    """What a plan will take: seconds of motion, of waiting and of taking images."""

    moving_s: float
    waiting_s: float
    imaging_s: float

    @property
    def total_s(self) -> float:
        """All together."""
        return self.moving_s + self.waiting_s + self.imaging_s


def estimate(plan: CapturePlan) -> Estimate:
    """Time that the plan takes from its first pose on.

    The axes turn at once, so the slowest counts; exposures of one set overlap, so the longest counts.
    """
    moving = 0.0
    table = plan.table
    if table is not None and plan.poses:
        here = np.array(plan.poses[0].angles, float)
        for pose in plan.poses:
            rows = zip(table.axes, pose.angles, here, strict=True)
            there = np.array([axis.axis.target(float(angle), float(now)) for axis, angle, now in rows])
            ways = zip(table.axes, there - here, strict=True)
            moving += max((axis.axis.duration(float(way)) for axis, way in ways), default=0.0)
            here = there
    settle = table.settle.window_s if table is not None else 0.0
    exposures = [camera.settings.get("ExposureTime", 0.0) for camera in plan.cameras]
    exposure = max(float(value) for value in exposures) / 1e6
    n = len(plan.poses) * plan.options.repeats
    waiting = len(plan.poses) * (settle + plan.options.wait_s)
    return Estimate(moving, waiting, n * (exposure + plan.options.overhead_s))
