"""Fresh noise on a survey whose observations are exact: each gets a draw from its own covariance."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.design.prediction import Predictor
from adjust.graph.assembly import StartValues
from adjust.lenses.models import MODELS
from adjust.model.observations import ImageBlock
from adjust.model.result import ParameterName
from adjust.model.rewriting import Rewriting, Vector
from adjust.model.survey import FloatArray, LensParameter, PointParameter, PoseParameter, Survey

Rng = np.random.Generator
Truth = Mapping[ParameterName, Pose3 | FloatArray]


def disturbed(survey: Survey, rng: Rng, sigmas: FloatArray | None = None) -> Survey:
    """The survey with noisy observations; means of priors are observations too.

    sigmas: (N,) of the readings, where they are not simply those that each has. Positions that lie on a line by
    definition stay there.
    """
    of_readings = np.array([r.sigma for r in survey.readings]) if sigmas is None else sigmas
    s = replace(
        survey,
        image_blocks=tuple(_block(b, rng) for b in survey.image_blocks),
        table_readings=tuple(replace(r, angles=r.angles + draw(r.cov, rng)) for r in survey.table_readings),
        pairs=tuple(replace(p, b_from_a=moved(p.b_from_a, draw(p.cov, rng))) for p in survey.pairs),
        distances=tuple(replace(d, value=d.value + d.sigma * rng.standard_normal()) for d in survey.distances),
        coordinates=tuple(replace(c, values=c.values + draw(c.cov, rng).reshape(-1, 3)) for c in survey.coordinates),
    )
    s = with_drawn_priors(s, rng)
    drawn = of_readings * rng.standard_normal(len(of_readings))
    noise = dict(zip((r.reading_id for r in s.readings), drawn, strict=True))
    for c in s.reading_covariances:
        noise |= dict(zip(c.reading_ids, draw(c.cov, rng), strict=True))
    return replace(
        s,
        readings=tuple(replace(r, value=r.value + float(noise[r.reading_id])) for r in s.readings),
        coordinate_differences=tuple(
            replace(d, values=d.values + draw(d.cov, rng).reshape(-1, 3)) for d in s.coordinate_differences
        ),
        levels=tuple(replace(x, value=x.value + x.sigma * rng.standard_normal()) for x in s.levels),
        alignments=tuple(replace(x, value=x.value + draw(x.cov, rng)) for x in s.alignments),
        laser_spots=tuple(replace(x, xy=x.xy + draw(x.cov, rng)) for x in s.laser_spots),
        on_surfaces=tuple(replace(x, offset=x.offset + x.sigma * rng.standard_normal()) for x in s.on_surfaces),
    )


def displaced(survey: Survey, start: StartValues, rng: Rng) -> Survey:
    """The survey with its readings as instruments read them that stand a little beside their points, as they will."""
    sigmas = {s.setup_id: np.array([s.centring_sigma] * 2 + [s.height_sigma]) for s in survey.setups}
    if not any(s.any() for s in sigmas.values()):
        return survey
    true: dict[ParameterName, FloatArray] = {
        ("centring", i): s * rng.standard_normal(3) for i, s in sigmas.items() if s.any()
    }
    before = Predictor(survey, start)
    for name, vector in before.graph.unknowns.vectors.items():
        if name[0] == "orientation":  # as it is, not as the readings to come would show it
            true[name] = vector.full(before.values)
    there = replace(start, vectors={**start.vectors, **true})
    return replace(survey, readings=Predictor(survey, there).readings())


def draw(cov: FloatArray, rng: Rng) -> FloatArray:
    """(n,) with covariance (n, n); zero where nothing is known (infinite) and where a component is exact."""
    noise = np.zeros(len(cov))
    known = np.flatnonzero(np.isfinite(np.diag(cov)) & (np.diag(cov) > 0.0))
    if len(known):
        noise[known] = np.linalg.cholesky(cov[np.ix_(known, known)]) @ rng.standard_normal(len(known))
    return noise


def _block(block: ImageBlock, rng: Rng) -> ImageBlock:
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(block.cov), rng.standard_normal(block.uv.shape))
    return replace(block, uv=block.uv + noise)


def moved(value: Pose3 | Rot3, tangent: FloatArray) -> Pose3 | Rot3:
    """A rotation or pose with a small motion on its right."""
    if isinstance(value, Rot3):
        return value.compose(Rot3.Expmap(tangent))
    return value.compose(Pose3.Expmap(tangent))


def with_drawn_priors(survey: Survey, rng: Rng, truth: Truth | None = None) -> Survey:
    """Means of priors with a draw from their covariance: around what they are, or around the truth by name."""
    return _Drawn(rng, truth)(survey)


class _Drawn(Rewriting):
    def __init__(self, rng: Rng, truth: Truth | None) -> None:
        self.rng, self.truth = rng, truth

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        true = given.value if self.truth is None else self.truth.get(name)
        if given.treatment != "prior" or given.prior_cov is None or not isinstance(true, Pose3):
            return given
        return replace(given, value=true.compose(Pose3.Expmap(draw(given.prior_cov, self.rng))))

    def vector(self, name: ParameterName, given: Vector) -> Vector:
        prior = given.prior
        if prior is None:
            return given
        mean = prior.mean
        if self.truth is not None:
            true = self.truth.get(name)
            if true is None or isinstance(true, Pose3):
                return given
            names = MODELS[given.model].names if isinstance(given, LensParameter) else given.names
            mean = np.array([true[names.index(n)] for n in prior.names])
        return replace(given, prior=replace(prior, mean=mean + draw(prior.cov, self.rng)))

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        true = given.value if self.truth is None else self.truth.get(name)
        if given.treatment != "prior" or given.prior_cov is None or true is None or isinstance(true, Pose3):
            return given
        return replace(given, value=true + draw(given.prior_cov, self.rng))
