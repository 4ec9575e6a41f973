"""The job behind ``labsurvey plan --error-analysis``: figures 4 to 6 of the head's paper, and tolerances from them."""

import time
from dataclasses import field
from pathlib import Path

import numpy as np
from markupsafe import Markup

from adjust.design.error_analysis import BeaconField, tolerance
from adjust.design.error_figures import ErrorFigure, error_figures
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.plain import plain
from survey.folder.replacing import write_set
from survey.planning.page import html_page
from survey.report import drawing as d
from survey.report.charts import Series, chart
from survey.report.markup import figures, fixed, general, section, table

PAPER = BeaconField()
BOUNDED = BeaconField(nearest_m=0.1)
_NUMBERS = {"beacon position": "4", "camera position": "5", "camera attitude": "6"}


@frozen(eq=False)
class ErrorAnalysis:
    """The figures with a nearest depth and as the paper has them, and the tolerances for ``rms_px``."""

    bounded: tuple[ErrorFigure, ...]
    paper: tuple[ErrorFigure, ...]
    rms_px: float
    n_trials: int
    seed: int
    seconds: float
    paths: dict[str, Path] = field(default_factory=dict)

    def summary(self) -> dict[str, object]:
        """As plain values."""
        figures = {_NUMBERS[f.kind]: _entry(f, self.rms_px) for f in self.bounded}
        paper = {_NUMBERS[f.kind]: _entry(f, self.rms_px) for f in self.paper}
        return {
            "trials": self.n_trials, "seed": self.seed, "rms_px": self.rms_px,
            "figures": figures, "figures_without_nearest_depth": paper, "seconds": self.seconds,
            "written": {k: str(p) for k, p in self.paths.items()},
        }  # fmt: skip

    def text(self) -> str:
        """For people."""
        lines = [f"Pixel error by beacon and camera errors, {self.n_trials} trials a point (figures 4 to 6)", ""]
        lines.append(f"  beacons from {1e3 * self.bounded[0].field.nearest_m:.0f} to "
                     f"{1e3 * self.bounded[0].field.farthest_m:.0f} mm; slopes in px per mm or deg")  # fmt: skip
        head = f"  {'':<18}{'analytic':>10}{'Monte Carlo':>13}{'± s.e.':>8}{'worst point':>13}{'plain worst':>13}"
        lines.append(f"{head}{'its s.e.':>10}{f'for {self.rms_px:g} px':>14}")
        for f, r in ((f, _Read(f, self.rms_px)) for f in self.bounded):
            lines.append(
                f"  {f.kind:<18}{r.slope:>10.4f}{r.monte_carlo:>13.4f}{r.se:>8.4f}{100 * r.deviation:>11.2f} %"
                f"{100 * r.plain[r.worst]:>11.2f} %{100 * f.rms_se[r.worst] / f.rms[r.worst]:>8.2f} %"
                f"{r.tolerance:>9.3f} {r.unit}"
            )
        lines += ["", "  as printed, beacons from 0 mm: the RMS of positions has no expectation, near beacons carry it"]
        for f, r in ((f, _Read(f, self.rms_px)) for f in self.paper):
            lines.append(
                f"  {f.kind:<18}{r.median:>10.2f} px per {r.unit} (median point), {np.median(f.effective):.0f} of "
                f"{f.n_trials} trials carry it; {r.loose_tolerance:.3f} {r.unit} for {self.rms_px:g} px"
            )
        return "\n".join(lines)


class _Read:
    """A figure in the unit that people read: slopes px per unit, their median, tolerances for the pixels allowed.

    plain: (n,) how far the RMS of the trials is from the analytic one; worst: where most. deviation: of the Monte Carlo
    with control variate, the largest. loose_tolerance: by the median, where the slope has no expectation.
    """

    def __init__(self, f: ErrorFigure, rms_px: float) -> None:
        self.unit, factor = ("deg", 180.0 / np.pi) if f.kind == "camera attitude" else ("mm", 1e3)
        self.factor = factor
        self.slope, self.monte_carlo, self.se = (x / factor for x in (f.slope, f.slope_monte_carlo, f.slope_se))
        median = float(np.median(f.rms / f.sigmas))
        self.median = median / factor
        self.deviation, self.plain = float(np.abs(f.deviation).max()), np.abs(f.rms / f.analytic - 1)
        self.worst = int(np.argmax(self.plain))
        own = f.slope if np.isfinite(f.slope) else median
        self.tolerance, self.of_three = (factor * tolerance(x, own) for x in (rms_px, rms_px / np.sqrt(3.0)))
        self.loose_tolerance = factor * tolerance(rms_px, median)


def _entry(f: ErrorFigure, rms_px: float) -> dict[str, object]:
    r = _Read(f, rms_px)
    return dict(plain({
        "kind": f.kind, "nearest_mm": 1e3 * f.field.nearest_m, f"sigma_{r.unit}": r.factor * f.sigmas,
        "monte_carlo_px": f.rms, "standard_error_px": f.rms_se, "controlled_px": f.controlled,
        "controlled_standard_error_px": f.controlled_se, "same_draws_px": f.same_draws, "analytic_px": f.analytic,
        f"slope_px_per_{r.unit}": r.slope, f"slope_monte_carlo_px_per_{r.unit}": r.monte_carlo,
        f"slope_standard_error_px_per_{r.unit}": r.se, f"slope_median_px_per_{r.unit}": r.median,
        "largest_deviation": r.deviation, "effective_trials": f.effective, f"tolerance_{r.unit}": r.tolerance,
        f"tolerance_of_three_{r.unit}": r.of_three,
    }))  # fmt: skip


def error_analysis_job(
    out: Path | None = None, *, n_trials: int = 10_000, seed: int = 0, rms_px: float = 5.0
) -> ErrorAnalysis:
    """Simulate all figures; writes ``error_analysis.html`` and its SVG pictures below ``out``. Raises SurveyError."""
    if not rms_px > 0.0:
        raise SurveyError(f"found {rms_px:g} px; the pixel error that is allowed must be positive")
    begin = time.perf_counter()
    bounded, paper = error_figures((BOUNDED, PAPER), n_trials, seed)
    result = ErrorAnalysis(bounded, paper, rms_px, n_trials, seed, time.perf_counter() - begin)
    if out is not None:
        files = {f"figure_{_NUMBERS[f.kind]}.svg": d.standalone(_drawn(f)) for f in bounded}
        result.paths.update(write_set(Path(out), {**files, "error_analysis.html": _page(result)}))
    return result


def _drawn(f: ErrorFigure) -> Markup:
    r = _Read(f, 1.0)
    x = r.factor * f.sigmas
    title = f"Figure {_NUMBERS[f.kind]}: {f.kind} error"
    if np.isfinite(f.slope):
        lines = [
            Series("Monte Carlo ± s.e.", x, f.rms, d.RED, error=f.rms_se),
            Series("analytic", np.concatenate([[0.0], x]), np.concatenate([[0.0], f.analytic]), d.BLUE, line=True),
        ]
    else:
        lines = [
            Series("Monte Carlo", x, f.rms, d.RED),
            Series("first order, same draws", x, f.same_draws, d.BLUE, line=True),
        ]
    return chart(lines, title, f"sigma of each component [{r.unit}]", "RMS error of u [px]")


def _page(a: ErrorAnalysis) -> str:
    rows = [
        (_NUMBERS[f.kind], f.kind, fixed(r.slope, 4), f"{fixed(r.monte_carlo, 4)} ± {fixed(r.se, 4)}",
         *(f"{fixed(100 * x, 2)} %" for x in (r.deviation, r.plain.max(), (f.rms_se / f.rms).max())),
         *(f"{general(x, 3)} {r.unit}" for x in (r.tolerance, r.of_three)))
        for f, r in ((f, _Read(f, a.rms_px)) for f in a.bounded)
    ]  # fmt: skip
    columns = ("Figure", "<Error of", "Analytic slope", "Monte Carlo slope", "Worst point", "Plain worst",
               "Its s.e. up to", f"Alone for {a.rms_px:g} px", "One of three")  # fmt: skip
    note = (
        f"Table 1 of the paper: alpha = 1600 px, principal point (640, 512), {a.n_trials:,} trials a point. Beacons "
        f"uniform over what the camera sees from {1e3 * a.bounded[0].field.nearest_m:.0f} to 1000 mm. Slopes in px per "
        "mm or degree. Worst point: largest deviation of the Monte Carlo with control variate from the analytic RMS; "
        "plain: of the RMS of the trials as they are, which is uncertain by its standard error."
    )
    body = figures(map(_drawn, a.bounded)) + table(columns, rows)
    first = section("bounded", "Figures 4 to 6, beacons not nearer than 100 mm", body, note)
    lines = [
        (_NUMBERS[f.kind], f.kind, general(r.median, 3), f"{np.median(f.effective):,.0f}",
         f"{general(r.loose_tolerance, 3)} {r.unit}")
        for f, r in ((f, _Read(f, a.rms_px)) for f in a.paper)
    ]  # fmt: skip
    said = (
        "As the paper has it, beacons may be anywhere from depth 0 on. The mean of 1/Z² is then infinite: the RMS of "
        "position errors has no expectation, and a handful of near beacons decides it. Effective: how many of the "
        "trials carry the sum. The paper's conclusion, less than 1 mm and less than 0.17° for several pixels, is the "
        "last column."
    )
    few = ("Figure", "<Error of", "Median slope", "Effective trials", f"Tolerance for {a.rms_px:g} px")
    pictures = figures(map(_drawn, a.paper))
    second = section("paper", "As printed, beacons from depth 0", pictures + table(few, lines), said)
    return html_page("Error analysis", "Pixel error by errors of beacons and cameras", [first, second])
