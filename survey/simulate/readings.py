"""Terrestrial and geometric observations of a simulated survey, by plain geometry and none of the code under test.

Truth: ``("orientation", setup)`` (1,) rad, ``("instrument", id)`` (4,), ``("vertical",)`` (2,), ``("beam", id)`` (4,),
``("surface", id)`` as in ``adjust.model.survey.SURFACES``; what is missing is zero, and an orientation is needed.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from adjust.design.noise import draw
from adjust.model.observations import Alignment, FrameRef, LaserSpot, Level, OnSurface, PositionRef, Reading
from adjust.model.survey import FloatArray, Survey, tilt_axes
from survey.simulate.scene import Scene


class Instruments:
    """Error-free readings of one survey, at true or displaced instruments."""

    def __init__(self, scene: Scene) -> None:
        survey = scene.survey
        if survey.vertical.radius is not None:
            raise ValueError("simulated readings know no curvature of the level surface")
        self.scene, self.survey = scene, survey
        self.setups = {s.setup_id: s for s in survey.setups}
        self.beams = {b.beam_id: b for b in survey.beams}
        self.surfaces = {s.surface_id: s for s in survey.surfaces}
        up = np.asarray(survey.vertical.up_in_world, dtype=float)
        first = np.eye(3)["xyz".index(survey.bearings.zero)]
        first = first - up * (up @ first)
        turn = Rotation.from_rotvec(self.vector(2, "vertical") @ tilt_axes(up))
        self.up, self.zero = turn.apply(up), turn.apply(first / np.linalg.norm(first))
        self.left = np.cross(self.up, self.zero)

    def vector(self, n: int, *name: str) -> FloatArray:
        """A true vector, zeros where there is none."""
        return self.scene.vector(*name) if name in self.scene.truth else np.zeros(n)

    def reading(self, r: Reading, displaced: FloatArray | None = None, plumbing: FloatArray | None = None) -> float:
        """The value; displaced, plumbing (3,) m: of the instrument and of the target, in the axes zero, left, up."""
        axes = np.stack([self.zero, self.left, self.up])
        start = self.scene.position(r.at) + r.instrument_height * self.up
        if r.kind != "height_difference" and displaced is not None:
            start = start + displaced @ axes
        shift = np.zeros(3) if plumbing is None else plumbing @ axes

        def sight(to: PositionRef, height: float) -> FloatArray:
            return np.asarray(axes @ (self.scene.position(to) + shift + height * self.up - start))

        q = sight(r.to, r.target_height)
        setup = self.setups.get(r.setup_id)
        offset, scale, _, index = self.vector(4, "instrument", (setup.instrument_id or "") if setup else "")
        match r.kind:
            case "direction":
                return self._bearing(q) - float(self.scene.vector("orientation", r.setup_id)[0])
            case "azimuth":
                return self._bearing(q)
            case "angle":
                if r.second is None:
                    raise ValueError(f"angle {r.reading_id} has no second target")
                return self._bearing(sight(r.second, r.second_height)) - self._bearing(q)
            case "zenith":
                return float(np.arctan2(np.hypot(q[0], q[1]), q[2])) + float(index)
            case "slope_distance":
                return float(offset + (1.0 + scale) * np.linalg.norm(q))
            case "horizontal_distance":
                return float(offset + (1.0 + scale) * np.hypot(q[0], q[1]))
        return float(q[2])

    def _bearing(self, q: FloatArray) -> float:
        angle = float(np.arctan2(q[1], q[0]))
        return -angle if self.survey.bearings.clockwise else angle

    def level(self, level: Level) -> float:
        """Inclination of the axis, rad."""
        axis = self.scene.world_from_frame(level.frame)[:3, :3] @ level.axis_in_frame
        return float(np.arcsin(axis @ self.up))

    def alignment(self, a: Alignment) -> FloatArray:
        """(2,) components of one axis across the other."""
        b_from_a = np.linalg.inv(self.scene.world_from_frame(a.b)) @ self.scene.world_from_frame(a.a)
        return np.asarray(tilt_axes(a.axis_in_b) @ b_from_a[:3, :3] @ a.axis_in_a)

    def spot(self, spot: LaserSpot) -> FloatArray:
        """(2,) m in the target."""
        beam = self.beams[spot.beam_id]
        along, start, k = np.zeros(3), np.zeros(3), "xyz".index(beam.axis)
        o1, o2, m1, m2 = self.scene.vector("beam", beam.beam_id)
        start[(k + 1) % 3], start[(k + 2) % 3] = o1, o2
        along[(k + 1) % 3], along[(k + 2) % 3], along[k] = m1, m2, 1.0
        carrier = self.scene.world_from_frame(FrameRef(beam.carrier_kind, beam.carrier_id, spot.epoch_id))
        T = np.linalg.inv(self.scene.world_from_target(spot.target_id, spot.epoch_id)) @ carrier
        p, d = T[:3, :3] @ start + T[:3, 3], T[:3, :3] @ along
        return np.asarray((p - d * p[2] / d[2])[:2])

    def offset(self, o: OnSurface) -> float:
        """Distance (m) of a position from a surface, as ``OnSurface.offset`` counts it."""
        surface, x = self.surfaces[o.surface_id], self.scene.position(o.position)
        p = self.scene.vector("surface", o.surface_id)
        if surface.kind == "sphere" or surface.reference is None:
            return float(np.linalg.norm(x - p[:3]) - p[3])
        across = tilt_axes(surface.reference)
        n = Rotation.from_rotvec(p[:2] @ across).apply(surface.reference)
        if surface.kind == "plane":
            return float(n @ x - p[2])
        return float(np.linalg.norm(np.cross(n, x - p[2:] @ across)))


def fresh_readings(scene: Scene, rng: np.random.Generator) -> dict[str, Any]:
    """The survey's terrestrial and geometric observations with new noise."""
    survey = scene.survey
    if not any((survey.readings, survey.levels, survey.alignments, survey.laser_spots, survey.on_surfaces,
                survey.coordinate_differences)):  # fmt: skip
        return {}
    ideal = Instruments(scene)
    return {
        "readings": _readings(ideal, survey, rng),
        "levels": tuple(replace(x, value=ideal.level(x) + x.sigma * rng.standard_normal()) for x in survey.levels),
        "alignments": tuple(replace(x, value=ideal.alignment(x) + draw(x.cov, rng)) for x in survey.alignments),
        "laser_spots": tuple(replace(x, xy=ideal.spot(x) + draw(x.cov, rng)) for x in survey.laser_spots),
        "on_surfaces": tuple(_on_surface(ideal, x, rng) for x in survey.on_surfaces),
        "coordinate_differences": tuple(
            replace(d, values=np.array([scene.position(b) - scene.position(a) for a, b in zip(d.at, d.to, strict=True)])
                    + draw(d.cov, rng).reshape(-1, 3)) for d in survey.coordinate_differences),
    }  # fmt: skip


def _readings(ideal: Instruments, survey: Survey, rng: np.random.Generator) -> tuple[Reading, ...]:
    displaced: Mapping[str, FloatArray] = {
        s.setup_id: np.array([s.centring_sigma, s.centring_sigma, s.height_sigma]) * rng.standard_normal(3)
        for s in survey.setups
    }
    noise = {r.reading_id: r.sigma * rng.standard_normal() for r in survey.readings}
    for item in survey.reading_covariances:
        joint = np.linalg.cholesky(item.cov) @ rng.standard_normal(len(item.cov))
        noise |= dict(zip(item.reading_ids, joint.tolist(), strict=True))
    out = []
    for r in survey.readings:
        plumbing = r.target_centring_sigma * np.append(rng.standard_normal(2), 0.0)
        value = ideal.reading(r, displaced.get(r.setup_id), plumbing) + noise[r.reading_id]
        out.append(replace(r, value=value))
    return tuple(out)


def _on_surface(ideal: Instruments, o: OnSurface, rng: np.random.Generator) -> OnSurface:
    """Offsets from planes and spheres scatter about the true one; a position on a line is on it by definition."""
    if ideal.surfaces[o.surface_id].kind == "line" and o.offset == 0.0:
        return o
    return replace(o, offset=ideal.offset(o) + o.sigma * float(rng.standard_normal()))
