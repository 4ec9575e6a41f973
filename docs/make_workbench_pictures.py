"""Pictures of the page of ``labsurvey open``, by Chromium, of at most 256 colours each.

Run in the project's folder: python -m docs.make_workbench_pictures FOLDER docs/pictures [NAME...]
FOLDER is an adjusted project, such as that of: labsurvey example full-lab FOLDER; labsurvey adjust FOLDER. The others
are made on the way. NAME: only these pictures of views.
With --every: every view of FOLDER, and its report, light and dark, on a desk and on a phone, in English and German, to
be looked at.
"""

import csv
import itertools
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

from adjust.model.errors import SurveyError
from docs.palette import write_palette_png
from survey.examples import write_example
from survey.project.captured import quality_path, status_path
from survey.workbench.guard import new_token
from survey.workbench.live import Listening
from survey.workbench.server import Server
from survey.workbench.session import Workbench
from tests.survey.test_workbench_faults import (
    HIGHLIGHT,
    POINT,
    READING,
    REFLECTED,
    place_in,
    write_reflection,
    write_spoilt,
)

CHROMIUM = "/usr/bin/chromium"
DESK, PHONE = (1440, 900), (390, 844)
SMALL = (1280, 800)
Act = Callable[[Any, Path], None]


def _nothing(_page: Any, _folder: Path) -> None:
    pass


def _detect(page: Any, _folder: Path | None = None) -> None:
    page.get_by_label("Run: Detect").click()
    page.wait_for_timeout(9000)


def _without_an_image(page: Any, _folder: Path) -> None:
    """Something to compare: the image shown is left out."""
    page.keyboard.press("X")
    page.locator("dialog input").fill("motion blur")
    _done(page, lambda: page.keyboard.press("Enter"))
    page.keyboard.press("s")


def _session(page: Any, folder: Path) -> None:
    """As if a session took the images of the folder just now: where it is, and what was seen."""
    _detect(page)
    rows = [(x["epoch_id"], x["camera_id"], float(x["u_px"]), float(x["v_px"])) for x in
            csv.DictReader((folder / "observations/image_points.csv").open(newline=""))]  # fmt: skip
    quality_path(folder).parent.mkdir(exist_ok=True)
    for epoch, camera in dict.fromkeys(row[:2] for row in rows):
        uv = [list(row[2:]) for row in rows if row[:2] == (epoch, camera)]
        of = {"camera_id": camera, "epoch_id": epoch, "width": 1280, "height": 1024, "points": {"board": uv}}
        with quality_path(folder).open("a") as stream:
            stream.write(json.dumps(of) + "\n")
    n, (epoch, camera) = len({row[0] for row in rows}), rows[-1][:2]
    told = {"state": "finished", "done": n, "total": n, "epoch_id": epoch, "images": {camera: "x"}}
    status_path(folder).write_text(json.dumps(told))
    page.wait_for_timeout(3000)


# name: place, what is done before
OF_FOLDER: dict[str, tuple[str, Act]] = {
    "workbench": ("", _nothing),
    "workbench-scene": ("point=B07&view=camera,scene", _nothing),
    "workbench-flat": ("point=B07&view=plan,south", _nothing),
    "workbench-east": ("point=B07&view=east,correlations", _nothing),
    "workbench-halves": ("camera=Z&view=halves,image", _nothing),
    "workbench-angles": ("view=angles,settings", _nothing),
    "workbench-compare": ("image=X/hX05&view=compare,history", _without_an_image),
}
OF_EXAMPLES: dict[str, tuple[str, str, Act]] = {
    "workbench-network": ("total-station", "view=network,settings", _nothing),
    "workbench-loops": ("relay", "view=loops,scene", _nothing),
    "workbench-detect": ("one-camera", "view=jobs,image", _detect),
    "workbench-capture": ("one-camera", "view=jobs,capture", _session),
}
ON_A_PHONE = (("", "left"), ("image=X/hX05", "right"), ("point=B07&view=findings,scene", "right"), ("", "tables"),
              ("obs=image_point:X/hX05/board/r7c2", "inspector"))  # fmt: skip
TWO_VIEWS, HIGH = ("left", "right"), 400  # px


def main(folder: Path, out: Path, *names: str) -> None:
    """Write every picture as a PNG, or those of the names."""
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as place:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        if not names:
            mistakes(browser, Path(place), out)
            phone(browser, folder, out / "workbench-phone.png")
        for name in names or (*OF_EXAMPLES, *OF_FOLDER):
            mine = folder
            if name in OF_EXAMPLES:
                mine = Path(place) / name / "lab"
                write_example(OF_EXAMPLES[name][0], mine)
            what = OF_EXAMPLES[name][1:] if name in OF_EXAMPLES else OF_FOLDER[name]
            picture(browser, mine, out / f"{name}.png", *what)
        browser.close()


def mistakes(browser: Any, place: Path, out: Path) -> None:
    """Every step of the tutorial of four mistakes."""
    write_spoilt(place / "spoilt")
    write_reflection(place / "reflection")
    with opened(browser, place / "spoilt", "view=findings,angles") as page:
        shot(page, out / "workbench-remedy.png")
        _done(page, lambda: page.keyboard.press("m"))
        for anchor, reason, name in ((POINT, "reflection", "corner"), (READING, "misread", "angle")):
            page.locator(f'#left a[data-id="{anchor}"]').first.click()
            page.locator("#inspector button", has_text="Leave out …").click()
            page.locator("dialog input").fill(reason)
            shot(page, out / f"workbench-mistake-{name}.png")
            _done(page, lambda: page.locator("dialog button.primary").click())
        page.keyboard.press("d")
        shot(page, out / "workbench-mistake-mended.png")
    with opened(browser, place / "reflection", "") as page:
        page.locator("#right canvas").first.click(position=place_in(page, HIGHLIGHT))
        page.wait_for_timeout(500)
        assert REFLECTED in page.evaluate("location.hash")
        page.locator("#right button", has_text="1:1").click()
        page.keyboard.press("o")
        page.mouse.move(2, 2)
        shot(page, out / "workbench-mistake-reflection.png")


def _done(page: Any, act: Callable[[], Any]) -> None:
    page.evaluate("delete document.body.dataset.done")
    act()
    _until(page, "document.body.dataset.done !== undefined")


@contextmanager
def opened(
    browser: Any, folder: Path, place: str, colours: str = "light", size: tuple[int, int] = SMALL
) -> Iterator[Any]:  # fmt: skip
    """The page of a project at a place."""
    bench, token = Workbench(folder), new_token()
    try:
        bench.adjust()
    except SurveyError as error:
        print(f"{folder}: {error}", file=sys.stderr)
    with Listening(Server(bench, token), "127.0.0.1", 0) as listening:
        sized = {"width": size[0], "height": size[1]}
        context = browser.new_context(viewport=sized, color_scheme=colours, locale="en-GB")
        page = context.new_page()
        page.on("console", lambda said: print(folder.name, place, said.text, file=sys.stderr))
        page.goto(f"{listening.address}#token={token}&{place}")
        _until(page, "document.body.dataset.ready !== undefined")
        yield page
        context.close()


def picture(browser: Any, folder: Path, out: Path, place: str, act: Act) -> None:
    """One picture of a place, after something was done there; and beside it how both views look otherwise."""
    with opened(browser, folder, place) as page:
        page.wait_for_timeout(1500)
        act(page, folder)
        shot(page, out)
        looks(page, out.with_name(out.name.replace("workbench", "look")))


def looks(page: Any, out: Path) -> None:
    """A page in the dark, and each of its two views on a phone, light and dark, in a row."""
    page.emulate_media(color_scheme="dark")
    parts = [_seen(page)]
    page.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
    for region, colours in itertools.product(TWO_VIEWS, ("light", "dark")):
        page.emulate_media(color_scheme=colours)
        _tab(page, region)
        parts.append(_seen(page))
    small = [cv2.resize(x, (round(HIGH * x.shape[1] / x.shape[0]), HIGH), interpolation=cv2.INTER_AREA) for x in parts]
    row = np.hstack([cv2.copyMakeBorder(x, 0, 0, 0, 6, cv2.BORDER_CONSTANT, value=(128, 128, 128)) for x in small])
    write_palette_png(out, cv2.imencode(".png", row[:, :-6])[1].tobytes())
    print(f"{out}: {out.stat().st_size / 1e3:.0f} kB")


def _tab(page: Any, region: str) -> None:
    page.evaluate(f"document.querySelector('#tabs button:nth-child({1 + _REGIONS.index(region)})').click()")


def _seen(page: Any) -> Any:
    return cv2.imdecode(np.frombuffer(_settled(page).screenshot(), np.uint8), cv2.IMREAD_COLOR)


def phone(browser: Any, folder: Path, out: Path) -> None:
    """The parts of a phone's page beside each other, light and dark in turn."""
    parts = []
    for k, (place, region) in enumerate(ON_A_PHONE):
        with opened(browser, folder, place, ("light", "dark")[k % 2], PHONE) as page:
            _tab(page, region)
            parts.append(_seen(page))
    write_palette_png(out, cv2.imencode(".png", np.hstack(parts))[1].tobytes())


_REGIONS = ("tree", "left", "right", "tables", "inspector")


def shot(page: Any, out: Path) -> None:
    """What is seen, once nothing is computed any more."""
    write_palette_png(out, _settled(page).screenshot())
    print(f"{out}: {out.stat().st_size / 1e3:.0f} kB")


def _settled(page: Any) -> Any:
    page.wait_for_timeout(800)
    _until(page, "document.querySelector('[aria-busy=true]') === null")
    page.wait_for_timeout(500)
    return page


def _until(page: Any, condition: str, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not page.evaluate(condition) and time.monotonic() < end:
        time.sleep(0.05)


def every(folder: Path, out: Path) -> None:
    """Every view and region as VIEW-SCHEME-WIDTH-LANGUAGE.png."""
    from survey.report.page import report_html

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
            _until(page, "document.body.dataset.results !== undefined")
            for region in _REGIONS if size is PHONE else ("left",):
                _tab(page, region)
                _settled(page).screenshot(path=out / f"{region}-{mark}")
            _tab(page, "right")
            for view in page.locator("#right .chooser option").evaluate_all("(all) => all.map((one) => one.value)"):
                page.locator("#right .chooser select").select_option(view)
                _settled(page).screenshot(path=out / f"{view}-{mark}")
            report = out / f"report-{language}.html"
            report.write_text(report_html(bench.adjustment, bench.run(), None, bench.statistics, language))
            page.goto(report.resolve().as_uri())
            page.wait_for_timeout(1500)
            page.screenshot(path=out / f"report-{mark}", full_page=True)
            context.close()
        browser.close()


if __name__ == "__main__":
    given = [text for text in sys.argv[1:] if text != "--every"]
    (every if "--every" in sys.argv else main)(Path(given[0]), Path(given[1]), *given[2:])
