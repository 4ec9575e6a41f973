"""mrcal's camera models: opened by mrcal itself where it is installed, parsed by Python elsewhere, and back."""

import ast
import json
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pytest
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.lenses.models import MODELS, camera_constants, project
from adjust.model.errors import SurveyError
from adjust.model.survey import Camera, LensParameter
from survey.cli import main
from survey.interop.cameras.formats import write_cameras
from survey.interop.cameras.mrcal import read_mrcal, rt_by_tangent, rt_of
from survey.interop.cameras.values import BROWN_8, mapped_lens
from survey.project import read
from tests.survey.camera_lab import LENSES, SIZE, pixels, points_before, same_rig

_PYTHON = "/usr/bin/python3"  # where Debian's package puts mrcal
_SCRIPT = """
import sys, json, mrcal, numpy as np
model = mrcal.cameramodel(sys.argv[1])
x = np.array(json.load(sys.stdin))
q = mrcal.transform_point_rt(model.extrinsics_rt_fromref(), x)
print(json.dumps([mrcal.project(q, *model.intrinsics()).tolist(), model.imagersize().tolist()]))
model.write(sys.argv[2])
"""


def _needs_mrcal():
    found = shutil.which(_PYTHON) and subprocess.run(
        [_PYTHON, "-c", "import mrcal"], capture_output=True, check=False
    )
    if not found or found.returncode:
        pytest.skip("mrcal is not installed (Debian's package python3-mrcal); parsed without it in the other tests")


@pytest.fixture
def folder(lab, tmp_path):
    write_cameras(lab[1], tmp_path / "m", "mrcal", None)
    return tmp_path / "m"


def test_mrcal_projects_as_the_survey_does_and_what_it_writes_comes_back(lab, folder, tmp_path):
    _needs_mrcal()
    _, values = lab
    right = values.survey.cameras[1]
    x = points_before(values, right)
    written = tmp_path / "again.cameramodel"
    call = [_PYTHON, "-c", _SCRIPT, str(folder / "right.cameramodel"), str(written)]
    done = subprocess.run(call, input=json.dumps(x.tolist()), capture_output=True, text=True, check=True)
    uv, size = json.loads(done.stdout)
    np.testing.assert_allclose(uv, pixels(values, right, x), rtol=0, atol=1e-9)
    assert size == list(SIZE)
    camera = read_mrcal(written).survey.cameras[0]
    # mrcal writes ten digits
    np.testing.assert_allclose(camera.lens.values, values.lens(right), rtol=1e-9)


def test_without_mrcal_opencv_says_the_same_and_it_comes_back(lab, folder, there_and_back):
    _, values = lab
    right = values.survey.cameras[1]
    model = ast.literal_eval((folder / "right.cameramodel").read_text(encoding="utf-8").strip())
    assert model["lensmodel"] == "LENSMODEL_OPENCV4"
    fx, fy, cx, cy, *k = model["intrinsics"]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rt = np.array(model["extrinsics"])
    x = points_before(values, right)
    uv = cv2.projectPoints(x, rt[:3], rt[3:], K, np.array(k))[0].reshape(-1, 2)
    np.testing.assert_allclose(uv, pixels(values, right, x), rtol=0, atol=1e-9)
    same_rig(values, there_and_back("mrcal", "models"), {"left": "left", "right": "right"})


def test_covariances_come_back_as_priors(lab, folder, there_and_back):
    _, values = lab
    back = there_and_back("mrcal", "models")
    right = next(c for c in back.survey.cameras if c.camera_id == "right")
    estimate = values.estimates["lens", "right"]
    rows = [estimate.components.index(n) for n in right.lens.prior.names]
    cov = values.factor**2 * estimate.cov[np.ix_(rows, rows)]
    np.testing.assert_allclose(right.lens.prior.cov, cov, rtol=1e-9)
    pose = right.station_from_camera
    assert pose.treatment == "prior"
    expected = values.cov("station_from_camera", "right")
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(pose.prior_cov / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-7)


@pytest.mark.parametrize("scale", [1e-5, 1.0])
def test_the_derivative_of_rt_by_the_tangent(scale):
    rng = np.random.default_rng(7)
    pose = Pose3.Expmap(np.concatenate([scale * rng.normal(size=3), rng.normal(size=3)]))
    J = np.column_stack([
        (rt_of(pose * Pose3.Expmap(d)) - rt_of(pose * Pose3.Expmap(-d))) / 2e-6 for d in 1e-6 * np.eye(6)
    ])  # fmt: skip
    np.testing.assert_allclose(rt_by_tangent(rt_of(pose)), J, atol=1e-8)


def test_the_covariance_of_rt_is_the_scatter_of_rt(lab, folder):
    _, values = lab
    model = ast.literal_eval((folder / "right.cameramodel").read_text(encoding="utf-8").strip())
    cov = np.array(model["labsurvey_extrinsics_covariance"]).reshape(6, 6)
    pose = values.station_from_camera(values.survey.cameras[1])
    rng = np.random.default_rng(11)
    ours = np.linalg.cholesky(values.cov("station_from_camera", "right"))
    n = 2000
    d = np.array([rt_of(pose * Pose3.Expmap(ours @ rng.standard_normal(6))) for _ in range(n)]) - rt_of(pose)
    mean = np.mean(np.einsum("ni,ij,nj->n", d, np.linalg.inv(cov), d))
    assert abs(mean - 6.0) < 4 * np.sqrt(12.0 / n)


def test_five_and_eight_terms_and_a_blob_between(tmp_path):
    path = tmp_path / "c.cameramodel"
    path.write_text(
        "{'lensmodel': 'LENSMODEL_OPENCV8', # a comment\n"
        " 'intrinsics': [900,901,320,240,.1,.2,-.001,.002,3e-2,.4,.5,.6,],"
        "\n'extrinsics': [0,0,.5, 1,2,3,],\n'imagersize': [640,480],\n'icam_intrinsics': 0,\n"
        "'optimization_inputs': b'K{b`1LcXJZ+{}#~'\n}",
        encoding="utf-8",
    )
    found = read_mrcal(path)
    camera = found.survey.cameras[0]
    assert camera.lens.values.tolist() == [900, 901, 0, 320, 240, 0.1, 0.2, -0.001, 0.002, 0.03, 0.4, 0.5, 0.6]
    np.testing.assert_allclose(
        camera.station_from_camera.value.inverse().rotation().matrix(), Rotation.from_rotvec([0, 0, 0.5]).as_matrix()
    )
    assert found.notes == ("left out: mrcal's optimisation inputs",)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{'lensmodel': __import__('os').getcwd()}", "expected a text"),
        ("{'lensmodel': 'LENSMODEL_CAHVOR'}", "mrcal-convert-lensmodel"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [1, 2, 3]}", "found 3 numbers"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [1, 2, 3, 1e999]}", "finite"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [1, 2, 3, 10**10**10]}", "finite"),
        ("open('x')", "dictionary"),
        ("{" * 5000, "dictionary"),
        ("{'lensmodel': 'LENSMODEL_OPENCV12', 'intrinsics': [1,1,3,4,0,0,0,0,0,0,0,0,1,0,0,0]}", "thin prism"),
    ],
)
def test_what_cannot_be_read_is_named_and_nothing_is_run(tmp_path, text, says):
    path = tmp_path / "bad.cameramodel"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyError, match=says) as found:
        read_mrcal(path)
    assert "bad.cameramodel, line 1" in str(found.value)


def test_a_lens_of_another_kind_is_converted_and_the_difference_is_stated():
    brown = LENSES["left"]
    names = MODELS["brown"].names
    plain = Camera("a", "s", SIZE, LensParameter("brown", (), np.array([brown.get(n, 0.0) for n in names])))
    assert mapped_lens(plain, plain.lens.values, {"brown": BROWN_8}).note is None
    model = MODELS["brown_backward"]
    values = np.array([8.0, 0.01, -0.02, 1e-4, -1e-6, 0, 1e-5, -1e-5, 1e-4, 0])
    camera = replace(plain, lens=LensParameter(model.name, (), values, pixel_size_mm=0.005))
    found = mapped_lens(camera, values, {"brown": BROWN_8})
    assert found.note is not None
    assert "differs by up to" in found.note
    rng = np.random.default_rng(1)
    q = np.column_stack([rng.uniform(-0.38, 0.38, 3000), rng.uniform(-0.28, 0.28, 3000), np.ones(3000)])
    before = project(model, values, camera_constants(camera), q)
    inside = ((before > -0.5) & (before < np.array(SIZE) - 0.5)).all(axis=1)
    after = project(MODELS["brown"], found.array(*names), camera_constants(plain), q[inside])
    worst = np.linalg.norm(after - before[inside], axis=1).max()
    assert 0.3 * found.largest_px < worst <= found.largest_px * 1.05


def test_back_from_mrcal_the_project_can_be_read(folder, tmp_path):
    assert main(["convert", str(folder), str(tmp_path / "p"), "--format", "mrcal", "--quiet"]) == 0
    assert [c.camera_id for c in read(tmp_path / "p").survey.cameras] == ["left", "right"]
