"""The example "total-station": the beacons of a laboratory by total station, caliper and levelling; no images."""

import numpy as np

from adjust.model.observations import PositionRef, Reading, ReadingKind
from adjust.model.survey import FloatArray, Point, Setup, Survey
from survey.folder.text import json_text
from survey.simulate.readings import Instruments
from survey.simulate.scene import Scene, Truth

MGON = np.pi / 2e5
SIGMA_MGON, DISTANCE_MM, DISTANCE_PPM, LEVEL_MM, CALIPER_MM = 0.5, 0.6, 1.5, 0.15, 0.05
HEIGHTS = {"S1": 1.612, "S2": 1.547, "S3": 1.583}
GROUND = {"S1": (2.1, 1.4, 0.0), "S2": (7.6, 2.2, 0.012), "S3": (5.2, 4.9, -0.008)}
LEVELLED = (("B01", "B03"), ("B03", "B05"), ("B05", "B07"), ("B07", "B09"), ("B09", "B11"), ("B11", "B01"))
CALIPERED = (("B01", "B02"), ("B03", "B04"), ("B05", "B06"), ("B07", "B08"), ("B09", "B10"), ("B11", "B12"))

DEFINITION = """# Twelve beacons on the walls of a laboratory of 10 m x 6 m, measured from three tripods.
format = 1
title = "Beacons by total station, caliper and levelling"

[instruments.total_station]
sigma_direction_mgon = 0.5
sigma_zenith_mgon = 0.5
sigma_distance_mm = 0.6                            # and 1.5 ppm of the distance
sigma_distance_ppm = 1.5
sigma_target_centring_mm = 0.1                     # of the reflector in the beacon's bore
free = ["distance_offset"]                         # of this reflector; the maker says 0 within 1 mm
sigma = { distance_offset_mm = 1.0 }

[instruments.level]
sigma_height_difference_mm = 0.15
"""


def beacon_survey() -> tuple[Survey, Truth]:
    """The error-free readings and the truth."""
    truth: dict[tuple[str, ...], FloatArray] = {("point", k): np.array(v) for k, v in GROUND.items()}
    for i in range(12):  # pairs of beacons a hand apart, round the walls
        side, along = i // 2, 0.35 * (i % 2)
        x, y = [(1.5 + along, 0.0), (6.5 + along, 0.0), (10.0, 1.5 + along), (8.0 - along, 6.0), (2.5 - along, 6.0),
                (0.0, 4.0 - along)][side]  # fmt: skip
        truth["point", f"B{i + 1:02d}"] = np.array([x, y, 1.1 + 0.45 * ((5 * i) % 4)])
    readings: list[Reading] = []

    def add(kind: ReadingKind, a: str, b: str, sigma: float, setup_id: str = "", height: float = 0.0) -> None:
        name = f"{kind[0]}{len(readings) + 1}"
        at, to = PositionRef(a), PositionRef(b)
        readings.append(Reading(name, kind, at, to, 0.0, sigma, setup_id, instrument_height=height, group=kind))

    for k, (station, height) in enumerate(HEIGHTS.items()):
        setup = f"{station}a"
        truth["orientation", setup] = np.array([0.7 + 1.9 * k])
        for target in (*(s for s in HEIGHTS if s != station), *(f"B{i + 1:02d}" for i in range(12))):
            length = float(np.linalg.norm(truth["point", target] - truth["point", station]))
            for kind in ("direction", "zenith"):
                add(kind, station, target, SIGMA_MGON * MGON, setup, height)
            add("slope_distance", station, target, 1e-3 * DISTANCE_MM + 1e-6 * DISTANCE_PPM * length, setup, height)
    for a, b in LEVELLED:
        add("height_difference", a, b, 1e-3 * LEVEL_MM)
    names = [name[1] for name in truth if name[0] == "point"]
    survey = Survey(
        points=tuple(Point(name) for name in names), readings=tuple(readings),
        setups=tuple(Setup(f"{s}a", "total_station") for s in HEIGHTS),
    )  # fmt: skip
    truth["instrument", "total_station"] = np.array([0.0004, 0.0, 0.0, 0.0])
    return survey, dict(truth)


def beacon_files(seed: int) -> dict[str, str]:
    """The project's files by their path."""
    survey, truth = beacon_survey()
    rng = np.random.default_rng(seed)
    ideal = Instruments(Scene(survey, truth))
    text = DEFINITION + "".join(f'\n[setups.{s.setup_id}]\ninstrument = "total_station"\n' for s in survey.setups)
    text += '\n[setups.levelling]\ninstrument = "level"\n\n[points]\n'
    text += "".join(f"{p.point_id} = {{}}\n" for p in survey.points)
    text += '\n[datum]                                            # nothing is known of the place and the azimuth\n'
    text += 'kind = "inner"\npoints = [' + ", ".join(f'"B{i + 1:02d}"' for i in range(12)) + "]\n"
    rows = ["kind,from_id,to_id,setup_id,value_gon,value_m,instrument_height_mm"]
    for r in survey.readings:
        plumbing = 1e-4 * np.append(rng.standard_normal(2), 0.0) if r.kind != "height_difference" else np.zeros(3)
        value = ideal.reading(r, plumbing=plumbing) + r.sigma * rng.standard_normal()
        angle = r.kind in ("direction", "zenith")
        shown = f"{value * 200.0 / np.pi % 400.0:.5f}," if angle else f",{value:.5f}"
        height = f"{1e3 * r.instrument_height:.0f}" if r.instrument_height else ""
        ends = f"{r.at.point_id},{r.to.point_id}"
        rows.append(f"{r.kind},{ends},{r.setup_id or 'levelling'},{shown},{height}")
    caliper = ["distance_id,from_id,to_id,value_mm,sigma_mm"]
    for k, (a, b) in enumerate(CALIPERED, 1):
        length = float(np.linalg.norm(truth["point", a] - truth["point", b]))  # type: ignore[operator]  # points are arrays
        caliper.append(f"c{k},{a},{b},{1e3 * length + CALIPER_MM * rng.standard_normal():.3f},{CALIPER_MM:g}")
    parameters = {"/".join(name): np.asarray(value).tolist() for name, value in truth.items()}
    note = "true values of the simulation in m and rad; nothing reads this file"
    return {
        "survey.toml": text,
        "observations/terrestrial.csv": "\n".join(rows) + "\n",
        "observations/distances.csv": "\n".join(caliper) + "\n",
        "truth.json": json_text({"note": note, "seed": seed, "parameters": parameters}),
    }
