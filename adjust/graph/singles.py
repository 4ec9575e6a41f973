"""Observations that are in no batch, and what holds single components: each has a factor of its own."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from adjust.frames.state import State
from adjust.frames.unknowns import Chain, Unknowns
from adjust.model.errors import SurveyError
from adjust.model.observations import Coordinates, PositionRef, position_text
from adjust.model.result import ParameterName
from adjust.model.rewriting import vector_parameters
from adjust.model.survey import FloatArray, PointParameter, PoseParameter, Survey, VectorPrior
from adjust.observations.between_epochs import reading_residual
from adjust.observations.clocks import Shifts
from adjust.observations.factors import (
    ObservationFactor,
    Position,
    coordinates_factor,
    custom,
    distance_factor,
    gaussian,
    hold_factor,
    known_components,
    pair_item,
    pose_prior_factor,
    step_factor,
    vector_prior_factor,
)

if TYPE_CHECKING:
    from adjust.observations.pairs import PairBatch
    from adjust.observations.terrestrial.batch import TerrestrialBatch


class Singles:
    """The factors of single observations, in the order in which they are asked for; one use.

    shifts: of the tables' angles to other times, where there are clocks.
    """

    def __init__(self, survey: Survey, unknowns: Unknowns, state: State, shifts: Shifts | None) -> None:
        self.survey, self.unknowns, self.state, self.shifts = survey, unknowns, state, shifts
        self.items: list[ObservationFactor] = []

    def add_table_readings(self) -> None:
        """Of the tables that something else is observed on."""
        for reading in self.survey.table_readings:
            unknown = self.unknowns.by_name.get(("table_angles", reading.table_id, reading.epoch_id))
            if unknown is not None:
                factor: gtsam.NonlinearFactor
                factor = gtsam.PriorFactorVector(unknown.key, reading.angles, gaussian(reading.cov))
                shifted = None if self.shifts is None else self.shifts.reading(reading)
                if shifted is not None:
                    keys, residual = reading_residual(shifted, self.unknowns, reading.angles)
                    factor = custom(keys, reading.cov, residual)
                self._add(factor, "table", reading.group, (reading.table_id, reading.epoch_id), unknown.components,
                            unknown.units, reading.angles, reading.used)  # fmt: skip

    def add_pairs(self, chains: Mapping[int, Chain]) -> None:
        """Those of these numbers, with their chains."""
        pairs = self.survey.pairs
        self.items += [pair_item(pairs[i], self.unknowns, self.state, chain) for i, chain in chains.items()]

    def add_distances(self, at: Mapping[PositionRef, Position]) -> None:
        """Raises SurveyError for one between held positions."""
        for d in self.survey.distances:
            if not at[d.a].keys and not at[d.b].keys:
                raise SurveyError(f"distance {d.distance_id!r} joins two held positions; it can adjust nothing")
            ids = (d.distance_id, position_text(d.a), position_text(d.b))
            self._add(distance_factor(d, at[d.a], at[d.b]), "distance", d.group, ids, ("distance",), ("m",),
                        np.array([d.value]), d.used)  # fmt: skip

    def add_coordinates(self, at: Mapping[PositionRef, Position]) -> None:
        """Each set is one factor."""
        for c in self.survey.coordinates:
            known, owners = known_components(c.cov), tuple(position_text(p) for p in c.positions)
            names = tuple(np.array([f"{owner} {axis}" for owner in owners for axis in "xyz"])[known].tolist())
            self._add(coordinates_factor(c, [at[p] for p in c.positions]), "coordinates", c.group, owners, names,
                        ("m",) * len(names), c.values.ravel()[known], c.used)  # fmt: skip

    def add_priors(self, of_readings: Mapping[ParameterName, VectorPrior]) -> None:
        """Of all unknowns; those that readings have are given."""
        for name, pose in self.unknowns.parameters.items():
            if pose.treatment == "prior":
                self._add_prior(name, pose)
        for p in self.survey.points:
            if p.x_in_world.treatment == "prior":
                self._add_prior(("point", p.point_id), p.x_in_world)
        self._vector_priors(of_readings)

    def _add_prior(self, name: ParameterName, parameter: PoseParameter | PointParameter) -> None:
        if parameter.value is None or parameter.prior_cov is None:
            raise SurveyError(f"{' '.join(name)} has a prior without value or covariance; give both")
        unknown, known = self.unknowns.by_name[name], known_components(parameter.prior_cov)
        if isinstance(parameter, PoseParameter):
            factor, observed = pose_prior_factor(parameter, unknown.key), np.zeros(6)
        else:
            mean = Coordinates((PositionRef(name[1]),), np.asarray(parameter.value)[None], parameter.prior_cov)
            factor = coordinates_factor(mean, [Position(None, np.zeros(3), unknown.key)])
            observed = np.asarray(parameter.value)
        components, units = (tuple(np.array(x)[known].tolist()) for x in (unknown.components, unknown.units))
        self._add(factor, "prior", "prior", name, components, units, observed[known])

    def _vector_priors(self, of_readings: Mapping[ParameterName, VectorPrior]) -> None:
        u = self.unknowns
        of_owners = {name: p.prior for name, p in vector_parameters(self.survey).items() if name[0] != "instrument"}
        for name, sigma in ({} if self.shifts is None else self.shifts.jitters).items():
            factor = step_factor(u.vectors[name], None, np.array([sigma]))
            self._add(factor, "prior", "prior", name, ("jitter",), u.vectors[name].units, np.zeros(1))
        for name, before, sigmas in self.state.lens_states.priors:
            change = u.vectors[name]
            factor = step_factor(change, None if before is None else u.vectors[before], sigmas)
            self._add(factor, "prior", "prior", name, change.names, change.units, np.zeros(len(sigmas)))
        for name, prior in (of_owners | dict(of_readings)).items():
            vector = u.vectors.get(name)
            if prior is not None and vector is not None and vector.key is not None:
                units = tuple(vector.units[vector.names.index(x)] for x in prior.names)
                self._add(vector_prior_factor(prior, vector), "prior", "prior", name, prior.names, units, prior.mean)

    def _add(
        self, factor: gtsam.NonlinearFactor, kind: str, group: str, ids: tuple[str, ...], components: tuple[str, ...],
        units: tuple[str, ...], observed: FloatArray, used: bool = True,
    ) -> None:  # fmt: skip
        self.items.append(
            ObservationFactor(factor, kind, group, ids, components, units, np.asarray(observed, dtype=float), used)
        )

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The factors of those that take part, and what holds components. Raises SurveyError where one has no value."""
        graph, u = gtsam.NonlinearFactorGraph(), self.unknowns
        for item in self.items:
            if item.used:
                graph.add(item.factor)
        points: dict[ParameterName, FloatArray | None]
        points = {("point", p.point_id): p.x_in_world.value for p in self.survey.points if u.held}
        for key, held in u.held.items():
            unknown = u.by_key[key]
            value = points[unknown.name] if unknown.kind == "point" else u.parameters[unknown.name].value
            if value is None:
                names = ", ".join(unknown.components[i] for i in held)
                raise SurveyError(f"{' '.join(unknown.name)}: {names} held without a value; give it one")
            graph.add(hold_factor(unknown, held, value))
        return graph


def beside_images(
    unknowns: Unknowns, singles: Iterable[ObservationFactor], pairs: "PairBatch | None",
    readings: "TerrestrialBatch | None",
) -> set[int]:  # fmt: skip
    """The unknowns that anything but image points touches, used or not, or that are held in part."""
    keys = {k for item in singles for k in list(item.factor.keys())} | set(unknowns.held)
    keys |= set() if pairs is None else pairs.keys()
    return keys | (set() if readings is None else readings.keys)
