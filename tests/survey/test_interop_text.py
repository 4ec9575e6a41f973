"""Krumm's, LGC's and plain tables: units, inheritance, datum, and what is said about bad ones."""

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.interop.networks.krumm import read_krumm
from survey.interop.networks.lgc import read_lgc
from survey.interop.networks.plain_csv import read_plain_csv
from survey.project import read
from tests.survey.interop_samples import CSV, KRUMM, LGC

GON, CC, ARCSEC = np.pi / 200, np.pi / 200 * 1e-4, np.pi / 648000


def _file(tmp_path, text, name):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_krumm_readings_and_inherited_deviations(tmp_path):
    network = read_krumm(_file(tmp_path, KRUMM, "net.dat"))
    readings = {r.reading_id: r for r in network.survey.readings}
    assert network.sigma0 == pytest.approx(0.005)
    assert (readings["h2"].value, readings["h2"].sigma) == (94.34, 0.002)
    assert readings["d2"].value == pytest.approx(81.2 * GON, rel=1e-14)
    assert readings["a1"].value == pytest.approx(np.radians(300 + 30.5 / 3600), rel=1e-14)
    assert readings["a1"].sigma == pytest.approx(2 * ARCSEC, rel=1e-14)
    # the mark M has no coordinates: its constant bearing and the angle give a bearing
    assert readings["az1"].kind == "azimuth"
    bearing = np.radians(68 + 15 / 60 + 20.7 / 3600) + 30 * GON
    assert (readings["az1"].value, readings["az1"].sigma) == pytest.approx((bearing, 0.002 * GON), rel=1e-13)
    assert "mark without coordinates" in network.notes[0]
    held = {p.point_id: (p.x_in_world.treatment, p.x_in_world.held) for p in network.survey.points}
    assert held == {"A": ("held", ()), "B": ("free", ("x", "z")), "C": ("free", ("z",))}


def test_krumm_dynamic_datum_is_observed_coordinates(tmp_path):
    text = """[Coordinates]\n1 0 0 100.0\n2 0 0 101.0\n3 0 0 99.0
[Datum]\ndyn\n1  0.0025 -0.0015\n2 -0.0015  0.0036\n[LevelledHeightDifferences]\n1 2 1.0 500 0.002\n2 3 -2.0 2000\n"""
    survey = read_krumm(_file(tmp_path, text, "net.dat")).survey
    (observed,) = survey.coordinates
    assert (observed.cov[2, 5], observed.cov[5, 5], observed.values[1, 2]) == (-0.0015, 0.0036, 101.0)
    assert survey.datum.kind == "given"
    assert [r.sigma for r in survey.readings] == pytest.approx([0.002 * np.sqrt(0.5), 0.002 * np.sqrt(2)])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.002 % and", "0.002 1e-3 % and", "line 14: found 2 words after the distance; two ways"),
        ("A C 94.34", "A X 94.34", "line 15: unknown point 'X'"),
        ("[Distances]", "[Distanzes]", r"line 13: section \[Distanzes\] is not supported; did you mean 'distance'"),
        ("fix xA", "fix xQ", "line 10: 'xQ' names no coordinate"),
        ("300°00'30.5\"", "300.5", "line 20: found '300.5' where an angle like"),
        ("0.5 cm", "0.5 furlong", "line 12: the unit 'furlong' is not known"),
        ("100.001 0.002", "100.001", "line 14: has no deviation"),
        ("68°15'20.7\"", "68°75'20.7\"", "line 22: angle: minutes and seconds are at most 60"),
        ("B M A 30", "B Q A 30", "line 24: points without coordinates: Q"),
    ],
)
def test_bad_krumm_files_are_named_with_their_line(tmp_path, old, new, message):
    assert KRUMM.count(old) == 1
    with pytest.raises(SurveyError, match=message):
        read_krumm(_file(tmp_path, KRUMM.replace(old, new), "net.dat"))


def test_lgc_units_heights_and_setups(tmp_path):
    network = read_lgc(_file(tmp_path, LGC, "net.lgc"))
    readings = {r.reading_id: r for r in network.survey.readings}
    assert (readings["d2"].value, readings["d2"].sigma) == pytest.approx((50 * GON, 10 * CC))
    assert (readings["z1"].instrument_height, readings["z1"].target_height) == (0.1, 0.2)
    # a height of instrument holds until the next one
    assert (readings["s1"].value, readings["s1"].sigma, readings["s1"].instrument_height) == (7.1414, 4e-3, 0.1)
    assert readings["d1"].setup_id == readings["d2"].setup_id == "A"
    assert (network.survey.bearings.zero, network.survey.bearings.clockwise) == ("y", True)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("*DMES 4.000", "*DMES 0.000", "line 15: the deviation after"),
        ("*ANGL", "*ANGLE", "line 9: '\\*ANGLE' is not supported; did you mean '\\*ANGL'"),
        ("A C 50.0", "A Q 50.0", "line 11: unknown point 'Q'"),
        ("C  5.0 5.0 1.0", "C  5.0 5.0", "line 8: point 'C': expected x y z"),
        ("*END\n", "", "\\*END is missing"),
    ],
)
def test_bad_lgc_files_are_named_with_their_line(tmp_path, old, new, message):
    with pytest.raises(SurveyError, match=message):
        read_lgc(_file(tmp_path, LGC.replace(old, new, 1), "net.lgc"))


def test_plain_table(tmp_path):
    survey = read_plain_csv(_file(tmp_path, CSV, "net.csv")).survey
    assert (survey.bearings.zero, survey.bearings.clockwise) == ("x", False)
    held = {p.point_id: (p.x_in_world.treatment, p.x_in_world.held) for p in survey.points}
    assert held == {"A": ("held", ()), "B": ("free", ()), "C": ("free", ("z",))}
    directions = [r for r in survey.readings if r.kind == "direction"]
    assert [r.setup_id for r in directions] == ["S1", "S1"]
    assert directions[1].value == pytest.approx(np.radians(54))
    assert directions[1].sigma == pytest.approx(1.5 * ARCSEC)
    np.testing.assert_allclose(np.diag(survey.coordinate_differences[0].cov), [1e-6, 4e-6, 9e-6])
    np.testing.assert_allclose(np.diag(survey.coordinates[0].cov), [25e-6, np.inf, np.inf])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("slope_distance,", "slope_dist,", "line 8: kind: found 'slope_dist'; did you mean 'slope_distance'"),
        (",10.001,,,0.5,", ",10.001,,,,", "line 8: fill in one of sigma_mm, found none"),
        (",10.001,,,0.5,", ",,10.001,,0.5,", "line 8: fill in one of value_m, found value_gon"),
        ("kind,id", "kind,it", "line 1: unknown column 'it'"),
        ("point,,C,,", "point,,B,,", "line 5: point 'B' is there already"),
        ("0,0,0,,,,xyz,", "0,,0,,,,xyz,", "line 3: y_m: is held but blank"),
        ("angle,,B,C,A", "angle,,B,C,B", "line 9: the points B, C, B must differ"),
    ],
)
def test_bad_tables_are_named_with_their_line(tmp_path, old, new, message):
    with pytest.raises(SurveyError, match=message):
        read_plain_csv(_file(tmp_path, CSV.replace(old, new, 1), "net.csv"))


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_text_in_latin_1_is_read_and_said(tmp_path, capsys, encoding):
    """Degree signs and umlauts of an older editor; a project is UTF-8 in any case."""
    path = tmp_path / "net.dat"
    text = KRUMM.replace("Small", "Höhe über Zürich").replace("′", "'").replace("″", '"')
    path.write_bytes(text.encode(encoding))
    assert main(["convert", str(path), str(tmp_path / "net")]) == 0
    assert ("not UTF-8" in capsys.readouterr().out) == (encoding == "latin-1")
    project = read(tmp_path / "net")
    assert project.title == "Höhe über Zürich"
    assert project.options.sigmas == "a_posteriori"
    path.write_bytes(text.encode("utf-16"))
    assert main(["convert", str(path), str(tmp_path / "again")]) == 1
    assert "save it as UTF-8" in capsys.readouterr().err
