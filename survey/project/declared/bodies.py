"""Beams and surfaces in ``survey.toml``, read and written."""

from typing import Any, Literal

import numpy as np

from adjust.model.survey import BEAM, Beam, FloatArray, Surface
from survey.project.declared.declarations import BEAM_UNITS, SURFACE_UNITS, keys_of
from survey.project.declared.node import Node
from survey.project.declared.toml_text import Section
from survey.project.declared.vectors import read_vector, vector_keys, vector_to_toml

_KINDS: tuple[Literal["plane", "line", "sphere"], ...] = ("plane", "line", "sphere")
_REFERENCE = {"plane": "normal", "line": "direction"}


def read_beams(root: Node, station_ids: tuple[str, ...], table_ids: tuple[str, ...]) -> tuple[Beam, ...]:
    """The tables [beams.*]: a laser on the mount of a turntable or on a station."""
    beams = []
    for beam_id, node in root.tables("beams"):
        node.allow(*keys_of("beam"))
        if node.has("mount") == node.has("station"):
            found = "both are given; keep one" if node.has("mount") else "neither is given; add one"
            raise node.error(f"a beam is fixed on the mount of a table or on a station: {found}", "station")
        kind: Literal["mount", "station"] = "mount" if node.has("mount") else "station"
        known = table_ids if kind == "mount" else station_ids
        carrier = node.reference(kind, known, "table" if kind == "mount" else "station")
        name = node.choice("axis", ("x", "y", "z"), "z")
        axis: Literal["x", "y", "z"] = "x" if name == "x" else "y" if name == "y" else "z"
        beams.append(Beam(beam_id, kind, carrier, axis, read_vector(node, BEAM_UNITS, BEAM)))
    return tuple(beams)


def read_surfaces(root: Node) -> tuple[Surface, ...]:
    """The tables [surfaces.*]; what they do not give is found by the program."""
    surfaces = []
    for surface_id, node in root.tables("surfaces"):
        name = node.choice("kind", tuple(SURFACE_UNITS))
        kind = next(known for known in _KINDS if known == name)
        units = SURFACE_UNITS[kind]
        key = _REFERENCE.get(kind)
        node.allow(*keys_of(f"surface_{kind}"))
        reference: FloatArray | None = None
        if key and node.has(key):
            reference = node.numbers(key, (3,))
            length = float(np.linalg.norm(reference))
            if length == 0.0:
                raise node.error("the direction is zero; give a vector", key)
            if abs(length - 1.0) > 1e-12:  # else the same bits come back
                reference = reference / length
        vector = read_vector(node, units, tuple(units), np.nan)
        given = node.has("free", *vector_keys(units)[2:])
        for parameter, value in zip(vector.names, vector.values, strict=True):
            if np.isnan(value) and parameter not in vector.free:
                raise node.error(f"{parameter} is not free and has no value; give it one", "free")
        surfaces.append(Surface(surface_id, kind, reference, vector if given else None))
    return tuple(surfaces)


def body_sections(beams: tuple[Beam, ...], surfaces: tuple[Surface, ...]) -> list[Section]:
    """[beams.*] and [surfaces.*]."""
    sections: list[Section] = []
    for beam in beams:
        path = ("beams", beam.beam_id)
        values: dict[str, Any] = {beam.carrier_kind: beam.carrier_id, "axis": beam.axis}
        sections.append((path, values | vector_to_toml(beam.parameters, BEAM_UNITS, ".".join(path))))
    for surface in surfaces:
        path = ("surfaces", surface.surface_id)
        values = {"kind": surface.kind}
        if surface.reference is not None and surface.kind in _REFERENCE:
            values[_REFERENCE[surface.kind]] = np.asarray(surface.reference).tolist()
        if surface.parameters is not None:
            values |= vector_to_toml(surface.parameters, SURFACE_UNITS[surface.kind], ".".join(path))
        sections.append((path, values))
    return sections
