"""Images of known points from which a lens is found: which of many, and how many points of each."""

from collections.abc import Sequence

import numpy as np

from adjust.model.survey import FloatArray
from adjust.start.views import ENOUGH, Sighting, few_of

MOST_IMAGES = 30
_MOST_POINTS = 1080  # of all images together


def plane_coordinates(x: FloatArray) -> FloatArray | None:
    """Coordinates (n, 2) of points in their plane, of unit size; None where they are no plane, or on a line."""
    centred = x - x.mean(axis=0)
    squares, vectors = np.linalg.eigh(centred.T @ centred)
    thin, middle, long = np.sqrt(np.maximum(squares, 0.0))
    if not (middle > 1e-3 * long and thin < 1e-2 * middle):
        return None
    xy = centred @ vectors[:, :0:-1]
    return np.asarray(xy / np.sqrt((xy**2).sum(axis=1).max()))


def enough_points(n_images: int) -> int:
    """Points of each of so many images that tell the lens and all poses."""
    return max(ENOUGH, _MOST_POINTS // max(1, min(n_images, MOST_IMAGES)))


def thinned(images: Sequence[Sighting], most: int) -> list[Sighting]:
    """The images with at most so many points each, one array for all that show the same."""
    parts = {i: x[few_of(len(x), most)] for i, x in {id(s.x): s.x for s in images if len(s.x) > most}.items()}
    return [s._replace(x=parts[id(s.x)], uv=s.uv[few_of(len(s.x), most)]) if id(s.x) in parts else s for s in images]


def every_nth(images: Sequence[Sighting], n: int) -> list[Sighting]:
    """At most n of them, evenly."""
    if len(images) <= n:
        return list(images)
    return [images[int(i)] for i in np.unique(np.linspace(0, len(images) - 1, n).round())]


def spread_out(images: Sequence[Sighting]) -> list[Sighting]:
    """``MOST_IMAGES`` at most, that differ most in place, size and tilt of the target (farthest-point sampling)."""
    if len(images) <= MOST_IMAGES:
        return list(images)
    features = _features(images)
    features = (features - features.mean(axis=0)) / np.maximum(features.std(axis=0), 1e-9)
    squares = ((features[:, None] - features) ** 2).sum(axis=2)  # of at most _MOST_SCREENED images
    sizes = [len(s.x) for s in images]
    chosen = [sizes.index(max(sizes))]
    nearest = squares[chosen[0]]
    while len(chosen) < MOST_IMAGES:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, squares[chosen[-1]])
    return [images[i] for i in sorted(chosen)]


def _features(images: Sequence[Sighting]) -> FloatArray:
    """Of every image centroid, logarithm of the size, and shape of the covariance of the image points, (B, 5)."""
    counts = np.array([len(s.uv) for s in images])
    first, uv = np.cumsum([0, *counts[:-1]]), np.concatenate([s.uv for s in images])
    mean = np.add.reduceat(uv, first) / counts[:, None]
    u, v = (uv - np.repeat(mean, counts, axis=0)).T
    uu, uv_, vv = (np.add.reduceat(p, first) / (counts - 1) for p in (u * u, u * v, v * v))
    size = np.sqrt(uu + vv)
    return np.column_stack([mean / size[:, None], np.log(size), (uu - vv) / size**2, uv_ / size**2])
