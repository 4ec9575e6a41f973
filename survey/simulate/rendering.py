"""Images as a real lens would see them: boards, marker blocks and LED beacons, with exactly known geometry.

The lens is OpenCV's (fx fy cx cy, k1 k2 p1 p2 k3 k4 k5 k6), the centre of the first pixel is (0, 0). Sub-pixels
integrate over their area (a Fibonacci lattice of rays where they see an edge); then follow a Gaussian point spread, the
sum to pixels, illumination, Gaussian noise and the digits of the sensor. What is nearer hides what is behind it.
"""

import threading
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from gtsam import Pose3
from scipy.special import erf

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.native.vision import Facets, draw_facets, pixel_corner_rays, spread_and_sum
from survey.simulate.facets import Facet, PlacedTarget, facets_of
from survey.simulate.scene import BROWN, Scene

GrayImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
_Gray32 = npt.NDArray[np.float32]
_kept = threading.local()


@frozen
class BrownCamera:
    """A camera with OpenCV's lens model; ``image_size`` (width, height) px, ``distortion`` up to k6, the rest zero."""

    image_size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def project(self, x_in_camera: FloatArray) -> FloatArray:
        """Image points (n, 2) px of points (n, 3) m in front of the camera."""
        matrix = np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])
        x = np.ascontiguousarray(x_in_camera, float).reshape(-1, 1, 3)
        uv, _ = cv2.projectPoints(x, np.zeros(3), np.zeros(3), matrix, np.array(self._coefficients()))
        return np.asarray(uv, float).reshape(-1, 2)

    def _coefficients(self) -> tuple[float, ...]:
        if len(self.distortion) > 8:
            raise SurveyError(f"distortion: {len(self.distortion)} coefficients given; give k1 k2 p1 p2 k3 k4 k5 k6")
        return self.distortion + (0.0,) * (8 - len(self.distortion))


@frozen(eq=False)
class Beacons:
    """Luminous spots that face the camera, at ``x_in_camera`` (n, 3) m.

    surface_gray: grey value of a large source of the same radiance (above 255: saturates when resolved); a spot smaller
    than the point spread peaks lower. A scalar or (n,). profile: ``disc`` of ``diameter_m``, or ``gaussian`` with
    a standard deviation of a quarter of it.
    """

    x_in_camera: FloatArray
    diameter_m: float
    surface_gray: float | FloatArray = 200.0
    profile: Literal["disc", "gaussian"] = "disc"


@frozen
class Imaging:
    """How light becomes digits.

    blur_px: standard deviation of the point spread. noise_gray: of each pixel. gradient: relative change of the
    illumination across the image's width and height. samples: rays in a sub-pixel that sees an edge. oversampling:
    sub-pixels across a pixel in which the point spread is applied (with 1 it becomes a staircase of whole pixels, which
    displaces axis-parallel edges by up to 0.03 px at a blur of 0.7 px).
    bits: grey values 0 to 255 are scaled to the full range of that many bits; above 8 the image is 16-bit.
    """

    blur_px: float = 0.7
    noise_gray: float = 2.0
    background_gray: float = 128.0
    gradient: tuple[float, float] = (0.0, 0.0)
    samples: Literal[21, 34, 55, 89, 144, 233, 377] = 55
    oversampling: int = 3
    bits: int = 8


def scene_camera(scene: Scene, camera_id: str) -> BrownCamera:
    """A camera as it truly is."""
    lens = dict(zip(BROWN, scene.vector("lens", camera_id), strict=True))
    distortion = tuple(float(lens[name]) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    size = scene.survey.cameras_by_id[camera_id].image_size
    return BrownCamera(size, lens["fx"], lens["fy"], lens["u0"], lens["v0"], distortion)


def may_be_seen(camera: BrownCamera, camera_from_target: Pose3, x_in_target: FloatArray) -> bool:
    """Whether a sphere around the target reaches into the cone around the image; rendering the others costs time."""
    middle = x_in_target.mean(axis=0)
    radius = 1.3 * float(np.linalg.norm(x_in_target - middle, axis=1).max())  # with what is around the points
    x, y, z = camera_from_target.transformFrom(middle)
    distance = float(np.linalg.norm((x, y, z)))
    if distance <= radius:
        return True
    half_field = np.arctan(0.5 * np.hypot(*camera.image_size) / min(camera.fx, camera.fy)) + np.radians(6.0)
    return bool(np.arctan2(np.hypot(x, y), z) < half_field + np.arcsin(radius / distance))


def render(
    camera: BrownCamera,
    targets: Sequence[PlacedTarget] = (),
    beacons: Beacons | None = None,
    imaging: Imaging | None = None,
    seed: int = 0,
) -> GrayImage:
    """The image (height, width) of all targets and beacons; equal arguments give equal images."""
    imaging = imaging or Imaging()
    facets = [facet for placed in targets for facet in facets_of(placed)]
    image = _blurred_planes(camera, facets, imaging)
    image *= _illumination(camera.image_size, imaging.gradient)
    if beacons is not None:
        _add_beacons(image, camera, beacons, facets, imaging.blur_px)
    rng = np.random.default_rng(seed)
    if imaging.noise_gray > 0.0:
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        noise *= imaging.noise_gray
        image += noise
    full = 2**imaging.bits - 1
    image *= full / 255.0
    np.clip(np.rint(image, out=image), 0, full, out=image)
    return np.asarray(image, np.uint8) if imaging.bits <= 8 else np.asarray(image, np.uint16)


def _blurred_planes(camera: BrownCamera, facets: list[Facet], imaging: Imaging) -> _Gray32:
    """Grey values under the point spread, which acts on sub-pixels before they are summed to pixels."""
    width, height = camera.image_size
    if not imaging.blur_px > 0.0:
        image = np.empty((height, width), np.float32)
        _draw_planes(camera, 1, facets, imaging, image)
        return image
    n = imaging.oversampling
    image = _canvas((n * height, n * width))
    _draw_planes(camera, n, facets, imaging, image)
    return spread_and_sum(image, n, n * imaging.blur_px)


def _canvas(shape: tuple[int, int]) -> _Gray32:
    """Room for sub-pixels, this thread's own until the next image: so much fresh memory takes as long as drawing."""
    kept = getattr(_kept, "canvas", None)
    if kept is None or kept.shape != shape:
        kept = _kept.canvas = np.empty(shape, np.float32)
    return np.asarray(kept)


@lru_cache(maxsize=4)
def _illumination(image_size: tuple[int, int], gradient: tuple[float, float]) -> _Gray32:
    width, height = image_size
    u, v = np.arange(width) / width - 0.5, np.arange(height) / height - 0.5
    return np.asarray(1.0 + gradient[0] * u[None, :] + gradient[1] * v[:, None], np.float32)


@lru_cache(maxsize=4)
def _rays(camera: BrownCamera) -> FloatArray:
    """Rays of the pixel corners; kept, since many images share a camera."""
    width, height = camera.image_size
    lens = np.array([camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *camera._coefficients()])
    return pixel_corner_rays(width, height, lens)


def _lattice(n: int) -> FloatArray:
    """Fibonacci lattice (n, 2) in the unit square; no two points share a row or column (good for straight edges)."""
    previous, current = 1, 1
    while current < n:
        previous, current = current, previous + current
    if current != n:
        raise SurveyError(f"samples: {n} is not a Fibonacci number; use 21, 34, 55, 89, 144, 233 or 377")
    i = np.arange(n)
    return np.stack([(i + 0.5) / n, ((i * previous) % n + 0.5) / n], axis=1)


def _draw_planes(camera: BrownCamera, n: int, facets: list[Facet], imaging: Imaging, image: _Gray32) -> None:
    """Grey values of n x n sub-pixels in each pixel, before the point spread, into image."""
    if not facets:
        image.fill(imaging.background_gray)
        return
    n_x, n_y = max(len(f.x_edges) for f in facets), max(len(f.y_edges) for f in facets)
    x_edges, y_edges = np.zeros((len(facets), n_x)), np.zeros((len(facets), n_y))
    cells, counts = np.zeros((len(facets), n_y - 1, n_x - 1)), np.zeros((len(facets), 2), np.int64)
    for k, f in enumerate(facets):
        rows, columns = f.cells.shape
        counts[k] = columns, rows
        x_edges[k, : columns + 1], y_edges[k, : rows + 1], cells[k, :rows, :columns] = f.x_edges, f.y_edges, f.cells
    inverse = np.stack([np.linalg.inv(f.camera_from_facet) for f in facets])
    bounds = np.stack([f.bounds() for f in facets])
    planes = Facets(inverse, bounds, counts, x_edges, y_edges, cells)
    draw_facets(_rays(camera), n, planes, float(imaging.background_gray), _lattice(imaging.samples), image)


def _add_beacons(image: _Gray32, camera: BrownCamera, beacons: Beacons, facets: list[Facet], blur_px: float) -> None:
    """Adds the spots to ``image``: many points of each disc, each with its point spread integrated over the pixels."""
    x = np.asarray(beacons.x_in_camera, float).reshape(-1, 3)
    surface = np.broadcast_to(np.asarray(beacons.surface_gray, float), (len(x),))
    for centre, gray in zip(x, surface, strict=True):
        if centre[2] <= 0.0 or any(f.hides(centre) for f in facets):
            continue
        points, area = _spot_points(centre, beacons)
        uv = camera.project(points)
        # px^2 of the source: the image's area over that of the source, by the directions that span it
        scale = np.linalg.det(np.linalg.lstsq(_plane_coordinates(centre, points), uv - uv.mean(0), rcond=None)[0])
        _splat(image, uv, abs(scale) * area * float(gray), blur_px)


def _spot_points(centre: FloatArray, beacons: Beacons, n: int = 200) -> tuple[FloatArray, float]:
    """Points (2 n, 3) of equal flux on a spot that faces the camera (sunflower pattern), and its area in m^2."""
    k = np.arange(n) + 0.5
    radius, angle = np.sqrt(k / n), np.pi * (1.0 + 5.0**0.5) * k
    r = beacons.diameter_m / 2.0
    area = np.pi * r * r
    if beacons.profile == "gaussian":
        radius, area = np.sqrt(-2.0 * np.log1p(-(radius**2))) / 2.0, 2.0 * np.pi * (r / 2.0) ** 2
    local = r * np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    local = np.concatenate([local, -local])  # odd moments vanish: the spot's centre is its centroid and its mode
    return centre + local @ _axes(centre), area


def _axes(centre: FloatArray) -> FloatArray:
    """Two unit vectors (2, 3) across the line of sight."""
    z = centre / np.linalg.norm(centre)
    x = np.cross([0.0, 1.0, 0.0], z) if abs(z[1]) < 0.9 else np.cross([1.0, 0.0, 0.0], z)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x)])


def _plane_coordinates(centre: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray((points - points.mean(0)) @ _axes(centre).T)


def _splat(image: _Gray32, uv: FloatArray, flux: float, blur_px: float) -> None:
    """Adds ``flux`` (grey px^2), spread evenly over the points ``uv`` and by the point spread."""
    sigma = max(blur_px, 1e-3)
    reach = 6.0 * sigma + 1.0
    height, width = image.shape
    u = np.arange(max(0, int(uv[:, 0].min() - reach)), min(width, int(uv[:, 0].max() + reach) + 2))
    v = np.arange(max(0, int(uv[:, 1].min() - reach)), min(height, int(uv[:, 1].max() + reach) + 2))
    if not len(u) or not len(v):
        return
    in_u, in_v = (_integral(k[:, None] - uv[None, :, a], sigma) for a, k in enumerate((u, v)))
    image[v[0] : v[-1] + 1, u[0] : u[-1] + 1] += (flux / len(uv)) * in_v @ in_u.T


def _integral(distance: FloatArray, sigma: float) -> FloatArray:
    """Share of a Gaussian that falls on a pixel at ``distance`` from its centre, in one direction."""
    s = sigma * np.sqrt(2.0)
    return np.asarray(0.5 * (erf((distance + 0.5) / s) - erf((distance - 0.5) / s)))
