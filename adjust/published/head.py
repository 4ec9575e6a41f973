"""The published steps on a survey that has been adjusted jointly, in the frames of that survey.

The paper's frames have the board's, the table's and the main camera's axes nearly parallel, x about the outer axis and
z about the inner one. Those of a survey are brought there by naming their axes anew (a turn of the cube), and the
results are brought back. The height of the body over the table, which a caliper tells, cancels out of what is compared:
the table in the world and every camera in the mount.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from adjust.adjustment import adjust
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import BoolArray, FloatArray, Station, Survey, Table
from adjust.published.method import Calibration, CpcInput, calibrate, propagate
from adjust.published.steps import TableImages
from adjust.published.surveys import single_camera_survey, table_images

SMALL_RAD = np.radians(10.0)  # beyond, the product of two small angles is half a degree and more
_CUBE = Rotation.create_group("O").as_matrix()
_GEOMETRY = ("non_orthogonality", "axis_offset")
_ZEROS = ("zero_1", "zero_2")


@frozen(eq=False)
class ComparedPose:
    """One rigid motion ``a_from_b`` both ways. (6,): turns about the axes of b (rad), then along those of a (m).

    claimed: the published sigmas, in which each step takes what came before as free of error. sigma: those that the
    observations cause, through all steps. joint_sigma: of the joint adjustment. All a priori.
    """

    name: ParameterName
    published: Pose3
    joint: Pose3
    claimed: FloatArray
    sigma: FloatArray
    joint_sigma: FloatArray

    @property
    def difference(self) -> FloatArray:
        """Published minus joint (6,), as the sigmas count."""
        turn = Rot3.Logmap(self.joint.rotation().between(self.published.rotation()))
        return np.concatenate([turn, self.published.translation() - self.joint.translation()])


@frozen(eq=False)
class HeadComparison:
    """The table in the world, then every camera in the mount ("mount_from_camera", id). notes: what was left out."""

    main_camera: str
    poses: tuple[ComparedPose, ...]
    notes: tuple[str, ...]


@frozen(eq=False)
class _Axes:
    """The names of axes: ``world_from_w``, ``mount_from_b`` (also of the table), ``camera_from_c`` of the main one."""

    world: FloatArray
    mount: FloatArray
    camera: FloatArray


def compare_head(adjusted: Adjustment) -> HeadComparison:
    """Run the published steps on the observations of ``adjusted`` and set them beside it.

    Raises SurveyError naming what the survey lacks for them: one head on a table of two perfect axes, images of a held
    board at the table's readings, and a camera along the inner axis with images about each axis alone.
    """
    survey = adjusted.survey
    station, table = _head(survey)
    _refuse_imperfect(adjusted, table)
    survey = _before_the_board(survey, station)
    angles = {r.epoch_id: r.angles for r in survey.table_readings if r.table_id == table.table_id and r.used}
    cameras, notes = _on_table(survey, station, angles)
    images = {k: _images(survey, table, adjusted, k) for k in cameras}
    main, axes = _main_camera(adjusted, station, table, images)
    others = tuple(k for k in images if k != main)
    sigma = np.sqrt(np.mean([np.trace(r.cov) / 2.0 for r in survey.table_readings if r.epoch_id in angles]))
    given = CpcInput(
        _named_anew(images[main], axes, axes.camera),
        tuple(_named_anew(images[k], axes, np.eye(3)) for k in others), 0.0, 0.0, float(sigma),
    )  # fmt: skip
    found, (names, cov) = calibrate(given), propagate(given)
    at = {name: i for i, name in enumerate(names)}
    both = _Both(adjusted, found, axes, at, cov)
    poses = [both.table(table), *(both.camera(station, k, k == main) for k in (main, *others))]
    if any(name in table.geometry.free for name in _GEOMETRY):
        notes += ("the published steps take the table's axes as perfect; the joint adjustment estimates them",)
    return HeadComparison(main, tuple(poses), notes)


def _head(survey: Survey) -> tuple[Station, Table]:
    carriers = {c.station_id for c in survey.cameras}
    heads = [s for s in survey.stations if s.motion == "table" and s.station_id in carriers]
    if len(heads) != 1:
        names = ", ".join(s.station_id for s in heads) or "none"
        raise SurveyError(f"they calibrate one head of cameras on a table; stations with motion table: {names}")
    table = survey.tables_by_id[heads[0].table_id or ""]
    if len(table.axes) != 2:
        raise SurveyError(f"they need a table of two axes; {table.table_id} has {len(table.axes)}")
    return heads[0], table


def _refuse_imperfect(adjusted: Adjustment, table: Table) -> None:
    given = table.geometry.by_name
    held = [x for x in _GEOMETRY if given.get(x, 0.0) != 0.0 and x not in table.geometry.free]
    free = [x for x in _ZEROS if x in table.geometry.free]
    if held:
        raise SurveyError(f"they take the axes of table {table.table_id} as perfect; {', '.join(held)} is held at more")
    if free:
        raise SurveyError(f"they take the readings of table {table.table_id} as its angles; {', '.join(free)} is free")
    if adjusted.precision is None:
        raise SurveyError("the joint adjustment has no covariances to compare with")


def _before_the_board(survey: Survey, station: Station) -> Survey:
    """Only the head's images of targets that are held in the world."""
    held = {
        t.target_id for t in survey.targets
        if t.station_id is None and t.motion == "fixed" and t.carrier_from_target.treatment == "held"
    }  # fmt: skip
    if not held:
        raise SurveyError("they need a board that is held and so is the world: its pose with treatment = \"held\"")
    mine = {c.camera_id for c in survey.cameras if c.station_id == station.station_id}
    blocks = tuple(
        b for b in survey.image_blocks if b.camera_id in mine and b.target_id in held and _in_use(b.used, len(b.uv))
    )
    return replace(survey, image_blocks=blocks)


def _in_use(used: BoolArray | None, n: int) -> bool:
    return n > 0 and (used is None or bool(np.any(used)))


def _on_table(
    survey: Survey, station: Station, angles: Mapping[str, FloatArray]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Cameras with images of the board at readings of the table, and what is said of the others."""
    every = [c.camera_id for c in survey.cameras if c.station_id == station.station_id]
    seen = {b.camera_id for b in survey.image_blocks if b.epoch_id in angles}
    without = [k for k in every if k not in seen]
    if len({k.lower() for k in every}) < len(every):
        raise SurveyError(f"they name cameras in lower case; give {', '.join(every)} ids that differ in more than case")
    if not seen:
        raise SurveyError("no camera of the head has an image of the held board at an epoch with a table reading")
    notes = tuple(f"camera {k} has no image of the held board at a reading of the table; left out" for k in without)
    return tuple(k for k in every if k in seen), notes


def _images(survey: Survey, table: Table, adjusted: Adjustment, camera_id: str) -> TableImages:
    """A camera calibrated alone; its angles are the readings with the held zeros of the axes."""
    zeros = np.array([table.geometry.by_name.get(x, 0.0) for x in _ZEROS])
    readings = [
        replace(r, angles=r.angles + zeros) for r in survey.table_readings if r.table_id == table.table_id and r.used
    ]
    return table_images(adjust(single_camera_survey(survey, camera_id)), readings)


def _nearest_names(rotation: FloatArray) -> FloatArray:
    """The turn of the cube (3, 3) nearest to a rotation."""
    return np.asarray(_CUBE[int(np.argmax(np.einsum("kij,ij->k", _CUBE, rotation)))])


def _main_camera(
    adjusted: Adjustment, station: Station, table: Table, images: Mapping[str, TableImages]
) -> tuple[str, _Axes]:
    """The camera nearest to the inner axis among those with images about each axis alone, and the names of axes."""
    unit = np.eye(3)
    outer, inner = (unit["xyz".index(axis)] for axis in table.axes)
    mount = np.stack([outer, np.cross(inner, outer), inner], axis=1)
    world_from_table = _pose(adjusted, ("world_from_table", table.table_id)).rotation().matrix() @ mount
    world = _nearest_names(world_from_table)
    tilt = _angle(world.T @ world_from_table)
    if tilt > SMALL_RAD:
        raise SurveyError(
            f"they hold for small angles: the axes of table {table.table_id} are {np.degrees(tilt):.1f} deg off those "
            f"of the world, more than {np.degrees(SMALL_RAD):.0f}; give the held board a pose along the table's axes"
        )
    found, said = [], []
    for k, its in images.items():
        rotation = mount.T @ _mount_from_camera(adjusted, station, k).rotation().matrix()
        names = _nearest_names(rotation.T)
        off, n = _angle(rotation @ names), (int(its.about_main().sum()), int(its.about_auxiliary().sum()))
        said.append(f"camera {k} has {n[0]} and {n[1]}, and is {np.degrees(off):.1f} deg off the axes")
        if n[0] >= 2 and n[1] >= 1 and off < SMALL_RAD:
            found.append((off, k, names))
    if not found:
        raise SurveyError(
            "they need a camera along the table's axes (within "
            f"{np.degrees(SMALL_RAD):.0f} deg) with two images or more about the inner axis alone and one or more "
            f"about the outer axis alone: {'; '.join(said)}"
        )
    _, main, names = min(found, key=lambda x: x[0])
    return main, _Axes(world, mount, names)


def _angle(rotation: FloatArray) -> float:
    return float(np.linalg.norm(Rot3.Logmap(Rot3(rotation))))


def _named_anew(images: TableImages, axes: _Axes, camera: FloatArray) -> TableImages:
    """The images in the paper's frames."""
    poses = images.world_from_camera.copy()
    poses[:, :3, :3] = axes.world.T @ poses[:, :3, :3] @ camera
    poses[:, :3, 3] = poses[:, :3, 3] @ axes.world
    turn = block_diag(*[camera.T] * (2 * len(poses)))
    return replace(images, world_from_camera=poses, cov=None if images.cov is None else turn @ images.cov @ turn.T)


def _pose(adjusted: Adjustment, name: ParameterName) -> Pose3:
    value = adjusted.estimates[name].value
    if not isinstance(value, Pose3):
        raise ValueError(f"{name} is no pose")
    return value


def _mount_from_camera(adjusted: Adjustment, station: Station, camera_id: str) -> Pose3:
    mount_from_station = _pose(adjusted, ("mount_from_station", station.station_id))
    return mount_from_station.compose(_pose(adjusted, ("station_from_camera", camera_id)))


@frozen(eq=False)
class _Both:
    """The joint adjustment and the steps' calibration, whose cov (n, n) has its components at these places."""

    adjusted: Adjustment
    found: Calibration
    axes: _Axes
    at: Mapping[tuple[str, str], int]
    cov: FloatArray

    def table(self, table: Table) -> ComparedPose:
        """The table in the world."""
        name, along = ("world_from_table", table.table_id), self.found.vectors["r_wt^w"].sigma_mm / 1e3
        axes, joint = (self.axes.world, self.axes.mount), _pose(self.adjusted, name)
        sigmas = _outside(self.adjusted.joint((name,)), joint)
        return self._compared(name, self.found.world_from_table, axes, ("C_t^w", "r_wt^w"), along, joint, sigmas)

    def camera(self, station: Station, camera_id: str, is_main: bool) -> ComparedPose:
        """A camera in the mount."""
        k, found = camera_id.lower(), self.found
        axes = self.axes.mount, self.axes.camera if is_main else np.eye(3)
        own = found.mount_from_station.compose(found.station_from_camera(camera_id))
        along = found.vectors[f"r_b{k}^b"].sigma_mm / 1e3
        if is_main:  # its height over the body and the body's over the table were found one after the other
            along = np.append(along[:2], np.hypot(along[2], found.vectors["r_tb^b"].sigma_mm[2] / 1e3))
        names = ("mount_from_station", station.station_id), ("station_from_camera", camera_id)
        J = np.hstack([_pose(self.adjusted, names[1]).inverse().AdjointMap(), np.eye(6)])
        joint = _mount_from_camera(self.adjusted, station, camera_id)
        sigmas = _outside(J @ self.adjusted.joint(names) @ J.T, joint)
        of = f"C_{k}^b", f"r_b{k}^b", "r_tb^b"
        return self._compared(("mount_from_camera", camera_id), own, axes, of, along, joint, sigmas)

    def _compared(
        self, name: ParameterName, own: Pose3, axes: tuple[FloatArray, FloatArray], of: tuple[str, ...],
        along: FloatArray, joint: Pose3, sigmas: FloatArray,
    ) -> ComparedPose:  # fmt: skip
        """own: a pose in the paper's frames, along: what it claims of its place. axes: the survey's, left and right.

        of: its rotation, and the vectors that its place is the sum of. joint: the same adjusted, with its sigmas.
        """
        (left, right), (turn, *vectors) = axes, of
        pose = Pose3(Rot3(left @ own.rotation().matrix() @ right.T), left @ own.translation())
        sigma = np.concatenate([self._sigmas([turn], right), self._sigmas(vectors, left)])
        claimed = np.concatenate([abs(right) @ np.radians(self.found.rotations[turn].sigma_deg), abs(left) @ along])
        return ComparedPose(name, pose, joint, claimed, sigma, sigmas)

    def _sigmas(self, names: Sequence[str], axes: FloatArray) -> FloatArray:
        """(3,) of the sum of what is named so, in the axes that it is brought back to."""
        J = np.zeros((3, len(self.cov)))
        for name in names:
            J[:, [self.at[name, axis] for axis in "xyz"]] = axes
        return np.sqrt(np.clip(np.diag(J @ self.cov @ J.T), 0.0, None))


def _outside(cov: FloatArray, pose: Pose3) -> FloatArray:
    """Sigmas (6,) of a tangent's covariance: turns as they are, the translation along the axes on the left."""
    turn = block_diag(np.eye(3), pose.rotation().matrix())
    return np.asarray(np.sqrt(np.clip(np.diag(turn @ cov @ turn.T), 0.0, None)))
