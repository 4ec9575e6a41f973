"""The pages and their script in a real browser, as first opened, on a phone, on a dark screen, and on paper."""

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from adjust.model.errors import SurveyError
from survey.project.observed import name_of_residual
from survey.report import page as printing
from survey.report import report_html
from survey.report.drawing import DARK
from survey.report.sections import observations
from survey.solution.anchors import anchor
from survey.solution.dictionary import RunInfo
from tests.survey.adjustments import Lab, lab_adjustment

pytestmark = [pytest.mark.browser, pytest.mark.slow]
RUN = RunInfo("lab", "Full lab", {"survey.toml": "12ab"}, {"alpha": 0.05}, {"labsurvey": "0.1.0"}, "2026-01-02")
SHOWN = (*observations.COLUMNS[:3], "state", *observations.COLUMNS[3:])
COMPONENT, W, OBSERVED = (SHOWN.index(name) for name in ("Component", "w", "Observed"))
PHONE = 390
# the smallest contrast of any text with what is behind it, by the formula of WCAG 2.1, with that text
CONTRAST = """(() => {
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = (c) => c.slice(0, 3).map((x) => x / 255)
    .map((x) => (x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4))
    .reduce((sum, x, k) => sum + x * [0.2126, 0.7152, 0.0722][k], 0);
  const behind = (e) => {
    for (; e; e = e.parentElement) {
      const c = rgb(getComputedStyle(e).backgroundColor);
      if (c.length < 4 || c[3] > 0) return c;
    }
    return [255, 255, 255];
  };
  let worst = [99, ""];
  for (const e of document.body.querySelectorAll("*")) {
    const own = [...e.childNodes].filter((n) => n.nodeType === 3).map((n) => n.textContent.trim()).join("");
    if (!own || e.closest("script, style, title") || !e.getClientRects().length) continue;
    const style = getComputedStyle(e);
    const [a, b] = [light(rgb(e.closest("svg") ? style.fill : style.color)), light(behind(e))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < worst[0]) worst = [ratio, own.slice(0, 60)];
  }
  return worst;
})()"""
BROWSER = next((path for name in printing.BROWSERS if (path := shutil.which(name))), None)


def need_browser() -> str:
    """A browser, or a skip; where data is required a missing browser is a failure too."""
    if BROWSER is None:
        if os.environ.get("LABSURVEY_REQUIRE_DATA"):
            pytest.fail("no browser is installed; install Chromium")
        pytest.skip("no browser is installed")
    return BROWSER


@pytest.fixture(scope="module")
def german() -> str:
    return report_html(lab_adjustment(Lab(n_epochs=6, n_beacons=6)), RUN, in_language="de")


@pytest.fixture(scope="module")
def english() -> str:
    return report_html(lab_adjustment(Lab(n_epochs=6, n_beacons=6, blunders=2)), RUN)


def dom_after(page: str, actions: str, folder: Path, dark: bool = False) -> str:
    """The document after the page's script and then ``actions`` have run; what is logged stands in its title."""
    path = folder / "page.html"
    path.write_text(page.replace("</body>", f"<script>{actions}</script></body>"), encoding="utf-8")
    command = [
        f"--blink-settings=preferredColorScheme={0 if dark else 1}",
        "--headless", "--disable-gpu", "--no-first-run", "--disable-background-networking",
        "--disable-component-update", "--disable-sync", "--disable-quic", f"--user-data-dir={folder / 'profile'}",
        "--virtual-time-budget=4000", "--dump-dom", path.as_uri(),
    ]  # fmt: skip
    if os.geteuid() == 0:
        command.insert(0, "--no-sandbox")
    return subprocess.run([need_browser(), *command], capture_output=True, timeout=120, check=True).stdout.decode()


def seen(page: str, measure: str, folder: Path, width: int = 1280, dark: bool = False) -> Any:
    """What the expression ``measure`` is on the page as first opened in a window of this width, px; nothing resizes."""
    inner = page.replace("</body>", f"<script>setTimeout(() => top.found({measure}), 1200)</script></body>")
    text = json.dumps(inner).replace("<", "\\u003c")
    outer = (
        f'<!doctype html><body><iframe style="border:0;width:{width}px;height:900px"></iframe><p id="found"></p></body>'
    )
    actions = (
        "top.found = (x) => { document.getElementById('found').textContent = JSON.stringify(x); };"
        f"document.querySelector('iframe').srcdoc = {text};"
    )
    found = re.search(r'<p id="found">(.*?)</p>', dom_after(outer, actions, folder, dark), re.S)
    assert found is not None
    return json.loads(html.unescape(found[1]))


def cells(dom: str, column: int) -> list[str]:
    """The texts of a column of the table of all observations, as shown."""
    table = dom[dom.index('id="all"') :]
    rows = re.findall(r'<div role="row"[^>]*data-place[^>]*>(.*?)</div>', table, re.S)
    return [html.unescape(re.sub("<[^>]*>", "", re.findall(r"<span[^>]*>(.*?)</span>", row)[column])) for row in rows]


def numbers(texts: list[str]) -> list[float]:
    return [float(x.replace("−", "-").replace(",", ".")) for x in texts if x != "–"]


def test_all_observations_can_be_sorted_and_searched(german: str, tmp_path: Path) -> None:
    first = dom_after(german, "", tmp_path)
    assert "ready" in first[: first.index("<head")]
    w = [abs(x) for x in numbers(cells(first, W))]
    assert 10 < len(w) < 60, "the rows in sight"
    assert w == sorted(w, reverse=True)
    click = f"document.querySelectorAll('#all .head button')[{OBSERVED}].click();"
    observed = numbers(cells(dom_after(german, click, tmp_path), OBSERVED))
    assert observed == sorted(observed)
    search = (
        "const f = document.querySelector('#all input'); f.value = 'drehtisch axis2';"
        "f.dispatchEvent(new Event('input'));"
    )
    found = dom_after(german, search, tmp_path)
    assert set(cells(found, COMPONENT)) == {"axis2"}
    assert len(cells(found, COMPONENT)) == 6


@pytest.mark.parametrize("kind", ["obs", "reading", "image", "point", "camera", "target", "table", "group"])
def test_places_of_the_workbench_lead_to_rows_of_the_report(english: str, tmp_path: Path, kind: str) -> None:
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
    shown = f"(() => {{ location.hash = {json.dumps(anchor(kind, name))}; }})()"
    page = english.replace("</body>", f"<script>{shown}</script></body>")
    if kind in ("point", "camera", "target", "table", "group"):
        measure = """[...document.querySelectorAll("main .here")]
          .map((e) => (e.cells?.[0] ?? e).textContent.split(", ")[0])"""
        assert seen(page, measure, tmp_path) == [{"group": "image points"}.get(name, name)]
        return
    rows = "'#all .rows .row'" if kind == "image" else "'#all .row[aria-selected=true]'"
    texts = "(r) => [...r.children].map((c) => c.textContent)"
    found = seen(page, f"[...document.querySelectorAll({rows})].map({texts})", tmp_path)
    where = name.partition(":")[2].split("/") if kind == "obs" else name.split("/")
    wanted = " · ".join(where[:3]) if kind != "reading" else "turntable · "
    assert found
    assert all(row[0].removeprefix("■ ").startswith(wanted) for row in found)
    assert {row[2] for row in found} <= ({"axis1", "axis2"} if kind == "reading" else {"u", "v"})
    inside = """(() => { const e = document.querySelector("#all").getBoundingClientRect();
      return e.top < innerHeight && e.bottom > 0; })()"""
    assert seen(page, inside, tmp_path)


def test_view_in_space_is_drawn_when_the_page_opens(english: str, tmp_path: Path) -> None:
    drawn = """(() => { const v = document.querySelector("#space canvas");
      const d = v.getContext("2d").getImageData(0, 0, v.width, v.height).data;
      return [v.width, d.filter((x, k) => k % 4 === 3 && x > 0).length]; })()"""
    width, n = seen(english, drawn, tmp_path)
    assert width > 1000
    assert n > 2000


def test_wheel_scrolls_the_page_and_zooms_with_ctrl(english: str, tmp_path: Path) -> None:
    turned = """[false, true].map((ctrlKey) => {
      const e = new WheelEvent("wheel", { deltaY: 100, ctrlKey, cancelable: true, bubbles: true });
      document.querySelector("#space canvas").dispatchEvent(e);
      return e.defaultPrevented; })"""
    assert seen(english, turned, tmp_path) == [False, True]
    assert seen(english, "getComputedStyle(document.querySelector('#space canvas')).touchAction", tmp_path) == "pan-y"


@pytest.mark.parametrize("width", [PHONE, 1280])
def test_nothing_is_wider_than_the_screen_and_no_figure_vanishes(
    english: str, german: str, tmp_path: Path, width: int
) -> None:
    measure = """[document.documentElement.scrollWidth,
      Math.min(...[...document.querySelectorAll("figure svg, canvas")].map((e) => e.getBoundingClientRect().width)),
      document.querySelector("#all [aria-sort]").getBoundingClientRect().right]"""
    for page in (english, german):
        page_width, smallest, sort_key = seen(page, measure, tmp_path, width)
        assert page_width <= width
        assert smallest > 200
        assert sort_key <= width  # what the rows are sorted by is on the screen


@pytest.mark.parametrize("dark", [False, True])
def test_every_word_can_be_read_in_light_and_dark(english: str, tmp_path: Path, dark: bool) -> None:
    ratio, words = seen(english, CONTRAST, tmp_path, dark=dark)
    assert ratio >= 4.5, words
    background = seen(english, "getComputedStyle(document.body).backgroundColor", tmp_path, dark=dark)
    assert (background != "rgb(255, 255, 255)") == dark


def test_pictures_use_colours_that_have_a_dark_counterpart(english: str) -> None:
    used = set(re.findall(r'(?:fill|stroke)="(#[^"]+)"', english))
    assert {"#1c2733", "#2166ac"} <= used
    assert used <= set(DARK)


def test_a_camera_is_one_page_of_paper(german: str, tmp_path: Path) -> None:
    need_browser()
    pypdf = pytest.importorskip("pypdf")
    path = tmp_path / "report.pdf"
    path.write_bytes(printing.report_pdf(german))
    pages = [page.extract_text() for page in pypdf.PdfReader(path).pages]
    at = [next(i for i, text in enumerate(pages) if f"Kamera {name}" in text) for name in "XYZ"]
    assert at == list(range(at[0], at[0] + 3))
    for name, i in zip("XYZ", at, strict=True):
        assert f"{name} station_from_camera" in pages[i]


def test_report_on_paper_has_the_words_of_the_page(german: str, tmp_path: Path) -> None:
    need_browser()
    path = tmp_path / "report.pdf"
    path.write_bytes(printing.report_pdf(german))
    assert path.read_bytes().startswith(b"%PDF")
    pypdf = pytest.importorskip("pypdf")
    pages = [page.extract_text() for page in pypdf.PdfReader(path).pages]
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
