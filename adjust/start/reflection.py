"""Results beside the start values that came with a survey: what lies far from them, and where its mirror image lies.

Distances do not tell a network from its mirror image, nor the two places of a point from which it is measured in a
plane; only the start values do.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.observations import PositionRef
from adjust.model.result import Adjustment
from adjust.model.survey import BoolArray, FloatArray, Survey

_SPREAD = 0.1
_AMONG, _SMALL = 20.0, 0.02
"""A point is far off by this share of the network's extent, or by so many times what is usual and a smaller share."""
_SIGMAS = 10.0
_FLAT = 0.05


@frozen(eq=False)
class Apart:
    """Points with start values: ids, the values given and found (n, 3) m, and which (n,) lie far from each other."""

    ids: tuple[str, ...]
    given: FloatArray
    found: FloatArray
    far: BoolArray

    @property
    def distances(self) -> FloatArray:
        """(n,) m."""
        return np.asarray(np.linalg.norm(self.found - self.given, axis=1))

    @property
    def rms(self) -> float:
        """Of the distances, m."""
        return float(np.sqrt(np.mean(self.distances**2))) if len(self.ids) else 0.0


def apart(survey: Survey, result: Adjustment) -> Apart:
    """The free points of a survey that came with a start value, and where they were adjusted."""
    ids, given, found, sigma = [], [], [], []
    for p in survey.points:
        estimate = result.estimates.get(("point", p.point_id))
        value = p.x_in_world.value
        if p.x_in_world.treatment != "free" or value is None or estimate is None or not np.isfinite(value).all():
            continue
        ids.append(p.point_id)
        given.append(np.asarray(value, dtype=float))
        found.append(np.asarray(estimate.value, dtype=float))
        sigma.append(float(np.sqrt(np.trace(estimate.cov))))
    x, y = np.array(given).reshape(-1, 3), np.array(found).reshape(-1, 3)
    d = np.linalg.norm(y - x, axis=1)
    every = np.array([np.asarray(e.value) for n, e in result.estimates.items() if n[0] == "point"]).reshape(-1, 3)
    extent = float(np.sqrt(((every - every.mean(axis=0)) ** 2).sum(axis=1).mean())) if len(every) > 1 else 0.0
    usual = float(np.median(d)) if len(d) else 0.0
    far = (d > _SPREAD * extent) | ((d > _AMONG * usual) & (d > _SMALL * extent))
    far &= d > _SIGMAS * max(1.0, result.sigma0 if np.isfinite(result.sigma0) else 1.0) * np.array(sigma)
    return Apart(tuple(ids), x, y, np.asarray(far if extent > 0.0 else np.zeros(len(d), dtype=np.bool_)))


def mirrored(survey: Survey, result: Adjustment, found: Apart) -> Iterator[dict[str, FloatArray]]:
    """Places (3,) m of points from which the adjustment may come out nearer to the start values, likeliest first.

    The far points mirrored in what they are measured from; all points mirrored in what is held; the whole network.
    """
    every = {n[1]: np.asarray(e.value, dtype=float) for n, e in result.estimates.items() if n[0] == "point"}
    free = [p.point_id for p in survey.points if p.x_in_world.treatment == "free"]
    flat = bool(free) and all("z" in p.x_in_world.held for p in survey.points if p.x_in_world.treatment == "free")
    near = _neighbours(survey)
    single = {}
    for n, far in zip(found.ids, found.far, strict=True):
        base = [every[m] for m in near.get(n, ()) if m in every]
        if far and (image := _image(every[n], np.array(base).reshape(-1, 3), flat)) is not None:
            single[n] = image
    held = np.array([every[p.point_id] for p in survey.points if p.x_in_world.treatment == "held"]).reshape(-1, 3)
    images = {n: _image(every[n], held, flat) for n in free if n in every}
    whole = _reflected_onto(found, every, flat)
    trials = [single, {n: x for n, x in images.items() if x is not None}, {n: whole[n] for n in free if n in whole}]
    yield from (trial for trial in trials if trial and _nearer(found, trial))


def _neighbours(survey: Survey) -> dict[str, set[str]]:
    """Points that distances or readings join to each point."""
    out: dict[str, set[str]] = {}

    def join(a: PositionRef, b: PositionRef) -> None:
        if a.frame is None and b.frame is None:
            out.setdefault(str(a.point_id), set()).add(str(b.point_id))
            out.setdefault(str(b.point_id), set()).add(str(a.point_id))

    for d in survey.distances:
        if d.used:
            join(d.a, d.b)
    for r in survey.readings:
        if r.used:
            join(r.at, r.to)
    return out


def _image(x: FloatArray, base: FloatArray, flat: bool) -> FloatArray | None:
    """Image (3,) of x in the plane of ``base`` (n, 3), in a plane network in their line; None where there is none."""
    dims = 2 if flat else 3
    if len(base) < dims:
        return None
    centre = base[:, :dims].mean(axis=0)
    _, s, Vt = np.linalg.svd(base[:, :dims] - centre, full_matrices=True)
    thin = s[dims - 1] if len(s) >= dims else 0.0
    if s[0] <= 0.0 or s[dims - 2] < 1e-3 * s[0] or thin > _FLAT * s[0] * 4.0:
        return None
    out = x.copy()
    out[:dims] -= 2.0 * ((x[:dims] - centre) @ Vt[dims - 1]) * Vt[dims - 1]
    return out


def _reflected_onto(found: Apart, every: Mapping[str, FloatArray], flat: bool) -> dict[str, FloatArray]:
    """All points by the motion with a reflection that brings those found nearest to those given (Umeyama 1991)."""
    dims = 2 if flat else 3
    if len(found.ids) <= dims:
        return {}
    a, b = found.given[:, :dims], found.found[:, :dims]
    U, s, Vt = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    if s[dims - 1] < 1e-9 * s[0]:
        return {}
    sign = np.ones(dims)
    sign[-1] = -np.sign(np.linalg.det(U @ Vt))
    R = (U * sign) @ Vt
    out = {}
    for n, x in every.items():
        out[n] = x.copy()
        out[n][:dims] = R @ (x[:dims] - b.mean(axis=0)) + a.mean(axis=0)
    return out


def _nearer(found: Apart, trial: Mapping[str, FloatArray]) -> bool:
    """Whether the places lie clearly nearer to the start values than what was found."""
    moved = np.array([trial.get(n, x) for n, x in zip(found.ids, found.found, strict=True)]).reshape(-1, 3)
    return float(((moved - found.given) ** 2).sum()) < 0.25 * float(((found.found - found.given) ** 2).sum())
