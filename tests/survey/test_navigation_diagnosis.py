"""Epochs to navigate that do not fit their calibration: planted causes are named, good ones are not blamed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adjust.model.observations import ImageBlock
from adjust.model.survey import Survey
from survey.cli import main
from survey.jobs.navigating.job import NavigateRequest, navigate_job
from survey.project.writing import write_project
from survey.simulate import beacons

pytestmark = pytest.mark.slow

Planted = Callable[[Survey], Survey]


@pytest.fixture(scope="module")
def lab() -> Survey:
    return beacons(seed=4, n_table_epochs=6, n_free_epochs=5, n_night_epochs=5)[0]


def of_night(change: Callable[[ImageBlock], ImageBlock]) -> Planted:
    """The spots of epochs to navigate changed, those of the calibration not."""
    return lambda survey: replace(survey, image_blocks=tuple(
        change(b) if b.target_id is None else b for b in survey.image_blocks))  # fmt: skip


WIDTH = 1280


def mirrored(b: ImageBlock) -> ImageBlock:
    S = np.diag([-1.0, 1.0])
    return b if b.camera_id != "Y" else replace(b, uv=b.uv @ S + [WIDTH - 1.0, 0.0], cov=S @ b.cov @ S)


def exchanged(b: ImageBlock) -> ImageBlock:
    return replace(b, camera_id={"X": "Z", "Z": "X"}.get(b.camera_id, b.camera_id))


def other_sign(survey: Survey) -> Survey:
    nights = {b.epoch_id for b in survey.image_blocks if b.target_id is None}
    return replace(survey, table_readings=tuple(
        replace(r, angles=r.angles * [1.0, -1.0]) if r.epoch_id in nights else r
        for r in survey.table_readings))  # fmt: skip


def misnamed(survey: Survey) -> Survey:
    """Two beacons that are seen often, by each other's names."""
    ids = [p.point_id for p in survey.points]
    a, b = ids.index("B02"), ids.index("B07")
    swap = np.arange(len(survey.points))
    swap[[a, b]] = b, a
    return of_night(lambda x: replace(x, point_idx=swap[x.point_idx]))(survey)


def boards_mirrored(survey: Survey) -> Survey:
    """The images of targets of camera Y, from which it is calibrated."""
    return replace(survey, image_blocks=tuple(
        mirrored(b) if b.target_id is not None else b for b in survey.image_blocks))  # fmt: skip


def navigated(survey: Survey, folder: Path) -> Any:
    write_project(folder, survey)
    return navigate_job(folder, NavigateRequest(), progress=False)


@pytest.mark.parametrize(
    ("plant", "name", "ids"),
    [
        (of_night(mirrored), "images mirrored", ("Y",)),
        (of_night(exchanged), "cameras exchanged", ("X", "Z")),
        (misnamed, "points exchanged", ("B02", "B07")),
        (other_sign, "table readings", ()),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_what_is_wrong_with_the_epochs_is_named_first(
    lab: Survey, plant: Planted, name: str, ids: tuple[str, ...], tmp_path: Path
) -> None:
    found = navigated(plant(lab), tmp_path / "lab")
    assert found.causes
    first = found.causes[0]
    assert first.name == name
    assert first.ids == ids
    if name == "table readings":
        assert "axis 2 counts the other way round" in first.cause
    assert f"! probable cause: {first.cause}" in found.text().splitlines()[1]
    assert found.summary()["diagnosis"][0]["name"] == name


def test_good_epochs_are_not_blamed(lab: Survey, tmp_path: Path) -> None:
    found = navigated(lab, tmp_path / "lab")
    assert found.causes == ()
    assert not [n for n in found.notes if "probable cause" in n]


def test_what_is_wrong_with_the_calibration_is_named(
    lab: Survey, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_project(tmp_path / "lab", boards_mirrored(lab))
    code = main(["navigate", str(tmp_path / "lab"), "--quiet"])
    said = capsys.readouterr()
    assert "camera Y: all its images are mirrored" in (said.err if code else said.out)
