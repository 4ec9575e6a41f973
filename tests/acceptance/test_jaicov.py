"""115 images with self-calibration: AICON's files through convert and adjust, at JAiCov's published result."""

import json
import re

import numpy as np
import pytest

from survey.cli import main
from tests.covariances import written_covariances
from tests.data import data_folder

# 0.657275451718 times the a priori variance of (0.5 micrometre)^2
S0_MM = 4.0536263e-4
A_PRIORI_MM = 5e-4
OMEGA, REDUNDANCY = 12359.40759, 18804


@pytest.fixture(scope="module")
def source():
    return data_folder("network", "jaicov")


@pytest.fixture(scope="module")
def published(source):
    """By point x y z and their deviations (mm), and whether it defines the datum."""
    rows = {}
    for line in (source / "jaicov_result.txt").read_text().splitlines():
        words = line.split()
        if len(words) == 8 and words[-1] in ("o", "d"):
            rows[words[0]] = (np.array(words[1:7], dtype=float), words[-1] == "d")
    return rows


@pytest.fixture(scope="module")
def adjusted(source, published, tmp_path_factory):
    """The report's image coordinates, which JAiCov read; the datum over its 66 points is one line of survey.toml."""
    folder = tmp_path_factory.mktemp("jaicov") / "car"
    assert main(["convert", str(source / "example.htm"), str(folder)]) == 0
    definition = folder / "survey.toml"
    datum = [name for name, (_, chosen) in published.items() if chosen]
    assert len(datum) == 66
    text = definition.read_text()
    assert text.count('kind = "inner"') == 1
    definition.write_text(text.replace('kind = "inner"', f'kind = "inner"\npoints = {json.dumps(datum)}'))
    # as a whole its sigmas are cautious (factor 0.66), but image 84 does not fit, and the lens did not stay the same
    assert main(["adjust", str(folder), "--quiet"]) == 3
    solution = json.loads((folder / "results" / "solution.json").read_text())
    assert solution["summary"]["global_test"]["status"] == "cautious"
    assert not solution["consistency"]["parts"]["epoch"]["84"]["fits"]
    assert {x["name"] for x in solution["consistency"]["changes"]} == {"camera1"}
    return folder


def test_unit_weight_and_counts(adjusted):
    summary = json.loads((adjusted / "results" / "solution.json").read_text())["summary"]
    assert (summary["n_observations"], summary["n_unknowns"], summary["redundancy"]) == (19945, 1147, REDUNDANCY)
    assert summary["datum_defect"] == 6
    assert summary["omega"] == pytest.approx(OMEGA, abs=5e-5)
    assert summary["sigma0"] * A_PRIORI_MM == pytest.approx(S0_MM, abs=5e-12)


def test_points_and_their_deviations_to_the_last_printed_digit(adjusted, published):
    """Coordinates and deviations are printed to 1e-5 mm, far below the 1e-4 mm asked for."""
    solution = json.loads((adjusted / "results" / "solution.json").read_text())
    assert len(published) == 150
    for name, (row, _) in published.items():
        point = solution["points"][name]
        ours = [point[f"{a}_mm"] for a in "xyz"] + [point[f"sigma_{a}_mm"] for a in "xyz"]
        np.testing.assert_allclose(ours, row, rtol=0, atol=5.1e-6, err_msg=name)


def test_lens_and_its_deviations(adjusted, source):
    """JAiCov's values to the ten decimals that it prints; AICON's deviations, whose datum a lens does not see.

    AICON stopped at a norm of 1e-6 ("norm" in its report), which leaves its deviations to 1e-5 of themselves.
    """
    lens = json.loads((adjusted / "results" / "solution.json").read_text())["cameras"]["camera1"]["lens"]
    text = (source / "jaicov_result.txt").read_text()
    names = {"PRINCIPAL_POINT_X": "xh", "PRINCIPAL_POINT_Y": "yh", "PRINCIPAL_DISTANCE": "ck",
             "TANGENTIAL_DISTORTION_Bx": "B1", "TANGENTIAL_DISTORTION_By": "B2", "RADIAL_POLYNOMIAL_A(1)": "A1",
             "RADIAL_POLYNOMIAL_A(2)": "A2"}  # fmt: skip
    values = _flat(lens)
    for title, name in names.items():
        printed = float(re.search(rf"{re.escape(title)}\s*=\s*(\S+)", text)[1])
        assert values[name] == pytest.approx(printed, abs=5.1e-11), title
    cov = written_covariances(adjusted / "results" / "covariance.npz")["lens/camera1"]
    sigma = np.sqrt(np.diag(cov))
    report = (source / "example.htm").read_text(encoding="utf-8")
    for k, name in enumerate(("Ck", "Xh", "Yh", "A1", "A2", "A3", "B1", "B2")):
        printed = re.search(rf"^ {name} +: +\S+ +(\S+)$", report, re.MULTILINE)[1]
        if printed != "fest":
            assert sigma[k] == pytest.approx(float(printed), rel=1e-5), name
    assert (sigma[[5, 8, 9]] == 0.0).all()


def _flat(lens):
    """Values of a lens by parameter, without their unit."""
    out = {}
    for key, value in lens.items():
        name = key.split("_")[0]
        if isinstance(value, float | int) and not key.startswith("sigma") and name not in out:
            out[name] = value
    return out


def test_image_coordinates_with_all_their_digits_change_it_little(source, adjusted, published, tmp_path):
    """The .phc has 12 decimals, the report 6: the points move by less than a hundredth of a micrometre."""
    from dataclasses import replace

    from adjust.adjustment import AdjustOptions, adjust
    from adjust.model.survey import Datum
    from survey.interop.photogrammetry.aicon import read_aicon

    survey = read_aicon(source / "example.phc").survey
    datum = tuple(name for name, (_, chosen) in published.items() if chosen)
    result = adjust(replace(survey, datum=Datum("inner", datum)), options=AdjustOptions(reject_blocks=False))
    assert result.sigma0 * A_PRIORI_MM == pytest.approx(S0_MM, abs=5e-9)
    for name, (row, _) in published.items():
        np.testing.assert_allclose(1e3 * result.estimates["point", name].value, row[:3], rtol=0, atol=2e-5)
