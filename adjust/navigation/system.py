"""Head and beacons as the arrays that the compiled code takes, checked once."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adjust.lenses.models import MODELS, unit_rays
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.lenses import FISHEYE, MAX_LENS
from adjust.native.navigation import SpotArrays, SystemArrays, spot_rows
from adjust.navigation.model import Beacons, Head, HeadCamera, NavigationEpoch, Spots

_BORDER_PX = 3.0


@frozen(eq=False)
class System:
    """The calibrated head and the beacons.

    arrays: what compiled code takes of both. table_at: row of F at which the table begins. F_inverse: (r, p + 3m), its
    pseudo-inverse. field: (c, 5) what a camera surely sees: smallest and largest x/z and y/z, and the cosine of the
    widest angle for a fisheye (2 elsewhere).
    """

    head: Head
    beacons: Beacons
    arrays: SystemArrays
    table_at: int
    F_inverse: FloatArray
    field: FloatArray

    @property
    def F(self) -> FloatArray:
        """(p + 3m, r) square root of the joint covariance of calibration and beacons: errors are ``F @ eta``.

        eta: uncorrelated, of unit variance, and common to all epochs.
        """
        return self.arrays.F


@frozen(eq=False)
class Sightings:
    """The spots of an epoch, camera after camera.

    camera: (n,). uv: (n, 2) px. cov: (n, 2, 2). label: (n,) beacon, -1 unknown.
    block: (n,) which of the epoch's ``spots``. row: (n,) position there. present: (c,) whether a camera took part.
    ray: (n, 3) in the station, where they were computed beforehand.
    """

    system: System
    camera: IntArray
    uv: FloatArray
    cov: FloatArray
    label: IntArray
    block: IntArray
    row: IntArray
    present: BoolArray
    ray: FloatArray | None = None

    def noise(self, used: IntArray) -> FloatArray:
        """Covariance (2n, 2n) px^2 of the used spots (n,)."""
        n, at = len(used), np.arange(len(used))
        out = np.zeros((n, 2, n, 2))
        out[at, :, at] = self.cov[used]
        return out.reshape(2 * n, 2 * n)


def make_system(head: Head, beacons: Beacons) -> System:
    """Check head and beacons against each other. Raises SurveyError."""
    sizes = [len(c.lens) + 6 for c in head.cameras]
    p = sum(sizes) + (16 if head.table is not None else 0)
    m = len(beacons.beacon_ids)
    _check_shapes(head, beacons, p, m)
    lenses = np.zeros((len(sizes), MAX_LENS))
    for row, camera in zip(lenses, head.cameras, strict=True):
        row[: len(camera.lens)] = camera.lens
    joint = np.zeros((p + 3 * m,) * 2)
    joint[:p, :p], joint[p:, p:] = head.cov, beacons.cov
    if beacons.cross_cov is not None:
        joint[:p, p:], joint[p:, :p] = beacons.cross_cov, beacons.cross_cov.T
    arrays = SystemArrays(
        kinds=np.array([MODELS[c.model].kind for c in head.cameras], dtype=np.int64),
        lenses=lenses,
        constants=np.array([c.constants for c in head.cameras], dtype=np.float64),
        camera_R=np.array([c.station_from_camera.rotation().matrix() for c in head.cameras]),
        camera_t=np.array([c.station_from_camera.translation() for c in head.cameras]),
        x_in_world=np.ascontiguousarray(beacons.x_in_world, dtype=np.float64),
        lens_at=np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
        n_lens=np.array([len(c.lens) for c in head.cameras], dtype=np.int64),
        beacon_at=p,
        F=square_root(joint),
    )
    F_inverse = np.asarray(np.linalg.pinv(arrays.F), dtype=np.float64)
    return System(head, beacons, arrays, sum(sizes), F_inverse, np.array([_field(c) for c in head.cameras]))


def _check_shapes(head: Head, beacons: Beacons, p: int, m: int) -> None:
    if not head.cameras:
        raise SurveyError("the head has no camera: name the station that carries the calibrated cameras")
    if m == 0 or np.shape(beacons.x_in_world) != (m, 3) or not np.isfinite(beacons.x_in_world).all():
        raise SurveyError(f"navigation needs beacons with coordinates; found {m} names: survey the beacons first")
    if len(set(beacons.beacon_ids)) < m:
        raise SurveyError("a beacon is named twice: give every beacon a name of its own")
    for what, cov, n in (("calibration", head.cov, p), ("beacons", beacons.cov, 3 * m)):
        if np.shape(cov) != (n, n):
            raise SurveyError(f"the covariance of the {what} is {np.shape(cov)}; it must be ({n}, {n})")


def square_root(cov: FloatArray) -> FloatArray:
    """F (n, r) with ``F F' = cov``, r its rank; raises SurveyError where the matrix is not a covariance."""
    if not np.isfinite(cov).all() or np.any(np.diag(cov) < 0):
        raise SurveyError("a variance of calibration or beacons is negative or not finite: adjust the survey again")
    scale = np.sqrt(np.diag(cov))
    used = np.flatnonzero(scale > 0)
    out = np.zeros((len(cov), len(used)))
    if not len(used):
        return np.zeros((len(cov), 0))
    values, vectors = np.linalg.eigh(cov[np.ix_(used, used)] / np.outer(scale[used], scale[used]))
    if not np.isfinite(values).all() or values[0] < -1e-6 * len(used):
        raise SurveyError(
            f"the joint covariance of calibration and beacons has a negative eigenvalue ({values[0]:.2e} of the "
            "correlation matrix): it is not a covariance; adjust the survey again"
        )
    out[used] = scale[used, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return np.ascontiguousarray(out[:, values > 1e-12])


def _field(camera: HeadCamera) -> FloatArray:
    """The field of view of a camera from the rays of its border."""
    width, height = camera.image_size
    u, v = (np.array([_BORDER_PX, (n - 1) / 2, n - 1 - _BORDER_PX]) for n in (width, height))
    model = MODELS[camera.model]
    border = np.array([[u[0], v[1]], [u[2], v[1]], [u[1], v[0]], [u[1], v[2]]])
    rays = unit_rays(model, camera.lens, camera.constants, border)
    if model.kind == FISHEYE:
        return np.array([0.0, 0.0, 0.0, 0.0, float(rays[:, 2].max())])
    xy = rays[:, :2] / rays[:, 2:]
    return np.array([xy[0, 0], xy[1, 0], xy[2, 1], xy[3, 1], 2.0])


def make_sightings(system: System, epoch: NavigationEpoch) -> Sightings:
    """The spots of an epoch. Raises SurveyError naming what is not known."""
    where = {c.camera_id: i for i, c in enumerate(system.head.cameras)}
    names = {b: i for i, b in enumerate(system.beacons.beacon_ids)}
    for spots in epoch.spots:
        if spots.camera_id not in where:
            known = ", ".join(where)
            raise SurveyError(f"epoch {epoch.epoch_id}: camera {spots.camera_id!r} is not on the head ({known})")
    sizes, none = [len(s.uv) for s in epoch.spots], np.zeros(0, dtype=np.int64)
    seen_by = np.array([where[s.camera_id] for s in epoch.spots], dtype=np.int64)
    label = np.concatenate([none, *(_labels(s, names, epoch.epoch_id) for s in epoch.spots)])
    row = np.concatenate([none, *map(np.arange, sizes)])
    uv = np.concatenate([np.zeros((0, 2)), *(s.uv for s in epoch.spots)])
    cov = np.concatenate([np.zeros((0, 2, 2)), *(s.cov for s in epoch.spots)])
    block, present = np.repeat(np.arange(len(sizes)), sizes), np.isin(np.arange(len(where)), seen_by)
    return Sightings(system, seen_by[block], uv, cov, label, block, row, present)


def sightings_of(system: System, camera: IntArray, beacon: IntArray, uv: FloatArray, sigma_px: float) -> Sightings:
    """Spots (n, 2) px of known beacons (n,) that every camera of the head might have seen."""
    n, zeros = len(camera), np.zeros(len(camera), dtype=np.int64)
    cov = np.tile(np.eye(2) * sigma_px**2, (n, 1, 1))
    return Sightings(system, camera, uv, cov, beacon, zeros, zeros, np.ones(len(system.head.cameras), dtype=np.bool_))


def station_rays(seen: Sightings) -> tuple[FloatArray, FloatArray]:
    """Origins and unit rays (n, 3) of the spots in the station. Raises SurveyError for pixels that have no ray."""
    cameras, origin = seen.system.head.cameras, np.ascontiguousarray(seen.system.arrays.camera_t[seen.camera])
    if seen.ray is not None:
        return origin, seen.ray
    ray = np.zeros((len(seen.uv), 3))
    for c in np.unique(seen.camera).tolist():
        rows, given = seen.camera == c, cameras[c]
        own = unit_rays(MODELS[given.model], given.lens, given.constants, seen.uv[rows])
        ray[rows] = own @ seen.system.arrays.camera_R[c].T
    return origin, ray


def with_rays(sequence: Sequence[Sightings]) -> list[Sightings]:
    """The same with the rays of all, computed at once: the lens is inverted by arrays, single spots would cost more."""
    if not sequence:
        return []
    camera, uv = (np.concatenate([getattr(s, name) for s in sequence]) for name in ("camera", "uv"))
    try:
        _, ray = station_rays(replace(sequence[0], camera=camera, uv=uv))
    except SurveyError:
        return list(sequence)  # one spot has no ray: said where its epoch needs it
    ends = np.cumsum([len(s.uv) for s in sequence])[:-1]
    return [replace(s, ray=np.ascontiguousarray(r)) for s, r in zip(sequence, np.split(ray, ends), strict=True)]


def _labels(spots: Spots, names: dict[str, int], epoch_id: str) -> IntArray:
    ids = (None,) * len(spots.uv) if spots.beacon_ids is None else spots.beacon_ids
    if unknown := {b for b in ids if b is not None and b not in names}:
        raise SurveyError(
            f"epoch {epoch_id}, camera {spots.camera_id}: {', '.join(sorted(unknown))} is no beacon with known "
            "coordinates; survey it, or leave its spot without a name"
        )
    return np.array([names[b] if b is not None else -1 for b in ids], dtype=np.int64)


def evaluate(
    system: System, pose: FloatArray, camera: IntArray, beacon: IntArray, uv: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residual (2n,) px, H (2n, 6) and M (2n, r) at a pose (4, 4) world_from_station; without uv predicted places."""
    n = len(camera)
    residual, H, M = np.empty(2 * n), np.empty((2 * n, 6)), np.empty((2 * n, system.F.shape[1]))
    spots = SpotArrays(camera, beacon, np.zeros((n, 2)) if uv is None else np.ascontiguousarray(uv))
    spot_rows(system.arrays, np.ascontiguousarray(pose), spots, residual, H, M)
    return residual, H, M


def in_view(system: System, pose: FloatArray) -> tuple[IntArray, IntArray]:
    """Camera and beacon (n,) of every image of a beacon in a field of view at a pose (4, 4)."""
    camera, beacon = np.nonzero(visible(system, pose))
    return camera.astype(np.int64), beacon.astype(np.int64)


def visible(system: System, pose: FloatArray, margin: float = 0.0) -> BoolArray:
    """Which beacons (c, m) lie in the field of view of each camera at a pose (4, 4); hidden ones count too.

    margin: how far outside its border (tangent of the angle) counts as inside.
    """
    q = (system.arrays.x_in_world - pose[:3, 3]) @ pose[:3, :3]
    p = np.einsum("cij,cbi->cbj", system.arrays.camera_R, q - system.arrays.camera_t[:, None])
    low_x, high_x, low_y, high_y, cosine = (column[:, None] for column in system.field.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = p[:, :, 0] / p[:, :, 2], p[:, :, 1] / p[:, :, 2]
    inside = (low_x - margin < x) & (x < high_x + margin) & (low_y - margin < y) & (y < high_y + margin)
    in_cone = p[:, :, 2] > (cosine - margin) * np.linalg.norm(p, axis=2)
    return np.asarray(np.where(cosine < 1.5, in_cone, (p[:, :, 2] > 0.0) & inside))
