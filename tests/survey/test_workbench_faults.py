"""Three planted mistakes of different kinds, found and mended in the page alone, by so many clicks each."""

import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from survey.examples import write_example
from survey.project.exclusions import read_exclusions
from survey.workbench.guard import new_token
from survey.workbench.live import Listening
from survey.workbench.server import Server
from survey.workbench.session import Workbench
from tests.browsing import Page
from tests.survey.test_workbench_browser import READY

pytestmark = [pytest.mark.slow, pytest.mark.browser]

POINT = "image_point:X/tX05/board/c40"  # moved by 4 px
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
    """A head on a table with the three mistakes."""
    write_example("head", folder)
    _rows(folder / "observations/image_points.csv", _spoilt)
    _rows(folder / "observations/table_angles.csv", _misread)


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
def page(browser: Any, tmp_path: Path) -> Iterator[tuple[Page, Path]]:
    """A page of a head on a table with the three mistakes."""
    folder = tmp_path / "lab"
    write_spoilt(folder)
    token = new_token()
    bench = Workbench(folder)
    bench.adjust()
    with Listening(Server(bench, token), "127.0.0.1", 0) as listening:
        found = Page(browser, f"{listening.address}#token={token}", 1280)
        yield found, folder
        found.context.close()
        assert [text for text in found.complaints if "404" not in text] == []  # the example has no pictures


def test_three_mistakes_are_mended_in_the_page_alone(page: tuple[Page, Path]) -> None:
    shown, folder = page
    p: Any = shown.page
    click, counts = Clicks(shown), []
    assert p.inner_text("#verdict") != "✓ Passed"
    assert "mirrored" in p.inner_text("#left .remedy")
    click("#left .remedy button", "Apply", renews=True)
    counts.append(click.n)
    assert p.locator("#left .remedy").count() == 0
    click.leave_out(POINT, "reflection")
    counts.append(click.n - sum(counts))
    click.leave_out(READING, "misread")
    counts.append(click.n - sum(counts))
    assert p.inner_text("#verdict") == "✓ Passed"
    assert counts == [1, 3, 3]
    rows, _ = read_exclusions(folder / "observations")
    assert [(f"{r.exclusion.name}", r.exclusion.reason) for r in rows] == [(POINT, "reflection"), (READING, "misread")]
    for _ in range(3):
        shown.done(lambda: p.locator("#undo").click())
    assert "mirrored" in p.inner_text("#left .remedy")
