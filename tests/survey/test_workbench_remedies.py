"""Every kind of change that a remedy may be, carried out by one click on the page, and taken back to the letter."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from adjust.diagnosis.diagnosis import Candidate
from adjust.diagnosis.hypothesis import (
    ChangeColumns,
    ChangeReadings,
    Edit,
    ExchangeColumns,
    Hypothesis,
    LeaveOut,
    Place,
    Rename,
    ScaleKey,
    SetKey,
    SetReadings,
)
from survey.project import write_project
from survey.project.exclusions import in_force, read_exclusions
from survey.simulate import stereo
from survey.workbench.session import Workbench
from tests.browsing import Page, opened

pytestmark = [pytest.mark.slow, pytest.mark.browser]

OF_IMAGE = {"camera_id": ("left",), "epoch_id": ("e05",)}
MORE = """
# two marks on the wall, and how far they are apart
[points]
P1 = { treatment = "held", x_mm = [0, 0, 2000] }    # as the plan has it
P2 = {}

[setups]
S = {}
S-2 = {}

[sigmas.scale]
image = 1.0   # as the maker says
"""
TOML, POINTS, DISTANCES = "survey.toml", "observations/image_points.csv", "observations/distances.csv"
READINGS = "observations/terrestrial.csv"
EDITS: tuple[tuple[Edit, str, str], ...] = (  # with the file that it changes and what then stands in it
    (ScaleKey(("sigmas", "scale", "image"), 1.25), TOML, "image = 1.25   # as the maker says\n"),
    (SetKey(("adjustment", "alpha"), 0.01), TOML, "alpha = 0.01\n"),
    (ChangeColumns("image_points", ("u_px", "v_px"), np.eye(2), np.array([0.0, 1e-3]), OF_IMAGE), POINTS, ""),
    (ExchangeColumns("image_points", ("sigma_u_px", "sigma_v_px"), OF_IMAGE), POINTS, ",0.11,0.1,"),
    (Rename("image_points", "epoch_id", {"e05": "e05-late"}, OF_IMAGE), POINTS, "\ne05-late,left,board,"),
    (ChangeReadings(("tape",), 1.0, 1e-5, "distances"), DISTANCES, "\ntape,P1,P2,500.02,"),
    (SetReadings(("sight",), "setup_id", "S-2"), READINGS, "\nsight,slope_distance,S-2,P1,P2,"),
    (LeaveOut(("image:left/e05",)), "observations/exclusions.csv", "\nimage,left/e05,excluded,"),
)


class Offering(Workbench):
    """A project of which a diagnosis says that each of the changes would mend it."""

    @property
    def remedies(self) -> tuple[Candidate, ...]:
        survey = self.situation.everything.survey
        return tuple(Candidate(Hypothesis(type(edit).__name__, f"cause {k}", "a change", Place("survey", ()), survey,
                                          (edit,)), 0.9, 99.0, 9.0, 0.9, 1.0)
                     for k, (edit, _, _) in enumerate(EDITS))  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras before a board, and a tape."""
    out = tmp_path_factory.mktemp("remedies") / "lab"
    write_project(out, stereo(3, n_pairs=8)[0])
    with (out / TOML).open("a") as stream:
        stream.write(MORE)
    (out / DISTANCES).write_text("distance_id,from_id,to_id,value_mm,sigma_mm\ntape,P1,P2,500.01,0.05\n")
    (out / READINGS).write_text(
        "reading_id,kind,setup_id,from_id,to_id,value_m,sigma_mm\nsight,slope_distance,S,P1,P2,0.50001,0.05\n"
    )
    (out / "observations/coordinates.csv").write_text(
        "point_id,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm\nP2,500,0,2000,0.1,0.1,0.1\n"
    )
    table = out / POINTS
    first, *rows = table.read_text().splitlines(keepends=True)
    table.write_text(first + "".join(r.replace(",0.1,0.1,", ",0.1,0.11,") if r.startswith("e05,left,") else r
                                     for r in rows))  # fmt: skip
    return out


@pytest.fixture(scope="module")
def page(browser: Any, folder: Path) -> Iterator[Page]:
    """One page for all of them."""
    bench = Offering(folder)
    bench.adjust()
    with opened(browser, bench) as found:
        yield found


def files_of(folder: Path) -> dict[str, bytes]:
    """What a survey is read from; rows of exclusions only grow."""
    paths = [folder / TOML, *(p for p in folder.rglob("*.csv") if p.name != "exclusions.csv" and "kept" not in p.parts)]
    return {str(p.relative_to(folder)): p.read_bytes() for p in paths}


def test_no_kind_of_change_is_missing() -> None:
    assert {type(edit) for edit, _, _ in EDITS} == set(get_args(Edit))


@pytest.mark.parametrize("number", range(1, len(EDITS) + 1), ids=[type(edit).__name__ for edit, _, _ in EDITS])
def test_one_click_mends_and_another_takes_it_back(page: Page, folder: Path, number: int) -> None:
    p, (_, name, stands) = page.page, EDITS[number - 1]
    before = files_of(folder)
    known = page.facts().split("unsaved")[0].strip()
    page.done(lambda: p.locator("#left .remedy button").nth(number - 1).click())
    assert p.inner_text("#message").startswith("Done in ")
    after = files_of(folder)
    assert {k for k in after if after[k] != before[k]} == {name} - {"observations/exclusions.csv"}
    assert stands in (folder / name).read_text()
    assert p.is_enabled("#undo")
    page.done(lambda: p.locator("#undo").click())
    assert files_of(folder) == before
    assert in_force(read_exclusions(folder / "observations")[0]) == {}
    assert page.facts().split("unsaved")[0].strip() == known
    assert page.complaints == []
