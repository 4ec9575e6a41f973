"""Instruments, their setups, the vertical, beams and surfaces in the dictionary of a solution."""

from typing import Any

import numpy as np

from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import FloatArray, Survey
from adjust.spatial.vertical import tilted
from survey.solution.quantities import Scale, vector_entry


def instrument_entries(adjustment: Adjustment, scale: Scale) -> dict[str, Any]:
    """``vertical``, ``instruments``, ``setups``, ``beams`` and ``surfaces``: those that the survey observes."""
    estimates, survey = adjustment.estimates, adjustment.survey

    def entry(name: ParameterName) -> dict[str, Any] | None:
        found = estimates.get(name)
        return None if found is None else vector_entry(found, scale)

    out: dict[str, Any] = {}
    if survey.levels or survey.readings:
        out["vertical"] = _vertical(survey, estimates.get(("vertical",)), scale)
    instruments = {i.instrument_id: entry(("instrument", i.instrument_id)) for i in survey.instruments}
    setups = {}
    for setup in survey.setups:
        parts = {kind: entry((kind, setup.setup_id)) for kind in ("orientation", "centring")}
        found = {kind: part for kind, part in parts.items() if part is not None}
        if found:
            used = {} if setup.instrument_id is None else {"instrument": setup.instrument_id}
            setups[setup.setup_id] = used | found
    beams = {}
    for beam in survey.beams:
        parameters = entry(("beam", beam.beam_id))
        if parameters is not None:
            beams[beam.beam_id] = {beam.carrier_kind: beam.carrier_id, "axis": beam.axis, "parameters": parameters}
    surfaces = {}
    for surface in survey.surfaces:
        estimate = estimates.get(("surface", surface.surface_id))
        if estimate is not None:
            values = np.asarray(estimate.value, dtype=float)
            direction = {} if surface.reference is None else _direction(surface.kind, surface.reference, values[:2])
            surfaces[surface.surface_id] = {
                "kind": surface.kind, **direction, "parameters": vector_entry(estimate, scale),
            }  # fmt: skip
    kinds: dict[str, dict[str, Any]]
    kinds = {"instruments": instruments, "setups": setups, "beams": beams, "surfaces": surfaces}
    for kind, entries in kinds.items():
        present = {thing: value for thing, value in entries.items() if value is not None}
        if present:
            out[kind] = present
    return out


def _vertical(survey: Survey, tilt: Estimate | None, scale: Scale) -> dict[str, Any]:
    """The direction of the plumb line, with its tilt where that is estimated."""
    up = np.asarray(survey.vertical.up_in_world, dtype=float)
    values = np.asarray(survey.vertical.tilt.values if tilt is None else tilt.value, dtype=float)
    out: dict[str, Any] = {"up_in_world": tilted(up / np.linalg.norm(up), values)[0].tolist()}
    if survey.vertical.radius is not None:
        out["radius_m"] = survey.vertical.radius
    return out if tilt is None else out | {"tilt": vector_entry(tilt, scale)}


def _direction(kind: str, reference: FloatArray, tilt: FloatArray) -> dict[str, Any]:
    return {"normal" if kind == "plane" else "direction": tilted(np.asarray(reference), tilt)[0].tolist()}
