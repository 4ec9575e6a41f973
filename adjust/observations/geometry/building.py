"""The geometric observations of a survey as factors."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from adjust.frames.state import State
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Chain, Unknowns, VectorMap, vector_map
from adjust.model.errors import SurveyError
from adjust.model.observations import (
    Alignment,
    FrameRef,
    LaserSpot,
    Level,
    OnSurface,
    PositionRef,
    frame_text,
    position_text,
)
from adjust.model.result import ParameterName
from adjust.model.survey import (
    SURFACES,
    Beam,
    BoolArray,
    FloatArray,
    Surface,
    Survey,
    VectorParameter,
    tilt_axes,
)
from adjust.observations.factors import (
    ChainPose,
    ObservationFactor,
    Position,
    custom,
    known_components,
    positions_factor,
)
from adjust.observations.geometry.fitting import fitted_beam, fitted_surface
from adjust.observations.geometry.poses import PoseBatch, aligned, beam_axes, inclined, spotted
from adjust.observations.geometry.residuals import surface_residual
from adjust.spatial.vertical import collect_vertical

BEAM_UNITS = ("m", "m", "1", "1")
SURFACE_UNITS: Mapping[str, tuple[str, ...]] = {
    "plane": ("rad", "rad", "m"),
    "line": ("rad", "rad", "m", "m"),
    "sphere": ("m", "m", "m", "m"),
}


def position_refs(survey: Survey) -> list[PositionRef]:
    """The positions that distances, coordinates and geometric observations need."""
    refs = [ref for d in survey.distances for ref in (d.a, d.b)]
    refs += [ref for c in survey.coordinates for ref in c.positions]
    refs += [ref for d in survey.coordinate_differences for ref in (*d.at, *d.to)]
    return refs + [o.position for o in survey.on_surfaces]


def frame_refs(survey: Survey) -> list[FrameRef]:
    """The frames that geometric observations need."""
    carriers = {b.beam_id: b for b in survey.beams}
    refs = [level.frame for level in survey.levels]
    refs += [ref for a in survey.alignments for ref in (a.a, a.b)]
    for spot in survey.laser_spots:
        refs += [carrier_of(carriers, spot), FrameRef("target", spot.target_id, spot.epoch_id)]
    return refs


def carrier_of(beams: Mapping[str, Beam], spot: LaserSpot) -> FrameRef:
    """The body that carries a spot's beam. Raises SurveyError for a beam that there is not."""
    if spot.beam_id not in beams:
        raise SurveyError(f"beam {spot.beam_id!r} is observed but not part of the survey; add it or correct the id")
    beam = beams[spot.beam_id]
    return FrameRef(beam.carrier_kind, beam.carrier_id, spot.epoch_id)


class GeometryFactors:
    """Makes the unknowns of beams and surfaces, their start values and the factors; one use, in this order."""

    def __init__(self, survey: Survey, unknowns: Unknowns, frames: FrameTree) -> None:
        self.survey, self.unknowns, self.frames = survey, unknowns, frames
        self.beams = {b.beam_id: b for b in survey.beams}
        self.surfaces = {s.surface_id: s for s in survey.surfaces}
        self.starts: dict[ParameterName, FloatArray] = {}
        for spot in survey.laser_spots:
            carrier_of(self.beams, spot)
            self._register(("beam", spot.beam_id), self.beams[spot.beam_id].parameters, BEAM_UNITS)
        for observation in survey.on_surfaces:
            surface = self._surface(observation)
            names = SURFACES[surface.kind]
            parameters = surface.parameters or VectorParameter(names, np.full(len(names), np.nan), free=names)
            if np.isnan(parameters.values[[x not in parameters.free for x in names]]).any():
                raise SurveyError(f"surface {surface.surface_id!r}: a parameter is held without a value; give it one")
            self._register(("surface", surface.surface_id), parameters, SURFACE_UNITS[surface.kind])
        self.vertical = collect_vertical(survey, unknowns) if survey.levels else None
        self.level_chains = [frames.relative(level.frame, FrameRef("world")) for level in survey.levels]
        self.alignment_chains = [frames.relative(a.a, a.b) for a in survey.alignments]
        self.spot_chains = [self._spot_chain(spot) for spot in survey.laser_spots]

    def _register(self, name: ParameterName, parameter: VectorParameter, units: tuple[str, ...]) -> None:
        if name not in self.unknowns.vectors:
            self.unknowns.vectors[name] = vector_map(parameter, units, self.unknowns, name)
            self.starts[name] = np.nan_to_num(parameter.values)

    def _surface(self, observation: OnSurface) -> Surface:
        if observation.surface_id not in self.surfaces:
            name = repr(observation.surface_id)
            raise SurveyError(f"surface {name} is observed but not part of the survey; add it or correct the id")
        return self.surfaces[observation.surface_id]

    def _spot_chain(self, spot: LaserSpot) -> Chain:
        return self.frames.relative(carrier_of(self.beams, spot), FrameRef("target", spot.target_id, spot.epoch_id))

    def find_starts(
        self,
        state: State,
        at: Mapping[PositionRef, Position],
        values: gtsam.Values,
        given: Mapping[ParameterName, FloatArray],
    ) -> Survey:
        """Put start values of surfaces and beams into ``values``; the survey with the surfaces complete.

        given: starts that are known, as of an earlier adjustment. Raises SurveyError where nothing shows a surface.
        """
        for name in self.starts:
            vector = self.unknowns.vectors[name]
            if name[0] == "surface":
                known = self.surfaces[name[1]]
                surface = self.surfaces[name[1]] = self._fitted(known, at, values)
                if surface.parameters is None:
                    continue
                self.unknowns.vectors[name] = vector = replace(vector, base=_base(vector, surface.parameters.values))
                full = given.get(name, surface.parameters.values) if known is surface else surface.parameters.values
            else:
                full = given[name] if name in given else self._beam_start(state, self.beams[name[1]], vector, values)
            if vector.key is not None:
                values.update(vector.key, np.array([full[vector.names.index(x)] for x in vector.free]))
        return replace(self.survey, surfaces=tuple(self.surfaces.values()))

    def _fitted(self, surface: Surface, at: Mapping[PositionRef, Position], values: gtsam.Values) -> Surface:
        mine = [o for o in self.survey.on_surfaces if o.surface_id == surface.surface_id]
        ready = surface.kind == "sphere" or surface.reference is not None
        if ready and surface.parameters is not None and not np.isnan(surface.parameters.values).any():
            return surface
        chosen = [o for o in mine if o.used] or mine
        x = np.array([at[o.position](values)[0] for o in chosen])
        return fitted_surface(surface, x, np.array([o.offset for o in chosen]))

    def _beam_start(self, state: State, beam: Beam, vector: VectorMap, values: gtsam.Values) -> FloatArray:
        poses, xy = [], []
        for spot, chain in zip(self.survey.laser_spots, self.spot_chains, strict=True):
            if spot.beam_id == beam.beam_id and spot.used:
                poses.append(ChainPose(self.unknowns, state, chain)(values)[0])
                xy.append(spot.xy)
        start = np.asarray(beam.parameters.values, dtype=float)
        free: BoolArray = np.array([x in vector.free for x in vector.names])
        return fitted_beam(start, free, beam_axes(beam.axis), poses, np.array(xy)) if xy and free.any() else start

    def factors(
        self, state: State, at: Mapping[PositionRef, Position], values: gtsam.Values
    ) -> list[ObservationFactor]:
        """All geometric observations; ``values`` are the start, at which what cannot be linearised is refused."""
        return [
            *self._differences(at),
            *self._levels(state, values),
            *self._alignments(state, values),
            *self._spots(state, values),
            *self._on_surfaces(at),
        ]

    def _differences(self, at: Mapping[PositionRef, Position]) -> Iterator[ObservationFactor]:
        for d in self.survey.coordinate_differences:
            ends = [(position_text(a), position_text(b)) for a, b in zip(d.at, d.to, strict=True)]
            signed = [((at[b], 1.0), (at[a], -1.0)) for a, b in zip(d.at, d.to, strict=True)]
            factor = positions_factor(signed, d.values, d.cov)
            _keys(f"the coordinate difference {ends[0][0]} to {ends[0][1]}", factor.keys())
            names = tuple(f"{a} {b} {axis}" if len(ends) > 1 else axis for a, b in ends for axis in "xyz")
            known, ids = known_components(d.cov), tuple(dict.fromkeys(x for pair in ends for x in pair))
            names, observed = tuple(np.array(names)[known]), d.values.ravel()[known]
            yield ObservationFactor(factor, "coordinate_difference", d.group, ids, names, ("m",) * len(names), observed,
                                    d.used)  # fmt: skip

    def _levels(self, state: State, values: gtsam.Values) -> Iterator[ObservationFactor]:
        levels, vertical = self.survey.levels, self.vertical
        if vertical is None:
            return
        axes, observed = np.array([x.axis_in_frame for x in levels]), np.array([x.value for x in levels])
        batch = PoseBatch(self.unknowns, state, self.level_chains, inclined(axes, observed, vertical),
                          [vertical] * len(levels))  # fmt: skip
        R, t = batch.poses(values)
        up = vertical.at(values).upwards(t)[0]
        for i, level in enumerate(levels):
            keys = _keys(f"level {level.level_id!r}", batch.keys[i], vertical.key)
            _check_level(level, float(up[i] @ R[i] @ level.axis_in_frame))
            factor = custom(keys, np.array([[level.sigma**2]]), batch.residual(i))
            yield ObservationFactor(factor, "level", level.group, (level.level_id, frame_text(level.frame)),
                                    ("inclination",), ("rad",), np.array([level.value]), level.used)  # fmt: skip

    def _alignments(self, state: State, values: gtsam.Values) -> Iterator[ObservationFactor]:
        every = self.survey.alignments
        if not every:
            return
        axes, across = np.array([a.axis_in_a for a in every]), np.array([tilt_axes(a.axis_in_b) for a in every])
        batch = PoseBatch(self.unknowns, state, self.alignment_chains,
                          aligned(axes, across, np.array([a.value for a in every])))  # fmt: skip
        for i, (a, R) in enumerate(zip(every, batch.poses(values)[0], strict=True)):
            keys, known = _keys(f"alignment {a.alignment_id!r}", batch.keys[i]), known_components(a.cov)
            _check_alignment(a, R)
            factor = custom(keys, a.cov[np.ix_(known, known)], batch.residual(i, known))
            names = tuple(np.array(["across_1", "across_2"])[known])
            yield ObservationFactor(factor, "alignment", a.group, (a.alignment_id, frame_text(a.a), frame_text(a.b)),
                                    names, ("rad",) * len(names), a.value[known], a.used)  # fmt: skip

    def _spots(self, state: State, values: gtsam.Values) -> Iterator[ObservationFactor]:
        spots = self.survey.laser_spots
        if not spots:
            return
        axes = np.array([beam_axes(self.beams[s.beam_id].axis) for s in spots])
        beams = [self.unknowns.vectors["beam", s.beam_id] for s in spots]
        batch = PoseBatch(self.unknowns, state, self.spot_chains,
                          spotted(axes, np.array([s.xy for s in spots]), beams), beams)  # fmt: skip
        for i, (spot, R) in enumerate(zip(spots, batch.poses(values)[0], strict=True)):
            along = R @ axes[i] @ np.array([*beams[i].full(values)[2:], 1.0])
            if abs(along[2]) < 0.02 * np.linalg.norm(along):
                raise SurveyError(
                    f"laser spot {spot.spot_id!r}: beam {spot.beam_id!r} runs along target {spot.target_id!r} at epoch "
                    f"{spot.epoch_id!r} instead of meeting it; correct its axis or the start of the target's pose"
                )
            keys = _keys(f"laser spot {spot.spot_id!r}", batch.keys[i], beams[i].key)
            factor = custom(keys, spot.cov, batch.residual(i))
            ids = (spot.spot_id, spot.beam_id, frame_text(FrameRef("target", spot.target_id, spot.epoch_id)))
            yield ObservationFactor(factor, "laser", spot.group, ids, ("x", "y"), ("m", "m"), spot.xy, spot.used)

    def _on_surfaces(self, at: Mapping[PositionRef, Position]) -> Iterator[ObservationFactor]:
        for o in self.survey.on_surfaces:
            surface, position, where = self.surfaces[o.surface_id], at[o.position], position_text(o.position)
            vector = self.unknowns.vectors["surface", o.surface_id]
            names = ("across_1", "across_2") if surface.kind == "line" and o.offset == 0.0 else ("offset",)
            n, keys = len(names), _keys(f"{where} on surface {o.surface_id!r}", position.keys, vector.key)
            factor = custom(keys, np.eye(n) * o.sigma**2, surface_residual(o, position, surface, vector))
            yield ObservationFactor(factor, "surface", o.group, (o.surface_id, where), names, ("m",) * n,
                                    np.full(n, o.offset), o.used)  # fmt: skip


def _base(vector: VectorMap, values: FloatArray) -> FloatArray:
    """Constants of a vector: the values of what is not free."""
    return np.array([0.0 if s in ("free", "prior", "tied") else v for s, v in zip(vector.status, values, strict=True)])


def _keys(what: str, own: Sequence[int], of_vector: int | None = None) -> list[int]:
    """The unknowns of an observation. Raises SurveyError where there are none."""
    keys = [*own, *([] if of_vector is None else [of_vector])]
    if not keys:
        raise SurveyError(f"{what} joins what is held; it can adjust nothing: free something or remove it")
    return keys


def _check_level(level: Level, sine: float) -> None:
    if abs(sine) > 0.9:
        angle = np.degrees(np.arcsin(min(1.0, abs(sine))))
        raise SurveyError(
            f"level {level.level_id!r}: the axis of {frame_text(level.frame)} starts {angle:.0f} deg above or "
            "below the horizontal, where a level tells nothing; name the axis along which it was laid"
        )


def _check_alignment(a: Alignment, R: FloatArray) -> None:
    along = float(a.axis_in_b @ R @ a.axis_in_a)
    if along < 0.5:
        angle = np.degrees(np.arccos(np.clip(along, -1.0, 1.0)))
        raise SurveyError(
            f"alignment {a.alignment_id!r}: the axes of {frame_text(a.a)} and {frame_text(a.b)} start {angle:.0f} deg "
            "apart; correct an axis (its sign) or the start of the poses"
        )
