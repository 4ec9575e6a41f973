"""Mistakes planted in the head on the turntable: each is named by ``labsurvey adjust``, and the good lab has none."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.survey import PoseParameter
from survey.cli import FAILED, main
from survey.jobs.adjusting.steps import adjust_project
from survey.project import read, write_project
from survey.simulate import Scene, head_on_table, resample
from tests.acceptance.mfns_replica import noisy, replica

SIGMA_PX = 0.115
SHIFT_MM, TURN_DEG = (8.0, 0.0, 3.0), 1.0


@pytest.fixture(scope="module")
def good():
    return head_on_table(1, n_table_epochs=8, n_free_epochs=4)


@pytest.fixture(scope="module")
def planted(good, tmp_path_factory):
    """The folder of a mistake that can be mended in its table, and what is said of it: once for all who ask."""

    @cache
    def of(fault):
        folder = tmp_path_factory.mktemp("fault")
        write_project(folder, MENDED[fault](good[0]))
        _, warnings, err = run(folder)
        return folder, "\n".join([*warnings, err])

    return of


def run(folder, *options):
    """Exit code, warnings and the text of an error of ``labsurvey adjust`` on a project folder."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = main(["adjust", str(folder), "--quiet", "--json", *options])
    return code, json.loads(out.getvalue())["warnings"] if code != FAILED else [], err.getvalue()


def said(folder, survey):
    """The warnings, or the text of the error, of the survey as a project folder, of which no report is asked for."""
    write_project(folder, survey)
    try:
        return "\n".join(adjust_project(read(folder), progress=False).warnings)
    except SurveyError as error:
        return str(error)


def with_angles(survey, change):
    angles = change(np.array([r.angles for r in survey.table_readings]))
    readings = (replace(r, angles=a) for r, a in zip(survey.table_readings, angles, strict=True))
    return replace(survey, table_readings=tuple(readings))


def times(*factors):
    return lambda a: a * np.array(factors)


def exchanged(a):
    a[[4, 5]] = a[[5, 4]]
    return a


def mistyped(a):
    a[16, 1] += np.radians(10.0)
    return a


SHARED = {
    "axes exchanged": (lambda a: a[:, ::-1], "axis1 and axis2 are exchanged"),
    "gon typed as degrees": (times(10 / 9, 10 / 9), "the readings of axis1 and axis2 are in gon"),
    "gon of one axis": (times(1.0, 10 / 9), "the readings of axis2 are in gon"),
    "radians typed as degrees": (times(np.pi / 180, np.pi / 180), "axis1 and axis2 are in radians"),
    "half turns": (times(0.5, 1.0), "the readings of axis1 are half the turn"),
    "one epoch late": (lambda a: np.roll(a, 1, axis=0), "every epoch has the reading of the preceding one"),
    "one epoch early": (lambda a: np.roll(a, -1, axis=0), "every epoch has the reading of the following one"),
}


@pytest.mark.parametrize("fault", SHARED)
def test_mistake_of_all_readings(fault, good, planted, tmp_path):
    change, named = SHARED[fault]
    text = planted(fault)[1] if fault in MENDED else said(tmp_path, with_angles(good[0], change))
    assert "probable cause" in text
    assert named in text
    assert "deg instead of" in text


def with_design(survey, truth):
    """Cameras that are known to some degrees and millimetres from the drawing of the head."""
    off = Pose3(Rot3.Expmap(np.radians([2.0, -1.5, 1.0])), np.array([0.003, -0.002, 0.004]))
    return replace(survey, cameras=tuple(
        replace(c, station_from_camera=PoseParameter(truth["station_from_camera", c.camera_id] * off))
        for c in survey.cameras
    ))  # fmt: skip


@pytest.mark.parametrize(("factors", "named"), [
    ((-1.0, 1.0), "the sign of axis1 is probably wrong"),
    ((1.0, -1.0), "the sign of axis2 is probably wrong"),
    ((-1.0, -1.0), "the signs of axis1 and axis2 are probably wrong"),
])  # fmt: skip
def test_wrong_sign(factors, named, good, tmp_path):
    text = said(tmp_path, with_angles(with_design(*good), times(*factors)))
    assert named in text
    assert "180.0 deg" in text or "deg from the pose given" in text


def test_one_reading_mistyped(good, planted):
    reading, text = good[0].table_readings[16], planted("mistyped")[1]
    line = next(row for row in text.splitlines() if f"epoch {reading.epoch_id}: axis2 reads" in row)
    stated, sigma = (float(v.split()[0]) for v in line.split("images say")[1].replace("+- ", "+-").split("+-"))
    true = np.degrees(good[1]["table_angles", "turntable", reading.epoch_id][1])
    assert abs(stated - true) < max(4.0 * sigma, 0.005)
    assert sigma < 0.05
    assert "axis1 reads" not in text


def test_two_readings_exchanged(planted):
    assert "the readings of epochs t05 and t06 are exchanged" in planted("exchanged")[1]


def displaced(survey, truth, epochs):
    """The board shifted and turned at these epochs."""
    scene, rng, blocks = Scene(survey, truth), np.random.default_rng(5), []
    D = Pose3(Rot3.Expmap(np.radians([0.0, 0.0, TURN_DEG])), np.array(SHIFT_MM) / 1e3)
    for b in survey.image_blocks:
        if b.epoch_id in epochs:
            x = scene.target_points(b.target_id, b.epoch_id)[b.point_idx]
            uv = scene.project(b.camera_id, b.epoch_id, np.array([D.transformFrom(p) for p in x]))
            b = replace(b, uv=uv + rng.normal(0.0, SIGMA_PX, uv.shape))
        blocks.append(b)
    return replace(survey, image_blocks=tuple(blocks))


def test_board_moved_between_images(good, tmp_path):
    survey, truth = good
    late = [r.epoch_id for r in survey.table_readings][14:]
    text = said(tmp_path, displaced(survey, truth, late))
    line = next(row for row in text.splitlines() if "target board, which stands for the world, was moved" in row)
    assert f"was moved before epoch {late[0]} by" in line
    assert f"leave out what was observed from {late[0]} on, or give it a name of its own there" in line
    shift = np.array([float(v) for v in line.split("by (")[1].split(")")[0].split(",")])
    np.testing.assert_allclose(shift, SHIFT_MM, atol=0.5)
    assert abs(float(line.split("mm and ")[1].split()[0]) - TURN_DEG) < 0.1


def test_board_moved_at_one_epoch(good, tmp_path):
    survey, truth = good
    text = said(tmp_path, displaced(survey, truth, ["t08"]))
    assert "epoch t08, target board: target board appears displaced by (8.0" in text
    assert "it was moved at epoch t08, or is mis-detected there" in text


def renumbered(survey, epoch_id, order):
    return replace(survey, image_blocks=tuple(
        replace(b, point_idx=order(b.point_idx)) if b.epoch_id == epoch_id else b for b in survey.image_blocks
    ))  # fmt: skip


def test_board_numbered_from_the_wrong_corner(planted):
    text = planted("wrong corner")[1]
    assert "epoch t08, target board is mis-detected: its points are numbered from the wrong corner" in text


def test_board_with_rows_in_a_circle(good, tmp_path):
    text = said(tmp_path, renumbered(good[0], "t08", lambda i: (i + 11) % 88))
    # refused by its own residuals, or recognised as the shift that a board allows nearly: both name the image
    assert "epoch 't08', target 'board'" in text
    assert "mis-detected" in text


def test_board_one_column_off(good, tmp_path):
    survey, _ = good
    blocks = []
    for b in survey.image_blocks:
        if b.epoch_id == "t08":  # the last column is missed, and the others are numbered one too high
            keep = b.point_idx % 11 < 10
            b = replace(b, point_idx=b.point_idx[keep] + 1, uv=b.uv[keep], cov=b.cov[keep])
        blocks.append(b)
    text = said(tmp_path, replace(survey, image_blocks=tuple(blocks)))
    assert "epoch t08, target board is mis-detected: its points are numbered one or more rows or columns off" in text
    assert "20.0 mm" in text


MENDED = {
    "axes exchanged": lambda s: with_angles(s, SHARED["axes exchanged"][0]),
    "gon of one axis": lambda s: with_angles(s, SHARED["gon of one axis"][0]),
    "mistyped": lambda s: with_angles(s, mistyped),
    "exchanged": lambda s: with_angles(s, exchanged),
    "wrong corner": lambda s: renumbered(s, "t08", lambda i: 87 - i),
    "wrong corner, and mistyped": lambda s: renumbered(with_angles(s, mistyped), "t08", lambda i: 87 - i),
}


@pytest.mark.parametrize("fault", MENDED)
def test_mistake_is_mended_in_its_table(fault, planted):
    code, warnings, _ = run(planted(fault)[0], "--try", "1")
    assert (code, warnings) == (0, [])


def test_readings_in_no_order_at_all(good, tmp_path):
    text = said(tmp_path, with_angles(good[0], lambda a: a[np.random.default_rng(1).permutation(len(a))]))
    assert "no exchange of the axes, unit or shift by one epoch explains it; compare the epochs of table_angles" in text


def test_without_caliper_the_direction_is_named(tmp_path):
    survey, truth = replica(1)
    survey = noisy(survey, truth, 1)
    bare = replace(survey, distances=(), points=())
    text = said(tmp_path / "no_caliper", bare)
    assert "the frame of station head: where its origin lies along its own z" in text
    assert "measure a caliper or tape distance" in text
    head = survey.stations[0].mount_from_station
    axes_only = PoseParameter(Pose3(), "prior", np.diag([*np.diag(head.prior_cov)[:3], np.inf, np.inf, np.inf]))
    bare = replace(bare, stations=(replace(survey.stations[0], mount_from_station=axes_only),))
    text = said(tmp_path / "no_axis", bare)
    assert "where its origin lies along its own x, y, z" in text
    assert "probable cause" not in text


def test_the_good_lab_raises_none(good, tmp_path):
    survey, truth = good
    for name, lab in (("bare", survey), ("design", with_design(survey, truth))):
        write_project(tmp_path / name, lab)
        assert run(tmp_path / name) == (0, [], "")


def test_noise_alone_is_no_cause(good, tmp_path):
    """Images three times worse than they claim fail the global test, but nothing has been moved or misread."""
    survey, truth = good
    worse = replace(survey, image_blocks=tuple(replace(b, cov=9.0 * b.cov) for b in survey.image_blocks))
    noisy_images = resample(worse, truth, 7)
    claimed = replace(survey, image_blocks=tuple(
        replace(b, uv=n.uv) for b, n in zip(survey.image_blocks, noisy_images.image_blocks, strict=True)
    ))  # fmt: skip
    write_project(tmp_path, claimed)
    code, warnings, _ = run(tmp_path)
    assert code == 3
    assert any("global test failed" in w for w in warnings)
    causes = [w for w in warnings if "probable cause" in w]
    assert all("sigmas" in w for w in causes), causes
