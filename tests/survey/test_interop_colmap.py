"""COLMAP's models: opened, projected and adjusted by pycolmap, and back."""

import shutil
import subprocess

import numpy as np
import pycolmap
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from survey.cli import main
from survey.interop.cameras.colmap_model import read_model
from survey.interop.cameras.colmap_writer import reconstruction, rigid3d
from survey.jobs.converting import adjusted_values
from survey.project import read
from tests.survey.camera_lab import SIGMA_PX, world_pixels


def pose3(rigid):
    return Pose3(Rot3(rigid.rotation.matrix()), rigid.translation)


@pytest.fixture(scope="module")
def models(lab, tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for format in ("colmap", "colmap-text"):
        assert main(["convert", str(lab[0]), str(folder / format), "--format", format, "--quiet"]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("format", ["colmap", "colmap-text"])
def test_pycolmap_reads_the_model_and_projects_as_the_survey_does(lab, models, format):
    _, values = lab
    model = pycolmap.Reconstruction(str(models / format))
    assert model.is_valid()
    assert (model.num_rigs(), model.num_cameras(), model.num_reg_frames()) == (1, 2, 9)
    ours = world_pixels(values)
    assert len(ours) == model.num_images() == 18
    for image in model.images.values():
        camera_id, epoch = image.name.removesuffix(".png").split("/")
        seen = [(p.xy, image.project_point(model.points3D[p.point3D_id].xyz)) for p in image.points2D]
        # COLMAP's pixel origin is the corner of the first pixel
        predicted = np.array([uv for _, uv in seen]) - 0.5
        np.testing.assert_allclose(predicted, ours[camera_id, epoch], rtol=0, atol=1e-9)
        blocks = [b.uv for b in values.blocks() if (b.camera_id, b.epoch_id) == (camera_id, epoch)]
        np.testing.assert_allclose([xy - 0.5 for xy, _ in seen], np.concatenate(blocks), rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("format", ["colmap", "colmap-text"])
def test_a_full_disk_leaves_no_half_model(lab, tmp_path, format, capsys):
    """pycolmap alone would write what has room and say nothing."""
    small = tmp_path / "small"
    small.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(small)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        assert main(["convert", str(lab[0]), str(small / "model"), "--format", format, "--quiet"]) == 1
        assert "No space left on device" in capsys.readouterr().err
        assert list(small.iterdir()) == []
    finally:
        subprocess.run(["umount", str(small)], check=True)


@pytest.mark.parametrize("format", ["colmap", "colmap-text"])
def test_back_again_the_reprojections_are_equal(lab, models, format, tmp_path):
    assert main(["convert", str(models / format), str(tmp_path / "back"), "--format", format, "--quiet"]) == 0
    back = adjusted_values(read(tmp_path / "back"))
    ours, theirs = world_pixels(lab[1]), world_pixels(back)
    assert ours.keys() == theirs.keys()
    for key, uv in ours.items():
        order = [np.lexsort(x.round(6).T) for x in (uv, theirs[key])]
        np.testing.assert_allclose(uv[order[0]], theirs[key][order[1]], rtol=0, atol=1e-9)
    names = {p.point_id for p in back.survey.points}
    assert {"board_r0c0", "board_r4c5", "B0", "B4"} <= names
    assert len(names) == 35


def test_our_reader_reads_what_pycolmap_reads(models):
    theirs = pycolmap.Reconstruction(str(models / "colmap"))
    for format in ("colmap", "colmap-text"):
        ours = read_model(models / format)
        assert set(ours.images) == set(theirs.images)
        assert set(ours.points) == set(theirs.points3D)
        for i, image in theirs.images.items():
            assert ours.images[i].name == image.name
            difference = Pose3.Logmap(ours.images[i].cam_from_world.between(pose3(image.cam_from_world())))
            np.testing.assert_allclose(difference, 0.0, atol=1e-12)
            np.testing.assert_array_equal(ours.images[i].points, [p.point3D_id for p in image.points2D])


def test_bundle_adjustment_of_pycolmap_stays_at_our_optimum(lab):
    _, values = lab
    model, names, _ = reconstruction(values)
    before = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = options.refine_focal_length = options.refine_extra_params = True
    options.refine_sensor_from_rig = True
    options.print_summary = False
    options.ceres.solver_options.function_tolerance = 1e-14
    options.ceres.solver_options.parameter_tolerance = 1e-14
    options.ceres.solver_options.gradient_tolerance = 1e-14
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    for point, name in names.items():
        (config.add_constant_point if name.startswith("board_") else config.add_variable_point)(point)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    adjuster.solve()
    for image in model.images.values():
        camera_id, epoch = image.name.removesuffix(".png").split("/")
        ours = values.world_from(FrameRef("station", "head", epoch))
        cov = values.estimates["world_from_station", "head", epoch].cov
        station_from_camera = values.station_from_camera(values.survey.cameras[0])
        if camera_id == "left":
            theirs = pose3(image.cam_from_world()).inverse() * station_from_camera.inverse()
            moved = np.abs(Pose3.Logmap(ours.between(theirs))) / np.sqrt(np.diag(cov))
            assert moved.max() < 0.02, (epoch, moved)
    for camera in model.cameras.values():
        name = ("left", "right")[camera.camera_id - 1]
        estimate = values.estimates["lens", name]
        names_ = [list(estimate.components).index(n) for n in ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")]
        sigma = np.sqrt(np.diag(estimate.cov))[names_]
        moved = np.abs(np.asarray(camera.params) - np.asarray(before.cameras[camera.camera_id].params)) / sigma
        assert moved.max() < 0.02, (name, moved)
    for point, name in names.items():
        if not name.startswith("board_"):
            sigma = np.sqrt(np.diag(values.estimates["point", name].cov))
            assert (np.abs(model.points3D[point].xyz - before.points3D[point].xyz) / sigma).max() < 0.02


def test_started_off_the_optimum_bundle_adjustment_would_move(lab):
    # so that the test above can fail: a beacon moved by 3 sigma comes back
    _, values = lab
    model, names, _ = reconstruction(values)
    point = next(p for p, n in names.items() if n == "B0")
    home = np.array(model.points3D[point].xyz)
    sigma = np.sqrt(np.diag(values.estimates["point", "B0"].cov))
    model.points3D[point].xyz = home + 3 * sigma
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
        config.set_constant_rig_from_world_pose(model.images[image].frame_id)
    for other in names:
        (config.add_variable_point if other == point else config.add_constant_point)(other)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.refine_sensor_from_rig = False
    options.print_summary = False
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    assert (np.abs(model.points3D[point].xyz - home) / sigma).max() < 0.3


def test_the_covariance_of_a_left_perturbation_is_ours():
    # cam_from_world' = Exp(d) cam_from_world is world_from_cam' = world_from_cam Exp(-d)
    rng = np.random.default_rng(3)
    world_from_camera = Pose3.Expmap(rng.normal(size=6))
    d = 1e-6 * rng.normal(size=6)
    theirs = rigid3d(Pose3.Expmap(d)) * rigid3d(world_from_camera.inverse())
    ours = world_from_camera * Pose3.Expmap(-d)
    np.testing.assert_allclose(Pose3.Logmap(pose3(theirs).inverse().between(ours)), 0.0, atol=1e-12)


def test_weights_that_are_lost_are_said(lab):
    _, values = lab
    assert reconstruction(values)[2] == ()
    uneven = values.survey.image_blocks[0]
    object.__setattr__(uneven, "cov", 4 * uneven.cov)
    try:
        assert f"{SIGMA_PX} to {2 * SIGMA_PX} px" in reconstruction(values)[2][0]
    finally:
        object.__setattr__(uneven, "cov", uneven.cov / 4)


def _refusal(folder, change, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    change(copy)
    with pytest.raises(SurveyError) as found:
        read_model(copy)
    return str(found.value)


def _replace(name, old, new):
    def change(folder):
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")

    return change


def test_damage_is_named_with_its_line(models, tmp_path):
    text = models / "colmap-text"
    message = _refusal(text, _replace("cameras.txt", "1 OPENCV 1280", "1 FOV 1280"), tmp_path / "a")
    assert "cameras.txt, line 4" in message
    assert "FOV has no lens here" in message
    assert "found 7 parameters" in _refusal(
        text, lambda f: _cut_last_word(f / "cameras.txt"), tmp_path / "b"
    )
    cut = _refusal(models / "colmap", lambda f: _cut(f / "images.bin", 1000), tmp_path / "c")
    assert "images.bin, byte" in cut
    huge = _refusal(models / "colmap", lambda f: _huge(f / "points3D.bin"), tmp_path / "d")
    assert "more than the file can hold" in huge


def _cut_last_word(path):
    lines = path.read_text(encoding="utf-8").rstrip("\n").split("\n")
    lines[-1] = lines[-1].rsplit(" ", 1)[0]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _cut(path, n):
    path.write_bytes(path.read_bytes()[:n])


def _huge(path):
    path.write_bytes(b"\xff" * 7 + b"\x00" + path.read_bytes()[8:])


def test_a_model_without_rigs_is_read_as_single_cameras(models, tmp_path):
    copy = tmp_path / "old"
    shutil.copytree(models / "colmap-text", copy)
    for name in ("rigs.txt", "frames.txt"):
        (copy / name).unlink()
    assert main(["convert", str(copy), str(tmp_path / "p"), "--format", "colmap", "--quiet"]) == 0
    survey = read(tmp_path / "p").survey
    assert {c.station_id for c in survey.cameras} == {"rig1", "rig2"}
