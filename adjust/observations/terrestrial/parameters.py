"""The unknowns that readings bring along, and what their survey must provide: instruments, setups, orientations."""

from collections.abc import Iterable, Mapping
from dataclasses import field
from typing import TypeVar

import numpy as np

from adjust.frames.unknowns import Unknowns, VectorMap, vector_map
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import PositionRef, Reading
from adjust.model.result import ParameterName
from adjust.model.survey import (
    INSTRUMENT,
    Instrument,
    PoseParameter,
    Setup,
    Survey,
    VectorParameter,
    VectorPrior,
)
from adjust.spatial.vertical import VerticalMap, collect_vertical

T = TypeVar("T")
CENTRING = ("centring_1", "centring_2", "height")
"""Components of the offset of an instrument from its point: along the zero of bearings, counter-clockwise of it, up."""
ORIENTATION = ("orientation",)
HEIGHTS = ("zenith", "height_difference")


@frozen(eq=False)
class TerrestrialParameters:
    """Vectors by id, in the order in which the arrays of a batch hold them; instruments are 4 numbers, centrings 3."""

    vertical: VerticalMap
    setups: Mapping[str, Setup]
    instruments: dict[str, VectorMap] = field(default_factory=dict)
    orientations: dict[str, VectorMap] = field(default_factory=dict)
    centrings: dict[str, VectorMap] = field(default_factory=dict)
    priors: dict[ParameterName, VectorPrior] = field(default_factory=dict)
    repeated: dict[str, ParameterName] = field(default_factory=dict)
    """Set-ups whose orientation would only repeat the turn of a station about its z axis: held at zero; that pose."""


def collect_terrestrial(survey: Survey, unknowns: Unknowns) -> TerrestrialParameters:
    """Register tilt, instrument parameters, orientations and centring errors of what the readings use.

    Raises SurveyError for a setup or an instrument that there is not, and for readings that need what is not given.
    """
    setups = _by_id("setup", ((s.setup_id, s) for s in survey.setups))
    instruments = _by_id("instrument", ((i.instrument_id, i) for i in survey.instruments))
    repeated = repeated_orientations(survey)
    out = TerrestrialParameters(collect_vertical(survey, unknowns), setups, repeated=repeated)
    used = dict.fromkeys(r.setup_id for r in survey.readings if r.setup_id)
    turned = {r.setup_id for r in survey.readings if r.kind == "direction"}
    if "" in turned:
        lost = next(r for r in survey.readings if r.kind == "direction" and not r.setup_id)
        raise SurveyError(f"reading {lost.reading_id!r}: a direction needs a setup, whose orientation it shares")
    for setup_id in used:
        if setup_id not in setups:
            raise SurveyError(f"setup {setup_id!r} is used by readings but not part of the survey; add it")
        setup = setups[setup_id]
        if setup.instrument_id is not None and setup.instrument_id not in out.instruments:
            if setup.instrument_id not in instruments:
                raise SurveyError(f"setup {setup_id!r}: instrument {setup.instrument_id!r} is not part of the survey")
            _instrument(instruments[setup.instrument_id], survey, unknowns, out)
        if setup_id in turned:
            name: ParameterName = ("orientation", setup_id)
            free = () if setup_id in out.repeated else ORIENTATION
            parameter = VectorParameter(ORIENTATION, np.zeros(1), free=free)
            out.orientations[setup_id] = unknowns.vectors[name] = vector_map(parameter, ("rad",), unknowns, name)
        _centring(setup, unknowns, out)
    return out


def repeated_orientations(survey: Survey) -> dict[str, ParameterName]:
    """Set-ups that are not levelled whose orientation nothing tells from the turn of their station, with that pose.

    The first set-up with directions on each station whose frame nothing else uses: no camera or target stands on it, no
    pair, level or beam refers to it, and its turn about z is not held or known, or it alone holds the world.
    """
    tilted = {s.setup_id for s in survey.setups if not s.levelled}
    if not tilted:
        return {}
    used = {c.station_id for c in survey.cameras} | {t.station_id for t in survey.targets}
    used |= {ref.frame_id for p in survey.pairs for ref in (p.a, p.b) if ref.kind == "station"}
    used |= {level.frame.frame_id for level in survey.levels if level.frame.kind == "station"}
    used |= {ref.frame_id for a in survey.alignments for ref in (a.a, a.b) if ref.kind == "station"}
    used |= {b.carrier_id for b in survey.beams if b.carrier_kind == "station"}
    stations = survey.stations_by_id
    at: dict[str, set[PositionRef]] = {}
    for r in survey.readings:
        if r.setup_id in tilted and r.kind == "direction":
            at.setdefault(r.setup_id, set()).add(r.at)
    out: dict[str, ParameterName] = {}
    for setup_id, places in at.items():
        frame = next(iter(places)).frame
        if len(places) > 1 or frame is None or frame.frame_id in used or frame.frame_id not in stations:
            continue
        station = stations[frame.frame_id]
        name: ParameterName = ("world_from_station", frame.frame_id)
        pose = station.world_from_station
        if station.motion != "fixed":
            name, pose = (*name, frame.epoch_id or ""), station.epochs.get(frame.epoch_id or "", pose)
        free = _turns_freely(pose) or (pose.treatment == "held" and _alone_holds_the_world(survey, frame.frame_id))
        if station.motion != "table" and free and name not in out.values():
            out[setup_id] = name
    return out


def _turns_freely(pose: PoseParameter) -> bool:
    """Whether nothing is known of the turn about the station's own z axis."""
    known = pose.treatment == "prior" and pose.prior_cov is not None and np.isfinite(pose.prior_cov[2, 2])
    return pose.treatment != "held" and not known and "rz" not in pose.held


def _alone_holds_the_world(survey: Survey, station_id: str) -> bool:
    """Whether a held station is all that tells the directions of the world's axes: its frame is the world's then."""
    points = any(p.x_in_world.treatment != "free" or p.x_in_world.held for p in survey.points)
    poses = [s.world_from_station for s in survey.stations if s.station_id != station_id]
    poses += [p for s in survey.stations for p in s.epochs.values()]
    poses += [t.carrier_from_target for t in survey.targets if t.station_id is None]
    poses += [t.world_from_table for t in survey.tables]
    held = any(p.treatment != "free" or p.held for p in poses)
    observed = survey.coordinates or survey.coordinate_differences or survey.cameras or survey.on_surfaces
    return not (points or held or observed or any(r.kind == "azimuth" for r in survey.readings))


def _by_id(kind: str, items: Iterable[tuple[str, T]]) -> dict[str, T]:
    out: dict[str, T] = {}
    for item_id, item in items:
        if item_id in out:
            raise SurveyError(f"{kind} {item_id!r} is there twice; give each its own id")
        out[item_id] = item
    return out


def _instrument(instrument: Instrument, survey: Survey, unknowns: Unknowns, out: TerrestrialParameters) -> None:
    parameter = instrument.parameters
    wrong = sorted(set(parameter.names) ^ set(INSTRUMENT) | set(parameter.free) - set(INSTRUMENT))
    if wrong:
        raise SurveyError(
            f"instrument {instrument.instrument_id!r}: parameters {wrong}; there are {', '.join(INSTRUMENT)}"
        )
    value = float(np.asarray(parameter.values)[parameter.names.index("refraction")])
    if survey.vertical.radius is None and ("refraction" in parameter.free or value != 0.0):
        raise SurveyError(
            f"instrument {instrument.instrument_id!r}: refraction is counted against the curvature of the earth; give "
            "the vertical a radius (about 6.38e6 m), or hold the coefficient at zero"
        )
    units = {"distance_offset": "m", "vertical_index": "rad"}
    name: ParameterName = ("instrument", instrument.instrument_id)
    vector = vector_map(parameter, tuple(units.get(x, "1") for x in parameter.names), unknowns, name)
    out.instruments[instrument.instrument_id] = unknowns.vectors[name] = vector
    if parameter.prior is not None:
        out.priors[name] = parameter.prior


def _centring(setup: Setup, unknowns: Unknowns, out: TerrestrialParameters) -> None:
    sigmas = (setup.centring_sigma, setup.centring_sigma, setup.height_sigma)
    if min(sigmas) < 0.0 or not np.isfinite(sigmas).all():
        raise SurveyError(f"setup {setup.setup_id!r}: centring and height sigmas must be finite and not negative")
    free = tuple(n for n, sigma in zip(CENTRING, sigmas, strict=True) if sigma > 0.0)
    if not free:
        return
    prior = VectorPrior(free, np.zeros(len(free)), np.diag([s**2 for s in sigmas if s > 0.0]))
    name: ParameterName = ("centring", setup.setup_id)
    vector = vector_map(VectorParameter(CENTRING, np.zeros(3), free, prior), ("m",) * 3, unknowns, name)
    out.centrings[setup.setup_id] = unknowns.vectors[name] = vector
    out.priors[name] = prior


def check_reading(reading: Reading, setup: Setup | None, flat: Mapping[PositionRef, int]) -> None:
    """Raises SurveyError for a reading that cannot be what it says. flat: 0 free height, 1 all held, 2 height held."""
    where = f"reading {reading.reading_id!r} ({reading.kind})"
    if not np.isfinite(reading.value) or not reading.sigma > 0.0 or not np.isfinite(reading.sigma):
        raise SurveyError(f"{where}: value {reading.value}, sigma {reading.sigma}; give a number and a positive sigma")
    if (reading.kind == "angle") != (reading.second is not None):
        what = "an angle needs its second target" if reading.kind == "angle" else "only angles have a second target"
        raise SurveyError(f"{where}: {what}")
    if reading.at in (reading.to, reading.second) or reading.to == reading.second:
        raise SurveyError(f"{where}: two of its positions are the same; correct the ids")
    if reading.kind in HEIGHTS and flat[reading.at] * flat[reading.to] > 1:
        raise SurveyError(
            f"{where}: the heights of both its points are held, as in a plane network, where it says nothing: free "
            "their z, or leave it out (a slope distance becomes a horizontal_distance)"
        )
    if setup is not None and not setup.levelled:
        if reading.at.frame is None or reading.at.frame.kind != "station" or reading.at.point_id is not None:
            raise SurveyError(
                f"{where}: setup {setup.setup_id!r} is not levelled, so its readings count in the axes of a station: "
                "let them start at the origin of a station's frame"
            )
        if reading.kind in ("azimuth", "height_difference"):
            raise SurveyError(f"{where}: needs the plumb line, and setup {setup.setup_id!r} is not levelled")
