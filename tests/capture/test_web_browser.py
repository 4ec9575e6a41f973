"""The page of ``labcapture view`` in a real browser, and a session watched in the workbench."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from capture.plan.plan import read_plan
from capture.session.run import run_plan
from capture.web.serve import Pages
from capture.web.state import SessionView
from survey.workbench.live import Listening
from survey.workbench.session import Workbench
from tests import labs
from tests.browsing import CONTRAST, INKED, Page, opened
from tests.capture.session_runs import write_plan
from tests.survey.test_capturing import said, seen

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


@pytest.mark.parametrize("width", [1280, 390])
def test_a_session_is_watched_in_the_workbench(browser: Any, tmp_path: Path, width: int) -> None:
    labs.example("head", tmp_path / "lab")
    (tmp_path / "lab/images/X").mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(tmp_path / "lab/images/X/live1.png"), np.full((80, 100), 90, np.uint8))
    bench = Workbench(tmp_path / "lab")
    bench.adjust()
    with opened(browser, bench, width, "&view=findings,capture") as page:
        page.wait("document.querySelector('#right .state')?.textContent === 'not started'")
        said(tmp_path / "lab", "live1")
        seen(tmp_path / "lab", "live1", [[10.0, 20.0], [60.0, 50.0]])
        page.wait("document.querySelector('#right .camera') !== null")
        page.wait("document.querySelector('#right .camera .bar output').textContent.includes('2')")
        assert "X · live1" in page.page.evaluate("document.querySelector('#right .camera').textContent")
        assert "1 of 4 epochs" in page.page.evaluate("document.querySelector('#right .capture').textContent")
        assert page.page.evaluate("document.documentElement.scrollWidth") <= width
