"""Terrestrial and geometric observations in the project folder: values, units, sigmas, round trip."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, PositionRef, Reading, ReadingCovariance
from adjust.model.survey import (
    Bearings,
    Instrument,
    Point,
    PointParameter,
    PoseParameter,
    Setup,
    Station,
    Survey,
    Table,
    VectorParameter,
    VectorPrior,
)
from survey import project as files
from survey.project.project import Accuracy, Sigmas
from tests.adjust.test_geometry import geometric
from tests.survey.test_files import differences

ARCSEC = np.pi / 180 / 3600
DEFINITION = """format = 1
[points]
A = { x_mm = [0, 0, 0], treatment = "held" }
B = { x_mm = [10000, 0, 0] }
C = {}
[stations.tripod]
[instruments.TS]
sigma_direction_cc = 3
sigma_zenith_arcsec = 2
sigma_distance_mm = 1.5
sigma_distance_ppm = 2
sigma_centring_mm = 0.5
sigma_target_centring_mm = 0.2
sigma_levelling_mm = 0.7
free = ["distance_offset"]
distance_offset_mm = 12.5
sigma = { distance_offset_mm = 0.4 }
[setups.S1]
instrument = "TS"
[setups.S2]
instrument = "TS"
levelled = false
sigma_centring_mm = 0
sigma_height_mm = 1
"""
COLUMNS = "kind,from_id,to_id,setup_id,second_id,value_deg,value_gon,value_dms,value_m,value_mm,sigma_arcsec,sigma_mm"


def folder(tmp_path: Path, definition: str, **tables: str) -> Path:
    (tmp_path / "observations").mkdir(exist_ok=True)
    (tmp_path / "survey.toml").write_text(definition)
    for name, text in tables.items():
        (tmp_path / "observations" / f"{name}.csv").write_text(text)
    return tmp_path


def readings(tmp_path: Path, *rows: str, columns: str = COLUMNS, definition: str = DEFINITION) -> list[Reading]:
    text = "\n".join([columns, *rows]) + "\n"
    return list(files.read(folder(tmp_path, definition, terrestrial=text)).survey.readings)


def test_values_in_every_unit(tmp_path: Path) -> None:
    """Degrees, gon, degrees-minutes-seconds, metres, millimetres."""
    found = readings(
        tmp_path,
        "direction,A,B,S1,,90,,,,,5,", "direction,A,C,S1,,,100,,,,5,", "zenith,A,B,S1,,,,89-59-30.5,,,5,",
        "slope_distance,A,B,S1,,,,,10.5,,,1", "height_difference,A,B,,,,,,,-250,,1", "angle,A,B,,C,,50,,,,5,",
        "azimuth,A,B,,,-10,,,,,5,",
    )  # fmt: skip
    values = [np.pi / 2, np.pi / 2, np.radians(89 + 59 / 60 + 30.5 / 3600), 10.5, -0.25, np.pi / 4, -np.radians(10)]
    np.testing.assert_allclose([r.value for r in found], values, rtol=1e-15)
    assert [r.reading_id for r in found] == [f"r{i}" for i in range(1, 8)]
    assert [r.group for r in found] == [r.kind for r in found]
    np.testing.assert_allclose([r.sigma for r in found],
                               [5 * ARCSEC] * 3 + [1e-3, 1e-3] + [5 * ARCSEC] * 2, rtol=1e-14)  # fmt: skip
    assert found[5].second == PositionRef("C")


@pytest.mark.parametrize(("text", "degrees"), [("89-59-60.00", 90.0), ("89-60-00", 90.0), ("0-59-60", 1.0)])
def test_seconds_rounded_up_to_60(tmp_path: Path, text: str, degrees: float) -> None:
    (found,) = readings(tmp_path, f"zenith,A,B,S1,,,,{text},,,5,")
    assert found.value == pytest.approx(np.radians(degrees), rel=1e-15)


def test_sigmas_from_the_instrument(tmp_path: Path) -> None:
    """3 cc; an angle root two of that; 2 arcsec; 1.5 mm + 2 ppm of 10.5 m; 0.7 mm per root kilometre of 250 m."""
    found = readings(
        tmp_path,
        "direction,A,B,S1,,90,,,,,,,", "angle,A,B,S1,C,90,,,,,,,", "zenith,A,B,S1,,90,,,,,,,",
        "slope_distance,A,B,S1,,,,,10.5,,,,", "height_difference,A,B,S1,,,,,0.1,,,,250",
        columns=COLUMNS + ",length_m",
    )  # fmt: skip
    cc = np.pi / 2e6
    expected = [3 * cc, 3 * cc * 2**0.5, 2 * ARCSEC, 1.5e-3 + 2e-6 * 10.5, 0.7e-3 * 0.25**0.5]
    np.testing.assert_allclose([r.sigma for r in found], expected, rtol=1e-14)
    assert {r.target_centring_sigma for r in found} == {0.0002}


def test_instruments_and_setups(tmp_path: Path) -> None:
    survey = files.read(folder(tmp_path, DEFINITION)).survey
    vector = survey.instruments[0].parameters
    assert (vector.free, vector.values[0]) == (("distance_offset",), 0.0125)
    assert vector.prior is not None
    assert np.sqrt(vector.prior.cov[0, 0]) == pytest.approx(0.0004, rel=1e-15)
    assert survey.setups == (Setup("S1", "TS", True, 0.0005, 0.0), Setup("S2", "TS", False, 0.0, 0.001))


def test_group_scale_and_correlations(tmp_path: Path) -> None:
    """rho between readings gives one covariance to those that hang together."""
    rows = [f"slope_distance,A,{to},S1,,,,,{d},,,2" for to, d in (("B", 10), ("C", 11))]
    rows += ["height_difference,A,B,,,,,,0.1,,,1"]
    text = "\n".join([COLUMNS, *rows]) + "\n"
    path = folder(tmp_path, DEFINITION + "[sigmas.scale]\nslope_distance = 1.5\n", terrestrial=text,
                  terrestrial_covariance="a_id,b_id,rho\nr2,r1,0.25\n")  # fmt: skip
    covariances = files.read(path).survey.reading_covariances
    assert [c.reading_ids for c in covariances] == [("r1", "r2")]
    np.testing.assert_allclose(covariances[0].cov, 9e-6 * np.array([[1, 0.25], [0.25, 1]]), rtol=1e-14)


def everything() -> tuple[Survey, Sigmas]:
    """A survey with every new kind of unknown and observation, awkward numbers in all of them."""
    survey, _ = geometric(5)
    rng = np.random.default_rng(5)
    parameters = VectorParameter(("distance_offset", "distance_scale", "refraction", "vertical_index"),
                                 np.array([0.0123, 3.7e-6, 0.13, 1e-5]), ("distance_scale", "vertical_index"),
                                 VectorPrior(("vertical_index",), np.array([1e-5]), np.array([[1e-10]])))  # fmt: skip
    far = {"instrument_height": 1.5123, "target_height": 0.123, "target_centring_sigma": 0.0003}
    a, b, h = PositionRef("A"), PositionRef("B"), PositionRef("H")
    head = PositionRef(frame=FrameRef("station", "head", "h1"))
    made = (
        Reading("r1", "direction", a, b, 1.234567, 3e-6, "S1", **far),
        Reading("r2", "direction", a, h, -0.2, 3e-6, "S1", group="far", used=False),
        Reading("r3", "zenith", a, head, 1.5, 4e-6, "S1"),
        Reading("r4", "slope_distance", h, PositionRef("c3", FrameRef("target", "board")), 3.21, 1e-3, "S2"),
        Reading("r5", "angle", a, b, 0.7, 3e-6, second=h, second_height=0.2),
        Reading("r6", "height_difference", a, b, -0.3, 2e-4),
        Reading("r7", "azimuth", a, b, 0.3, 2e-4),
        Reading("r8", "horizontal_distance", a, b, 0.3, 2e-4),
    )
    made = tuple(r if r.group != "reading" else replace(r, group=r.kind) for r in made)
    rho = np.array([[1.0, 0.3, 0.0], [0.3, 1.0, -0.2], [0.0, -0.2, 1.0]])
    sigma = np.array([3e-6, 4e-6, 1e-3])
    covariance = ReadingCovariance(("r1", "r3", "r4"), rho * np.outer(sigma, sigma))
    pose = PoseParameter(survey.stations[1].world_from_station.value, "free")
    survey = replace(
        survey,
        image_blocks=(),
        # lenses as the project folder has them
        cameras=(),
        targets=tuple(replace(t, warp=None) for t in survey.targets),
        stations=(survey.stations[0], replace(survey.stations[1], world_from_station=pose)),
        points=(*survey.points, Point("P", PointParameter(np.array([1.0, 2.0, 0.5]), held=("z",))),
                Point("Q", PointParameter(np.array([np.nan, np.nan, 0.0]), held=("z",)))),
        bearings=Bearings("x", False),
        instruments=(Instrument("TS", parameters), Instrument("level")),
        setups=(Setup("S1", "TS", True, 0.0005, 0.0002), Setup("S2", None, False)),
        readings=made,
        reading_covariances=(covariance,),
        beams=tuple(replace(b, parameters=with_prior(b.parameters)) for b in survey.beams),
        on_surfaces=tuple(sorted(survey.on_surfaces, key=lambda o: (o.surface_id, str(o.position.point_id)))),
        levels=tuple(replace(x, used=i > 0, group="bubble") for i, x in enumerate(survey.levels)),
    )  # fmt: skip
    survey = replace(survey, alignments=tuple(replace(
        x, cov=x.cov if np.isfinite(x.cov).all() else np.diag(np.diag(x.cov)),
        value=np.where(np.isfinite(np.diag(x.cov)), x.value, 0.0)) for x in survey.alignments))  # fmt: skip
    cov = h_cov(rng)
    part = tuple(replace(c, cov=cov if len(c.cov) == 6 else c.cov,
                         values=np.where(np.isfinite(np.diag(cov)).reshape(-1, 3), c.values, np.nan)
                         if len(c.cov) == 6 else c.values) for c in survey.coordinates)  # fmt: skip
    baselines = tuple(replace(d, cov=cov, values=np.where(np.isfinite(np.diag(cov)).reshape(-1, 3), d.values, np.nan))
                      if len(d.cov) == 6 else d for d in survey.coordinate_differences)  # fmt: skip
    sigmas = Sigmas(tables={}, instruments={"TS": Accuracy(direction=3e-6, zenith=5e-6, distance=1e-3,
                                                          distance_slope=2e-6, target_centring=1e-4)})  # fmt: skip
    return replace(survey, coordinates=part, coordinate_differences=baselines), sigmas


def with_prior(vector: VectorParameter) -> VectorParameter:
    """The file format has one value for the start and the mean of a prior."""
    if vector.prior is None:
        return vector
    mean = np.array([vector.values[vector.names.index(name)] for name in vector.prior.names])
    return replace(vector, prior=replace(vector.prior, mean=mean))


def h_cov(rng: np.random.Generator) -> np.ndarray:
    """A joint covariance (6, 6) of two triples, the fifth component not observed."""
    A = rng.normal(size=(6, 6))
    cov = (A @ A.T + np.eye(6)) * 1e-6
    cov[4, :] = cov[:, 4] = 0.0
    cov[4, 4] = np.inf
    return cov


@pytest.mark.parametrize("parquet", [False, True])
def test_round_trip(tmp_path: Path, parquet: bool) -> None:
    """Everything that is written comes back, to the rounding of a change of units."""
    survey, sigmas = everything()
    files.write_project(tmp_path / "one", survey, sigmas=sigmas, parquet=parquet)
    first = files.read(tmp_path / "one")
    again = first.survey
    for name in ("vertical", "bearings", "instruments", "setups", "beams", "surfaces", "readings", "levels",
                 "alignments", "laser_spots", "on_surfaces", "points"):  # fmt: skip
        assert not loose(getattr(survey, name), getattr(again, name)), name
    assert not loose(survey.reading_covariances, again.reading_covariances, 1e-12)
    order = [tuple(str(p) for p in c.positions) for c in again.coordinates]
    for c in survey.coordinates:
        mine = again.coordinates[order.index(tuple(str(p) for p in c.positions))]
        assert not loose((c.values, c.cov), (mine.values, mine.cov), 1e-12)
    assert [d.set_id for d in again.coordinate_differences] == ["set1", "d3"]  # what had no name got one
    named = tuple(replace(d, set_id="") for d in again.coordinate_differences)
    assert not loose(survey.coordinate_differences, named, 1e-12)
    assert not loose(sigmas.instruments, first.sigmas.instruments)
    files.write_project(tmp_path / "two", again, sigmas=first.sigmas, parquet=parquet)
    assert not differences(files.read(tmp_path / "two").survey.readings, again.readings)


def loose(a: object, b: object, rtol: float = 3e-15) -> list[str]:
    """Differences beyond the rounding of a change of units."""
    import tests.survey.test_files as t

    original = np.allclose
    try:
        t.np.allclose = lambda x, y, **k: original(x, y, rtol=rtol, atol=k.get("atol", 0), equal_nan=True)
        return differences(a, b)
    finally:
        t.np.allclose = original


@pytest.mark.parametrize(
    ("dimensions", "points", "held", "value"),
    [
        (2, "A = { x_mm = [1000, 2000] }", ("z",), [1.0, 2.0, 0.0]),
        (2, "A = { x_mm = [1000, 2000, 300] }", ("z",), [1.0, 2.0, 0.3]),
        (2, "A = {}", ("z",), [np.nan, np.nan, 0.0]),
        (1, "A = { x_mm = [300] }", ("x", "y"), [0.0, 0.0, 0.3]),
        (3, 'A = { x_mm = [1000, nan, 300], held = ["z"] }', ("z",), [1.0, np.nan, 0.3]),
    ],
)
def test_networks_of_fewer_dimensions(tmp_path: Path, dimensions: int, points: str, held, value) -> None:
    text = f"format = 1\ndimensions = {dimensions}\n[points]\n{points}\n"
    parameter = files.read(folder(tmp_path, text)).survey.points[0].x_in_world
    assert parameter.held == held
    np.testing.assert_array_equal(parameter.value, value)


def test_tie_points_of_a_plane_network(tmp_path: Path) -> None:
    text = "format = 1\ndimensions = 2\ntie_points = true\n[setups.S]\n"
    path = folder(tmp_path, text, terrestrial="kind,from_id,to_id,setup_id,value_gon,sigma_cc\ndirection,A,B,S,10,5\n")
    points = files.read(path).survey.points
    assert [(p.point_id, p.x_in_world.held) for p in points] == [("A", ("z",)), ("B", ("z",))]


def test_level_by_accelerometer(tmp_path: Path) -> None:
    """The specific force along an axis is g sin(inclination): asin(0.01) and its sigma over the cosine."""
    text = "level_id,frame_id,axis,value_g,sigma_g,value_mm_per_m,sigma_mm_per_m\n"
    text += "a,station:tripod,x,0.01,0.0001,,\nb,station:tripod,-y,,,2,0.1\nc,tripod,0 3 4,,,0,0.1\n"
    a, b, c = files.read(folder(tmp_path, DEFINITION, levels=text)).survey.levels
    assert a.value == pytest.approx(np.arcsin(0.01), rel=1e-15)
    assert a.sigma == pytest.approx(1e-4 / np.cos(np.arcsin(0.01)), rel=1e-14)
    assert (b.value, b.sigma) == (0.002, 0.0001)
    np.testing.assert_allclose([a.axis_in_frame, b.axis_in_frame, c.axis_in_frame],
                               [[1, 0, 0], [0, -1, 0], [0, 0.6, 0.8]], atol=1e-15)  # fmt: skip


def test_mount_of_a_table_is_a_frame(tmp_path: Path) -> None:
    survey = Survey(tables=(Table("t"),), stations=(Station("head", "table", table_id="t"),))
    files.write_project(tmp_path, survey)
    (tmp_path / "observations").mkdir(exist_ok=True)
    text = "level_id,frame_id,axis,value_arcsec,sigma_arcsec\na,mount:t@e1,x,0,5\n"
    (tmp_path / "observations" / "levels.csv").write_text(text)
    assert files.read(tmp_path).survey.levels[0].frame == FrameRef("mount", "t", "e1")


ROW = "height_difference,A,B,,,,,,0.1,,,1"


def test_directions_of_a_set_up_are_from_one_place(tmp_path: Path) -> None:
    """With ends swapped a free network would fit as well, mirrored at a point."""
    swapped = "direction,B,A,S1,,10,,,,,5,", "direction,C,A,S1,,20,,,,,5,"
    said = "from_id: 'C', but set-up 'S1' stands on 'B' in line 2; .* correct from_id and to_id"
    with pytest.raises(SurveyError, match=rf"terrestrial.csv:3: {said}"):
        readings(tmp_path, *swapped)
    kept = readings(tmp_path, "direction,A,B,S1,,10,,,,,5,", "direction,A,C,S1,,20,,,,,5,",
                    "slope_distance,B,C,S1,,,,,3,,,1")  # fmt: skip
    assert len(kept) == 3


@pytest.mark.parametrize(
    ("row", "line", "message"),
    [
        ("drection,A,B,S1,,10,,,,,5,", 3, r"kind: found 'drection'; did you mean 'direction'\?"),
        ("direction,A,B,,,10,,,,,5,", 3, "setup_id: is blank; directions of one set-up share an orientation"),
        ("direction,A,B,S3,,10,,,,,5,", 3, r"setup_id: unknown setup 'S3'; known: S1, S2; setups are listed as"),
        ("direction,A,B,S1,,10,11.1,,,,5,", 3, "value is given twice"),
        ("direction,A,B,S1,,,,,10,,5,", 3, "the direction has a value of the wrong kind"),
        ("slope_distance,A,B,S1,,10,,,,,,1", 3, "the slope_distance .* give it a length: value_m or value_mm"),
        ("slope_distance,A,B,S1,,,,,10,,5,", 3, "that of a reading of kind slope_distance stands in sigma_mm; move it"),
        ("azimuth,A,B,S1,,10,,,,,,", 3, r"the azimuth has no sigma; .* or sigma_azimuth_arcsec to \[instruments.TS\]"),
        ("slope_distance,A,B,,,,,,10,,,", 3, "sigma_distance_mm to the instrument of its setup"),
        ("zenith,A,B,S1,,270,,,,,5,", 3, r"found 270 deg; a zenith angle lies between 0 and 180 deg \(reduce it"),
        ("zenith,A,B,S1,,,,89-61-00,,,5,", 3, "minutes and seconds go up to 60"),
        ("zenith,A,B,S1,,,,89 59 00,,,5,", 3, "value_dms: found '89 59 00'; write degrees-minutes-seconds"),
        ("slope_distance,A,B,S1,,,,,-1,,,1", 3, "found -1 m; a distance is positive"),
        ("angle,A,B,S1,,10,,,,,5,", 3, "an angle needs its right-hand target; fill it in"),
        ("azimuth,A,B,,C,10,,,,,5,", 3, "readings of kind azimuth have no second target; remove it"),
        ("azimuth,A,A,,,10,,,,,5,", 3, "'A' stands in this row twice"),
        ("azimuth,A,X,,,10,,,,,5,", 3, r"to_id: unknown point 'X'; .*list it as \[points.X\]"),
    ],
)
def test_faults_are_named_with_line_and_remedy(tmp_path: Path, row: str, line: int, message: str) -> None:
    with pytest.raises(SurveyError, match=rf"terrestrial.csv:{line}: .*({message})"):
        readings(tmp_path, ROW, row)


@pytest.mark.parametrize(
    ("table", "text", "message"),
    [
        ("terrestrial", "kind,from_id,to_id,value_dg\n", "unknown column 'value_dg'; did you mean 'value_deg'"),
        ("terrestrial_covariance", "a_id,b_id,rho\nr1,r2,0.1\n", "no table of terrestrial beside it"),
        ("levels", "level_id,frame_id,axis,value_arcsec,sigma_arcsec\na,tripod,up,0,1\n",
         "levels.csv:2: axis: found 'up'; write x, y, z, -x"),
        ("levels", "level_id,frame_id,axis,value_g,sigma_g\na,tripod,x,1.2,1\n", "value_g: found 1.2; along a level"),
        ("alignments", "alignment_id,a_id,axis_a,b_id,axis_b\na,tripod,x,world,x\n", "the row has none; give sigma_1"),
        ("laser_spots", "spot_id,beam_id,epoch_id,target_id,x_mm,y_mm,sigma_mm\na,b,e,t,0,0,1\n",
         "unknown beam 'b'; none is known here"),
        ("on_surfaces", "surface_id,point_id,sigma_mm\nwall,A,1\n", "unknown surface 'wall'; none is known here"),
        ("coordinates", "point_id,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm\nB,1,2,,1,1,1\n",
         "coordinates.csv:2: z_mm: is blank but sigma_z_mm is not; fill in both, or none"),
        ("coordinates", "point_id,x_mm,sigma_x_mm\nB,,\n", "all are blank; fill in what was observed"),
        ("coordinates", "point_id,x_mm,z_mm,sigma_x_mm,sigma_z_mm,rho_xy\nB,1,2,1,1,0.3\n",
         "rho_xy: correlates a coordinate that is blank"),
        ("coordinate_differences", "difference_id,from_id,to_id,dx_mm,sigma_dx_mm\nd,A,A,1,1\n",
         "a difference joins two different positions"),
    ],
)  # fmt: skip
def test_faults_of_the_other_tables(tmp_path: Path, table: str, text: str, message: str) -> None:
    with pytest.raises(SurveyError, match=message):
        files.read(folder(tmp_path, DEFINITION, **{table: text}))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[setups.S9]\ninstrument = "TX"\n', r"instrument: unknown instrument 'TX'; known: TS"),
        ("[vertical]\nup_in_world = [0, 0, 2]\n", "the direction has length 2, not 1"),
        ("[bearings]\nzero = 'z'\n", "found 'z'"),
        ("[beams.b]\naxis = 'z'\n", "fixed on the mount of a table or on a station: neither is given"),
        ("[surfaces.w]\nkind = 'wall'\n", "found 'wall'"),
        ("[surfaces.w]\nkind = 'sphere'\nfree = ['x']\n", "y is not free and has no value; give it one"),
        ("[surfaces.w]\nkind = 'plane'\nradius_mm = 1\n", "unknown key"),
        ("[instruments.L]\nsigma_distance_ppm = 1\n", "sigma_distance_mm is missing"),
        ("[instruments.L]\nsigma = { refraction = 0.1 }\n", "refraction has a sigma but is not free"),
    ],
)
def test_faults_of_the_definition(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SurveyError, match=rf"survey.toml:\d+: .*{message}"):
        files.read(folder(tmp_path, DEFINITION + text))
