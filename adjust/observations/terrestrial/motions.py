"""How orientations, instrument parameters and centring errors move with the seven motions of a whole survey."""

import gtsam
import numpy as np

from adjust.frames.unknowns import Unknown, Unknowns
from adjust.model.survey import FloatArray, Survey
from adjust.observations.geometry.motions import vector_motions
from adjust.observations.terrestrial import equations as k
from adjust.observations.terrestrial.batch import TerrestrialBatch
from adjust.spatial.motions import point_motions
from adjust.spatial.vertical import VERTICAL

MOVED = ("orientation", "instrument", "centring")


def reading_motions(
    survey: Survey, unknowns: Unknowns, batch: TerrestrialBatch | None, unknown: Unknown, values: gtsam.Values
) -> FloatArray:
    """Motions (dim, 7) of one of ``MOVED``; ``batch`` was last evaluated near ``values``."""
    out = np.zeros((unknown.dim, 7))
    vector = unknowns.vectors[unknown.name]
    full = vector.full(values)
    if unknown.name[0] == "orientation":
        return out if batch is None else _orientation(survey, unknowns, batch, unknown, values)
    for i, component in enumerate(vector.free):
        value = full[vector.names.index(component)]
        if component == "distance_scale":  # what lengthens in the world is read as before
            out[i, 6] = -(1.0 + value)
        elif component == "refraction":
            out[i, 6] = -value
        elif unknown.name[0] == "centring":
            out[i, 6] = value
    return out


def _orientation(
    survey: Survey, unknowns: Unknowns, batch: TerrestrialBatch, unknown: Unknown, values: gtsam.Values
) -> FloatArray:
    """The directions stay as they were read: the orientation turns by what the survey turns more than the axes do."""
    out = np.zeros((1, 7))
    a = batch.layout.arrays
    number = list(batch.parameters.orientations).index(unknown.name[1])
    first = int(np.flatnonzero((a.orientation == number) & (a.kind == k.DIRECTION))[0])
    if a.body[first] >= 0:
        return out
    at = a.at[first]
    turn = -batch.horizon.by_x[at] @ point_motions(batch.X[at])
    turn[:, 3:6] += np.eye(3)
    tilt = batch.parameters.vertical.tilt
    if tilt is not None and tilt.key is not None:
        by_free = batch.horizon.by_tilt[at] @ tilt.matrix
        turn -= by_free @ vector_motions(survey, unknowns, unknowns.by_name[VERTICAL], values)
    out[0] = batch.sign * (batch.horizon.axes[at, 2] @ turn)
    return out
