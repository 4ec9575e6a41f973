"""Nominal error rates and power of the tests, planted errors, and a real pair of epochs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from adjust.adjustment import adjust
from adjust.epochs.congruence import CongruenceOptions, congruence
from adjust.model.result import Adjustment
from adjust.model.survey import Datum
from adjust.statistics.reliability import reliability
from survey.cli import main
from survey.interop.networks.gama import read_gama
from survey.project import write_project
from tests.adjust import statistics_networks as net
from tests.data import data_folder
from tests.sizes import size


def test_w_and_tau_at_their_nominal_rates_over_10000_observations() -> None:
    """5 % and 0.1 %, a priori and a posteriori. Tests of one network are correlated: the bounds are generous."""
    p_w, p_tau = [], []
    for seed in range(16):
        survey, start = net.hall(seed, n_points=40, n_stations=5)
        tests = reliability(adjust(survey, start), most_influences=0).tests
        p_w.append(tests.p_w)
        p_tau.append(tests.p_tau)
    for p in (np.concatenate(p_w), np.concatenate(p_tau)):
        p = p[np.isfinite(p)]
        assert len(p) > 10_000
        for level in (0.05, 0.001):
            low, high = binom.ppf([1e-4, 1.0 - 1e-4], len(p), level)
            assert low <= np.sum(p < level) <= high


def test_the_detectable_bias_is_found_with_its_power() -> None:
    """One reading off by its minimal detectable bias: its own test fails in 80 % of the samples."""
    clean, start = net.hall(1, noise=False)
    tests = reliability(adjust(clean, start), most_influences=0)
    first = len(tests.tests.used) - len(clean.readings)
    critical = tests.criteria.critical[0]
    rng, found, n = np.random.default_rng(3), 0, size(100, 30)
    for sample in range(n):
        noisy, _ = net.hall(1, factors=None, noise=True, sample=sample)
        i = int(rng.integers(len(noisy.readings)))
        bias = tests.tests.detectable_component[tests.tests.ptr[first + i]] * rng.choice([-1.0, 1.0])
        wrong = net.with_reading(noisy, i, value=noisy.readings[i].value + bias)
        residuals = adjust(wrong, start).reading_residuals
        assert residuals is not None
        found += bool(residuals.test[i] > critical)
    low, high = binom.ppf([1e-3, 1.0 - 1e-3], n, 0.8)
    assert low <= found <= high


def barta(phase: int) -> Adjustment:
    """A phase of the tunnel measurements by Barta, as a free network."""
    path = data_folder("network", "gama") / f"2020-barta-phase_{phase}-1TK.gkf"
    survey = read_gama(path).survey
    points = tuple(replace(p, x_in_world=replace(p.x_in_world, treatment="free")) for p in survey.points)
    return adjust(replace(survey, points=points, datum=Datum("inner")))


def test_a_real_pair_of_epochs() -> None:
    """Metro tunnel, two epochs: both tripods stood elsewhere; of the marks on the walls none moved by 1 mm and more.

    The eight marks that the second epoch was fixed on by its surveyor are congruent.
    """
    first, second = barta(0), barta(1)
    marks = ["201", "202", "203", "204", "211", "212", "213", "214"]
    found = congruence(first, second, CongruenceOptions(reference=tuple(("point", p) for p in marks)))
    assert found.before.passed
    assert found.datum == ("tx", "ty", "tz", "rz")
    assert {n[1] for n in found.moved} == {"4901", "4902"}
    free = congruence(first, second)
    assert {n[1] for n in free.moved} >= {"4901", "4902"}
    assert {s.name[1] for s in free.steps[:2]} == {"4901", "4902"}
    assert {n[1] for n in free.stable} >= set(marks)


def test_compare_command_on_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two project folders of a hall; one point moved by 4 mm."""
    x = net.coordinates(1, 12, 3)
    for name, sample, shift in (("spring", 1, 0.0), ("autumn", 2, 0.004)):
        places = {n: v + (np.array([shift, 0.0, 0.0]) if n == "P3" else 0.0) for n, v in x.items()}
        survey, _ = net.hall(1, places=places, sample=sample, n_tapes=0)
        write_project(tmp_path / name, survey)
    arguments = ["compare", str(tmp_path / "spring"), str(tmp_path / "autumn"), "--quiet"]
    assert main([*arguments, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["congruence"]
    assert found["moved_names"] == ["point/P3"]
    motion = next(m for m in found["motions"] if m["name"] == "point/P3")
    assert abs(motion["displacement_mm"][0] - 4.0) < 4.0 * motion["sigma_displacement_mm"][0]
    assert not found["all"]["passed"]
    assert found["stable"]["passed"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "1 of 14 moved" in text
    assert [line.split()[0] for line in text.splitlines() if line.endswith(" *")] == ["P3"]
