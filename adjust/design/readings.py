"""Terrestrial and geometric observations of a design: as the model predicts them, and with fresh noise."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from adjust.design.prediction import Predictor
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.result import ParameterName
from adjust.model.rewriting import Fields
from adjust.model.survey import FloatArray, Survey, VectorParameter, VectorPrior
from adjust.observations.factors import ObservationFactor
from adjust.precision.precision import noise_of

Rng = np.random.Generator
_NO_RESIDUAL_M = 1e-7


def exact_readings(p: Predictor) -> Fields:
    """The fields of the survey with the readings and geometric observations that the predictor's values give.

    Raises SurveyError for a position that should lie on a line and does not: only its coordinates could mend that.
    """
    s = p.survey
    wrong = {kind: [_residual(p, o) for o in p.graph.others if o.kind == kind] for kind in _KINDS}
    return {
        "readings": tuple(replace(r, value=v) for r, v in zip(s.readings, predicted_readings(p), strict=True)),
        "coordinate_differences": tuple(
            replace(d, values=np.array([p.position(b) - p.position(a) for a, b in zip(d.at, d.to, strict=True)]))
            for d in s.coordinate_differences
        ),
        "levels": tuple(
            replace(x, value=x.value + float(w[0])) for x, w in zip(s.levels, wrong["level"], strict=True)
        ),
        "alignments": tuple(
            replace(x, value=_moved(x.value, x.cov, w)) for x, w in zip(s.alignments, wrong["alignment"], strict=True)
        ),
        "laser_spots": tuple(replace(x, xy=x.xy + w) for x, w in zip(s.laser_spots, wrong["laser"], strict=True)),
        "on_surfaces": tuple(
            replace(x, offset=_offset(p, i, w))
            for i, (x, w) in enumerate(zip(s.on_surfaces, wrong["surface"], strict=True))
        ),
        "instruments": tuple(
            replace(x, parameters=_with_mean(p, ("instrument", x.instrument_id), x.parameters)) for x in s.instruments
        ),
        "beams": tuple(replace(x, parameters=_with_mean(p, ("beam", x.beam_id), x.parameters)) for x in s.beams),
        "surfaces": tuple(
            x if x.parameters is None
            else replace(x, parameters=_with_mean(p, ("surface", x.surface_id), x.parameters)) for x in s.surfaces
        ),
        "vertical": replace(s.vertical, tilt=_with_mean(p, ("vertical",), s.vertical.tilt)),
    }  # fmt: skip


_KINDS = ("level", "alignment", "laser", "surface")


def predicted_readings(p: Predictor) -> list[float]:
    """Values of all readings, rad and m, horizontal angles in (-pi, pi]."""
    batch = p.graph.terrestrial
    if batch is None:
        return []
    batch.evaluate(p.values)
    return [r.value + float(w) for r, w in zip(p.survey.readings, batch.residual, strict=True)]


def reading_sigmas(survey: Survey, start: StartValues) -> FloatArray:
    """Sigmas (N,) of all readings with the centring of their targets, rad and m."""
    p = Predictor(survey, start)
    batch = p.graph.terrestrial
    if batch is None:
        return np.zeros(0)
    return np.array(batch.with_sigmas_at(p.values)[0].sigma)


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
    p = Predictor(survey, replace(start, vectors={**start.vectors, **true}))
    return replace(
        survey, readings=tuple(replace(r, value=v) for r, v in zip(survey.readings, predicted_readings(p), strict=True))
    )


def disturbed_readings(survey: Survey, sigmas: FloatArray, rng: Rng) -> Fields:
    """The fields of the survey with noise on these observations and on the means of their priors.

    sigmas: (N,) of the readings. Positions that lie on a line by definition stay there.
    """
    noise = dict(zip((r.reading_id for r in survey.readings), sigmas * rng.standard_normal(len(sigmas)), strict=True))
    for c in survey.reading_covariances:
        noise |= dict(zip(c.reading_ids, draw(c.cov, rng), strict=True))
    return {
        "readings": tuple(replace(r, value=r.value + float(noise[r.reading_id])) for r in survey.readings),
        "coordinate_differences": tuple(
            replace(d, values=d.values + draw(d.cov, rng).reshape(-1, 3)) for d in survey.coordinate_differences
        ),
        "levels": tuple(replace(x, value=x.value + x.sigma * rng.standard_normal()) for x in survey.levels),
        "alignments": tuple(replace(x, value=x.value + draw(x.cov, rng)) for x in survey.alignments),
        "laser_spots": tuple(replace(x, xy=x.xy + draw(x.cov, rng)) for x in survey.laser_spots),
        "on_surfaces": tuple(replace(x, offset=x.offset + x.sigma * rng.standard_normal()) for x in survey.on_surfaces),
        "instruments": tuple(replace(x, parameters=_noisy(x.parameters, rng)) for x in survey.instruments),
        "beams": tuple(replace(x, parameters=_noisy(x.parameters, rng)) for x in survey.beams),
        "surfaces": tuple(
            x if x.parameters is None else replace(x, parameters=_noisy(x.parameters, rng)) for x in survey.surfaces
        ),
        "vertical": replace(survey.vertical, tilt=_noisy(survey.vertical.tilt, rng)),
    }


def draw(cov: FloatArray, rng: Rng) -> FloatArray:
    """(n,) with covariance (n, n); zero where nothing is known (infinite) and where a component is exact."""
    noise = np.zeros(len(cov))
    known = np.flatnonzero(np.isfinite(np.diag(cov)) & (np.diag(cov) > 0.0))
    if len(known):
        noise[known] = np.linalg.cholesky(cov[np.ix_(known, known)]) @ rng.standard_normal(len(known))
    return noise


def _residual(p: Predictor, item: ObservationFactor) -> FloatArray:
    b = np.asarray(item.factor.linearize(p.values).jacobian()[1])  # whitened, observed minus predicted
    return np.asarray(-np.linalg.solve(noise_of(item).R(), b))


def _moved(value: FloatArray, cov: FloatArray, residual: FloatArray) -> FloatArray:
    out = np.array(value, dtype=float)
    out[np.isfinite(np.diag(cov))] += residual
    return out


def _offset(p: Predictor, number: int, residual: FloatArray) -> float:
    o = p.survey.on_surfaces[number]
    if len(residual) == 1:
        return float(o.offset + residual[0])
    if (far := float(np.linalg.norm(residual))) > _NO_RESIDUAL_M:
        name = o.position.point_id or "a position"
        raise SurveyError(
            f"{name} is to lie on line {o.surface_id!r}, but its coordinates are {1e3 * far:.3g} mm off; give it "
            "coordinates on the line"
        )
    return float(o.offset)


def _with_mean(p: Predictor, name: ParameterName, parameter: VectorParameter) -> VectorParameter:
    vector = p.graph.unknowns.vectors.get(name)
    if parameter.prior is None or vector is None:
        return parameter
    full: Mapping[str, float] = dict(zip(vector.names, vector.full(p.values), strict=True))
    return replace(parameter, prior=replace(parameter.prior, mean=np.array([full[n] for n in parameter.prior.names])))


def _noisy(parameter: VectorParameter, rng: Rng) -> VectorParameter:
    prior: VectorPrior | None = parameter.prior
    if prior is None:
        return parameter
    return replace(parameter, prior=replace(prior, mean=prior.mean + draw(prior.cov, rng)))
