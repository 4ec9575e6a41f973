"""A page in a real browser: opened, waited for, asked; what it complains of is kept."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import pytest

from survey.report import page as printing
from survey.workbench.guard import new_token
from survey.workbench.live import Listening
from survey.workbench.server import Server

SECONDS = 120.0  # the machine may be busy
UNASKED = ("AimEnabled", "MediaRouter", "NetworkTimeServiceQuerying", "OptimizationHints", "PaintHolding",
           "PreconnectToSearch", *printing.UNSEEN)  # fmt: skip
"""What a browser is not to do: ask others when it starts, or prepare what no page shows."""
LEFT = "about:blank"
READY = "document.body.dataset.ready !== undefined"
"""Of the workbench."""
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
# reading a page's own canvas twice makes Chromium complain of it: a copy that is there to be read is read
INKED = """((c) => {
  const copy = Object.assign(document.createElement("canvas"), { width: c.width, height: c.height });
  const d = copy.getContext("2d", { willReadFrequently: true });
  d.drawImage(c, 0, 0);
  return d.getImageData(0, 0, c.width, c.height).data.filter((x, k) => k % 4 === 3 && x > 0).length;
})"""
"""How many pixels of a canvas something is drawn in; a function of the canvas."""
BROWSER = next((path for name in printing.BROWSERS if (path := shutil.which(name))), None)


def need_browser() -> str:
    """A browser, or a skip; where data is required a missing browser is a failure too."""
    if BROWSER is None:
        if os.environ.get("LABSURVEY_REQUIRE_DATA"):
            pytest.fail("no browser is installed; install Chromium")
        pytest.skip("no browser is installed")
    return BROWSER


def need_playwright() -> Any:
    """The driver of the browser, or a skip; where data is required its absence is a failure too."""
    if os.environ.get("LABSURVEY_REQUIRE_DATA"):
        from playwright import sync_api
    else:
        sync_api = pytest.importorskip("playwright.sync_api")
    return sync_api


@contextmanager
def launched() -> Iterator[Any]:
    """Debian's Chromium; nothing is downloaded."""
    with need_playwright().sync_playwright() as playwright:
        args = ["--no-sandbox", "--disable-gpu", "--process-per-site", f"--disable-features={','.join(UNASKED)}",
                "--window-size=1280,800"]  # fmt: skip  # of most pages: no tab has to grow
        found = playwright.chromium.launch(executable_path=need_browser(), args=args)
        yield found
        found.close()


class Page:
    """A page, with what it complained of and what it asked of others: of nothing where it is left without an error.

    All pages of a browser are tabs of one context, for which scripts are compiled once; a tab that was left is the next
    page's, which costs half of a new one. What a page keeps for the next one goes when it is closed. ``apart``: in a
    context, and so in a process, of its own.
    """

    def __init__(
        self, browser: Any, address: str, width: int, ready: str = READY, dark: bool = False, apart: bool = False
    ) -> None:
        shared = [] if apart else browser.contexts[:1]
        context = shared[0] if shared else browser.new_context(locale="en-GB")
        self.page = next((tab for tab in context.pages if tab.url == LEFT), None) or context.new_page()
        self.page.set_viewport_size({"width": width, "height": 800})
        self.page.emulate_media(color_scheme="dark" if dark else "light")
        self.complaints: list[str] = []
        self._heard = {
            "pageerror": lambda error: self.complaints.append(str(error)),
            "console": lambda m: self.complaints.append(m.text) if m.type in ("error", "warning") else None,
            "request": lambda r: None if r.url.startswith((address.split("#")[0], "blob:")) else
                       self.complaints.append(r.url),
        }  # fmt: skip
        for event, heard in self._heard.items():
            self.page.on(event, heard)
        self.page.goto(address)
        self.wait(ready)

    def close(self) -> None:
        for event, heard in self._heard.items():
            self.page.remove_listener(event, heard)
        # by the page itself: an address that the browser is given begins a new process
        self.page.evaluate(f"localStorage.clear(), sessionStorage.clear(), location.replace('{LEFT}')")
        self.page.wait_for_url(LEFT)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        self.close()
        assert error or self.complaints == []

    def wait(self, expression: str) -> None:
        """Looked at inside the page, by a script that the content policy does not ask about."""
        looked_at = f"""(async () => {{
          const end = performance.now() + {1e3 * SECONDS};
          while (!({expression}) && performance.now() < end) await new Promise((r) => setTimeout(r, 10));
          return performance.now() < end; }})()"""
        if not self.page.evaluate(looked_at):
            raise TimeoutError(f"{expression}\n{self.page.inner_text('body')[:600]}\n{self.complaints}")

    def done(self, act: Callable[[], Any]) -> None:
        """Does something and waits until the page shows what came of it."""
        self.page.evaluate("delete document.body.dataset.done")
        act()
        self.wait("document.body.dataset.done !== undefined")

    def drawn(self, expression: str) -> Any:
        """What an expression is once all that was changed has been drawn."""
        self.page.evaluate("new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(() => r(0))))")
        return self.page.evaluate(expression)

    def facts(self) -> str:
        return str(self.page.inner_text("#facts"))


@contextmanager
def opened(browser: Any, shown: Any, width: int = 1280, place: str = "", apart: bool = False) -> Iterator[Page]:
    """The workbench at a place of what it shows, served until its page is closed."""
    token = new_token()
    with (
        Listening(Server(shown, token), "127.0.0.1", 0) as listening,
        Page(browser, f"{listening.address}#token={token}{place}", width, apart=apart) as page,
    ):
        yield page


def asked(
    browser: Any, page: str, folder: Path, *questions: str, width: int = 1280, dark: bool = False, place: str = "",
    ready: str = "document.documentElement.classList.contains('ready')",
) -> list[Any]:  # fmt: skip
    """What expressions are, one after the other, on a page as first opened, at a place of it."""
    path = folder / "page.html"
    path.write_text(page, encoding="utf-8")
    with Page(browser, path.as_uri() + place, width, ready, dark) as shown:
        return [shown.drawn(question) for question in questions]
