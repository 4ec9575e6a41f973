"""The page and its script in a real browser, and the report on paper."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from adjust.errors import SurveyError
from survey.report import pdf, report_html
from survey.solution import RunInfo
from tests.survey.adjustments import Lab, lab_adjustment

RUN = RunInfo("lab", "Full lab", {"survey.toml": "12ab"}, {"alpha": 0.05}, {"labsurvey": "0.1.0"}, "2026-01-02")
BROWSER = next((path for name in pdf.BROWSERS if (path := shutil.which(name))), None)


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


def dom_after(page: str, actions: str, folder: Path) -> str:
    """The document after the page's script and then ``actions`` have run; what is logged stands in its title."""
    path = folder / "page.html"
    path.write_text(page.replace("</body>", f"<script>{actions}</script></body>"), encoding="utf-8")
    command = [
        need_browser(), "--headless", "--disable-gpu", "--no-first-run", "--disable-background-networking",
        "--disable-component-update", "--disable-sync", "--disable-quic", f"--user-data-dir={folder / 'profile'}",
        "--virtual-time-budget=2000", "--dump-dom", path.as_uri(),
    ]  # fmt: skip
    if os.geteuid() == 0:
        command.insert(1, "--no-sandbox")
    return subprocess.run(command, capture_output=True, timeout=120, check=True).stdout.decode()


def cells(dom: str, column: int) -> list[str]:
    """The texts of a column of the table of all observations, as shown."""
    table = dom[dom.index('id="all"') :]
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", table[table.index("<tbody>") : table.index("</tbody>")], re.S)
    return [re.findall(r"<td[^>]*>(.*?)</td>", row)[column] for row in rows]


def numbers(texts: list[str]) -> list[float]:
    return [float(x.replace("−", "-").replace(",", ".")) for x in texts if x != "–"]


def test_all_observations_can_be_paged_sorted_and_searched(german: str, tmp_path: Path) -> None:
    """Columns: 0 kind, 4 component, 7 observed, 11 residual, 13 w."""
    first = dom_after(german, "", tmp_path)
    assert "ready" in first[: first.index("<head")]
    w = [abs(x) for x in numbers(cells(first, 13))]
    assert len(cells(first, 13)) == 50
    assert w == sorted(w, reverse=True)
    click = "document.querySelectorAll('#all th')[7].click();" * 2
    observed = numbers(cells(dom_after(german, click, tmp_path), 7))
    assert observed == sorted(observed)
    search = (
        "const f = document.getElementById('all-filter'); f.value = 'drehtisch axis2';"
        "f.dispatchEvent(new Event('input'));"
    )
    found = dom_after(german, search, tmp_path)
    assert set(cells(found, 4)) == {"axis2"}
    assert len(cells(found, 4)) == 6


def test_report_on_paper_has_the_words_of_the_page(german: str, tmp_path: Path) -> None:
    need_browser()
    path = tmp_path / "report.pdf"
    path.write_bytes(pdf.report_pdf(german))
    assert path.read_bytes().startswith(b"%PDF")
    pypdf = pytest.importorskip("pypdf")
    pages = [page.extract_text() for page in pypdf.PdfReader(path).pages]
    assert "Ausgleichungsbericht" in pages[0]
    assert "Globaltest" in pages[0]
    assert len(pages) > 3
    assert f"{len(pages)} / {len(pages)}" in pages[-1]
    assert all(line not in "".join(pages) for line in ("only suspect", "nur verdächtige"))  # of the screen alone


def test_without_browser_and_weasyprint_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pdf, "BROWSERS", ())
    monkeypatch.setitem(__import__("sys").modules, "weasyprint", None)
    with pytest.raises(SurveyError, match=r"install Chromium, or 'pip install labsurvey\[pdf\]'"):
        pdf.report_pdf("<p>x</p>")
