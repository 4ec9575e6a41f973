"""Confidence ellipsoids, and the precision of one point, station or camera relative to another."""

from collections.abc import Sequence

import numpy as np
from gtsam import Pose3

from adjust.graph.assembly import values_of
from adjust.graph.building import GraphBuilder
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray
from adjust.observations.factors import ChainPose
from adjust.precision.precision import rotations_only
from adjust.statistics.result import Ellipsoid, RelativePrecision
from adjust.testing.distributions import chi2, fisher

_HELD = 1e-16
"""Variance (m^2) of what is held, (10 nm)^2."""
Place = ParameterName | FrameRef


def ellipsoid(
    cov: FloatArray, level: float = 0.95, sigma0: float | None = None, redundancy: int = 0
) -> Ellipsoid:
    """Confidence region of a position with covariance (3, 3) or, of x and y alone, (2, 2); m^2.

    With sigma0 (and its redundancy) the covariance is scaled by it and Fisher's F stands for chi-square.
    """
    return ellipsoids(cov[None], level, sigma0, redundancy)[0]


def ellipsoids(
    cov: FloatArray, level: float = 0.95, sigma0: float | None = None, redundancy: int = 0
) -> list[Ellipsoid]:
    """The same of many positions, (p, 3, 3) or (p, 2, 2)."""
    values, vectors = np.linalg.eigh(0.5 * (cov + np.swapaxes(cov, 1, 2)))
    scaled, k = sigma0 is not None and redundancy > 0, np.arange(1, 4)
    if sigma0 is not None and redundancy > 0:
        quantiles = k * fisher.ppf(level, k, redundancy) * sigma0**2
    else:
        quantiles = chi2.ppf(level, k)
    n_kept = (values > _HELD).sum(axis=1)
    semi_axes = np.sqrt(quantiles[np.maximum(1, n_kept) - 1, None] * np.where(values > _HELD, values, 0.0))[:, ::-1]
    axes = np.zeros((len(cov), 3, cov.shape[1]))
    axes[:, : cov.shape[1]] = vectors[:, :, ::-1]
    return [Ellipsoid(a[:n], x[:, :n], level, scaled) for n, a, x in zip(n_kept.tolist(), semi_axes, axes, strict=True)]


def relative_precision(
    adjustment: Adjustment, pairs: Sequence[tuple[Place, Place]], level: float = 0.95, scaled: bool = False
) -> tuple[RelativePrecision, ...]:
    """Of b relative to a, for every pair (a, b); positions are nan in networks of rotations alone.

    Places are names of unknowns that are points or poses in the world, or frames (cameras, stations on a table ...).
    Raises SurveyError for a name that is no position.
    """
    places = _Places(adjustment)
    known = {what: places.place(what) for what in dict.fromkeys(what for both in pairs for what in both)}
    found = [(known[a], known[b]) for a, b in pairs]
    unknowns = (tuple(dict.fromkeys([*a.by, *b.by])) for a, b in found)
    adjustment.precision.bring_together((names[0], names[1]) for names in unknowns if len(names) == 2)
    covs = [_covariance(adjustment, a, b) for a, b in found]
    own = np.array([cov[3:, 3:] for cov in covs]).reshape(-1, 3, 3)
    sigma0 = adjustment.sigma0 if scaled and adjustment.redundancy > 0 else None
    regions = ellipsoids(own, level, sigma0, adjustment.redundancy)
    none = Ellipsoid(np.zeros(0), np.zeros((3, 0)), level, scaled)
    return tuple(_relative(*both, cov, region, none) for both, cov, region in zip(found, covs, regions, strict=True))


@frozen(eq=False)
class _Place:
    """A position x (3,), its axes R (3, 3), and derivatives (6, dim) by unknowns: turn (own axes), x (world)."""

    name: ParameterName
    x: FloatArray
    R: FloatArray | None
    by: dict[ParameterName, FloatArray]


class _Places:
    """Positions by name or frame; the frames of a survey are built when one is asked for."""

    def __init__(self, adjustment: Adjustment) -> None:
        self.adjustment = adjustment
        self.builder: GraphBuilder | None = None

    def place(self, what: Place) -> _Place:
        if isinstance(what, FrameRef):
            return self._frame(what)
        estimate = self.adjustment.estimates.get(what)
        if estimate is None or what[0] not in ("point", "world_from_station", "world_from_table"):
            raise SurveyError(f"{' '.join(what)}: no such position was adjusted; name a point, a station or a frame")
        held = np.array([s == "held" for s in estimate.status], dtype=np.bool_)
        if isinstance(estimate.value, Pose3):
            R, x, J = estimate.value.rotation().matrix(), np.asarray(estimate.value.translation()), np.eye(6)
            J[3:, 3:] = R
            if rotations_only(self.adjustment):
                x, J[3:], held = np.full(3, np.nan), 0.0, np.full(6, held.all())
            return _Place(what, x, R, {} if held.all() else {what: J * ~held})
        return _Place(what, np.asarray(estimate.value), None, {} if held.all() else {what: np.eye(6)[:, 3:] * ~held})

    def _frame(self, ref: FrameRef) -> _Place:
        if self.builder is None:
            start = values_of(self.adjustment)
            self.builder = GraphBuilder(self.adjustment.survey, start.lenses)
            self.graph = self.builder.build(start)
        unknowns = self.graph.unknowns
        chain = self.builder.frames.relative(ref, FrameRef("world"))
        pose, jacobians = ChainPose(unknowns, self.graph.state, chain)(self.graph.start)
        R, by = pose.rotation().matrix(), dict[ParameterName, FloatArray]()
        for key, D in jacobians:
            J = np.vstack([D[:3], R @ D[3:]])
            J[:, list(unknowns.held.get(key, ()))] = 0.0
            name = unknowns.by_key[key].name
            by[name] = by[name] + J if name in by else J
        called: ParameterName = (ref.kind, ref.frame_id) + ((ref.epoch_id,) if ref.epoch_id else ())
        return _Place(called, np.asarray(pose.translation()), R, by)


def _covariance(adjustment: Adjustment, a: _Place, b: _Place) -> FloatArray:
    """Of b relative to a (6, 6): turn in the axes of b, position in the world."""
    dims = {n: J.shape[1] for p in (a, b) for n, J in p.by.items()}
    back = b.R.T @ a.R if a.R is not None and b.R is not None else np.eye(3)
    columns = [np.zeros((6, 0))]
    for n, dim in dims.items():
        of_a, of_b = (p.by.get(n, np.zeros((6, dim))) for p in (a, b))
        columns.append(np.vstack([of_b[:3] - back @ of_a[:3], of_b[3:] - of_a[3:]]))
    J = np.hstack(columns)
    return np.asarray(J @ np.asarray(adjustment.precision.joint(list(dims))) @ J.T if dims else np.zeros((6, 6)))


def _relative(a: _Place, b: _Place, cov: FloatArray, region: Ellipsoid, none: Ellipsoid) -> RelativePrecision:
    """region: of positions; none: where there are none."""
    d, own, of_rotation = b.x - a.x, cov[3:, 3:], cov[:3, :3] if a.R is not None and b.R is not None else None
    if not np.isfinite(d).all():
        return RelativePrecision(a.name, b.name, d, np.full((3, 3), np.nan), np.nan, np.nan, none, of_rotation)
    length = float(np.linalg.norm(d))
    u = d / length if length > 0.0 else np.zeros(3)
    along = float(np.sqrt(max(0.0, float(u @ own @ u))))
    return RelativePrecision(a.name, b.name, d, own, length, along, region, of_rotation)
