"""Pictures of the page of ``labsurvey open``, by Chromium.

Run: python docs/make_workbench_pictures.py FOLDER docs/pictures
FOLDER is a project that is adjusted, such as that of: labsurvey example full-lab FOLDER.
"""

import sys
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

from survey.workbench.guard import new_token
from survey.workbench.live import Listening
from survey.workbench.server import Server
from survey.workbench.session import Workbench

CHROMIUM = "/usr/bin/chromium"
PICTURES = {  # name: place, width, colours
    "workbench": ("", 1280, "light"),
    "workbench-scene": ("point=B07&view=camera,scene", 1280, "dark"),
    "workbench-phone": ("view=findings,image", 390, "dark"),
}


def main(folder: Path, out: Path) -> None:
    """Write every picture as a PNG."""
    bench, token = Workbench(folder, read_only=True), new_token()
    bench.adjust()
    with Listening(Server(bench, token), "127.0.0.1", 0) as listening, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for name, (place, width, colours) in PICTURES.items():
            size = {"width": width, "height": 800}
            context = browser.new_context(viewport=size, color_scheme=colours, locale="en-GB")
            page = context.new_page()
            page.goto(f"{listening.address}#token={token}&{place}")
            settled(page)
            page.screenshot(path=out / f"{name}.png")
            context.close()
        browser.close()


def settled(page: Any, seconds: float = 20.0) -> None:
    """Waits until the views are drawn."""
    end = time.monotonic() + seconds
    while page.evaluate("document.body.dataset.ready === undefined") and time.monotonic() < end:
        time.sleep(0.05)
    page.wait_for_timeout(2500)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
