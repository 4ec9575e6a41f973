"""A simulated head among beacons: the three-camera system of the published experiment, projected by OpenCV."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from gtsam import Pose3, Rot3

from adjust.lenses.models import lens_constants
from adjust.model.survey import TABLE_GEOMETRY
from adjust.navigation import Beacons, Head, HeadCamera, HeadTable, NavigationEpoch, Spots

SIZE = (1280, 1024)
MM = 1e-3
# table 2: fx fy u0 v0 k1 k2 p1 p2 and their sigmas
LENSES = {
    "X": ((1599.26136, 1599.93302, 632.61591, 522.17870, -0.13013, 0.28701, -0.00040, -0.00004),
          (1.78966, 1.64101, 1.62023, 1.61823, 0.00336, 0.02243, 0.00029, 0.00031)),
    "Y": ((1605.35286, 1603.54359, 619.71227, 505.99361, -0.11276, 0.01776, -0.00031, 0.00057),
          (1.66249, 1.73608, 1.80177, 1.93821, 0.00301, 0.01776, 0.00034, 0.00030)),
    "Z": ((1611.21596, 1610.79607, 649.51210, 531.29472, -0.10481, 0.15881, -0.00137, 0.00184),
          (2.14183, 2.14219, 1.39920, 1.34749, 0.00338, 0.02341, 0.00021, 0.00022)),
}  # fmt: skip
# table 3: camera to body, angles (phi, theta, psi) deg of C3(psi) C1(phi) C2(theta), and place mm, with sigmas
MOUNTS = {
    "X": ((-0.5788, -90.3523, 0.0395), (0.0413, 0.099, 0.0153), (76.1319, -36.8373, 78.8949), (0.2529, 0.4498, 0.4959)),
    "Y": ((90.1636, -0.5501, 0.1925), (0.0301, 0.0920, 0.0157), (-32.5004, 75.7149, 76.9967), (0.5358, 0.0825, 0.1963)),
    "Z": ((-0.1076, -0.7211, 1.1690), (0.0485, 0.0657, 0.0443), (34.1604, 30.8251, 119.7096), (0.3097, 0.3097, 0.2932)),
}  # fmt: skip
# table 4, mm
BEACONS_MM = np.array([
    [487.4734, -720.0265, 240.8359], [-51.2618, -737.6155, 164.7393], [-366.1525, -711.8317, 131.2681],
    [-458.8302, -215.2964, -69.2627], [-454.6380, 410.3959, -60.6549], [-117.4392, 296.0537, 83.0754],
    [182.4478, 279.1964, 143.2510], [481.8346, 252.9609, 217.5775], [647.3834, -127.6167, 178.7407],
    [-122.5798, -44.9064, 562.5394],
])  # fmt: skip
BEACON_SIGMA = 0.3963 * MM
_LENS_PLACES = (0, 1, 3, 4, 5, 6, 7, 8)


def about(axis, angle):
    """Right-handed turn (3, 3)."""
    vector = np.zeros(3)
    vector["xyz".index(axis)] = angle
    return cv2.Rodrigues(vector)[0]


def station_from_camera(name):
    """``C3(psi) C1(phi) C2(theta)``, each turning the frame."""
    phi, theta, psi = np.radians(MOUNTS[name][0])
    return Pose3(Rot3(about("z", -psi) @ about("x", -phi) @ about("y", -theta)), np.array(MOUNTS[name][2]) * MM)


def mfns_head():
    """The head with the printed calibration and its printed sigmas, which the paper gives without correlations."""
    cameras, blocks = [], []
    for name, (values, sigmas) in LENSES.items():
        lens, lens_sigma = np.zeros(13), np.zeros(13)
        lens[list(_LENS_PLACES)], lens_sigma[list(_LENS_PLACES)] = values, sigmas
        cameras.append(HeadCamera(name, SIZE, "brown", lens, lens_constants("brown", SIZE), station_from_camera(name)))
        phi, theta, _ = np.radians(MOUNTS[name][0])
        # columns of the tangent (in the camera) by psi, phi, theta, which turn one after the other
        turn = np.column_stack([
            -(about("x", -phi) @ about("y", -theta)).T @ [0, 0, 1], -about("y", -theta).T @ [1, 0, 0], [0, -1, 0]
        ])  # fmt: skip
        s_phi, s_theta, s_psi = np.radians(MOUNTS[name][1])
        R = station_from_camera(name).rotation().matrix()
        cov = np.zeros((6, 6))
        cov[:3, :3] = turn @ np.diag([s_psi**2, s_phi**2, s_theta**2]) @ turn.T
        cov[3:, 3:] = R.T @ np.diag(np.square(np.array(MOUNTS[name][3]) * MM)) @ R
        blocks += [np.diag(lens_sigma**2), cov]
    return Head(tuple(cameras), block_diagonal(blocks))


def wide_head(focal_px=600.0):
    """The same mounts behind shorter lenses without distortion: more beacons in view."""
    head = mfns_head()
    lens = np.zeros(13)
    lens[[0, 1, 3, 4]] = focal_px, focal_px, 640.0, 512.0
    cov = head.cov.copy()
    for at in (0, 19, 38):
        cov[at : at + 13] = cov[:, at : at + 13] = 0.0
        cov[[at, at + 1, at + 3, at + 4], [at, at + 1, at + 3, at + 4]] = 0.3**2
    return replace(head, cameras=tuple(replace(c, lens=lens) for c in head.cameras), cov=cov)


def with_table(head, sigma_deg=0.0, sigma_mm=0.0):
    """The head on a two-axis table whose axes meet in the world's origin."""
    extra = [np.diag([np.radians(sigma_deg) ** 2] * 3 + [(sigma_mm * MM) ** 2] * 3), np.zeros((10, 10))]
    table = HeadTable(("x", "z"), Pose3(), dict.fromkeys(TABLE_GEOMETRY, 0.0), Pose3())
    return replace(head, cov=block_diagonal([head.cov, *extra]), table=table)


def block_diagonal(blocks):
    n = sum(len(b) for b in blocks)
    out, at = np.zeros((n, n)), 0
    for b in blocks:
        out[at : at + len(b), at : at + len(b)] = b
        at += len(b)
    return out


def printed_beacons():
    """Table 4."""
    ids = tuple(f"B{i + 1}" for i in range(10))
    return Beacons(ids, BEACONS_MM * MM, np.eye(30) * BEACON_SIGMA**2)


def scattered_beacons(n, seed=1, sigma=BEACON_SIGMA):
    """n beacons around the head, 0.6 to 1.4 m away, in all directions."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    x *= (rng.uniform(0.6, 1.4, n) / np.linalg.norm(x, axis=1))[:, None]
    return Beacons(tuple(f"P{i + 1:02d}" for i in range(n)), x, np.eye(3 * n) * sigma**2)


def drawn(head, beacons, rng):
    """True head and beacons whose errors belong to the stated covariances."""
    cameras, at = [], 0
    step = _draw(head.cov, rng)
    for c in head.cameras:
        n = len(c.lens)
        pose = c.station_from_camera.compose(
            Pose3(Rot3(cv2.Rodrigues(step[at + n : at + n + 3])[0]), step[at + n + 3 : at + n + 6])
        )
        cameras.append(replace(c, lens=c.lens + step[at : at + n], station_from_camera=pose))
        at += n + 6
    x = beacons.x_in_world + _draw(beacons.cov, rng).reshape(-1, 3)
    return replace(head, cameras=tuple(cameras)), replace(beacons, x_in_world=x)


def _draw(cov, rng):
    values, vectors = np.linalg.eigh(cov)
    return vectors @ (np.sqrt(np.maximum(values, 0)) * rng.normal(size=len(cov)))


@dataclass(frozen=True)
class Sight:
    """What an epoch's simulation does to its spots.

    false_share: of all spots of an epoch, anywhere in the images of all cameras. most: beacons left in view.
    """

    sigma_px: float = 0.2
    named: bool = True
    false_share: float = 0.0
    missing: float = 0.0
    only: tuple = ()
    most: int = 0


def project(camera, world_from_station, x):
    """OpenCV's image points (m, 2) px and which of them are in the image."""
    q = (world_from_station * camera.station_from_camera).matrix()
    p = (x - q[:3, 3]) @ q[:3, :3]
    ok = (p[:, 2] > 0.02) & (np.hypot(p[:, 0], p[:, 1]) < 0.8 * p[:, 2])
    uv = np.full((len(x), 2), -1.0)
    if ok.any():
        v = camera.lens
        K = np.array([[v[0], 0, v[3]], [0, v[1], v[4]], [0, 0, 1]])
        uv[ok] = cv2.projectPoints(p[ok], np.zeros(3), np.zeros(3), K, v[5:10])[0].reshape(-1, 2)
    inside = ok & np.all((uv > 3) & (uv < np.array(SIZE) - 4), axis=1)
    return uv, inside


def simulated(head, beacons, world_from_station, rng, sight=Sight(), epoch_id="e", **more):
    """The epoch that true head and beacons give, and the true labels."""
    views = []
    for camera in head.cameras:
        uv, inside = project(camera, world_from_station, beacons.x_in_world)
        inside &= rng.random(len(inside)) >= sight.missing
        if sight.only:
            inside &= np.isin(beacons.beacon_ids, sight.only)
        views.append((uv, inside))
    if sight.most:
        in_view = np.flatnonzero(np.any([inside for _, inside in views], axis=0))
        kept = np.isin(np.arange(len(beacons.beacon_ids)), rng.permutation(in_view)[: sight.most])
        views = [(uv, inside & kept) for uv, inside in views]
    n_true = sum(int(inside.sum()) for _, inside in views)
    n_false = rng.binomial(n_true, sight.false_share / (1 - sight.false_share)) if sight.false_share else 0
    where = rng.integers(0, len(views), n_false)
    spots, truth = [], []
    for c, (camera, (uv, inside)) in enumerate(zip(head.cameras, views, strict=True)):
        names = [b for b, ok in zip(beacons.beacon_ids, inside, strict=True) if ok]
        points = uv[inside] + rng.normal(0, sight.sigma_px, (len(names), 2))
        extra = int((where == c).sum())
        points = np.vstack([points, rng.uniform((5, 5), np.array(SIZE) - 5, (extra, 2))])
        names += [None] * extra
        order = rng.permutation(len(names))
        names = tuple(names[i] for i in order)
        cov = np.tile(np.eye(2) * sight.sigma_px**2, (len(names), 1, 1))
        spots.append(Spots(camera.camera_id, points[order], cov, names if sight.named else None))
        truth.append(names)
    return NavigationEpoch(epoch_id, tuple(spots), **more), tuple(truth)


def turned(psi, wobble=(0.0, 0.0), place=(0.0, 0.0, 0.0)):
    """A pose of the head turned by psi about the main axis."""
    return Pose3(Rot3(about("z", psi) @ about("x", wobble[0]) @ about("y", wobble[1])), np.array(place))


def pose_error(estimated, true):
    """(6,) rad and m: ``true = estimated * Exp(error)``, to first order."""
    d = estimated.inverse().compose(true)
    return np.concatenate([Rot3.Logmap(d.rotation()), d.translation()])
