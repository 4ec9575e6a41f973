"""Pictures of the page of ``labsurvey open``, by Chromium.

Run in the project's folder: python -m docs.make_workbench_pictures FOLDER docs/pictures
FOLDER is a project, such as that of: labsurvey example full-lab FOLDER. The others are made on the way.
With --every: every view of FOLDER, and its report, light and dark, on a desk and on a phone, in English and German, to
be looked at.
"""

import itertools
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

from adjust.model.errors import SurveyError
from survey.examples import write_example
from survey.workbench.guard import new_token
from survey.workbench.live import Listening
from survey.workbench.server import Server
from survey.workbench.session import Workbench
from tests.survey.test_workbench_faults import write_spoilt

CHROMIUM = "/usr/bin/chromium"
DESK, PHONE = (1440, 900), (390, 844)
Act = Callable[[Any], None]


def _nothing(_page: Any) -> None:
    pass


def _detect(page: Any) -> None:
    page.get_by_label("Run: Detect").click()
    page.wait_for_timeout(9000)


# name: place, width, colours, what is done before
OF_FOLDER: dict[str, tuple[str, int, str, Act]] = {
    "workbench": ("", 1280, "light", _nothing),
    "workbench-scene": ("point=B07&view=camera,scene", 1280, "dark", _nothing),
    "workbench-phone": ("view=findings,image", 390, "dark", _nothing),
}
OF_EXAMPLES: dict[str, tuple[str, str, int, str, Act]] = {
    "workbench-remedy": ("spoilt", "view=findings,angles", 1280, "light", _nothing),
    "workbench-network": ("total-station", "view=settings,network", 1280, "dark", _nothing),
    "workbench-detect": ("one-camera", "view=jobs,image", 1280, "light", _detect),
}


def main(folder: Path, out: Path) -> None:
    """Write every picture as a PNG."""
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as place:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for name, how in OF_FOLDER.items():
            picture(browser, folder, out / f"{name}.png", *how)
        for name, (example, *how) in OF_EXAMPLES.items():
            mine = Path(place) / name / "lab"
            if example == "spoilt":
                write_spoilt(mine)
            else:
                write_example(example, mine)
            picture(browser, mine, out / f"{name}.png", *how)
        browser.close()


def every(folder: Path, out: Path) -> None:
    """Every view and region as VIEW-SCHEME-WIDTH-LANGUAGE.png."""
    from survey.report import report_html

    out.mkdir(parents=True, exist_ok=True)
    bench, token = Workbench(folder), new_token()
    bench.adjust()
    with sync_playwright() as playwright, Listening(Server(bench, token), "127.0.0.1", 0) as listening:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for language, scheme, size in itertools.product(("en", "de"), ("light", "dark"), (DESK, PHONE)):
            mark = f"{scheme}-{size[0]}-{language}.png"
            sized = {"width": size[0], "height": size[1]}
            context = browser.new_context(viewport=sized, color_scheme=scheme, locale=language)
            page = context.new_page()
            page.on("console", lambda said, mark=mark: print(mark, said.text, file=sys.stderr))
            page.goto(f"{listening.address}#token={token}")
            settled(page)
            for region in ("left", "tree", "tables", "inspector") if size is PHONE else ("left",):
                page.evaluate(f"document.body.dataset.pane = '{region}'")
                page.screenshot(path=out / f"{region}-{mark}")
            page.evaluate("document.body.dataset.pane = 'right'")
            chooser = page.locator("#right .chooser select")
            for view in chooser.locator("option").evaluate_all("(all) => all.map((one) => one.value)"):
                page.locator("#right .chooser select").select_option(view)
                page.wait_for_timeout(1500)
                page.screenshot(path=out / f"{view}-{mark}")
            report = out / f"report-{language}.html"
            report.write_text(report_html(bench.adjustment, bench.run(), None, bench.statistics, language))
            page.goto(report.resolve().as_uri())
            page.wait_for_timeout(1500)
            page.screenshot(path=out / f"report-{mark}", full_page=True)
            context.close()
        browser.close()


def picture(browser: Any, folder: Path, out: Path, place: str, width: int, colours: str, act: Act) -> None:
    """One picture of a place, after something was done there."""
    bench, token = Workbench(folder), new_token()
    try:
        bench.adjust()
    except SurveyError as error:
        print(f"{folder}: {error}", file=sys.stderr)
    with Listening(Server(bench, token), "127.0.0.1", 0) as listening:
        size = {"width": width, "height": 800}
        context = browser.new_context(viewport=size, color_scheme=colours, locale="en-GB")
        page = context.new_page()
        page.goto(f"{listening.address}#token={token}&{place}")
        settled(page)
        act(page)
        page.screenshot(path=out)
        context.close()


def settled(page: Any, seconds: float = 20.0) -> None:
    """Waits until the views are drawn."""
    end = time.monotonic() + seconds
    while page.evaluate("document.body.dataset.ready === undefined") and time.monotonic() < end:
        time.sleep(0.05)
    page.wait_for_timeout(2500)


if __name__ == "__main__":
    given = [text for text in sys.argv[1:] if text != "--every"]
    (every if "--every" in sys.argv else main)(Path(given[0]), Path(given[1]))
