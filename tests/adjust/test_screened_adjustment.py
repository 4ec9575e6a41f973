"""Cleaning as a whole: which of several explanations of a contradiction is taken."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import AdjustOptions
from adjust.statistics.screened_adjustment import CleanOptions, adjust_cleaned
from survey.simulate import beacons
from tests.adjust import helpers as h
from tests.adjust import statistics_networks as net


@pytest.mark.slow
def test_a_wrong_tape_is_not_blamed_on_the_few_rays_to_its_beacon() -> None:
    """Two images see the beacon: leaving both rays out explains a wrong distance too, but needs twice as many."""
    survey, truth = beacons(2, n_table_epochs=4, n_free_epochs=3, n_night_epochs=5)
    names = [p.point_id for p in survey.points]
    distance = survey.distances[0]
    beacon = names.index(str(distance.a.point_id))
    blocks, seen = [], 0
    for block in survey.image_blocks:
        keep = np.ones(len(block.uv), dtype=bool)
        if block.target_id is None:
            mine = block.point_idx == beacon
            seen += int(mine.any())
            keep = ~mine if seen > 2 else keep
        blocks.append(replace(block, point_idx=block.point_idx[keep], uv=block.uv[keep], cov=block.cov[keep]))
    coordinates = tuple(c for c in survey.coordinates if all(r.point_id != names[beacon] for r in c.positions))
    wrong = replace(distance, value=distance.value + 60.0 * distance.sigma)
    survey = replace(survey, image_blocks=tuple(b for b in blocks if len(b.uv)), coordinates=coordinates,
                     distances=(wrong, *survey.distances[1:]))  # fmt: skip
    options = CleanOptions(adjust=AdjustOptions(reject_points=True))
    start = h.shaken(h.start_at(truth), 1, 0.0005, 0.0005)
    found = adjust_cleaned(survey, options, start=start)
    assert [d.ids[0] for d in found.decisions if d.action == "rejected"] == [wrong.distance_id]
    assert found.image_residuals.used.all()


def test_a_search_that_is_left_out_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    survey, start = net.hall(8)
    wrong = net.with_reading(survey, 4, value=survey.readings[4].value + 100.0 * survey.readings[4].sigma)
    monkeypatch.setattr("adjust.statistics.screened_adjustment._LARGEST", 10)
    assert not [w for w in adjust_cleaned(wrong, start=start).warnings if "not searched for" in w]
    monkeypatch.setattr("adjust.statistics.screened_adjustment._ROOM", 10.0)
    found = adjust_cleaned(wrong, start=start, options=CleanOptions())
    assert [w for w in found.warnings if "gross errors were not searched for" in w]
    assert not [w for w in adjust_cleaned(survey, CleanOptions(), start=start).warnings if "not searched" in w]
