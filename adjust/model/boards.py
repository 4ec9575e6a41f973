"""How the points of a board deviate from their nominal places: bent, stretched, sheared, grown with temperature.

With u, v from 0 to 1 over the points of the target, at a temperature T and with the nominal x:

    x_in_target = x + (scale_x x + shear y, scale_y y, warp_x 4u(1-u) + warp_y 4v(1-v) + warp_xy (2u-1)(2v-1))
                    + expansion (T - reference_temperature) x

The two parabolas are those of mrcal's ``calobject_warp``; the twist completes the second order, and no pose of the
board makes up for any of the three. Linear in all components, so that :func:`deformation` is the derivative as well.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from adjust.model.arrays import FloatArray
from adjust.model.errors import SurveyError
from adjust.model.survey import Survey, Target, VectorParameter

BOARD: Mapping[str, str] = {
    "warp_x": "m", "warp_y": "m", "warp_xy": "m", "scale_x": "1", "scale_y": "1", "shear": "1", "expansion": "1/K",
}  # fmt: skip
"""Components of ``Target.warp`` and their units, in the order of the core."""
BENT = ("warp_x", "warp_y")
"""Those that ``free = true`` means."""


def extent(x: FloatArray) -> FloatArray:
    """Least x and y of points (n, 3) m and their spans, (4,) m; a span of zero counts as 1 m."""
    low, span = x[:, :2].min(axis=0), np.ptp(x[:, :2], axis=0)
    return np.concatenate([low, np.where(span > 0.0, span, 1.0)])


def deformation(x: FloatArray, names: Sequence[str], warming: float = 0.0) -> FloatArray:
    """Displacements (n, 3, k) m of points (n, 3) m of a target by one unit of each named component.

    warming: K above the temperature for which x holds.
    """
    box = extent(x)
    u = (x[:, :2] - box[:2]) / box[2:]
    bends = np.column_stack([4.0 * u * (1.0 - u), np.prod(2.0 * u - 1.0, axis=1)])
    whole = np.zeros((len(x), 3, len(BOARD)))
    whole[:, 2, :3] = bends
    whole[:, 0, 3], whole[:, 1, 4], whole[:, 0, 5] = x[:, 0], x[:, 1], x[:, 1]
    whole[:, :, 6] = warming * x
    order = tuple(BOARD)
    return whole[:, :, [order.index(name) for name in names]]


def deformed(target: Target, values: FloatArray | None = None, warming: float = 0.0) -> FloatArray:
    """Points (n, 3) m of a target with its warp; ``values`` of its components where they are not those given."""
    x = np.array(target.x_in_target, dtype=float)
    if target.warp is None:
        return x
    return x + deformation(x, target.warp.names, warming) @ (target.warp.values if values is None else values)


def warming_of(survey: Survey, target: Target, epoch_id: str | None) -> float:
    """K above the target's reference temperature; 0 where the target does not expand, or no epoch is named.

    Raises SurveyError where it does, and the temperature of the epoch is not known.
    """
    if epoch_id is None or target.warp is None or "expansion" not in target.warp.names:
        return 0.0
    if epoch_id not in survey.temperatures:
        raise SurveyError(f"target {target.target_id!r} expands, but epoch {epoch_id!r} has no temperature; give it "
                          "under temperatures_degC")  # fmt: skip
    return survey.temperatures[epoch_id] - target.reference_temperature


def checked_warp(target: Target) -> VectorParameter | None:
    """The warp of a target. Raises SurveyError for components that there are not, or ties."""
    warp = target.warp
    if warp is not None and (wrong := set(warp.names) - set(BOARD)):
        raise SurveyError(f"target {target.target_id!r}: a warp has no {sorted(wrong)}; it has {', '.join(BOARD)}")
    if warp is not None and warp.ties:
        raise SurveyError(f"target {target.target_id!r}: components of a warp cannot be tied to each other")
    return warp
