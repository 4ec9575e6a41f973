"""The pages and their script in a real browser, as first opened, on a phone, on a dark screen, and on paper."""

import html
import re
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from adjust.model.errors import SurveyError
from survey.project.observed import name_of_residual
from survey.report import page as printing
from survey.report.anchors import anchor
from survey.report.drawing import DARK
from survey.report.page import report_html
from survey.report.sections import every_observation
from survey.solution.dictionary import RunInfo
from tests.browsing import CONTRAST, INKED, Page, asked, need_browser
from tests.survey.accessible import FAULTS
from tests.survey.adjustments import Lab, lab_adjustment

pytestmark = [pytest.mark.browser, pytest.mark.slow]
RUN = RunInfo("lab", "Full lab", {"survey.toml": "12ab"}, {"alpha": 0.05}, {"labsurvey": "0.1.0"}, "2026-01-02")
SHOWN = (*every_observation.COLUMNS[:3], "state", *every_observation.COLUMNS[3:])
COMPONENT, W, OBSERVED = (SHOWN.index(name) for name in ("Component", "w", "Observed"))
PHONE = 390


@pytest.fixture(scope="module")
def german() -> str:
    return report_html(lab_adjustment(Lab(n_epochs=6, n_beacons=6)), RUN, in_language="de")


@pytest.fixture(scope="module")
def english() -> str:
    return report_html(lab_adjustment(Lab(n_epochs=6, n_beacons=6, blunders=2)), RUN)


def cells(dom: str, column: int) -> list[str]:
    """The texts of a column of the table of all observations, as shown."""
    table = dom[dom.index('id="all"') :]
    rows = re.findall(r'<div role="row"[^>]*data-place[^>]*>(.*?)</div>', table, re.S)
    return [html.unescape(re.sub("<[^>]*>", "", re.findall(r"<span[^>]*>(.*?)</span>", row)[column])) for row in rows]


def numbers(texts: list[str]) -> list[float]:
    return [float(x.replace("−", "-").replace(",", ".")) for x in texts if x != "–"]


@pytest.fixture(scope="module")
def page(browser: Any, english: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A page that is looked at, and by no test changed."""
    path = tmp_path_factory.mktemp("report") / "page.html"
    path.write_text(english, encoding="utf-8")
    with Page(browser, path.as_uri(), 1280, "document.documentElement.classList.contains('ready')") as found:
        yield found


@pytest.fixture(scope="module")
def paper(german: str) -> bytes:
    need_browser()
    return printing.report_pdf(german)


def test_all_observations_can_be_sorted_and_searched(browser: Any, german: str, tmp_path: Path) -> None:
    click = f"document.querySelectorAll('#all .head button')[{OBSERVED}].click()"
    search = """(() => { const f = document.querySelector('#all input'); f.value = 'drehtisch axis2';
        f.dispatchEvent(new Event('input')); })()"""
    dom = "document.documentElement.outerHTML"
    first, _, ordered, _, found = asked(browser, german, tmp_path, dom, click, dom, search, dom)
    w = [abs(x) for x in numbers(cells(first, W))]
    assert 10 < len(w) < 60, "the rows in sight"
    assert w == sorted(w, reverse=True)
    observed = numbers(cells(ordered, OBSERVED))
    assert len(observed) > 10
    assert observed == sorted(observed)
    assert set(cells(found, COMPONENT)) == {"axis2"}
    assert len(cells(found, COMPONENT)) == 6


@pytest.mark.parametrize("kind", ["obs", "reading", "image", "point", "camera", "target", "table", "group"])
def test_places_of_the_workbench_lead_to_rows_of_the_report(
    browser: Any, english: str, tmp_path: Path, kind: str
) -> None:
    adjustment = lab_adjustment(Lab(n_epochs=6, n_beacons=6, blunders=2))
    block = adjustment.survey.image_blocks[0]
    target = next(t for t in adjustment.survey.targets if t.target_id == block.target_id)
    image = f"{block.camera_id}/{block.epoch_id}"
    name = {
        "obs": f"image_point:{image}/{block.target_id}/{target.point_ids[int(block.point_idx[3])]}", "image": image,
        "reading": name_of_residual(next(o for o in adjustment.other_residuals if o.kind == "table")),
        "point": adjustment.survey.points[0].point_id, "camera": block.camera_id, "target": block.target_id,
        "table": "turntable", "group": "image",
    }[kind]  # fmt: skip
    place = "#" + quote(anchor(kind, name).removeprefix("#"), safe="=:/")
    if kind in ("point", "camera", "target", "table", "group"):
        measure = """[...document.querySelectorAll("main .here")]
          .map((e) => (e.cells?.[0] ?? e).textContent.split(", ")[0])"""
        assert asked(browser, english, tmp_path, measure, place=place) == [[{"group": "image points"}.get(name, name)]]
        return
    rows = "'#all .rows .row'" if kind == "image" else "'#all .row[aria-selected=true]'"
    texts = "(r) => [...r.children].map((c) => c.textContent)"
    inside = """(() => { const e = document.querySelector("#all").getBoundingClientRect();
      return e.top < innerHeight && e.bottom > 0; })()"""
    listed = f"[...document.querySelectorAll({rows})].map({texts})"
    found, is_inside = asked(browser, english, tmp_path, listed, inside, place=place)
    where = name.partition(":")[2].split("/") if kind == "obs" else name.split("/")
    wanted = " · ".join(where[:3]) if kind != "reading" else "turntable · "
    assert found
    assert all(row[0].removeprefix("■ ").startswith(wanted) for row in found)
    assert {row[2] for row in found} <= ({"axis1", "axis2"} if kind == "reading" else {"u", "v"})
    assert is_inside


def test_view_in_space_is_drawn_when_the_page_opens(page: Page) -> None:
    space = "document.querySelector('#space canvas')"
    assert page.drawn(f"{space}.width") > 1000
    assert page.drawn(f"{INKED}({space})") > 2000


def test_wheel_scrolls_the_page_and_zooms_with_ctrl(page: Page) -> None:
    turned = """[false, true].map((ctrlKey) => {
      const e = new WheelEvent("wheel", { deltaY: 100, ctrlKey, cancelable: true, bubbles: true });
      document.querySelector("#space canvas").dispatchEvent(e);
      return e.defaultPrevented; })"""
    touched = "getComputedStyle(document.querySelector('#space canvas')).touchAction"
    assert [page.drawn(turned), page.drawn(touched)] == [[False, True], "pan-y"]


@pytest.mark.parametrize("width", [PHONE, 1280])
def test_nothing_is_wider_than_the_screen_and_no_figure_vanishes(
    browser: Any, english: str, german: str, tmp_path: Path, width: int
) -> None:
    measure = """[document.documentElement.scrollWidth,
      Math.min(...[...document.querySelectorAll("figure svg, canvas")].map((e) => e.getBoundingClientRect().width)),
      document.querySelector("#all [aria-sort]").getBoundingClientRect().right]"""
    for text in (english, german):
        ((page_width, smallest, sort_key),) = asked(browser, text, tmp_path, measure, width=width)
        assert page_width <= width
        assert smallest > 200
        assert sort_key <= width  # what the rows are sorted by is on the screen


def test_every_control_and_heading_has_a_name(browser: Any, page: Page, german: str, tmp_path: Path) -> None:
    assert [page.drawn(FAULTS)] == asked(browser, german, tmp_path, FAULTS) == [[]]


def test_every_word_can_be_read_in_light_and_dark(page: Page) -> None:
    for scheme in ("dark", "light"):
        page.page.emulate_media(color_scheme=scheme)
        ratio, words = page.drawn(CONTRAST)
        assert ratio >= 4.5, words
        background = page.page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (background != "rgb(255, 255, 255)") == (scheme == "dark")


def test_pictures_use_colours_that_have_a_dark_counterpart(english: str) -> None:
    used = set(re.findall(r'(?:fill|stroke)="(#[^"]+)"', english))
    assert {"#1c2733", "#2166ac"} <= used
    assert used <= set(DARK)


def test_on_paper_stands_nothing_that_needs_a_hand(page: Page) -> None:
    displayed = """[...document.querySelectorAll("#all, #space, .screen, .paper")]
      .map((e) => [e.id || e.className.split(" ").pop(), getComputedStyle(e).display])"""
    assert {name for name, how in page.drawn(displayed) if how != "none"} >= {"all", "space", "screen"}
    page.page.emulate_media(media="print")
    assert {name for name, how in page.drawn(displayed) if how != "none"} == {"paper"}
    page.page.emulate_media(media="screen")


def test_a_camera_is_one_page_of_paper(paper: bytes) -> None:
    pypdf = pytest.importorskip("pypdf")
    pages = [page.extract_text() for page in pypdf.PdfReader(BytesIO(paper)).pages]
    at = [next(i for i, text in enumerate(pages) if f"Kamera {name}" in text) for name in "XYZ"]
    assert at == list(range(at[0], at[0] + 3))
    for name, i in zip("XYZ", at, strict=True):
        assert f"{name} station_from_camera" in pages[i]


def test_report_on_paper_has_the_words_of_the_page(paper: bytes) -> None:
    assert paper.startswith(b"%PDF")
    pypdf = pytest.importorskip("pypdf")
    pages = [page.extract_text() for page in pypdf.PdfReader(BytesIO(paper)).pages]
    assert "Ausgleichungsbericht" in pages[0]
    assert "Globaltest" in pages[0]
    assert len(pages) > 3
    assert f"{len(pages)} / {len(pages)}" in pages[-1]
    assert all(line not in "".join(pages) for line in ("only suspect", "nur verdächtige"))  # of the screen alone


def test_without_browser_and_weasyprint_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(printing, "BROWSERS", ())
    monkeypatch.setitem(__import__("sys").modules, "weasyprint", None)
    with pytest.raises(SurveyError, match=r"install Chromium, or 'pip install labsurvey\[pdf\]'"):
        printing.report_pdf("<p>x</p>")
