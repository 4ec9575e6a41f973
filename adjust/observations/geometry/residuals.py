"""Residuals of positions on surfaces, predicted minus observed, with analytic Jacobians."""

import gtsam
import numpy as np

from adjust.frames.unknowns import VectorMap
from adjust.model.observations import OnSurface
from adjust.model.survey import FloatArray, Surface, tilt_axes
from adjust.observations.factors import Jacobians, Position, Residual
from adjust.spatial.rigid import skew
from adjust.spatial.vertical import tilted_frame


def surface_residual(observation: OnSurface, position: Position, surface: Surface, vector: VectorMap) -> Residual:
    """Distance from a plane, a line or a sphere minus the observed one; two components for a position on a line."""
    distance = {"plane": plane_distance, "line": line_distance, "sphere": sphere_distance}[surface.kind]
    reference = np.zeros(3) if surface.reference is None else surface.reference
    on_it = observation.offset == 0.0

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        x, jacobians = position(values)
        r, by_x, by_surface = distance(x, vector.full(values), reference, on_it)
        blocks = [(key, by_x @ J) for key, J in jacobians]
        if vector.key is not None:
            blocks.append((vector.key, by_surface @ vector.matrix))
        return r - observation.offset, blocks

    return residual


Distances = tuple[FloatArray, FloatArray, FloatArray]
"""Distances (k,) m of a position from a surface, by the position (k, 3), by the surface's parameters (k, n)."""


def plane_distance(x: FloatArray, parameters: FloatArray, reference: FloatArray, on_it: bool) -> Distances:
    """Along the normal: n . x - distance."""
    axes, turn = tilted_frame(reference, parameters[:2])
    v = axes.T @ x
    by_tilt = (skew(v) @ turn)[2:]
    return v[2:] - parameters[2], axes.T[2:], np.hstack([by_tilt, [[-1.0]]])


def line_distance(x: FloatArray, parameters: FloatArray, reference: FloatArray, on_it: bool) -> Distances:
    """Across the line: the two components where the position lies on it, else their length."""
    axes, turn = tilted_frame(reference, parameters[:2])
    fixed = tilt_axes(reference).T
    v = axes.T @ (x - fixed @ parameters[2:])
    by_x = axes.T[:2]
    by_line = np.hstack([(skew(v) @ turn)[:2], -by_x @ fixed])
    if on_it:
        return v[:2], by_x, by_line
    length = float(np.hypot(v[0], v[1]))
    u = (v[:2] / length)[None, :]
    return np.array([length]), u @ by_x, u @ by_line


def sphere_distance(x: FloatArray, parameters: FloatArray, reference: FloatArray, on_it: bool) -> Distances:
    """Beyond the radius."""
    d = x - parameters[:3]
    length = float(np.linalg.norm(d))
    u = (d / length)[None, :]
    return np.array([length - parameters[3]]), u, np.hstack([-u, [[-1.0]]])
