"""A terrestrial network on its way out of the program: the survey, where its points are, and how well that is known."""

from collections.abc import Iterable, Mapping
from dataclasses import field

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import CoordinateDifferences, Coordinates, Distance, PositionRef, Reading
from adjust.model.survey import FloatArray, Survey
from survey.solution.quantities import SigmaKind


@frozen(eq=False)
class NetworkValues:
    """x: (3,) m by point, adjusted or start values; points without either are missing.

    covs: (3, 3) m^2 by point, empty where not adjusted; multiplied by factor^2. joint: of ``names`` (point, axis).
    sigmas, alpha: what the project asks for.
    """

    survey: Survey
    title: str
    x: Mapping[str, FloatArray]
    adjusted: bool = False
    covs: Mapping[str, FloatArray] = field(default_factory=dict)
    factor: float = 1.0
    names: tuple[tuple[str, str], ...] = ()
    joint: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    n_observations: int = 0
    n_unknowns: int = 0
    redundancy: int = 0
    omega: float = 0.0
    sigmas: SigmaKind | None = None
    alpha: float = 0.05


def point_of(position: PositionRef) -> str | None:
    """The world point that a position is, or None."""
    return position.point_id if position.frame is None else None


Observed = Reading | Distance | CoordinateDifferences | Coordinates


def between_points(observation: Observed) -> bool:
    """Whether all ends of an observation are world points."""
    return all(point_of(e) is not None for e in ends_of(observation))


def ends_of(observation: Observed) -> list[PositionRef]:
    """The positions that an observation is of: where a reading stands, and what it sights."""
    match observation:
        case Reading():
            return [e for e in (observation.at, observation.to, observation.second) if e is not None]
        case Distance():
            return [observation.a, observation.b]
        case CoordinateDifferences():
            return [*observation.at, *observation.to]
        case Coordinates():
            return list(observation.positions)


def readings_of(survey: Survey) -> list[Reading]:
    """Readings in use between world points; distances among them, of no instrument."""
    names = {r.reading_id for r in survey.readings}
    found = [r for r in survey.readings if r.used]
    for d in survey.distances:
        name = f"distance-{d.distance_id}" if d.distance_id in names else d.distance_id
        found += [Reading(name, "slope_distance", d.a, d.b, d.value, d.sigma)] if d.used else []
    return [r for r in found if between_points(r)]


@frozen(eq=False)
class Triples:
    """Baselines from ``at`` to ``to``, or coordinates of ``to`` (n): values (n, 3) m, cov (3n, 3n), inf: unobserved."""

    at: tuple[str, ...]
    to: tuple[str, ...]
    values: FloatArray
    cov: FloatArray


def triples_of(survey: Survey, priors: bool = False) -> tuple[list[Triples], list[Triples]]:
    """Baselines and coordinates in use of world points; priors: those of points among the latter."""
    differences, coordinates = [], []
    for d in survey.coordinate_differences:
        if d.used and between_points(d):
            differences.append(Triples(_world(d.at), _world(d.to), d.values, d.cov))
    for c in survey.coordinates:
        if c.used and between_points(c):
            coordinates.append(Triples((), _world(c.positions), c.values, c.cov))
    for point in survey.points if priors else ():
        x = point.x_in_world
        if x.treatment == "prior" and x.value is not None and x.prior_cov is not None:
            coordinates.append(Triples((), (point.point_id,), x.value[None], x.prior_cov))
    return differences, coordinates


def _world(positions: Iterable[PositionRef]) -> tuple[str, ...]:
    return tuple(name for p in positions if (name := point_of(p)) is not None)


def _held(survey: Survey) -> dict[str, tuple[Observed, ...]]:
    """Observations that formats of networks hold, by kind."""
    return {
        "readings": survey.readings, "coordinate_differences": survey.coordinate_differences,
        "coordinates": survey.coordinates, "distances": survey.distances,
    }  # fmt: skip


def counted(survey: Survey) -> dict[str, int]:
    """How much formats of networks hold of a survey, by what it is called."""
    baselines, coordinates = triples_of(survey)
    counts = {
        "readings": len(readings_of(survey)), "baselines": sum(len(t.to) for t in baselines),
        "coordinates": sum(len(t.to) for t in coordinates),
    }  # fmt: skip
    return {"points": len(survey.points)} | {what: n for what, n in counts.items() if n}


def left_out(survey: Survey, unused: bool = True) -> tuple[str, ...]:
    """What formats of networks cannot hold, for people; unused: observations that are not in use are among it."""
    counts = {
        "cameras": len(survey.cameras),
        "stations": len(survey.stations),
        "tables": len(survey.tables),
        "targets": len(survey.targets),
        "image points": sum(len(b.uv) for b in survey.image_blocks),
        "table readings": len(survey.table_readings),
        "pairs": len(survey.pairs),
        "beams and spots": len(survey.beams) + len(survey.laser_spots),
        "surfaces": len(survey.surfaces),
        "levels": len(survey.levels),
        "alignments": len(survey.alignments),
        "free parameters of instruments": sum(len(i.parameters.free) for i in survey.instruments),
        **{
            f"{kind.replace('_', ' ')} on stations, cameras or targets": sum(not between_points(o) for o in every)
            for kind, every in _held(survey).items()
        },
        "observations not in use": unused * sum(not o.used for every in _held(survey).values() for o in every),
        "centring errors": sum(r.target_centring_sigma > 0.0 for r in survey.readings)
        + sum(s.centring_sigma > 0.0 or s.height_sigma > 0.0 for s in survey.setups),
        "tilts or curvature of the level surface": int(
            survey.vertical.radius is not None or len(survey.vertical.tilt.free) > 0
            or not np.array_equal(survey.vertical.up_in_world, [0.0, 0.0, 1.0])
        ),
    }  # fmt: skip
    return tuple(f"left out, {what}: {n}" for what, n in counts.items() if n)


def require_network(survey: Survey, where: str, what: str) -> None:
    """Raise where nothing of the survey can be written as a network."""
    if not survey.points:
        raise SurveyError(f"{where}: the project has no points; {what} holds networks of points")
