"""Networks of other programs at their published results. A dense NumPy adjustment decides who is wrong."""

import json
from pathlib import Path

import numpy as np
import pytest

from survey.cli import main
from tests.acceptance.networks import (
    DEFAULTS,
    GAMA,
    KRUMM,
    LARGE,
    LGC_SIGMA0,
    RAILWAY,
    SYNTHETIC,
    compare_krumm,
    compare_large,
    compare_lgc,
    compare_railway,
    core_points,
    core_rows,
    core_sigmas,
    gama_case,
    gama_statistics,
    printed_statistics,
    unit_of,
)
from tests.data import data_folder

pytestmark = pytest.mark.usefixtures("undiagnosed_module")
PRINTED = np.array([5e-4, 5e-4, 5e-4])  # half digits of qrr, f and the standardized residual


@pytest.fixture(scope="module", params=[*GAMA, *SYNTHETIC])
def case(request):
    folder = "synthetic" if request.param in SYNTHETIC else "gama"
    return gama_case(data_folder("network", folder), request.param)


def test_gama_counts_and_unit_weight(case):
    published, result = case.published, case.result
    assert (result.redundancy, result.datum_defect) == (published.redundancy, published.defect)
    # Gama's own step, repeated: to the seven digits that it prints
    assert case.one.sigma0 * published.apriori == pytest.approx(published.aposteriori, rel=1e-6)
    assert result.sigma0 == pytest.approx(case.converged.sigma0, rel=1e-9)


def test_gama_coordinates(case):
    """To 1e-6 m, and what Gama's one linearisation leaves undone."""
    published = np.array(list(case.published.adjusted.values()))
    left = case.coordinates(case.one.points) - case.coordinates(case.converged.points)
    ours = case.coordinates(core_points(case.result))
    assert (np.abs(ours - published) <= 1e-6 + np.abs(left)).all()
    # the start is printed to 1e-6 m, and in a free network it is the datum
    np.testing.assert_allclose(case.coordinates(case.one.points), published, rtol=0, atol=2e-7)
    np.testing.assert_allclose(ours, case.coordinates(case.converged.points), rtol=0, atol=6e-7)


def test_gama_sigmas(case):
    """Deviations to the digits of Gama's covariance, and what its one linearisation changes."""
    published = case.published_sigmas()
    one = case.sigmas(case.one.sigmas, case.one.sigma0)
    converged = case.sigmas(case.converged.sigmas, case.converged.sigma0)
    ours = case.coordinates(core_sigmas(case.result))
    np.testing.assert_allclose(one, published, rtol=2e-6)
    assert (np.abs(ours / published - 1.0) <= 2e-6 + np.abs(converged / one - 1.0)).all()
    np.testing.assert_allclose(ours, converged, rtol=2e-6)


def test_gama_covariance_is_that_of_the_dense_adjustment(case):
    names = case.published.names
    setups = iter(case.one.orientations)
    n_points = len(case.one.columns)
    turned = {setup: n_points + k for k, setup in enumerate(case.one.orientations)}
    columns = [case.one.columns[p, "xyz".index(a)] if a in "xyz" else turned[next(setups)] for p, a in names]
    cov = case.scale(case.one.sigma0) ** 2 * case.one.cov[np.ix_(columns, columns)]
    sigma = np.sqrt(np.diag(cov))
    difference = (cov - case.published.cov) / np.outer(sigma, sigma)
    assert np.nanmax(np.abs(difference)) < 5e-6
    assert np.isfinite(case.published.cov).all()


def test_gama_statistics_of_every_observation(case):
    survey, rows = case.network.survey, core_rows(case.network.survey, case.result)
    assert (
        len(rows.sigma)
        == len(case.published.rows)
        == len(survey.readings) + 3 * sum(len(d.to) for d in survey.coordinate_differences)
    )
    printed = printed_statistics(case)
    one = gama_statistics(case, case.one.sigma, case.one.residuals, case.one.decorrelated, case.one.sigma0)
    converged = gama_statistics(
        case, case.converged.sigma, case.converged.residuals, case.converged.residual_cov, case.converged.sigma0
    )
    ours = gama_statistics(case, rows.sigma, rows.residual, rows.residual_var, case.result.sigma0)
    checked = printed[:, 1] > 0.1  # what nothing controls has no standardized residual
    compare = np.column_stack([np.isfinite(rows.residual_var), np.isfinite(rows.residual_var), checked])
    # Gama prints its start to 1e-6 m only, and the shortest sight is 0.6 m
    digits = 1.2 * PRINTED + 5e-6 * np.abs(np.nan_to_num(printed))
    assert (np.abs(one - printed) <= digits)[compare].all()
    undone = np.abs(converged - one)
    assert (np.abs(ours - printed) <= digits + 1.01 * undone)[compare].all()
    np.testing.assert_allclose(ours[compare], converged[compare], rtol=1e-4, atol=1e-4)


def test_gama_adjusted_observations(case):
    printed, one = np.array([r.sigma for r in case.published.rows]), case.one
    ours = case.scale(one.sigma0) * np.sqrt(np.clip(one.sigma**2 - one.decorrelated, 0.0, None))
    np.testing.assert_allclose(ours / unit_of(case), printed / unit_of(case), rtol=2e-6, atol=2e-3)


def test_gama_contradicts_itself_where_baselines_are_correlated():
    """The deviation of an adjusted dy from a fixed point is that of the other point's y, and Gama prints another."""
    case = gama_case(data_folder("network", "gama"), "tst-tetrahedron-3-gon")
    k = next(i for i, r in enumerate(case.published.rows) if (r.kind, r.ends) == ("dy", ("1", "4")))
    y = case.published_sigmas()[list(case.published.adjusted).index(("4", "y"))]
    assert case.published.rows[k].sigma == pytest.approx(19.959e-3, abs=1e-6)
    assert y == pytest.approx(19.6857e-3, abs=1e-6)
    rows = core_rows(case.network.survey, case.result)
    adjusted = np.sqrt(rows.sigma[k] ** 2 - rows.residual_var[k])
    assert case.result.sigma0 * adjusted == pytest.approx(y, rel=1e-5)


@pytest.mark.parametrize("name", LARGE)
def test_a_thousand_points_at_gamas_coordinates_and_variances(name):
    found = compare_large(data_folder("network", "synthetic"), name)
    assert found.sigma0 == pytest.approx(found.published_sigma0, rel=1e-6)
    assert found.differences["coordinate_m"] < 1e-6
    # Gama's variances belong to its start values, ours to the solution
    assert found.differences["sigma_gap"] < 2e-6
    assert found.differences["sigma_dense"] < 1e-6
    assert found.differences["sigma_relative"] < 1e-4


@pytest.mark.parametrize("name", KRUMM)
def test_krumms_networks_to_printed_digits(name):
    """Coordinates, corrections and deviations, every one within half a unit of its last digit."""
    found = compare_krumm(data_folder("network", "krumm"), name)
    if name == "3D/BlankenbachWillert3D_Distance_fix":
        # two gross errors: Gauss-Newton only halves the rest each step, and what was published had stopped at 1e-6 m
        assert max(v for k, v in found.differences.items() if k.endswith("_gap")) <= 1.0
        assert found.differences["sigma"] <= 1.1
    else:
        assert max(found.differences.values()) <= 1.0


def test_lgc_at_cerns_result():
    found = compare_lgc(data_folder("network", "lgc"))
    assert found.sigma0 == pytest.approx(LGC_SIGMA0, abs=5e-7)
    assert found.differences["points"] == 47
    assert found.differences["coordinate_m"] <= 5.01e-7
    assert found.differences["sigma_m"] <= 5.01e-7
    result = found.result
    assert (result.n_observations, result.n_unknowns) == (258, 149)


def test_the_railway_is_at_the_minimum_in_its_own_datum():
    """833 points in 163 direction sets; no result is published."""
    found = compare_railway(data_folder("network", "gama"))
    assert found.result.datum_defect == 3
    assert found.differences["gradient"] < 1e-3
    assert found.differences["datum_m"] < 1e-6


@pytest.mark.parametrize(
    ("source", "sigma0", "r"),
    [
        ("gama/zoltan-test_2d_gon.gkf", 75.488517 / 10, 117),  # a network of Gama without start values, and 7.5 sigmas
        ("gama/tst-tetrahedron-3-gon.gkf", 51.791759 / 10, 37),  # correlated baselines, a datum in z alone
        ("lgc/MathisLGC_V1_20150709-141437.lgc", LGC_SIGMA0, 109),
        ("krumm/1D/Niemeier_Height_free.dat", 3.3941763, 4),  # 0.0033941763 m over an a priori of 1 mm for 1 km
    ],
)
def test_through_convert_and_adjust(tmp_path, source, sigma0, r):
    """The folder gives what the program gave: nothing is lost on the way, and nothing rejected."""
    folder, _, name = source.rpartition("/")
    assert main(["convert", str(data_folder("network", *folder.split("/")) / name), str(tmp_path / "lab")]) == 0
    assert main(["adjust", str(tmp_path / "lab"), "--quiet"]) == 3
    summary = json.loads((tmp_path / "lab" / "results" / "solution.json").read_text())["summary"]
    assert summary["redundancy"] == r
    assert summary["sigma0"] == pytest.approx(sigma0, rel=1e-6)


def test_the_page_lists_every_network():
    page = (Path(__file__).parents[2] / "docs" / "networks.md").read_text(encoding="utf-8")
    for name in (*GAMA, *DEFAULTS, *SYNTHETIC, *LARGE, *KRUMM, RAILWAY, "HIE-ISOLDE"):
        assert f"| {name} |" in page, name
    assert "no start value" not in page
