"""The report as PDF: printed by a browser that is there, or by WeasyPrint (extra ``pdf``)."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from adjust.model.errors import SurveyError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
_TIMEOUT_S = 180.0


def report_pdf(html: str) -> bytes:
    """Raises SurveyError where nothing that prints is installed, or the browser fails."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is not None:
        return _by_browser(browser, html)
    try:
        from weasyprint import HTML
    except (ImportError, OSError) as error:  # OSError: its system libraries are missing
        raise SurveyError(
            "a PDF needs a browser (Chromium, Chrome or Edge on the path) or WeasyPrint: install Chromium, or "
            f"'pip install labsurvey[pdf]' ({error})"
        ) from error
    return bytes(HTML(string=html).write_pdf())


def _by_browser(browser: str, html: str) -> bytes:
    with tempfile.TemporaryDirectory() as scratch:
        page, out = Path(scratch) / "report.html", Path(scratch) / "report.pdf"
        page.write_text(html, encoding="utf-8")
        command = [
            browser, "--headless", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", "--disable-quic", "--no-pdf-header-footer",
            f"--user-data-dir={scratch}/profile", f"--print-to-pdf={out}", page.as_uri(),
        ]  # fmt: skip
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.insert(1, "--no-sandbox")  # a browser refuses its sandbox to root
        try:
            done = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired as error:
            late = f"{browser} did not finish the PDF within {_TIMEOUT_S:g} s; print report.html by hand"
            raise SurveyError(late) from error
        if not out.is_file():
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise SurveyError(f"{browser} made no PDF: {said[-1] if said else 'no message'}; print report.html by hand")
        return out.read_bytes()
