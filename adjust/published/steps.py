"""The steps of the calibration, each a least squares of its own (appendix A of the paper, equations A1 to A18).

Frames: w the board (our world), t the table, b the body, which the table carries with its axes parallel to the table's
and its origin on the main axis; k a camera. ``C_t^w`` is the rotation of world_from_table, ``C_z^b`` of
station_from_camera. The table turns the body by ``Rx(omega) Rz(Omega)``: auxiliary axis x outside, main axis z inside.
Rotations of small angles (a, b, c) are ``[[1, c, -b], [-c, 1, a], [b, -a, 1]]`` (A2, A3).
"""

from functools import cached_property

import numpy as np

from adjust.frames.tables import turns
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray
from adjust.spatial.rigid import nearest_rotation, rotation_log

# a reading this near to zero is an axis that was not turned; far above the noise of any table that deserves the name
STILL_RAD = 1e-3
SMALL_ANGLES = ("alpha", "beta", "gamma", "phi", "theta", "psi")


@frozen(eq=False)
class TableImages:
    """What one camera's own calibration tells of its n images on the table.

    angles: (n, 2) rad, auxiliary (x) and main (z) axis. world_from_camera: (n, 4, 4) m. cov: (6n, 6n) joint, in the
    tangents of the poses (rotation, translation, in the camera), or None where it is not known.
    """

    camera_id: str
    angles: FloatArray
    world_from_camera: FloatArray
    cov: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.angles)
        cov_fits = self.cov is None or self.cov.shape == (6 * n, 6 * n)
        if n == 0 or self.angles.shape != (n, 2) or self.world_from_camera.shape != (n, 4, 4) or not cov_fits:
            raise SurveyError(
                f"camera {self.camera_id}: {self.angles.shape} table angles and {self.world_from_camera.shape} poses; "
                "give (n, 2), (n, 4, 4) and a covariance (6n, 6n) of n > 0 images"
            )

    @property
    def R(self) -> FloatArray:
        """Rotations ``C_k^w`` (n, 3, 3)."""
        return self.world_from_camera[:, :3, :3]

    @property
    def r(self) -> FloatArray:
        """Positions ``r_wk^w`` (n, 3) m."""
        return self.world_from_camera[:, :3, 3]

    @cached_property
    def turned(self) -> FloatArray:
        """``C_b'^b`` (n, 3, 3): how the table has turned the body (A5)."""
        return turns(0, self.angles[:, 0]) @ turns(2, self.angles[:, 1])

    def about_main(self) -> BoolArray:
        """Which images (n,) were taken with the main axis alone turned, or none."""
        return np.asarray(np.abs(self.angles[:, 0]) < STILL_RAD)

    def about_auxiliary(self) -> BoolArray:
        """Which images (n,) were taken with the auxiliary axis alone turned."""
        return np.asarray((np.abs(self.angles[:, 1]) < STILL_RAD) & ~self.about_main())


@frozen(eq=False)
class Fit:
    """Least squares with equal weights: cov is that of the values with the variance of unit weight of its residuals."""

    values: FloatArray
    cov: FloatArray

    @property
    def sigmas(self) -> FloatArray:
        """A posteriori standard deviations (k,)."""
        return np.sqrt(np.diag(self.cov))


def fit(A: FloatArray, y: FloatArray, names: tuple[str, ...], advice: str, taken: int = 0) -> Fit:
    """Solve ``A x = y``; ``taken``: unknowns eliminated beforehand. Raises SurveyError naming what has no solution."""
    u, s, vt = np.linalg.svd(A, full_matrices=False)
    # singular values below any turn a table can make between its images: the column is not seen
    lost = s < STILL_RAD * max(float(s[0]), 1e-12)
    if lost.any():
        share = np.abs(vt[lost]).max(axis=0)
        missing = ", ".join(name for name, part in zip(names, share, strict=True) if part > 0.1)
        raise SurveyError(f"the images on the table do not determine {missing}: {advice}")
    values = vt.T @ (u.T @ y / s)
    freedom = len(y) - len(values) - taken
    unit = float(np.sum((y - A @ values) ** 2)) / freedom if freedom > 0 else float("nan")
    return Fit(values, unit * (vt.T / s**2) @ vt)


def table_and_main_camera(images: TableImages) -> Fit:
    """Small angles (alpha, beta, gamma) of ``C_t^w`` and (phi, theta, psi) of ``C_z^b``, equation A10; rad.

    First order: what it leaves out is the product of two of the angles, 0.01 deg where they are of one degree.
    """
    main, auxiliary = images.about_main(), images.about_auxiliary()
    R, c, s = images.R[main], np.cos(images.angles[main, 1]), np.sin(images.angles[main, 1])
    o, i = np.zeros_like(c), np.ones_like(c)
    rows = [[-s, c, o, o, i, o], [-c, -s, o, -i, o, o], [o, -i, o, -s, -c, o], [i, o, o, c, -s, o]]
    A = [np.stack(row, axis=1) for row in rows]
    y = [R[:, 2, 0], R[:, 2, 1], R[:, 0, 2], R[:, 1, 2]]
    R, c, s = images.R[auxiliary], np.cos(images.angles[auxiliary, 0]), np.sin(images.angles[auxiliary, 0])
    o, i = np.zeros_like(c), np.ones_like(c)
    rows = [[o, -s, c, o, o, i], [o, -c, -s, o, -i, o], [o, o, -i, o, -s, -c], [o, i, o, o, c, -s]]
    A += [np.stack(row, axis=1) for row in rows]
    y += [R[:, 0, 1], R[:, 0, 2], R[:, 1, 0], R[:, 2, 0]]
    advice = (
        f"camera {images.camera_id} needs images with the main axis alone turned and images with the auxiliary axis "
        f"alone turned (it has {int(main.sum())} and {int(auxiliary.sum())}), to different angles"
    )
    return fit(np.concatenate(A), np.concatenate(y), SMALL_ANGLES, advice)


def camera_rotation(world_from_table: FloatArray, images: TableImages) -> Fit:
    """``C_k^b`` of another camera, equations A11 and A12: the rotation nearest to what its images say.

    values: (9,), the matrix row by row. cov: (3, 3) rad^2, about the camera's axes, from the scatter of the images.
    """
    each = np.swapaxes(world_from_table @ images.turned, -1, -2) @ images.R
    mean = nearest_rotation(each.sum(axis=0))
    return Fit(mean.ravel(), _scatter(rotation_log(mean.T @ each)))


def lateral_offset(world_from_table: FloatArray, images: TableImages) -> Fit:
    """``z_x, z_y`` of ``r_bz^b`` from images turned about the main axis, equation A16; m.

    All differences between images weigh as much as the deviations from their mean, which are independent; hence those.
    """
    main = images.about_main()
    C = (world_from_table @ images.turned[main])[:, :, :2]
    A, y = C - C.mean(axis=0), images.r[main] - images.r[main].mean(axis=0)
    advice = f"camera {images.camera_id} needs images with the main axis turned to different angles"
    return fit(A.reshape(-1, 2), y.ravel(), ("z_x", "z_y"), advice, taken=3)


def body_origin(world_from_table: FloatArray, images: TableImages, lateral: FloatArray, b_z: float) -> Fit:
    """``b_x, b_y`` of ``r_wb^w`` and ``z_z`` of ``r_bz^b``, equation A14, with ``b_z`` measured by caliper; m."""
    main = images.about_main()
    C = world_from_table @ images.turned[main]
    y = images.r[main] - C[:, :, :2] @ lateral - (0.0, 0.0, b_z)
    A = np.zeros((len(C), 3, 3))
    A[:, 0, 0] = A[:, 1, 1] = 1.0
    A[:, :, 2] = C[:, :, 2]
    return fit(A.reshape(-1, 3), y.ravel(), ("b_x", "b_y", "z_z"), f"camera {images.camera_id} needs more images")


def table_origin(world_from_table: FloatArray, images: TableImages, r_bz: FloatArray) -> Fit:
    """``r_wt^w`` and the height of the body over the table's centre, ``r_tb^b = (0, 0, h)``, equation A15; m.

    The body's origin is on the main axis by definition, or A14 would not hold; h shows when the auxiliary axis turns.
    """
    C = world_from_table @ images.turned
    A = np.zeros((len(C), 3, 4))
    A[:, :, :3], A[:, :, 3] = np.eye(3), C[:, :, 2]
    advice = f"camera {images.camera_id} needs images with the auxiliary axis turned to different angles"
    return fit(A.reshape(-1, 4), (images.r - C @ r_bz).ravel(), ("t_x", "t_y", "t_z", "height"), advice)


def camera_position(world_from_table: FloatArray, r_wt: FloatArray, height: float, images: TableImages) -> Fit:
    """``r_bk^b`` of another camera, equations A17 and A18: the mean of its images; m."""
    each = np.einsum("nji,nj->ni", world_from_table @ images.turned, images.r - r_wt) - (0.0, 0.0, height)
    return Fit(each.mean(axis=0), _scatter(each - each.mean(axis=0)))


def _scatter(deviations: FloatArray) -> FloatArray:
    """Covariance (3, 3) of a mean from the deviations (n, 3) of its parts; nan for a single one."""
    n = len(deviations)
    return deviations.T @ deviations / (n * (n - 1)) if n > 1 else np.full((3, 3), np.nan)
