"""How the vertical, beams and surfaces move with the seven motions of a survey (``adjust.spatial.motions``)."""

import gtsam
import numpy as np

from adjust.frames.unknowns import Unknown, Unknowns
from adjust.model.survey import FloatArray, Surface, Survey, tilt_axes
from adjust.spatial.directions import tilted
from adjust.spatial.motions import point_motions
from adjust.spatial.rigid import skew

MOVED = ("vertical", "beam", "surface")


def vector_motions(survey: Survey, unknowns: Unknowns, unknown: Unknown, values: gtsam.Values) -> FloatArray:
    """Motions (dim, 7) of the free components of one of ``MOVED``."""
    vector = unknowns.vectors[unknown.name]
    full = vector.full(values)
    if unknown.name[0] == "beam":  # fixed on its body: only lengths change
        motions = np.zeros((4, 7))
        motions[:2, 6] = full[:2]
    elif unknown.name[0] == "vertical":
        up = np.asarray(survey.vertical.up_in_world, dtype=float)
        motions = direction_motions(up / np.linalg.norm(up), full)
    else:
        motions = surface_motions(next(s for s in survey.surfaces if s.surface_id == unknown.name[1]), full)
    return motions[[vector.names.index(x) for x in vector.free]]


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
