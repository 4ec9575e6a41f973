import cv2
import numpy as np
import pytest

from adjust.lenses.models import (
    MODELS,
    camera_constants,
    default_start,
    focal_length_px,
    lens_constants,
    lens_model,
    monotone_radius_px,
    principal_point_px,
    project,
    unit_rays,
)
from adjust.lenses.radial import invert_radius, radial_profile
from adjust.model.errors import SurveyError
from adjust.model.survey import Camera, LensParameter
from tests.adjust.lenses import IMAGE_SIZE, NAMES, lens, points_in_camera, slopes


@pytest.mark.parametrize("name", NAMES)
def test_rays_and_projection_are_inverse(name):
    model, values, constants = lens(name)
    q = points_in_camera(500)
    uv = project(model, values, constants, q)
    np.testing.assert_allclose(slopes(model, values, constants, uv), q[:, :2] / q[:, 2:], atol=1e-13)
    unit = unit_rays(model, values, constants, uv)
    np.testing.assert_allclose(unit, q / np.linalg.norm(q, axis=1, keepdims=True), atol=1e-13)
    np.testing.assert_allclose(project(model, values, constants, unit), uv, atol=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_no_points_give_no_rays(name):
    model, values, constants = lens(name)
    assert project(model, values, constants, np.empty((0, 3))).shape == (0, 2)
    assert slopes(model, values, constants, np.empty((0, 2))).shape == (0, 2)


def test_opencv_projects_the_rays_back():
    model, values, constants = lens("brown")
    values[2] = 0.0
    uv = np.random.default_rng(1).uniform([0, 0], IMAGE_SIZE, (200, 2))
    matrix = np.array([[values[0], 0, values[3]], [0, values[1], values[4]], [0, 0, 1]])
    q = np.column_stack([slopes(model, values, constants, uv), np.ones(200)])
    seen, _ = cv2.projectPoints(q, np.zeros(3), np.zeros(3), matrix, values[5:])
    np.testing.assert_allclose(seen.reshape(-1, 2), uv, atol=1e-10)


def test_fisheye_rays_beyond_90_degrees():
    model, values, constants = lens("fisheye")
    values[5:] = 0.01, -0.003, 0.0, 0.0
    theta = np.radians([0.0, 45.0, 89.0, 91.0, 120.0, 150.0])
    expected = np.column_stack([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)])
    uv = project(model, values, constants, expected)
    np.testing.assert_allclose(unit_rays(model, values, constants, uv), expected, atol=1e-13)


def test_the_fold_of_a_barrel_distortion_is_found_and_named():
    model = MODELS["brown"]
    constants = lens_constants(model, IMAGE_SIZE)
    values = default_start(model, IMAGE_SIZE, 800.0)
    values[5] = -0.4  # r (1 - 0.4 r^2) has its top at r = sqrt(1 / 1.2)
    radius = 800 * np.sqrt(1 / 1.2) * 2 / 3
    assert monotone_radius_px(model, values, constants) == pytest.approx(radius, rel=1e-12)
    centre = values[3:5]
    inside = centre + [[0.999 * radius, 0.0], [0.0, -0.999 * radius]]
    np.testing.assert_allclose(
        project(model, values, constants, np.column_stack([slopes(model, values, constants, inside), [1, 1]])), inside
    )
    with pytest.raises(SurveyError, match=r"pixels \(819\.5, 239\.5\).*no ray.*486\.9 px"):
        slopes(model, values, constants, centre + [[500.0, 0.0], [100.0, 0.0]])


def test_a_point_imaged_beyond_the_fold_gets_the_ray_of_the_inner_branch():
    model = MODELS["brown"]
    constants = lens_constants(model, IMAGE_SIZE)
    values = default_start(model, IMAGE_SIZE, 800.0)
    values[5] = -0.4
    beyond = project(model, values, constants, np.array([[1.2, 0.0, 1.0]]))
    inner = slopes(model, values, constants, beyond)
    assert np.hypot(*inner[0]) < np.sqrt(1 / 1.2)
    np.testing.assert_allclose(project(model, values, constants, np.array([[*inner[0], 1.0]])), beyond)


@pytest.mark.parametrize(
    "terms", [(0.787, -0.433, 0.0, 0.001, -0.515), (0.132, -0.314, 0.002, 0.002, 1.021, 0.658, 0.179, -0.604)]
)
def test_rays_up_to_the_fold_where_newton_from_the_distorted_point_goes_astray(terms):
    model, constants = MODELS["brown"], lens_constants("brown", IMAGE_SIZE)
    values = default_start(model, IMAGE_SIZE, 800.0)
    values[5 : 5 + len(terms)] = terms
    radius = np.linspace(0.0, 0.98 * radial_profile(model.kind, values, constants).limit, 300)
    tangents = np.column_stack([0.8 * radius, 0.6 * radius])
    uv = project(model, values, constants, np.column_stack([tangents, np.ones(300)]))
    np.testing.assert_allclose(slopes(model, values, constants, uv), tangents, atol=1e-11)


@pytest.mark.parametrize("name", ["brown_backward", "brown_backward_dbat"])
def test_a_ray_beyond_the_fold_of_a_correction_has_no_image_point(name):
    model, values, constants = lens(name)
    first = 4 if name.endswith("dbat") else 3
    values[first : first + 3] = -0.02, 0.0, 0.0
    # r (1 - 0.02 r^2) mm has its top at r = sqrt(1 / 0.06) mm
    assert monotone_radius_px(model, values, constants) == pytest.approx(np.sqrt(1 / 0.06) / 0.01)
    with pytest.raises(SurveyError, match=r"1 of 2 points, 4.* deg or more off the axis, have no image point"):
        project(model, values, constants, np.array([[0.1, 0.0, 1.0], [1.0, 0.0, 1.0]]))


def test_monotone_radius_of_a_rational_lens_and_of_aicon():
    model = MODELS["brown"]
    constants = lens_constants(model, IMAGE_SIZE)
    values = default_start(model, IMAGE_SIZE, 800.0)
    assert monotone_radius_px(model, values, constants) == np.inf
    values[10] = 1.0  # r / (1 + r^2): top 1/2 at r = 1
    assert monotone_radius_px(model, values, constants) == pytest.approx(400.0)
    model, values, constants = lens("aicon")
    values[3:6] = -0.01, 0.0, 0.0  # r (1 + 0.01 r0^2 - 0.01 r^2), r0 = 2 mm
    top = np.sqrt(1.04 / 0.03)
    assert monotone_radius_px(model, values, constants) == pytest.approx(100 * top * 1.04 * 2 / 3)


def test_inverse_of_the_radial_function_reaches_the_fold():
    profile = radial_profile(0, np.array([1, 1, 0, 0, 0, -0.4, 0, 0, 0, 0, 0, 0, 0.0]), np.zeros(4))
    top = profile.value(np.array([profile.limit]))[0]
    radius, found = invert_radius(profile, np.array([0.0, 0.5 * top, top * (1 - 1e-6), top * 1.001]))
    np.testing.assert_array_equal(found, [True, True, True, False])
    np.testing.assert_allclose(profile.value(radius[:3]), [0.0, 0.5 * top, top * (1 - 1e-6)], rtol=1e-14)
    assert np.all(radius <= profile.limit)


@pytest.mark.parametrize("name", NAMES)
def test_default_start_is_a_pinhole_with_its_centre_in_the_middle(name):
    model, _, constants = lens(name)
    values = default_start(model, IMAGE_SIZE, 800.0, 0.01)
    q = np.array([[0.0, 0.0, 1.0], [0.1, -0.2, 2.0]])
    expected = [[319.5, 239.5], [359.5, 159.5]]
    if name == "fisheye":
        theta, r = np.arctan2(np.hypot(0.1, 0.2), 2.0), np.hypot(0.1, 0.2)
        expected[1] = [319.5 + 800 * theta * 0.1 / r, 239.5 - 800 * theta * 0.2 / r]
    np.testing.assert_allclose(project(model, values, constants, q), expected)
    assert focal_length_px(model, values, constants) == pytest.approx(800.0)
    np.testing.assert_allclose(principal_point_px(model, values, constants), [319.5, 239.5])


@pytest.mark.parametrize("name", NAMES)
def test_principal_point_is_where_a_lens_without_decentring_shows_the_axis(name):
    model, values, constants = lens(name)
    seen = project(model, values, constants, np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(principal_point_px(model, values, constants), seen, atol=1e-9)


def test_errors_say_what_to_do():
    with pytest.raises(SurveyError, match="choose one of brown, fisheye"):
        lens_model("pinhole")
    with pytest.raises(SurveyError, match="state the camera's pixel_size_mm"):
        lens_constants(MODELS["aicon"], IMAGE_SIZE)
    with pytest.raises(SurveyError, match="must be positive"):
        lens_constants(MODELS["aicon"], IMAGE_SIZE, -0.01)
    model, values, constants = lens("brown")
    with pytest.raises(SurveyError, match="1 of 2 points lie behind the camera"):
        project(model, values, constants, np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))


def test_names_and_units_of_the_models():
    for name, model in MODELS.items():
        assert model.name == name
        assert len(model.units) == model.n
    assert " ".join(MODELS["brown"].names) == "fx fy skew u0 v0 k1 k2 p1 p2 k3 k4 k5 k6"
    assert MODELS["brown_backward"].units[3] == "1/mm^2"


def test_constants_of_a_camera_of_a_survey():
    lens_of_survey = LensParameter("aicon", (), pixel_size_mm=0.004, balance_radius_mm=13.5)
    camera = Camera("c", "s", (640, 480), lens_of_survey)
    np.testing.assert_array_equal(camera_constants(camera), [0.004, 319.5, 239.5, 13.5])
