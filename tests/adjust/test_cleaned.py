"""The whole adjustment: gross errors of all kinds out, variances estimated, both told."""

from dataclasses import replace

import numpy as np

from adjust.statistics.cleaned import CleanOptions, adjust_cleaned
from tests.adjust import statistics_networks as net


def test_gross_errors_and_variances_together() -> None:
    """Directions twice as good, distances three times as bad as they say, and two readings far off."""
    survey, start = net.hall(9, n_points=20, n_stations=4, n_tapes=20, factors={"direction": 0.25, "slope_distance": 9.0})
    wrong = survey
    for i in (10, 101):
        r = wrong.readings[i]
        wrong = net.with_reading(wrong, i, value=r.value + 60.0 * r.sigma)
    names = {wrong.readings[i].reading_id for i in (10, 101)}
    found = adjust_cleaned(wrong, CleanOptions(variance_components=True), start=start)
    out = {r.reading_id for r in found.survey.readings if not r.used}
    assert out == names
    assert sum(w.startswith("left out: ") for w in found.warnings) == 2
    assert {d.ids[0] for d in found.decisions if d.action == "rejected"} >= names
    for group, factor in (("direction", 0.25), ("slope_distance", 9.0), ("zenith", 1.0)):
        c = next(c for c in found.variance_components.components if c.group == group)
        assert abs(c.factor - factor) < 3.0 * c.sigma
    assert any("variance component of group slope_distance: sigmas were 3" in w for w in found.warnings)
    assert abs(found.sigma0 - 1.0) < 1e-3
    kept = adjust_cleaned(wrong, CleanOptions(reject_others=False), start=start)
    assert all(r.used for r in kept.survey.readings)
    assert kept.decisions == ()
    assert kept.variance_components is None


def test_nothing_to_do_changes_nothing() -> None:
    survey, start = net.hall(1)
    found = adjust_cleaned(survey, CleanOptions(), start=start)
    assert found.survey.readings == survey.readings
    assert not any(w.startswith("left out") for w in found.warnings)
    again = adjust_cleaned(replace(survey), CleanOptions(), start=start)
    np.testing.assert_array_equal(again.omega, found.omega)
