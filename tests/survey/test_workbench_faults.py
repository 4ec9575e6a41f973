"""Mistakes mended in the page alone: four planted ones of different kinds are found, by so many clicks each; and every
kind of change that a remedy may be is carried out by one click, and taken back to the letter."""

import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import cv2
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
from survey.notebook.steps import detect
from survey.project import write_project
from survey.project.exclusions import in_force, read_exclusions
from survey.simulate import stereo
from survey.workbench.session import Workbench
from tests import labs
from tests.browsing import Page, opened

pytestmark = [pytest.mark.slow, pytest.mark.browser]

POINT = "image_point:X/tX05/board/c40"  # moved by 4 px
REFLECTED = "image_point:left/e05/board/r3c4"
HIGHLIGHT = (806.0, 664.0)  # px: 7 from the corner that is meant
READING = "table_angles:turntable/tZ05"  # typed wrong by half a degree


def _rows(path: Path, change: Callable[[dict[str, str]], dict[str, str]]) -> None:
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    with path.open("w", newline="") as stream:
        out = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(change(row) for row in rows)


def _spoilt(row: dict[str, str]) -> dict[str, str]:
    if row["camera_id"] == "Y" and row["epoch_id"] >= "tY01":
        row["u_px"] = repr(1279.0 - float(row["u_px"]))
    elif (row["epoch_id"], row["camera_id"], row["point_id"]) == ("tX05", "X", "c40"):
        row["u_px"] = repr(float(row["u_px"]) + 4.0)
    return row


def _misread(row: dict[str, str]) -> dict[str, str]:
    if row["epoch_id"] == "tZ05":
        row["axis1_deg"] = repr(float(row["axis1_deg"]) + 0.5)
    return row


def write_spoilt(folder: Path) -> None:
    """A head on a table with three mistakes."""
    labs.example("head", folder)
    _rows(folder / "observations/image_points.csv", _spoilt)
    _rows(folder / "observations/table_angles.csv", _misread)


def write_reflection(folder: Path) -> None:
    """Two cameras and a board with a lamp mirrored in it, beside a corner; another program took that for the corner."""
    labs.example("stereo", folder)
    path = folder / "images/left/e05.png"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    u, v = HIGHLIGHT
    cv2.ellipse(image, (round(u), round(v)), (9, 6), 30, 0, 360, 250, -1, cv2.LINE_AA)
    cv2.imwrite(str(path), image)
    detect(folder)  # which does without that corner
    table = folder / "observations/image_points.csv"
    lines = table.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("e05,left,board,r3c3,"))
    cells = lines[at].split(",")
    lines.insert(at + 1, ",".join([*cells[:3], "r3c4", repr(u), repr(v), *cells[6:]]))
    table.write_text("\n".join(lines) + "\n")


class Clicks:
    """Clicks on a page, counted."""

    def __init__(self, page: Page) -> None:
        self.page, self.n = page, 0

    def __call__(self, selector: str, text: str = "", renews: bool = False) -> None:
        found = self.page.page.locator(selector, has_text=text or None).first
        self.n += 1
        if renews:
            self.page.done(found.click)
        else:
            found.click()

    def leave_out(self, anchor: str, reason: str) -> None:
        """The suspect in the list, the button, and the button of the question; the reason is typed."""
        self(f'#left a[data-id="{anchor}"]')
        self("#inspector button", "Leave out …")
        field = self.page.page.locator("dialog input")
        field.fill(reason)
        self("dialog button.primary", renews=True)


@pytest.fixture
def page(request: pytest.FixtureRequest, browser: Any, tmp_path: Path) -> Iterator[tuple[Page, Path]]:
    """A page of a project that the function given has spoilt."""
    folder = tmp_path / "lab"
    request.param(folder)
    bench = Workbench(folder)
    bench.adjust()
    with opened(browser, bench) as found:
        yield found, folder


@pytest.mark.parametrize("page", [write_spoilt], indirect=True)
def test_three_mistakes_are_mended_in_the_page_alone(page: tuple[Page, Path]) -> None:
    shown, folder = page
    p: Any = shown.page
    click, counts = Clicks(shown), []
    assert p.inner_text("#verdict") != "✓ Passed"
    assert "mirrored" in p.inner_text("#left .remedy")
    click("#left .remedy button", "Apply", renews=True)
    counts.append(click.n)
    assert "table turntable, epoch" in p.inner_text("#left .remedy")  # which may be mended so, or left out
    click.leave_out(POINT, "reflection")
    counts.append(click.n - sum(counts))
    click.leave_out(READING, "misread")
    counts.append(click.n - sum(counts))
    assert p.inner_text("#verdict") == "✓ Passed"
    assert p.locator("#left .remedy").count() == 0
    assert counts == [1, 3, 3]
    rows, _ = read_exclusions(folder / "observations")
    assert [(f"{r.exclusion.name}", r.exclusion.reason) for r in rows] == [(POINT, "reflection"), (READING, "misread")]
    for _ in range(3):
        shown.done(lambda: p.locator("#undo").click())
    assert "mirrored" in p.inner_text("#left .remedy")


def place_in(page: Any, uv: tuple[float, float], size: tuple[int, int] = (1280, 1024)) -> dict[str, float]:
    """Where a pixel is on the canvas of an image that is seen as a whole."""
    box = page.locator("#right canvas").first.bounding_box()
    scale = min(box["width"] / size[0], box["height"] / size[1])
    return {axis: 0.5 * (box[side] - scale * n) + scale * (x + 0.5)
            for axis, side, n, x in zip("xy", ("width", "height"), size, uv, strict=True)}  # fmt: skip


@pytest.mark.parametrize("page", [write_reflection], indirect=True)
def test_a_reflection_is_seen_in_the_image_and_left_out(page: tuple[Page, Path]) -> None:
    """The page opens with the image of the largest residual; it is clicked and looked at pixel by pixel."""
    shown, folder = page
    p: Any = shown.page
    click = Clicks(shown)
    shown.wait("document.body.dataset.picture !== undefined")
    assert p.inner_text("#right .bar b") == "left · e05"
    click.n += 1
    place = place_in(p, HIGHLIGHT)
    p.locator("#right canvas").first.click(position=place)
    shown.wait(f"location.hash.includes({REFLECTED!r})")
    click("#right button", "1:1")
    p.locator("#right canvas").first.press("o")  # without marks
    shown.wait("document.querySelector('#right .bar output').textContent.includes('(o)')")
    picture = cv2.imdecode(np.frombuffer(p.locator("#right canvas").first.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    x, y = round(place["x"]), round(place["y"])
    bright = picture[y - 8 : y + 8, x - 8 : x + 8] > 240  # the board's white is 222
    assert bright.mean() > 0.25, "where the point was clicked the highlight is seen, pixel by pixel"
    p.keyboard.press("o")
    click("#inspector button", "Leave out …")
    p.locator("dialog input").fill("reflection of a lamp")
    click("dialog button.primary", renews=True)
    assert click.n == 4
    assert p.inner_text("#verdict") == "✓ Passed"
    rows, _ = read_exclusions(folder / "observations")
    assert [(f"{r.exclusion.name}", r.exclusion.reason) for r in rows] == [(REFLECTED, "reflection of a lamp")]


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
def offering(browser: Any, folder: Path) -> Iterator[Page]:
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
def test_one_click_mends_and_another_takes_it_back(offering: Page, folder: Path, number: int) -> None:
    p, (_, name, stands) = offering.page, EDITS[number - 1]
    before = files_of(folder)
    known = offering.facts().split("unsaved")[0].strip()
    offering.done(lambda: p.locator("#left .remedy button").nth(number - 1).click())
    assert p.inner_text("#message").startswith("Done in ")
    after = files_of(folder)
    assert {k for k in after if after[k] != before[k]} == {name} - {"observations/exclusions.csv"}
    assert stands in (folder / name).read_text()
    assert p.is_enabled("#undo")
    offering.done(lambda: p.locator("#undo").click())
    assert files_of(folder) == before
    assert in_force(read_exclusions(folder / "observations")[0]) == {}
    assert offering.facts().split("unsaved")[0].strip() == known
    assert offering.complaints == []
