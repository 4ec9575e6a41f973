"""How vectors of observations move with the seven motions of a whole survey (``adjust.spatial.motions``)."""

import gtsam
import numpy as np

from adjust.frames.unknowns import Unknown, Unknowns
from adjust.model.survey import FloatArray, Surface, Survey, Vertical, tilt_axes
from adjust.observations.terrestrial import equations as k
from adjust.observations.terrestrial.batch import TerrestrialBatch
from adjust.spatial.motions import point_motions, points_motions
from adjust.spatial.rigid import skew
from adjust.spatial.vertical import VERTICAL, tilted

MOVED, READINGS_MOVED = ("vertical", "beam", "surface"), ("instrument", "centring")


def vector_motions(survey: Survey, unknowns: Unknowns, unknown: Unknown, values: gtsam.Values) -> FloatArray:
    """Motions (dim, 7) of the free components of one of ``MOVED``."""
    vector = unknowns.vectors[unknown.name]
    full = vector.full(values)
    if unknown.name[0] == "beam":  # fixed on its body: only lengths change
        motions = np.zeros((4, 7))
        motions[:2, 6] = full[:2]
    elif unknown.name[0] == "vertical":
        motions = vertical_motions(survey.vertical, full)
    else:
        motions = surface_motions(next(s for s in survey.surfaces if s.surface_id == unknown.name[1]), full)
    return motions[[vector.names.index(x) for x in vector.free]]


def vertical_motions(vertical: Vertical, tilt: FloatArray) -> FloatArray:
    """Of the two tilts (2, 7) of the plumb line at the origin; the centre of curved level surfaces is shifted, too."""
    up = np.asarray(vertical.up_in_world, dtype=float)
    reference = up / np.linalg.norm(up)
    motions = direction_motions(reference, tilt)
    if vertical.radius is not None:
        motions[:, :3] = -np.linalg.pinv(tilted(reference, tilt)[1]) / vertical.radius
    return motions


def direction_motions(reference: FloatArray, tilt: FloatArray) -> FloatArray:
    """Of the two tilts (2, 7) of a direction of the world: dn = w x n."""
    n, by_tilt = tilted(reference, tilt)
    out = np.zeros((2, 7))
    out[:, 3:6] = np.linalg.pinv(by_tilt) @ -skew(n)
    return out


def surface_motions(surface: Surface, full: FloatArray) -> FloatArray:
    """Of all parameters of a surface, (n, 7)."""
    if surface.kind == "sphere":
        return np.vstack([point_motions(full[:3]), np.append(np.zeros(6), full[3])])
    reference = np.asarray(surface.reference, dtype=float)
    turn = direction_motions(reference, full[:2])
    n = tilted(reference, full[:2])[0]
    if surface.kind == "plane":  # n . x = distance
        return np.vstack([turn, np.concatenate([n, np.zeros(3), full[2:]])])
    # the moved line meets the plane of its two offsets a little further along itself
    across = tilt_axes(reference)
    shift = point_motions(across.T @ full[2:])
    return np.vstack([turn, across @ (shift - np.outer(n, reference @ shift) / (n @ reference))])


def reading_motions(unknowns: Unknowns, unknown: Unknown, values: gtsam.Values) -> FloatArray:
    """Motions (dim, 7) of an instrument or a centring."""
    out, vector = np.zeros((unknown.dim, 7)), unknowns.vectors[unknown.name]
    full = vector.full(values)
    for i, component in enumerate(vector.free):
        value = full[vector.names.index(component)]
        if component == "distance_scale":  # what lengthens in the world is read as before
            out[i, 6] = -(1.0 + value)
        elif component == "refraction":
            out[i, 6] = -value
        elif unknown.name[0] == "centring":
            out[i, 6] = value
    return out


def orientation_motions(
    survey: Survey, unknowns: Unknowns, batch: TerrestrialBatch, values: gtsam.Values
) -> dict[int, FloatArray]:
    """Of all orientations (1, 7), by key; ``batch`` was last evaluated near ``values``.

    The directions stay as they were read: the orientation turns by what the survey turns more than the axes do.
    """
    a, maps = batch.layout.arrays, list(batch.parameters.orientations.values())
    rows = np.flatnonzero((a.orientation >= 0) & (a.kind == k.DIRECTION) & (a.body < 0))
    number, first = np.unique(a.orientation[rows], return_index=True)
    at = a.at[rows[first]]
    turn = -batch.horizon.by_x[at] @ points_motions(batch.X[at])
    turn[:, :, 3:6] += np.eye(3)
    tilt = batch.parameters.vertical.tilt
    if tilt is not None and tilt.key is not None:
        by_free = batch.horizon.by_tilt[at] @ tilt.matrix
        turn -= by_free @ vector_motions(survey, unknowns, unknowns.by_name[VERTICAL], values)
    out = np.zeros((len(maps), 1, 7))
    out[number] = batch.sign * (batch.horizon.axes[at, 2][:, None] @ turn)
    return {vector.key: moved for vector, moved in zip(maps, out, strict=True) if vector.key is not None}
