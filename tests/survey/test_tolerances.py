"""Demands on results: read from survey.toml, judged with the expanded uncertainty."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm, t

from adjust.model.errors import SurveyError
from survey.project import read, write_project
from survey.project.project import AdjustmentOptions, Tolerance
from survey.solution.quantities import scale_of
from survey.solution.tolerances import coverage, verdicts
from tests.survey.adjustments import Lab, lab_adjustment

TOML = """format = 1
[stations.s]
[tolerances.beacons]
of = "points"
ids = ["B1", "B2"]
expanded_mm = 0.5
[tolerances.heading]
of = "stations"
expanded_arcsec = 30
[tolerances.square]
of = "table_geometry"
component = "non_orthogonality"
nominal_arcsec = 0
tolerance_arcsec = 60
"""


@pytest.fixture(scope="module")
def adjustment():
    return lab_adjustment(Lab())


def test_tolerances_are_read_in_si_and_written_again(tmp_path: Path) -> None:
    (tmp_path / "survey.toml").write_text(TOML)
    found = read(tmp_path)
    beacons, heading, square = found.options.tolerances
    assert beacons == Tolerance("beacons", "points", ("B1", "B2"), "position", 0.0005)
    assert heading.expanded == pytest.approx(np.radians(30 / 3600))
    assert (square.nominal, square.within) == (0.0, pytest.approx(np.radians(60 / 3600)))
    write_project(tmp_path / "again", found.survey, options=found.options)
    assert read(tmp_path / "again").options.tolerances == found.options.tolerances


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("expanded_mm = 0.5", "expanded_cm = 0.5"), r"survey.toml:6: tolerances.beacons.expanded_cm: unknown key"),
        (('of = "points"', 'of = "point"'), r"survey.toml:4: tolerances.beacons.of: found 'point'"),
        (("expanded_mm = 0.5", ""), "nothing is demanded"),
        (("expanded_mm = 0.5", "expanded_mm = -1"), "must be positive"),
        (("tolerance_arcsec = 60", ""), "nothing is demanded"),
        (("expanded_mm = 0.5", "expanded_mm = 0.5\nexpanded_deg = 1"), "make two tolerances"),
        (("expanded_mm = 0.5", "nominal_mm = 0.5\nexpanded_mm = 1"), "name it with 'component'"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, change: tuple[str, str], words: str) -> None:
    (tmp_path / "survey.toml").write_text(TOML.replace(*change))
    with pytest.raises(SurveyError, match=words):
        read(tmp_path)


def test_uncertainty_is_judged_in_its_worst_direction(adjustment) -> None:
    scale = scale_of(adjustment, "a_posteriori")
    k = float(t.ppf(0.975, adjustment.redundancy))
    assert coverage(adjustment, scale) == pytest.approx(k)
    assert coverage(adjustment, scale_of(adjustment, "a_priori")) == pytest.approx(norm.ppf(0.975))
    cov = adjustment.estimates["point", "B1"].cov
    worst = k * adjustment.sigma0 * np.sqrt(np.linalg.eigvalsh(cov)[-1])
    assert worst > k * adjustment.sigma0 * np.sqrt(np.diag(cov).max())
    loose, tight = (Tolerance("x", "points", ("B1",), "position", worst * f) for f in (1.001, 0.999))
    assert [v.met for v in verdicts(adjustment, (loose, tight), scale)] == [True, False]
    every = verdicts(adjustment, (Tolerance("x", "points", (), "position", 1.0),), scale)
    assert len(every) == sum(name[0] == "point" for name in adjustment.estimates)


def test_a_value_must_be_proven_to_lie_within(adjustment) -> None:
    scale = scale_of(adjustment, "a_posteriori")
    lens = adjustment.estimates["lens", "X"]
    i = lens.components.index("fx")
    fx, u = float(lens.value[i]), coverage(adjustment, scale) * adjustment.sigma0 * np.sqrt(lens.cov[i, i])
    for nominal, within, met in ((fx + 1.0, 1.0 + 1.01 * u, True), (fx + 1.0, 1.0 + 0.99 * u, False)):
        (found,) = verdicts(adjustment, (Tolerance("f", "lenses", ("X",), "fx", None, nominal, within),), scale)
        assert (found.met, found.of_value, found.unit) == (met, True, "px")


def test_a_demand_about_nothing_is_an_error(adjustment) -> None:
    scale = scale_of(adjustment, "a_posteriori")
    demand = Tolerance("x", "points", ("B99",), "position", 1.0)
    for wrong, words in ((demand, "no result for B99"), (replace(demand, ids=(), quantity="fx"), "none of the points")):
        with pytest.raises(SurveyError, match=words):
            verdicts(adjustment, (wrong,), scale)
    assert AdjustmentOptions().tolerances == ()
