"""The report as one HTML page that needs nothing but itself."""

from pathlib import Path
from typing import Any

from markupsafe import Markup

from adjust.result import Adjustment
from survey.quantities import scale_of
from survey.report import every, loops, observations, overview, published, statistics, unknowns
from survey.report.context import Context
from survey.report.drawing import DARK
from survey.report.language import localised, speaking, t
from survey.report.markup import document, element, joined, json_script, part
from survey.residual_tables import image_rows
from survey.solution import RunInfo, solution_dict
from survey.statistics import Statistics

_SECTIONS = (
    ("Identification", "identification", overview.identification),
    ("Summary", "summary", overview.summary),
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
    ("All observations", "all-observations", every.every_observation),
    ("Distribution", "normality", statistics.normality),
    ("Reliability", "reliability", statistics.reliability),
    ("Relative precision", "relative", statistics.relative),
    ("Budget", "budget", statistics.budget),
    ("Correlations", "correlations", statistics.correlations),
    ("Inputs", "inputs", overview.inputs),
)


def report_html(
    adjustment: Adjustment,
    run: RunInfo,
    solution: dict[str, Any] | None = None,
    found: Statistics | None = None,
    in_language: str = "en",
) -> str:
    """The page; ``solution`` is that of :func:`survey.solution.solution_dict`, made here where it is not given.

    found: the statistics, where they are to be shown. in_language: "en" or "de"; raises SurveyError for others.
    """
    solution = solution_dict(adjustment, run) if solution is None else solution
    limit = solution["summary"]["suspects"]["image_test_limit"]
    images = adjustment.image_residuals
    c = Context(
        adjustment, run, solution, scale_of(adjustment, run.sigmas), image_rows(adjustment),
        images.used & (images.test > limit), found,
    )  # fmt: skip
    with speaking(in_language):
        return _page(c)


def _page(c: Context) -> str:
    made = [(name, anchor, make(c)) for name, anchor, make in _SECTIONS]
    nav = part("nav", [(anchor, t(name)) for name, anchor, body in made if body])
    script = Path(__file__).with_name("script.js").read_text(encoding="utf-8")
    title = f"{c.solution['summary']['title'] or c.run.folder} – {t('Adjustment report')}"
    shown = overview.header(c) + nav + joined((body for _, _, body in made), "\n")
    return document(title, shown, json_script("words", _words()) + element("script", Markup(script)))


def _words() -> dict[str, Any]:
    """What the script says."""
    return {
        "decimal": localised("."),
        "dark": DARK,
        "filter": t("filter"),
        "flags": ["", t("suspect"), t("not used")],
        "where": t("page {{page}} of {{pages}}, {{n}} rows").replace("{{", "{").replace("}}", "}"),
    }
