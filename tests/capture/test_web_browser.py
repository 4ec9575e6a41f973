"""The page of ``labcapture view`` in a real browser."""

from collections.abc import Iterator
from typing import Any

import pytest

from capture.plan.plan import read_plan
from capture.session.run import run_plan
from capture.web.serve import Pages
from capture.web.state import SessionView
from survey.workbench.live import Listening
from tests.browsing import CONTRAST, INKED, Page
from tests.capture.session_runs import write_plan

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Of a session that has taken its images."""
    plan = read_plan(write_plan(tmp_path_factory.mktemp("view")))
    run_plan(plan, shown=False)
    with Listening(Pages(SessionView(plan)), "127.0.0.1", 0) as listening:
        yield listening.address


@pytest.fixture
def page(browser: Any, address: str, width: int) -> Iterator[Page]:
    with Page(browser, address, width, "document.querySelector('.camera') !== null") as found:
        yield found


@pytest.mark.parametrize("width", [1280, 390])
def test_images_overlay_and_coverage_are_shown(page: Page, width: int) -> None:
    p = page.page
    page.wait("document.body.dataset.picture !== undefined")
    assert p.inner_text("#state") == "finished"
    assert "6 of 6 epochs" in p.inner_text("#count")
    assert p.locator(".camera").first.inner_text().startswith("X · t06")
    page.wait(f"{INKED}(document.querySelector('.stage canvas')) > 1000")
    for k in range(p.locator("canvas").count()):
        assert p.locator("canvas").nth(k).get_attribute("aria-label")
    for scheme in ("light", "dark"):
        p.emulate_media(color_scheme=scheme)
        ratio, text = page.drawn(CONTRAST)
        assert ratio >= 4.5, (scheme, text)
    assert p.evaluate("document.documentElement.scrollWidth") <= width
    p.keyboard.press("g")
    page.wait("document.querySelector('#state').textContent === 'fertig'")
    p.keyboard.press("o")
    page.wait("document.querySelector('.bar output').textContent.includes('(o)')")
