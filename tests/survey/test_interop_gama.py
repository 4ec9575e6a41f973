"""GNU Gama's files: conventions, units, datum, covariances, and what is said about bad ones."""

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.interop.networks.gama import read_gama
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
    assert (network.sigma0, network.sigmas, network.alpha) == (2.0, "a_priori", 0.01)
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


ANGULAR_DEFAULTS = """<gama-local><network><parameters sigma-apr="1"/>
<points-observations direction-stdev="5" angle-stdev="6" zenith-angle-stdev="7" azimuth-stdev="8">
<point id="1" x="0" y="0" z="0" fix="xyz"/><point id="2" x="30" y="40" z="0" fix="xyz"/><point id="3" adj="xyz"/>
<obs from="1"><direction to="2" val="0.0"/><direction to="3" val="0-00-00"/></obs>
<obs><angle from="1" bs="2" fs="3" val="{0}"/><z-angle from="1" to="3" val="{0}"/>
<azimuth from="1" to="3" val="{0}"/><s-distance from="1" to="3" val="50" stdev="1"/></obs>
</points-observations></network></gama-local>"""


@pytest.mark.parametrize(("value", "unit"), [("50.0", CC), ("45-00-00.0", ARCSEC)])
def test_default_deviations_are_in_the_unit_that_the_value_demands(tmp_path, value, unit):
    readings = _read(tmp_path, ANGULAR_DEFAULTS.format(value)).survey.readings
    assert [r.kind for r in readings[2:5]] == ["angle", "zenith", "azimuth"]
    assert [r.value for r in readings[2:5]] == pytest.approx([np.pi / 4] * 3)
    sigmas = [5 * CC, 5 * ARCSEC, 6 * unit, 7 * unit, 8 * unit]
    assert [r.sigma for r in readings[:5]] == pytest.approx(sigmas, rel=1e-14)


def test_seconds_and_minutes_rounded_up_to_60(tmp_path):
    for text, degrees in (("44-59-60.00", 45.0), ("44-60-00", 45.0), ("-0-59-60", -1.0)):
        angle = _read(tmp_path, ANGULAR_DEFAULTS.format(text)).survey.readings[2]
        assert angle.value == pytest.approx(np.radians(degrees), rel=1e-14)


def _tolerance(tmp_path, limit, more=""):
    text = f"""<gama-local><network><parameters sigma-apr="10" tol-abs="{limit}" {more}/>
    <points-observations distance-stdev="5" direction-stdev="10" zenith-angle-stdev="40">
    <point id="A" x="0" y="0" z="0" fix="xyz"/><point id="B" x="100" y="0" z="0" adj="xyz"/>
    <point id="C" x="0" y="100" z="0" adj="xyz"/><point id="D" adj="xyz"/>
    <obs from="A"><direction to="B" val="50"/><direction to="C" val="150"/><distance to="B" val="100.9"/></obs>
    <obs from="B"><distance to="C" val="141.42"/><s-distance to="C" val="143" stdev="5"/>
    <cov-mat dim="2" band="1">25 1 25</cov-mat></obs>
    <obs from="B"><direction to="A" val="0"/><direction to="C" val="351"/><direction to="D" val="100"/>
    <s-distance to="D" val="50" stdev="5"/><z-angle to="D" val="90"/><z-angle to="A" val="101" from_dh="1.5708"/>
    <z-angle to="C" val="98.5"/></obs>
    <height-differences>
    <dh from="A" to="B" val="0.5" stdev="1"/><dh from="A" to="C" val="-1.5" stdev="1"/>
    </height-differences>
    <vectors><vec from="A" to="B" dx="100" dy="3" dz="0"/><cov-mat dim="3" band="0">1 1 1</cov-mat></vectors>
    </points-observations></network></gama-local>"""
    return _read(tmp_path, text)


def test_readings_beyond_tol_abs_are_not_used_and_named(tmp_path):
    network = _tolerance(tmp_path, 1000)
    # slope distance 143 beside 141.4; dh -1.5 beside 0; a direction half a gon of 141 m from the median of its set
    assert [r.reading_id for r in network.survey.readings if not r.used] == ["s1", "d4", "dh2"]
    assert "s1 (slope distance B - C) by 1.579 m" in network.notes[0]
    assert "dh2 (height difference A - C) by 1.500 m" in network.notes[0]
    # the zenith angle to C is 3.3 m off, but its weight is a sixteenth; what was correlated with s1 stays
    assert network.survey.reading_covariances == ()
    assert any("not applied to 3 readings of points that have no coordinates" in note for note in network.notes)
    assert any("beyond it are A - B" in note for note in network.notes)
    assert all(r.used for r in _tolerance(tmp_path, 1e7).survey.readings)
    few = {r.reading_id for r in _tolerance(tmp_path, 800).survey.readings if not r.used}
    assert few == {"s1", "d4", "dh2", "h1", "z3"}


def test_what_a_file_asks_for_and_does_not_get_is_said(tmp_path):
    notes = _tolerance(tmp_path, 1e7, 'latitude="50.2" ellipsoid="wgs84" iterations="5" algorithm="gso"').notes
    assert any("not applied: latitude = 50.2, ellipsoid = wgs84; the 8 zenith angles and" in n for n in notes)
    assert any("not read: iterations of <parameters>" in n for n in notes)
    assert not any("algorithm" in n for n in notes)
    dated = _read(tmp_path, GKF.replace('angles="left', 'epoch="3.5" angles="left'))
    (said,) = [n for n in dated.notes if "epoch" in n]
    assert said == "not kept: the epoch 3.5 of the network"


def test_points_defined_by_their_observed_coordinates(tmp_path):
    text = GKF.replace('<point id="B" x="100" y="0" z="12" adj="xyz" />', "").replace(
        '<point id="B" x="100.01" y="0.01" />', '<point id="B" x="100.01" y="0.01" adj="xyz" />'
    )
    points = {p.point_id: p.x_in_world for p in _read(tmp_path, text).survey.points}
    np.testing.assert_array_equal(points["B"].value, [100.01, 0.01, np.nan])
    assert points["B"].held == ()
    # coordinates that the file gives elsewhere go before
    again = GKF.replace('<point id="B" x="100.01" y="0.01" />', '<point id="B" x="100.01" y="0.01" adj="XYZ" />')
    survey = _read(tmp_path, again).survey
    np.testing.assert_array_equal(survey.points[1].x_in_world.value, [100, 0, 12])
    assert survey.datum.points == ("B", "C")


def test_fix_goes_before_adj(tmp_path):
    (survey,) = [_read(tmp_path, GKF.replace('y="0" z="12" adj="xyz"', 'y="0" z="12" fix="xy" adj="xyz"')).survey]
    assert survey.points[1].x_in_world.held == ("x", "y")


def test_parameters_that_come_in_parts_are_linked_together(tmp_path):
    text = GKF.replace('<points-observations', '<parameters conf-pr="0.9"/><points-observations')
    network = _read(tmp_path, text)
    assert (network.sigma0, network.sigmas, network.alpha) == (2.0, "a_priori", 0.1)


def test_coordinates_that_nothing_observes_are_left_out_and_said(tmp_path):
    text = """<gama-local><network><points-observations distance-stdev="5">
    <point id="1" x="0" y="0" fix="xy"/><point id="2" x="90" y="0" fix="xy" adj="z"/><point id="3" adj="xy"/>
    <point id="4" x="1" y="1" z="1" adj="xyz"/>
    <obs><distance from="1" to="3" val="50"/><distance from="2" to="3" val="50"/></obs>
    </points-observations></network></gama-local>"""
    network = _read(tmp_path, text)
    assert [(p.point_id, p.x_in_world.treatment, p.x_in_world.held) for p in network.survey.points] == [
        ("1", "held", ()), ("2", "held", ()), ("3", "free", ("z",)),
    ]  # fmt: skip
    assert "left out, coordinates that nothing observes: z of 2, xyz of 4" in network.notes


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
        ("98-30-15.5", "98-61-15.5", r"line 17.*at most 60"),
        ('<direction to="B" val="0.0000" />', '<direction to="A" val="0.0000" />', r"line 14.*must differ"),
        ("</network>", "", r"not well-formed"),
        ('sigma-act="apriori"', 'sigma-act="priori"', r"sigma-act is 'priori'; did you mean 'apriori'"),
        ('tol-abs="1e6"', 'tol-abs="0"', r"tol-abs: found 0, which is not above zero"),
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
        '<!DOCTYPE x SYSTEM "x.dtd" [<!ENTITY % a SYSTEM "file:///etc/passwd"> %a;]>\n',
        '<!DOCTYPE gama-local [<!ATTLIST gama-local x CDATA "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa">]>\n',
    ],
)
def test_document_types_that_declare_anything_are_refused(tmp_path, head):
    path = tmp_path / "bomb.gkf"
    path.write_text(head + "<gama-local>&a;</gama-local>", encoding="utf-8")
    with pytest.raises(SurveyError, match="the document type declares entities or the like"):
        read_gama(path)


@pytest.mark.parametrize(
    "doctype",
    [
        '<!DOCTYPE gama-local SYSTEM "gama-local.dtd">',
        '<!DOCTYPE gama-xml SYSTEM\n"http://nowhere.invalid/gama-local.dtd" >',
        "<!DOCTYPE gama-local PUBLIC '-//x//EN' 'gama-local.dtd'>",
        "<!-- <!DOCTYPE x [ --><?note a?><!DOCTYPE gama-local>",
    ],
)
def test_a_document_type_that_names_a_grammar_is_passed_over(tmp_path, doctype):
    plain = _read(tmp_path)
    text = GKF.replace('<?xml version="1.0" ?>\n', '<?xml version="1.0" ?>\n' + doctype)
    assert _read(tmp_path, text).survey.readings == plain.survey.readings
    # lines are counted as they are in the file
    line = 22 + doctype.count("\n")
    with pytest.raises(SurveyError, match=f"line {line}: val: found '94,3'"):
        _read(tmp_path, text.replace('val="94.3"', 'val="94,3"'))


@pytest.mark.parametrize("where", ["{}", '<point id="{}" x="1" />'])
def test_an_entity_that_nobody_declared_leaves_no_gap(tmp_path, where):
    body = where.format("1&secret;2")
    path = tmp_path / "net.gkf"
    path.write_text(f'<!DOCTYPE gama-local SYSTEM "x.dtd"><gama-local>{body}</gama-local>', encoding="utf-8")
    with pytest.raises(SurveyError, match="undefined entity"):
        read_gama(path)


@pytest.mark.parametrize("encoding", ["", "iso-8859-1", "utf-8"])
def test_latin_1_is_read_whatever_the_file_says_of_itself(tmp_path, encoding):
    declaration = f'<?xml version="1.0" encoding="{encoding}"?>' if encoding else ""
    text = GKF.replace('<?xml version="1.0" ?>', declaration).replace('"D"', '"Dürnstein"')
    text = text.replace("A small", "Ein kleines ößä")
    path = tmp_path / "net.gkf"
    path.write_bytes(text.strip().encode("latin-1"))
    network = read_gama(path)
    assert network.title.startswith("Ein kleines ößä")
    path.write_text(text.strip().replace("iso-8859-1", "utf-8"), encoding="utf-8")
    assert read_gama(path).title == network.title


def test_xml_that_is_nested_too_deep_is_refused(tmp_path):
    path = tmp_path / "deep.gkf"
    path.write_text("<a>" * 5000 + "</a>" * 5000, encoding="utf-8")
    with pytest.raises(SurveyError, match="nested deeper"):
        read_xml(path, "a")
