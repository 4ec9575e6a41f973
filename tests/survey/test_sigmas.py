"""Sigmas a priori or a posteriori: one key of the project, and everything that follows it."""

import json
from pathlib import Path

import numpy as np
import pytest

import survey
from adjust.model.errors import SurveyError
from survey.cli import main
from survey.jobs.aligning import align_job
from survey.jobs.navigating.job import NavigateRequest, navigate_job
from survey.project import AdjustmentOptions, read, write_project
from survey.simulate import beacons
from tests.adjust.test_deformation import chain, measured, small
from tests.covariances import written_covariances
from tests.survey.test_working_sheet import definition, write

KINDS = (None, "a_priori", "a_posteriori")


def _project(folder: Path, sigmas, seed=4, poses=None, held=0) -> Path:
    pairs = measured(chain() if poses is None else poses, np.random.default_rng(seed), held=held)
    return write_project(folder, pairs, options=AdjustmentOptions(sigmas=sigmas))


def _solution(folder: Path):
    assert main(["adjust", str(folder), "--quiet"]) in (0, 3)
    return json.loads((folder / "results" / "solution.json").read_text(encoding="utf-8"))


def _json(capsys, *arguments, code=0):
    capsys.readouterr()
    assert main([*map(str, arguments), "--json", "--quiet"]) == code
    return json.loads(capsys.readouterr().out)


def test_the_key_is_kept_and_a_wrong_word_is_named(tmp_path, capsys):
    for sigmas in KINDS:
        _project(tmp_path / str(sigmas), sigmas)
        assert read(tmp_path / str(sigmas)).options.sigmas == sigmas
    path = tmp_path / "a_priori" / "survey.toml"
    path.write_text(path.read_text(encoding="utf-8").replace('"a_priori"', '"apriori"'), encoding="utf-8")
    assert main(["adjust", str(path.parent), "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "sigmas" in said
    assert "did you mean 'a_priori'" in said


def test_levels_of_the_tests_are_those_of_the_project(tmp_path, capsys):
    """Sidak's by alpha, or Baarda's with alpha0 and power; lambda0 17.075 is that of his nomogram (1968)."""
    told, pairs = {}, measured(chain(), np.random.default_rng(4))
    given = {"usual": {}, "strict": {"alpha": 0.01}, "baarda": {"alpha0": 0.001}, "sure": {"power": 0.95}}
    for name, levels in given.items():
        options = AdjustmentOptions(**levels)
        write_project(tmp_path / name, pairs, options=options)
        assert read(tmp_path / name).options == options
        told[name] = _solution(tmp_path / name)["reliability"]
    n = len(json.loads((tmp_path / "usual" / "results" / "solution.json").read_text(encoding="utf-8"))["pairs"])
    levels = {name: told[name]["level_of_one_test"] for name in told}
    assert levels["usual"] == pytest.approx(1.0 - 0.95 ** (1.0 / n))
    assert levels["strict"] == pytest.approx(1.0 - 0.99 ** (1.0 / n))
    assert (told["baarda"]["method"], levels["baarda"]) == ("b", pytest.approx(0.001))
    assert told["baarda"]["noncentrality"] == pytest.approx(17.075, abs=1e-3)
    assert (told["sure"]["power"], levels["sure"]) == (0.95, levels["usual"])
    assert told["sure"]["noncentrality"] > told["usual"]["noncentrality"]
    assert "Baarda" in (tmp_path / "baarda" / "results" / "report.html").read_text(encoding="utf-8")
    path = tmp_path / "baarda" / "survey.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("alpha0 = 0.001", "alpha0 = 1.5"), encoding="utf-8")
    assert main(["adjust", str(path.parent), "--quiet"]) == 1
    assert "alpha0: found 1.5; it is a probability" in capsys.readouterr().err.replace("'", "")


def test_results_and_report_obey(tmp_path):
    found, covs, pages = {}, {}, {}
    for sigmas in KINDS:
        folder = tmp_path / str(sigmas)
        _project(folder, sigmas)
        found[sigmas] = _solution(folder)
        covs[sigmas] = written_covariances(folder / "results" / "covariance.npz")["world_from_station/S3"]
        pages[sigmas] = (folder / "results" / "report.html").read_text(encoding="utf-8")
    sigma0 = found[None]["summary"]["sigma0"]
    assert abs(sigma0 - 1.0) > 0.01  # so that the two kinds differ
    factor = {None: sigma0, "a_posteriori": sigma0, "a_priori": 1.0}
    for sigmas, solution in found.items():
        assert solution["summary"]["sigmas"] == (sigmas or "a_posteriori")
        assert solution["summary"]["sigma_factor"] == pytest.approx(factor[sigmas], rel=1e-12)
        own = solution["stations"]["S3"]["world_from_station"]["sigma_translation_mm"]
        base = found["a_priori"]["stations"]["S3"]["world_from_station"]["sigma_translation_mm"]
        np.testing.assert_allclose(own, factor[sigmas] * np.array(base), rtol=1e-9)
        np.testing.assert_allclose(covs[sigmas], factor[sigmas] ** 2 * covs["a_priori"], rtol=1e-9, atol=1e-18)
        said = "a priori</b>: they follow" if sigmas == "a_priori" else "a posteriori</b>: multiplied by sigma0"
        assert f"Sigmas of unknowns here are <b>{said}" in pages[sigmas]
        # observations and their tests stay a priori
        residuals = (tmp_path / str(sigmas) / "results" / "residuals_other.csv").read_bytes()
        assert residuals == (tmp_path / "None" / "results" / "residuals_other.csv").read_bytes()
    assert "sigmas" not in found[None]["inputs"]["options"]
    assert found["a_priori"]["inputs"]["options"]["sigmas"] == "a_priori"


def test_compare_obeys_and_does_not_mix(tmp_path, capsys):
    moved = chain()
    moved[3] = moved[3] @ small(np.r_[0, 0, np.radians(60 / 3600), 5e-4, 0, 0])
    for sigmas in KINDS:
        _project(tmp_path / f"spring-{sigmas}", sigmas, seed=4)
        _project(tmp_path / f"autumn-{sigmas}", sigmas, seed=5, poses=moved, held=5)
    found = {s: _json(capsys, "compare", tmp_path / f"spring-{s}", tmp_path / f"autumn-{s}") for s in KINDS}
    sigma = {s: np.array([d["sigma_displacement_mm"] for d in f["deformations"]]) for s, f in found.items()}
    np.testing.assert_allclose(sigma["a_priori"], sigma[None], rtol=1e-12)
    ratio = sigma["a_posteriori"] / sigma["a_priori"]
    assert min(found[None]["sigma0"]) <= ratio.min() <= ratio.max() <= max(found[None]["sigma0"])
    assert [found[s]["sigmas"] for s in KINDS] == ["a_priori", "a_priori", "a_posteriori"]
    assert [found[s]["congruence"]["sigma0"] == 1.0 for s in KINDS] == [False, True, False]
    # what only one of them says holds for both; two different words do not
    one = _json(capsys, "compare", tmp_path / "spring-None", tmp_path / "autumn-a_posteriori")
    assert one["sigmas"] == "a_posteriori"
    assert main(["compare", str(tmp_path / "spring-a_priori"), str(tmp_path / "autumn-a_posteriori"), "--quiet"]) == 1
    assert "[adjustment] sigmas differ" in capsys.readouterr().err


@pytest.mark.slow
def test_how_far_things_moved_when_something_is_removed_obeys(tmp_path, capsys):
    most = {}
    for sigmas in KINDS:
        _project(tmp_path / str(sigmas), sigmas)
        sigma0 = _solution(tmp_path / str(sigmas))["summary"]["sigma0"]
        said = _json(capsys, "remove", tmp_path / str(sigmas), "01")
        most[sigmas] = max(m["moved_sigmas"] for m in said["moved"])
    assert most["a_priori"] == pytest.approx(most[None], rel=1e-9)
    assert most["a_posteriori"] == pytest.approx(most[None] / sigma0, rel=1e-9)


@pytest.mark.slow
def test_navigation_obeys(tmp_path):
    lab, _ = beacons(seed=4, n_table_epochs=5, n_free_epochs=4, n_night_epochs=3)
    found = {}
    for sigmas in KINDS:
        write_project(tmp_path / str(sigmas), lab, options=AdjustmentOptions(sigmas=sigmas))
        found[sigmas] = navigate_job(tmp_path / str(sigmas), NavigateRequest(), progress=False)
    usual, prior, posterior = found.values()
    sigma0 = usual.calibration.sigma0
    for a, b, c in zip(usual.trajectory.epochs, prior.trajectory.epochs, posterior.trajectory.epochs, strict=True):
        np.testing.assert_array_equal(a.cov, b.cov)
        np.testing.assert_allclose(c.cov, sigma0**2 * a.cov, rtol=1e-12)
    assert [o.summary()["sigmas"] for o in found.values()] == ["a_priori", "a_priori", "a_posteriori"]
    assert "median sigmas (a posteriori)" in posterior.text()


def test_the_working_sheet_obeys(tmp_path):
    found = {}
    for sigmas in KINDS:
        text = definition() + (f'\n[adjustment]\nsigmas = "{sigmas}"\n' if sigmas else "")
        outcome = align_job(write(tmp_path / str(sigmas), 3, **{"survey.toml": text}), progress=False)
        found[sigmas] = outcome.sheets[0].cov
        sigma0 = outcome.adjustment.sigma0
    np.testing.assert_allclose(found["a_posteriori"], sigma0**2 * found["a_priori"], rtol=1e-9)
    np.testing.assert_allclose(found[None], max(1.0, sigma0) ** 2 * found["a_priori"], rtol=1e-9)


GKF = """<gama-local><network><parameters sigma-apr="10" conf-pr="0.99" sigma-act="{}"/>
<points-observations distance-stdev="5">
<point id="1" x="0" y="0" fix="xy"/><point id="2" x="90" y="0" fix="xy"/><point id="3" x="40" y="30" adj="xy"/>
<point id="-4" x="10" y="30" adj="xy"/><point id="=5" x="10" y="60" adj="xy"/>
<obs><distance from="1" to="3" val="50.02"/><distance from="2" to="3" val="58.31"/>
<distance from="1" to="-4" val="31.6"/>
<distance from="2" to="-4" val="85.44"/><distance from="3" to="-4" val="30.03"/><distance from="1" to="=5" val="60.82"/>
<distance from="2" to="=5" val="100"/><distance from="3" to="=5" val="42.42"/></obs>
</points-observations></network></gama-local>"""


@pytest.mark.slow
@pytest.mark.parametrize(("word", "kind"), [("apriori", "a_priori"), ("aposteriori", "a_posteriori")])
def test_a_network_of_another_program_brings_its_kind_and_takes_it_along(tmp_path, word, kind):
    (tmp_path / "net.gkf").write_text(GKF.format(word), encoding="utf-8")
    assert main(["convert", str(tmp_path / "net.gkf"), str(tmp_path / "net")]) == 0
    assert read(tmp_path / "net").options.sigmas == kind
    assert _solution(tmp_path / "net")["summary"]["sigmas"] == kind
    assert main(["convert", str(tmp_path / "net"), str(tmp_path / "back.gkf")]) == 0
    back = (tmp_path / "back.gkf").read_text(encoding="utf-8")
    assert f'conf-pr="0.99" tol-abs="1000000000" sigma-act="{word}"' in back
    assert main(["convert", str(tmp_path / "net"), str(tmp_path / "net.snx")]) == 0
    factor = _solution(tmp_path / "net")["summary"]["sigma_factor"]
    said = (tmp_path / "net.snx").read_text(encoding="utf-8").split("covariances are a priori times ")[1]
    assert float(said.split()[0]) == pytest.approx(factor**2, rel=1e-9)


def test_points_named_like_formulas_are_renamed_on_the_way_in(tmp_path, capsys):
    (tmp_path / "net.gkf").write_text(GKF.format("apriori"), encoding="utf-8")
    assert main(["convert", str(tmp_path / "net.gkf"), str(tmp_path / "net")]) == 0
    assert "-4 -> _4, =5 -> _5" in capsys.readouterr().out
    _solution(tmp_path / "net")
    for path in tmp_path.rglob("*.csv"):
        cells = [cell for line in path.read_text(encoding="utf-8").splitlines() for cell in line.split(",")]
        texts = [cell for cell in cells if not cell.replace("-", "").replace(".", "").replace("e", "").isdigit()]
        assert not [cell for cell in texts if cell.startswith(("=", "+", "-", "@"))], path


def test_a_wrong_word_in_python_is_no_kind(tmp_path):
    _project(tmp_path / "lab", None)
    with pytest.raises(SurveyError, match="there are no sigmas 'apriori'; write a_priori or a_posteriori"):
        survey.adjust(survey.problem(tmp_path / "lab").with_options(sigmas="apriori")).scale  # noqa: B018  # asked for, it raises
