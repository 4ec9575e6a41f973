"""A survey whose observations are what its own model predicts: the design without the observations' values."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.design.prediction import Predictor
from adjust.graph.assembly import StartValues
from adjust.lenses.models import MODELS, camera_constants, project
from adjust.model.errors import SurveyError
from adjust.model.observations import Distance, ImageBlock, OnSurface, Pair
from adjust.model.result import ParameterName
from adjust.model.rewriting import Rewriting, Vector
from adjust.model.survey import FloatArray, PointParameter, PoseParameter, Survey
from adjust.observations.factors import ObservationFactor
from adjust.precision.precision import noise_of

_KINDS = ("level", "alignment", "laser", "surface")
_NO_RESIDUAL_M = 1e-7


def exact(survey: Survey, start: StartValues) -> Survey:
    """The survey with every observation and prior as the model predicts it at ``start``: no residual is left.

    Raises SurveyError for an image point that these values put behind its camera, and for a point that should lie on a
    line but does not.
    """
    p, s = Predictor(survey, start), survey
    wrong = {kind: [_residual(p, o) for o in p.graph.others if o.kind == kind] for kind in _KINDS}
    return replace(
        _Exact(p)(survey),
        image_blocks=tuple(_block(p, b) for b in s.image_blocks),
        table_readings=tuple(replace(r, angles=p.angles(r)) for r in s.table_readings),
        pairs=tuple(_pair(p, pair) for pair in s.pairs),
        distances=tuple(replace(d, value=_apart(p, d)) for d in s.distances),
        coordinates=tuple(replace(c, values=np.array([p.position(ref) for ref in c.positions])) for c in s.coordinates),
        readings=p.readings(),
        coordinate_differences=tuple(
            replace(d, values=np.array([p.position(b) - p.position(a) for a, b in zip(d.at, d.to, strict=True)]))
            for d in s.coordinate_differences
        ),
        levels=tuple(replace(x, value=x.value + float(w[0])) for x, w in zip(s.levels, wrong["level"], strict=True)),
        alignments=tuple(
            replace(x, value=_moved(x.value, x.cov, w)) for x, w in zip(s.alignments, wrong["alignment"], strict=True)
        ),
        laser_spots=tuple(replace(x, xy=x.xy + w) for x, w in zip(s.laser_spots, wrong["laser"], strict=True)),
        on_surfaces=tuple(
            replace(x, offset=_offset(x, w)) for x, w in zip(s.on_surfaces, wrong["surface"], strict=True)
        ),
    )


def _block(p: Predictor, block: ImageBlock) -> ImageBlock:
    camera = p.cameras[block.camera_id]
    uv, q, _ = p.image(block)
    if np.isnan(uv).any():
        lens = p.lens(camera, block.epoch_id)
        uv = project(MODELS[camera.lens.model], lens, camera_constants(camera), q)  # says why there is none
    return replace(block, uv=uv)


def _pair(p: Predictor, pair: Pair) -> Pair:
    motion = p.b_from_a(pair.a, pair.b)
    return replace(pair, b_from_a=motion if isinstance(pair.b_from_a, Pose3) else motion.rotation())


def _apart(p: Predictor, d: Distance) -> float:
    return float(np.linalg.norm(p.position(d.b) - p.position(d.a)))


def _residual(p: Predictor, item: ObservationFactor) -> FloatArray:
    b = np.asarray(item.factor.linearize(p.values).jacobian()[1])  # whitened, observed minus predicted
    return np.asarray(-np.linalg.solve(noise_of(item).R(), b))


def _moved(value: FloatArray, cov: FloatArray, residual: FloatArray) -> FloatArray:
    out = np.array(value, dtype=float)
    out[np.isfinite(np.diag(cov))] += residual
    return out


def _offset(o: OnSurface, residual: FloatArray) -> float:
    if len(residual) == 1:
        return float(o.offset + residual[0])
    if (far := float(np.linalg.norm(residual))) > _NO_RESIDUAL_M:
        name = o.position.point_id or "a position"
        raise SurveyError(
            f"{name} is to lie on line {o.surface_id!r}, but its coordinates are {1e3 * far:.3g} mm off; give it "
            "coordinates on the line"
        )
    return float(o.offset)


class _Exact(Rewriting):
    """Means of priors as the values are."""

    def __init__(self, p: Predictor) -> None:
        self.p, self.by_name = p, p.graph.unknowns.by_name

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        if given.treatment != "prior" or name not in self.by_name:
            return given
        return replace(given, value=self.p.values.atPose3(self.by_name[name].key))

    def epochs(
        self, name: ParameterName, given: Mapping[str, PoseParameter], usual: PoseParameter
    ) -> Mapping[str, PoseParameter]:
        """A prior that holds for all epochs becomes one for each, since each has its own value."""
        own = [n for n in self.by_name if n[:2] == name and len(n) == 3]
        wanted = {**given, **{n[2]: given.get(n[2], usual) for n in own}}
        listed = {e: x for e, x in wanted.items() if e in given or x.treatment == "prior"}
        return super().epochs(name, listed, usual)

    def vector(self, name: ParameterName, given: Vector) -> Vector:
        vector = self.p.graph.unknowns.vectors.get(name)
        if given.prior is None or vector is None:
            return given
        full = vector.full(self.p.values)
        mean = np.array([full[vector.names.index(n)] for n in given.prior.names])
        return replace(given, prior=replace(given.prior, mean=mean))

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        if given.treatment != "prior" or name not in self.by_name:
            return given
        return replace(given, value=np.asarray(self.p.values.atPoint3(self.by_name[name].key)))
