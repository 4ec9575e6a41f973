"""The report as one HTML page that needs nothing but itself, and printed from it as PDF."""

import json
import os
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from markupsafe import Markup

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from survey.report.context import Context
from survey.report.language import language, localised, speaking, t
from survey.report.markup import document, element, joined, json_of, json_script, part
from survey.report.modules import WEB, bundled
from survey.report.sections import (
    diagnosis,
    every_observation,
    loops,
    observations,
    overview,
    published,
    statistics,
    unknowns,
)
from survey.solution.dictionary import RunInfo, solution_dict
from survey.solution.quantities import scale_of
from survey.solution.residual_tables import ImageRows, image_rows
from survey.solution.statistics import Statistics

_SECTIONS = (
    ("Identification", "identification", overview.identification),
    ("Summary", "summary", overview.summary),
    ("Diagnosis", "diagnosis", diagnosis.diagnosis),
    ("Tolerances", "tolerances", overview.tolerances),
    ("Variance components", "components", statistics.components),
    ("Groups", "groups", overview.groups),
    ("Parts", "parts", overview.parts),
    ("Picture", "picture", overview.picture),
    ("Cameras", "cameras", unknowns.cameras),
    ("Poses", "poses", unknowns.stations),
    ("Turntables", "tables", unknowns.tables),
    ("Targets", "targets", unknowns.targets),
    ("Points", "points", unknowns.points),
    ("Instruments and surfaces", "instruments", unknowns.instruments),
    ("Network", "network", loops.network),
    ("Loops", "loops", loops.loops),
    ("Pairs", "pairs", loops.pairs),
    ("Published methods", "published", published.published),
    ("Excluded by people", "excluded", observations.excluded),
    ("Observations", "observations", observations.others),
    ("Image points", "image-points", observations.image_points),
    ("All observations", "all-observations", every_observation.every_observation),
    ("Distribution", "normality", statistics.normality),
    ("Reliability", "reliability", statistics.reliability),
    ("Relative precision", "relative", statistics.relative),
    ("Budget", "budget", statistics.budget),
    ("Correlations", "correlations", statistics.correlations),
    ("Inputs", "inputs", overview.inputs),
)


_LAST = "all-observations"
"""Of the sections that are made when there are statistics, that which has a part of its own without them."""
_OF_STATISTICS = frozenset((
    "tolerances", "components", "parts", "reliability", "relative", "budget", "correlations", _LAST,
))  # fmt: skip


@frozen(eq=False)
class BegunPage:
    """A page without what statistics say. made: sections by their anchors."""

    context: Context
    language: str
    made: dict[str, Markup]


def report_html(
    adjustment: Adjustment,
    run: RunInfo,
    solution: dict[str, Any] | None = None,
    found: Statistics | None = None,
    in_language: str = "en",
) -> str:
    """The page; ``solution`` is that of ``solution_dict``, made here where it is not given.

    found: the statistics, where they are to be shown. in_language: "en" or "de"; raises SurveyError for others.
    """
    solution = solution_dict(adjustment, run) if solution is None else solution
    return finished_page(begun_page(adjustment, run, solution, image_rows(adjustment), in_language), solution, found)


def begun_page(
    adjustment: Adjustment, run: RunInfo, solution: dict[str, Any], rows: ImageRows, in_language: str
) -> BegunPage:
    """What can be made before there are statistics; the ``solution`` may lack them."""
    limit = solution["summary"]["suspects"]["image_test_limit"]
    images = adjustment.image_residuals
    c = Context(
        adjustment, run, solution, scale_of(adjustment, run.sigmas), rows,
        images.used & (images.test > limit),
    )  # fmt: skip
    with speaking(in_language):
        c = replace(c, listed=every_observation.listed(c))
        made = {anchor: make(c) for _, anchor, make in _SECTIONS if anchor not in _OF_STATISTICS}
    return BegunPage(c, in_language, made)


def finished_page(begun: BegunPage, solution: dict[str, Any], found: Statistics | None) -> str:
    """The whole page; arguments as of :func:`report_html`."""
    c = replace(begun.context, solution=solution, statistics=found)
    with speaking(begun.language):
        made = begun.made | {anchor: make(c) if found is not None or anchor == _LAST else Markup()
                             for _, anchor, make in _SECTIONS if anchor in _OF_STATISTICS}  # fmt: skip
        nav = part("nav", [(anchor, t(name)) for name, anchor, _ in _SECTIONS if made[anchor]])
        title = f"{c.solution['summary']['title'] or c.run.folder} – {t('Adjustment report')}"
        shown = overview.header(c) + nav + joined((made[anchor] for _, anchor, _ in _SECTIONS), "\n")
        scripts = json_script("words", json_of(_words())) + element("script", Markup(bundled("report")))
        return document(title, shown, scripts)


def _words() -> dict[str, object]:
    """What the script says."""
    of_modules = json.loads((WEB / f"{language()}.json").read_text(encoding="utf-8"))
    return {
        "language": language(), "decimal": localised("."), "texts": of_modules,
        "flags": ["", t("suspect"), t("not used")],
    }  # fmt: skip


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
UNSEEN = ("WebUIOmniboxPopup", "WebUIOmniboxAimPopup")
"""Parts of a browser's own window, for which it would start a process without a window too."""
_TIMEOUT_S = 180.0


def report_pdf(html: str) -> bytes:
    """The page printed by a browser that is there, or by WeasyPrint (extra ``pdf``).

    Raises SurveyError where nothing that prints is installed, or the browser fails.
    """
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
            f"--disable-features={','.join(UNSEEN)}",
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
