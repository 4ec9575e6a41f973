"""Residuals of geometric observations, predicted minus observed, with analytic Jacobians.

A direction u = R a of a body turns with its pose by ``du = -R [a]x dw`` (perturbation on the right).
"""


import gtsam
import numpy as np
from gtsam import Pose3

from adjust.frames.unknowns import VectorMap
from adjust.model.observations import Alignment, LaserSpot, Level, OnSurface
from adjust.model.survey import BoolArray, FloatArray, Surface, tilt_axes
from adjust.observations.factors import ChainPose, Jacobians, Position, Residual
from adjust.spatial.rigid import skew
from adjust.spatial.vertical import VerticalMap, tilted_frame, up_at


def alignment_residual(observation: Alignment, b_from_a: ChainPose, known: BoolArray) -> Residual:
    """``axis_in_a`` seen from b along the two axes across ``axis_in_b``; ``known`` (k,): those that were observed."""
    across = tilt_axes(observation.axis_in_b)[known]
    wanted, axis = observation.value[known], observation.axis_in_a

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        pose, jacobians = b_from_a(values)
        R = pose.rotation().matrix()
        turn = -across @ R @ skew(axis)
        return across @ R @ axis - wanted, [(key, turn @ J[:3]) for key, J in jacobians]

    return residual


def level_residual(observation: Level, world_from_body: ChainPose, vertical: VerticalMap) -> Residual:
    """Inclination of the body's axis above the horizontal at the body's origin."""
    axis = observation.axis_in_frame

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        pose, jacobians = world_from_body(values)
        R = pose.rotation().matrix()
        up, up_by_x, up_by_tilt = up_at(vertical.at(values), pose.translation())
        u = R @ axis
        sine = float(u @ up)
        cosine = float(np.linalg.norm(u - sine * up))
        by_pose = np.concatenate([-up @ R @ skew(axis), u @ up_by_x @ R])[None, :] / cosine
        blocks = [(key, by_pose @ J) for key, J in jacobians]
        if vertical.key is not None:
            blocks.append((vertical.key, (u @ up_by_tilt @ vertical.matrix)[None, :] / cosine))
        return np.array([np.arctan2(sine, cosine) - observation.value]), blocks

    return residual


def beam_axes(axis: str) -> FloatArray:
    """The axis that a beam runs along and the two next ones, as columns (3, 3): 1, 2, then the beam's own."""
    return np.roll(np.eye(3), -("xyz".index(axis) + 1), axis=0).T


def spot_residual(
    observation: LaserSpot, target_from_body: ChainPose, beam: VectorMap, axes: FloatArray
) -> Residual:
    """Where the beam meets the plane z = 0 of the target; ``axes`` as in :func:`beam_axes`."""

    def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
        pose, jacobians = target_from_body(values)
        spot, by_pose, by_beam = spot_on_target(pose, beam.full(values), axes)
        blocks = [(key, by_pose @ J) for key, J in jacobians]
        if beam.key is not None:
            blocks.append((beam.key, by_beam @ beam.matrix))
        return spot - observation.xy, blocks

    return residual


def spot_on_target(pose: Pose3, beam: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Spot (2,) m in a target, and its derivatives by ``target_from_body`` (2, 6) and by the beam (2, 4)."""
    R = pose.rotation().matrix()
    offset = axes[:, :2] @ beam[:2]
    along = axes @ np.array([beam[2], beam[3], 1.0])
    q, d = R @ offset + pose.translation(), R @ along
    s = -q[2] / d[2]
    # a point of the line moves by dq + s dd; back along the line onto z = 0
    onto = np.array([[1.0, 0.0, -d[0] / d[2]], [0.0, 1.0, -d[1] / d[2]]])
    moved = onto @ R
    across = moved @ axes[:, :2]
    by_pose = np.concatenate([-moved @ skew(offset + s * along), moved], axis=1)
    return (q + s * d)[:2], by_pose, np.concatenate([across, s * across], axis=1)


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
