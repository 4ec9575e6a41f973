"""The report as one HTML page that needs nothing but itself."""

from pathlib import Path
from typing import Any

from adjust.result import Adjustment
from survey.quantities import scale_of
from survey.report import loops, observations, overview, unknowns
from survey.report.context import Context
from survey.report.language import language, t
from survey.report.markup import esc
from survey.residual_tables import image_rows
from survey.solution import RunInfo, solution_dict

_SECTIONS = (
    ("Summary", "summary", overview.summary),
    ("Groups", "groups", overview.groups),
    ("Picture", "picture", overview.picture),
    ("Cameras", "cameras", unknowns.cameras),
    ("Poses", "poses", unknowns.stations),
    ("Turntables", "tables", unknowns.tables),
    ("Targets", "targets", unknowns.targets),
    ("Points", "points", unknowns.points),
    ("Network", "network", loops.network),
    ("Loops", "loops", loops.loops),
    ("Pairs", "pairs", loops.pairs),
    ("Observations", "observations", observations.others),
    ("Image points", "image-points", observations.image_points),
    ("Inputs", "inputs", overview.inputs),
)


def report_html(adjustment: Adjustment, run: RunInfo, solution: dict[str, Any] | None = None) -> str:
    """The page; ``solution`` is that of :func:`survey.solution.solution_dict`, made here where it is not given."""
    solution = solution_dict(adjustment, run) if solution is None else solution
    limit = solution["summary"]["suspects"]["image_test_limit"]
    found = adjustment.image_residuals
    c = Context(
        adjustment, run, solution, scale_of(adjustment, run.sigmas), image_rows(adjustment),
        found.used & (found.test > limit),
    )  # fmt: skip
    made = [(name, anchor, make(c)) for name, anchor, make in _SECTIONS]
    nav = "".join(f'<a href="#{anchor}">{esc(t(name))}</a>' for name, anchor, body in made if body)
    style = Path(__file__).with_name("style.css").read_text(encoding="utf-8")
    title = esc(solution["summary"]["title"] or run.folder)
    return (
        f'<!doctype html>\n<html lang="{language()}"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title} – {t('Adjustment report')}</title><style>{style}</style></head>\n<body><main>"
        f"{overview.header(c)}<nav>{nav}</nav>" + "\n".join(body for _, _, body in made) + "</main></body></html>\n"
    )
