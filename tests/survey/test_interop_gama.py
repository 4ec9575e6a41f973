"""GNU Gama's files: conventions, units, datum, covariances, and what is said about bad ones."""

import numpy as np
import pytest

from adjust.errors import SurveyError
from survey.interop.gama import read_gama
from survey.interop.safe_xml import read_xml
from tests.survey.interop_samples import GKF

GON, CC, ARCSEC = np.pi / 200, np.pi / 200 * 1e-4, np.pi / 648000


def _read(tmp_path, text=GKF):
    path = tmp_path / "net.gkf"
    path.write_text(text, encoding="utf-8")
    return read_gama(path)


def _reading(network, reading_id):
    return next(r for r in network.survey.readings if r.reading_id == reading_id)


def test_readings_in_si_with_their_units(tmp_path):
    network = _read(tmp_path)
    assert (network.sigma0, network.scaled, network.alpha) == (2.0, False, 0.01)
    mine = _reading(network, "mine")
    assert (mine.kind, mine.at.point_id, mine.to.point_id) == ("direction", "A", "C")
    assert (mine.value, mine.sigma) == pytest.approx((64 * GON, 4 * CC), rel=1e-14)
    slope = _reading(network, "s1")
    # a + b times the length in km
    assert (slope.value, slope.sigma) == pytest.approx((1000.0, 3e-3), rel=1e-14)
    zenith = _reading(network, "z1")
    # degrees come with arc seconds
    assert zenith.value == pytest.approx(np.radians(98 + 30 / 60 + 15.5 / 3600), rel=1e-14)
    assert zenith.sigma == pytest.approx(2 * ARCSEC, rel=1e-14)
    assert (zenith.instrument_height, zenith.target_height) == (1.5, 1.6)
    # sigma-apr times the root of the length in km
    assert _reading(network, "dh1").sigma == pytest.approx(2e-3 * 0.5, rel=1e-14)


def test_covariances_mix_kinds_and_units(tmp_path):
    joint = _read(tmp_path).survey.reading_covariances
    assert [c.reading_ids for c in joint] == [("a1", "h1", "az1")]
    expected = [[9 * ARCSEC**2, ARCSEC * 1e-3, 0], [ARCSEC * 1e-3, 4e-6, 2e-3 * CC], [0, 2e-3 * CC, 100 * CC**2]]
    np.testing.assert_allclose(joint[0].cov, expected, rtol=1e-12)


def test_an_angle_goes_from_backsight_to_foresight(tmp_path):
    angle = _reading(_read(tmp_path), "a1")
    assert (angle.at.point_id, angle.to.point_id, angle.second.point_id) == ("B", "C", "A")


def test_baselines_split_where_nothing_is_correlated(tmp_path):
    text = GKF.replace("1 0.1 2 0 3 0 4 0 5 0 6", "1 0.1 2 0 3 0.5 4 0 5 0 6")
    assert [len(d.to) for d in _read(tmp_path).survey.coordinate_differences] == [1, 1]
    (joint,) = _read(tmp_path, text).survey.coordinate_differences
    assert joint.cov[2, 3] == pytest.approx(0.5e-6)
    # heights of instrument and antenna: 2.003 + 1.0 - 1.5
    np.testing.assert_allclose(joint.values[0], [100.001, 0.002, 1.503], rtol=1e-14)


def test_coordinates_observed_in_part(tmp_path):
    first, second = _read(tmp_path).survey.coordinates
    np.testing.assert_allclose(np.diag(first.cov), [25e-6, 16e-6, np.inf])
    np.testing.assert_allclose(np.diag(second.cov), [np.inf, np.inf, 9e-6])


def test_what_touches_undeclared_points_is_left_out_and_said(tmp_path):
    network = _read(tmp_path)
    assert "D" not in [p.point_id for p in network.survey.points]
    assert any("readings: 1" in note for note in network.notes)


def test_datum_held_and_free_axes(tmp_path):
    survey = _read(tmp_path).survey
    assert (survey.datum.kind, survey.datum.points) == ("inner", ("C",))
    points = {p.point_id: p.x_in_world for p in survey.points}
    assert points["A"].treatment == "held"
    # z of C is unknown, but x, y are not
    np.testing.assert_array_equal(points["C"].value, [50, 80, 11])
    plane = _read(tmp_path, _plane())
    assert plane.survey.points[1].x_in_world.held == ("z",)
    np.testing.assert_array_equal(plane.survey.points[1].x_in_world.value, [np.nan, np.nan, 0.0])


def _plane():
    return """<gama-local><network><points-observations direction-stdev="5" distance-stdev="1">
    <point id="1" x="0" y="0" fix="xy"/><point id="2" adj="xy"/>
    <obs from="1"><direction to="2" val="3"/><distance to="2" val="9"/></obs>
    </points-observations></network></gama-local>"""


def test_a_datum_over_some_axes_of_a_point_is_refused(tmp_path):
    with pytest.raises(SurveyError, match=r"line 11.*'C'.*constrain all"):
        _read(tmp_path, GKF.replace('adj="XYZ"', 'adj="xyZ"'))


@pytest.mark.parametrize(
    ("axes", "angles", "expected"),
    [
        # a point due east, seen clockwise from north, and counter-clockwise
        ("ne", "left-handed", np.pi / 2), ("en", "left-handed", np.pi / 2), ("sw", "left-handed", np.pi / 2),
        ("wn", "left-handed", np.pi / 2), ("es", "left-handed", np.pi / 2), ("nw", "left-handed", np.pi / 2),
        ("ne", "right-handed", -np.pi / 2), ("en", "right-handed", -np.pi / 2), ("ws", "right-handed", -np.pi / 2),
    ],
)  # fmt: skip
def test_azimuths_count_from_north_whatever_the_axes_are_called(tmp_path, axes, angles, expected):
    east = {"n": 0.0, "s": 0.0, "e": 7.0, "w": -7.0}
    x, y = (east[a] for a in axes)
    text = f"""<gama-local><network axes-xy="{axes}" angles="{angles}"><points-observations azimuth-stdev="5">
    <point id="1" x="0" y="0" fix="xy"/><point id="2" x="{x}" y="{y}" adj="xy"/>
    <obs><azimuth from="1" to="2" val="{expected / GON}"/></obs></points-observations></network></gama-local>"""
    survey = _read(tmp_path, text).survey
    theta = np.arctan2(y, x) - (np.pi / 2 if survey.bearings.zero == "y" else 0.0)
    bearing = -theta if survey.bearings.clockwise else theta
    turn = (bearing - survey.readings[0].value + np.pi) % (2 * np.pi) - np.pi
    assert turn == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('val="94.3"', 'val="94,3"', r"line 22: val: found '94,3'"),
        ('val="94.3"', 'val="nan"', r"line 22: val: found 'nan'"),
        ('val="94.3"', 'val="-94.3"', r"line 22.*distances are above zero"),
        ('stdev="0.7"', 'stdev="0"', r"line 32: stdev: found 0, which is not above zero"),
        ('dim="3" band="1"', 'dim="4" band="1"', r"line 24.*dim is 4"),
        ("  100\n", "", r"line 24.*found 4 numbers, a band of 1 needs 5"),
        ("9 1\n", "9 60\n", r"line 24.*not positive definite"),
        ("<direction to=\"B\"", "<direktion to=\"B\"", r"line 14.*direktion.*did you mean 'direction'"),
        ('fix="xyz"', 'fixed="xyz"', r"line 9.*unknown attribute 'fixed'.*did you mean 'fix'"),
        ('axes-xy="ne"', 'axes-xy="nn"', r"line 3.*axes-xy is 'nn'"),
        ("98-30-15.5", "98-61-15.5", r"line 17.*below 60"),
        ('<direction to="B" val="0.0000" />', '<direction to="A" val="0.0000" />', r"line 14.*must differ"),
        ("</network>", "", r"not well-formed"),
        ('<point id="A" x="0"', '<point id="A"', r"line 9.*x of point 'A' is fixed but not given"),
    ],
)  # fmt: skip
def test_bad_files_are_named_with_their_line(tmp_path, old, new, message):
    assert GKF.count(old) == 1
    with pytest.raises(SurveyError, match=message):
        _read(tmp_path, GKF.replace(old, new))


@pytest.mark.parametrize(
    "head",
    [
        '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n',
        '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>\n',
        '<!DOCTYPE x SYSTEM "http://nowhere.invalid/x.dtd">\n',
    ],
)
def test_entities_and_document_types_are_refused(tmp_path, head):
    path = tmp_path / "bomb.gkf"
    path.write_text(head + "<gama-local>&a;</gama-local>", encoding="utf-8")
    with pytest.raises(SurveyError, match="a document type or an entity is declared"):
        read_gama(path)


def test_xml_that_is_nested_too_deep_is_refused(tmp_path):
    path = tmp_path / "deep.gkf"
    path.write_text("<a>" * 5000 + "</a>" * 5000, encoding="utf-8")
    with pytest.raises(SurveyError, match="nested deeper"):
        read_xml(path, "a")
