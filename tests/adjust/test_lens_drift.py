"""Lenses that change: derivatives, the whole precision against one dense matrix, and refusals."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.graph.assembly import AdjustmentGraph
from adjust.model.errors import SurveyError
from adjust.model.survey import LensDrift, Survey
from survey.simulate import Truth, beacons, resample, stereo
from tests.adjust import helpers as h

PARAMETERS = ("v0", "fx")  # not in the order of the lens, and not beside each other


def drifting(survey: Survey, truth: Truth, drift: LensDrift) -> tuple[Survey, Truth]:
    """The second camera's lens changes."""
    camera = survey.cameras[1]
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks))
    survey = replace(survey, temperatures={e: 18.0 + 0.7 * i for i, e in enumerate(epochs)},
                     cameras=tuple(replace(c, lens=replace(c.lens, drift=drift)) if c is camera else c
                                   for c in survey.cameras))  # fmt: skip
    changes = {("lens_drift", camera.camera_id, e): np.array([1.5 - i, 2.0 + i]) for i, e in enumerate(drift.begins)}
    truth = truth | changes | {("lens_drift", camera.camera_id): np.array([0.4, -0.3])}
    return resample(survey, truth, 3), truth


def begins(survey: Survey, n: int) -> tuple[str, ...]:
    mine = dict.fromkeys(b.epoch_id for b in survey.image_blocks if b.camera_id == survey.cameras[1].camera_id)
    every = list(mine)
    return tuple(every[(i + 1) * len(every) // (n + 1)] for i in range(n))


def kinds(survey: Survey) -> dict[str, LensDrift]:
    starts = begins(survey, 2)
    return {
        "blocks": LensDrift(PARAMETERS, starts),
        "walk": LensDrift(PARAMETERS, starts, np.array([0.5, 2.0])),
        "temperature": LensDrift(PARAMETERS, (), None, 20.0),
    }


def check_gradient(graph: AdjustmentGraph, values: gtsam.Values) -> None:
    """Of the whole objective by every unknown of a lens, against differences."""
    linear = graph.linearized(graph.prepare(values, jacobians=True, reduced=False))
    gradient = linear.gradientAtZero()
    for name, unknown in graph.unknowns.by_name.items():
        if name[0] not in ("lens", "lens_drift", "lens_crop"):
            continue
        steps = 0.1 * h.steps_of(unknown, values)
        numeric = h.differences(lambda v: np.array([0.5 * graph.omega(v)]), values, unknown.key, steps)[0]
        np.testing.assert_allclose(gradient.at(unknown.key), numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["blocks", "walk", "temperature"])
@pytest.mark.parametrize("lab", ["boards", "beacons"])
def test_derivatives_by_the_changes(kind: str, lab: str) -> None:
    """Of boards, whose poses are reduced, and of unknown points."""
    base = stereo(4, n_pairs=10) if lab == "boards" else beacons(4, n_table_epochs=2, n_free_epochs=2, n_night_epochs=6)
    survey, truth = drifting(*base, kinds(base[0])[kind])
    start = h.start_at(truth)
    graph = h.build(survey, start)
    assert any(name[0] == "lens_drift" for name in graph.unknowns.by_name)
    assert bool(graph.bundles) == (lab == "beacons")
    values = gtsam.Values(graph.start)
    for name, unknown in graph.unknowns.by_name.items():
        if name[0] == "lens_drift":
            values.update(unknown.key, np.array([0.7, -0.4]))
    check_gradient(graph, values)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["blocks", "walk", "temperature"])
def test_changes_are_found_within_their_sigmas(kind: str) -> None:
    base = stereo(4, n_pairs=15)
    survey, truth = drifting(*base, kinds(base[0])[kind])
    if kind == "walk":
        truth = {n: v for n, v in truth.items() if n[0] != "lens_drift"}
        truth |= {("lens_drift", "right", e): np.array([0.3 * (i + 1), 1.0]) for i, e in enumerate(begins(base[0], 2))}
        survey = resample(survey, truth, 5)
    result = adjust(survey)
    assert result.global_test is not None
    assert result.global_test.passed
    found = [(n, e) for n, e in result.estimates.items() if n[0] == "lens_drift"]
    assert len(found) == (1 if kind == "temperature" else 2)
    for name, estimate in found:
        d = np.asarray(estimate.value) - np.asarray(truth[name])
        assert float(d @ np.linalg.solve(estimate.cov, d)) < 18.4  # chi-square with 2 degrees of freedom, 1e-4
        assert estimate.units == (("px/K",) * 2 if kind == "temperature" else ("px",) * 2)


def test_reduced_poses_see_the_changes() -> None:
    """The same minimum with the poses of the board reduced and without."""
    base = stereo(4, n_pairs=12)
    survey, truth = drifting(*base, kinds(base[0])["blocks"])
    graph = h.build(survey, h.start_at(truth))
    assert graph.reduction is not None
    reduced, plain = (h.solve(g, h.SolveOptions(max_step=1e-10)) for g in (graph, replace(graph, reduction=None)))
    assert reduced.omega == pytest.approx(plain.omega, rel=1e-10)


def test_what_cannot_change_is_refused() -> None:
    base = stereo(4, n_pairs=9)
    for drift, said in (
        (LensDrift(("k3",), begins(base[0], 1)), "'right': k3 is to change, but is not free"),
        (LensDrift(("fx",), ("never",)), "'right': its lens is to change at epoch 'never'"),
    ):
        with pytest.raises(SurveyError, match=said):
            _adjusted(base[0], drift)
    with pytest.raises(SurveyError, match="'right' changes with temperature, but epoch"):
        _adjusted(base[0], LensDrift(("fx",), (), None, 20.0))


def _adjusted(survey: Survey, drift: LensDrift) -> None:
    camera = survey.cameras[1]
    adjust(replace(survey, cameras=(survey.cameras[0], replace(camera, lens=replace(camera.lens, drift=drift)))))
