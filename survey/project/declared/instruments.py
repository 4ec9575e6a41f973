"""Instruments, set-ups, beams and surfaces in ``survey.toml``, read and written."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Literal

import numpy as np

from adjust.model.survey import BEAM, Beam, Bearings, FloatArray, Instrument, Setup, Surface, Vertical
from survey.folder.text import suggestion
from survey.folder.units import from_si
from survey.project.declared.declarations import BEAM_UNITS, INSTRUMENT_UNITS, SURFACE_UNITS, TILT_UNITS
from survey.project.declared.node import Node
from survey.project.declared.toml_text import Section, in_units
from survey.project.declared.vectors import read_vector, vector_keys, vector_to_toml
from survey.project.project import Accuracy

_ANGLE = ("arcsec", "mgon", "cc", "deg")
_LENGTH = ("mm",)
_ACCURACY: dict[str, tuple[str, tuple[str, ...]]] = {
    "direction": ("sigma_direction", _ANGLE),
    "angle": ("sigma_angle", _ANGLE),
    "zenith": ("sigma_zenith", _ANGLE),
    "azimuth": ("sigma_azimuth", _ANGLE),
    "distance": ("sigma_distance", _LENGTH),
    "distance_slope": ("sigma_distance", ("ppm",)),
    "height_difference": ("sigma_height_difference", _LENGTH),
    "levelling": ("sigma_levelling", ("mm",)),
    "target_centring": ("sigma_target_centring", _LENGTH),
    "centring": ("sigma_centring", _LENGTH),
    "height": ("sigma_height", _LENGTH),
}


def read_vertical(node: Node) -> Vertical:
    """The table [vertical]."""
    up = node.numbers("up_in_world", (3,))
    length = float(np.linalg.norm(up))
    if abs(length - 1.0) > 1e-3:
        raise node.error(f"the direction has length {length:g}, not 1; correct it", "up_in_world")
    if abs(length - 1.0) > 1e-12:  # else the same bits come back
        up = up / length
    return Vertical(up, read_vector(node, TILT_UNITS, ()), node.si("radius_m", None))


def read_bearings(node: Node) -> Bearings:
    """The table [bearings]."""
    return Bearings(node.choice("zero", ("x", "y")), node.flag("clockwise"))


def read_instruments(root: Node) -> tuple[tuple[Instrument, ...], dict[str, Accuracy]]:
    """The tables [instruments.*], and what their readings are worth."""
    instruments, accuracies = [], {}
    for instrument_id, node in root.tables("instruments"):
        instruments.append(Instrument(instrument_id, read_vector(node, INSTRUMENT_UNITS, ())))
        given: dict[str, float] = {}
        for name, (key, units) in _ACCURACY.items():
            sigma = node.sigmas(key, units, 1)
            if sigma is not None:
                given[name] = float(sigma[0])
        if "distance_slope" in given and "distance" not in given:
            raise node.error("sigma_distance_mm is missing; the sigma of a distance is mm + ppm", "sigma_distance_ppm")
        if given:
            accuracies[instrument_id] = Accuracy(**given)
    return tuple(instruments), accuracies


def read_setups(root: Node, instruments: tuple[str, ...], accuracies: Mapping[str, Accuracy]) -> tuple[Setup, ...]:
    """The tables [setups.*]; centring is the instrument's where they do not say."""
    setups = []
    for setup_id, node in root.tables("setups"):
        instrument_id = node.reference("instrument", instruments, "instrument") if node.has("instrument") else None
        usual = accuracies.get(instrument_id or "", Accuracy())
        sigmas = []
        for key, value in (("sigma_centring_mm", usual.centring), ("sigma_height_mm", usual.height)):
            sigma = node.number(key, float(from_si(value, "mm")))
            if sigma < 0:
                raise node.error(f"found {sigma:g}; a sigma is positive, or 0 for none", key)
            sigmas.append(sigma / 1000.0)
        setups.append(Setup(setup_id, instrument_id, node.flag("levelled"), *sigmas))
    return tuple(setups)


def vertical_sections(vertical: Vertical, bearings: Bearings) -> list[Section]:
    """[vertical] and [bearings], where they are not as usual."""
    sections: list[Section] = []
    plain = not vertical.tilt.free and not np.any(vertical.tilt.values) and vertical.radius is None
    if not plain or not np.array_equal(vertical.up_in_world, Vertical().up_in_world):
        tilt = vector_to_toml(vertical.tilt, TILT_UNITS, "vertical")
        sections.append((("vertical",), in_units(up_in_world=vertical.up_in_world, radius_m=vertical.radius) | tilt))
    if bearings != Bearings():
        sections.append((("bearings",), asdict(bearings)))
    return sections


def instrument_sections(
    instruments: tuple[Instrument, ...], setups: tuple[Setup, ...], accuracies: Mapping[str, Accuracy]
) -> list[Section]:
    """[instruments.*] and [setups.*]."""
    sections: list[Section] = []
    for instrument in instruments:
        path = ("instruments", instrument.instrument_id)
        given = asdict(accuracies[instrument.instrument_id]) if instrument.instrument_id in accuracies else {}
        keys = {f"{_ACCURACY[name][0]}_{_ACCURACY[name][1][0]}": sigma or None for name, sigma in given.items()}
        values = vector_to_toml(instrument.parameters, INSTRUMENT_UNITS, ".".join(path)) | in_units(**keys)
        sections.append((path, values))
    return sections + [
        (("setups", x.setup_id), in_units(instrument=x.instrument_id, levelled=x.levelled,
                                          sigma_centring_mm=x.centring_sigma, sigma_height_mm=x.height_sigma))
        for x in setups
    ]  # fmt: skip


def setup_problem(setup_id: str, setups: tuple[Setup, ...]) -> str | None:
    """Why ``setup_id`` names no setup, or None."""
    known = [setup.setup_id for setup in setups]
    if setup_id in known:
        return None
    return f"unknown setup {setup_id!r}; {suggestion(setup_id, known)}; setups are listed as [setups.{setup_id}]"


_REFERENCE = {"plane": "normal", "line": "direction"}


def read_beams(root: Node, station_ids: tuple[str, ...], table_ids: tuple[str, ...]) -> tuple[Beam, ...]:
    """The tables [beams.*]: a laser on the mount of a turntable or on a station."""
    beams = []
    for beam_id, node in root.tables("beams"):
        if node.has("mount") == node.has("station"):
            found = "both are given; keep one" if node.has("mount") else "neither is given; add one"
            raise node.error(f"a beam is fixed on the mount of a table or on a station: {found}", "station")
        kind: Literal["mount", "station"] = "mount" if node.has("mount") else "station"
        known = table_ids if kind == "mount" else station_ids
        carrier = node.reference(kind, known, "table" if kind == "mount" else "station")
        axis: Literal["x", "y", "z"] = node.choice("axis", ("x", "y", "z"))
        beams.append(Beam(beam_id, kind, carrier, axis, read_vector(node, BEAM_UNITS, BEAM)))
    return tuple(beams)


def read_surfaces(root: Node) -> tuple[Surface, ...]:
    """The tables [surfaces.*]; what they do not give is found by the program."""
    surfaces = []
    for surface_id, node in root.tables("surfaces"):
        kind: Literal["plane", "line", "sphere"] = node.choice("kind", ("plane", "line", "sphere"))
        units, key = SURFACE_UNITS[kind], _REFERENCE.get(kind)
        node = node.declared_as(f"surface_{kind}")
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
        values: dict[str, object] = {beam.carrier_kind: beam.carrier_id, "axis": beam.axis}
        sections.append((path, values | vector_to_toml(beam.parameters, BEAM_UNITS, ".".join(path))))
    for surface in surfaces:
        path, key = ("surfaces", surface.surface_id), _REFERENCE.get(surface.kind)
        values = in_units(kind=surface.kind, **({} if key is None else {key: surface.reference}))
        if surface.parameters is not None:
            values |= vector_to_toml(surface.parameters, SURFACE_UNITS[surface.kind], ".".join(path))
        sections.append((path, values))
    return sections
