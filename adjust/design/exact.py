"""A survey whose observations are what its own model predicts: the design without the observations' values."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.design.prediction import Predictor
from adjust.design.readings import exact_readings
from adjust.graph.assembly import StartValues
from adjust.lenses.models import MODELS, camera_constants, project
from adjust.model.observations import Coordinates, Distance, ImageBlock, Pair
from adjust.model.result import ParameterName
from adjust.model.rewriting import Rewriting, Vector
from adjust.model.survey import PointParameter, PoseParameter, Survey


def exact(survey: Survey, start: StartValues) -> Survey:
    """The survey with every observation and prior as the model predicts it at ``start``: no residual is left.

    Raises SurveyError for an image point that these values put behind its camera, and for a point that should lie on a
    line but does not.
    """
    p = Predictor(survey, start)
    return replace(
        _Exact(p)(survey),
        image_blocks=tuple(_block(p, b) for b in survey.image_blocks),
        table_readings=tuple(replace(r, angles=p.reading(r)) for r in survey.table_readings),
        pairs=tuple(_pair(p, pair) for pair in survey.pairs),
        distances=tuple(_distance(p, d) for d in survey.distances),
        coordinates=tuple(_coordinates(p, c) for c in survey.coordinates),
        **exact_readings(p),
    )


def _block(p: Predictor, block: ImageBlock) -> ImageBlock:
    camera = p.cameras[block.camera_id]
    uv, q = p.image(block)
    if np.isnan(uv).any():
        lens = p.lens(camera, block.epoch_id)
        uv = project(MODELS[camera.lens.model], lens, camera_constants(camera), q)  # says why there is none
    return replace(block, uv=uv)


def _pair(p: Predictor, pair: Pair) -> Pair:
    motion = p.b_from_a(pair.a, pair.b)
    return replace(pair, b_from_a=motion if isinstance(pair.b_from_a, Pose3) else motion.rotation())


def _distance(p: Predictor, d: Distance) -> Distance:
    return replace(d, value=float(np.linalg.norm(p.position(d.b) - p.position(d.a))))


def _coordinates(p: Predictor, c: Coordinates) -> Coordinates:
    return replace(c, values=np.array([p.position(ref) for ref in c.positions]))


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
