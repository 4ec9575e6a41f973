"""How long ``labsurvey open`` takes, from the command to what a click shows, and what the browser holds.

``python -m tests.benchmarks.opening FOLDER`` of a project, or ``--points 1000000`` of a stereo head with so many; with
``--report`` how long its ``report.html`` takes. Times are of the wall and of a machine that does nothing else, but for
those of the processor; a few rounds, the least of each is printed.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

from survey.project import write_project
from survey.simulate import stereo
from tests.browsing import need_browser

POINTS_PER_PAIR = 108
PATIENCE_S = 120.0


def project_of(points: int, place: Path) -> Path:
    """A stereo head before a board, of about so many image points."""
    write_project(place / "lab", stereo(3, n_pairs=-(-points // POINTS_PER_PAIR))[0])
    return place / "lab"


def wait(page: Any, expression: str) -> None:
    """From outside: the content policy of the page forbids evaluating a text in it."""
    end = time.monotonic() + PATIENCE_S
    while not page.evaluate(expression):
        if time.monotonic() > end:
            raise TimeoutError(expression)
        time.sleep(0.01)


def browsers(root: int) -> list[Path]:
    """The processes of a browser, as folders of /proc."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    mine = {root}
    while more := {pid for pid, above in parents.items() if above in mine} - mine:
        mine |= more
    found = []
    for pid in mine:
        with suppress(OSError):
            if b"chrom" in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[0]:
                found.append(Path(f"/proc/{pid}"))
    return found


def browser_mb(root: int) -> float:
    """What the processes of a browser hold by themselves and their share of what they hold together, MB."""
    total = 0
    for place in browsers(root):
        with suppress(OSError, IndexError):
            total += int((place / "smaps_rollup").read_text().split("\nPss:")[1].split()[0])
    return total / 1024.0


def settled_mb(page: Any) -> float:
    """What a browser holds once what it no longer needs is given back, which it does beside other work; MB."""
    session, found = page.context.new_cdp_session(page), []
    for _ in range(6):
        session.send("HeapProfiler.collectGarbage")
        time.sleep(0.5)
        found.append(browser_mb(os.getpid()))
    return min(found)


def processor_s(places: Iterable[Path]) -> float:
    """Seconds of processor that processes have taken so far, whatever else the machine does."""
    total = 0
    for place in places:
        with suppress(OSError):
            total += sum(int(x) for x in (place / "stat").read_text().rpartition(")")[2].split()[11:13])
    return total / os.sysconf("SC_CLK_TCK")


def report(folder: Path) -> dict[str, float]:
    """One round of ``results/report.html``: until it is loaded and drawn; then a table sorted."""
    path, out = folder / "results" / "report.html", dict[str, float]()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=need_browser(), args=["--no-sandbox"])
        page = browser.new_context(viewport={"width": 1280, "height": 800}, locale="en-GB").new_page()
        used, begin = processor_s(browsers(os.getpid())), time.perf_counter()
        page.goto(path.resolve().as_uri())
        page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        out["report loaded and drawn, s"] = time.perf_counter() - begin
        out["processor of the browser, s"] = processor_s(browsers(os.getpid())) - used
        begin = time.perf_counter()
        page.locator("#all-observations .row.head button").nth(4).click()
        page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        out["table sorted, s"] = time.perf_counter() - begin
        out["elements"] = page.evaluate("document.querySelectorAll('*').length")
        out |= {"page, MB": path.stat().st_size / 1e6, "browser, MB": browser_mb(os.getpid())}
        browser.close()
    return out


def measured(folder: Path) -> dict[str, float]:
    """One round: seconds by what was waited for, MB of the browser."""
    out: dict[str, float] = {}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=need_browser(), args=["--no-sandbox"])
        page = browser.new_context(viewport={"width": 1280, "height": 800}, locale="en-GB").new_page()
        empty, idle = browser_mb(os.getpid()), processor_s(browsers(os.getpid()))
        begin = time.perf_counter()
        command = [sys.executable, "-m", "survey", "open", str(folder), "--port", "0", "--no-browser"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        mine = [Path(f"/proc/{server.pid}")]
        try:
            address = server.stdout.readline().strip() if server.stdout else ""
            out["address printed, s"] = time.perf_counter() - begin
            page.goto(address)
            wait(page, "document.body.dataset.ready !== undefined")
            out["first view, s"] = time.perf_counter() - begin
            out["  first view: processor, server, s"] = processor_s(mine)
            out["  first view: processor, browser, s"] = processor_s(browsers(os.getpid())) - idle
            wait(page, "document.body.dataset.results !== undefined")
            out["first solution, s"] = time.perf_counter() - begin
            out["  first solution: processor, server, s"] = processor_s(mine)
            out["  first solution: processor, browser, s"] = processor_s(browsers(os.getpid())) - idle
            out |= clicks(page)
            out |= {"browser without a page, MB": empty, "browser, MB": settled_mb(page)}
        finally:
            server.terminate()
            server.wait(20.0)
            browser.close()
    return out


def clicks(page: Any) -> dict[str, float]:
    """Of a row to its image, of a table sorted, scrolled and filtered, of a point left out to before and after."""
    out = {}
    page.evaluate("delete document.body.dataset.picture")
    begin = time.perf_counter()
    page.locator("#tables .rows .row").nth(2).click()
    wait(page, "document.body.dataset.picture !== undefined && document.querySelector('#inspector h2') !== null")
    out["click to image, s"] = time.perf_counter() - begin
    begin = time.perf_counter()
    page.locator("#tables .row.head button").nth(4).click()
    out["table sorted, s"] = time.perf_counter() - begin
    begin = time.perf_counter()
    page.evaluate("document.querySelector('#tables .scroll').scrollTop = 1e6")
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    out["table scrolled, s"] = time.perf_counter() - begin
    page.keyboard.press("x")
    page.keyboard.type("measured")
    page.evaluate("delete document.body.dataset.done")
    begin = time.perf_counter()
    page.keyboard.press("Enter")
    wait(page, "document.body.dataset.done !== undefined")
    page.keyboard.press("d")
    wait(page, "document.querySelector('#left .cards') !== null")
    out["left out, before and after, s"] = time.perf_counter() - begin
    page.evaluate("delete document.body.dataset.done")
    begin = time.perf_counter()
    page.keyboard.press("u")
    wait(page, "document.body.dataset.done !== undefined")
    out["undone, s"] = time.perf_counter() - begin
    return out


def main() -> None:
    """Prints the least of each over the rounds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--points", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--report", action="store_true", help="the report of an adjusted project instead")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = project_of(given.points, Path(place)) if given.points else given.folder
        if given.report and given.points:
            subprocess.run([sys.executable, "-m", "survey", "adjust", str(folder), "--quiet"], check=True)
        rounds = [(report if given.report else measured)(folder) for _ in range(given.rounds)]
    for name in rounds[0]:
        print(f"{name:<42}{min(one[name] for one in rounds):10.2f}")


if __name__ == "__main__":
    main()
