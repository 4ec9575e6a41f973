"""The job behind ``labsurvey plan --error-analysis``: figures 4 to 6 of the head's paper, and tolerances from them."""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from markupsafe import Markup

from adjust.design.error_analysis import BeaconField, tolerance
from adjust.design.error_figures import ErrorFigure, error_figures
from adjust.model.errors import SurveyError
from survey.folder.plain import plain
from survey.folder.replacing import write_set
from survey.planning.page import html_page
from survey.report import drawing as d
from survey.report.charts import Series, chart
from survey.report.markup import figures, fixed, general, section, table

PAPER = BeaconField()
BOUNDED = BeaconField(nearest_m=0.1)
_NUMBERS = {"beacon position": "4", "camera position": "5", "camera attitude": "6"}


@dataclass(frozen=True, eq=False)
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
        for f in self.bounded:
            unit, factor = _unit(f)
            at = int(np.argmax(np.abs(f.rms / f.analytic - 1)))
            slopes = f"{f.slope / factor:>10.4f}{f.slope_monte_carlo / factor:>13.4f}{f.slope_se / factor:>8.4f}"
            lines.append(
                f"  {f.kind:<18}{slopes}"
                f"{100 * np.abs(f.deviation).max():>11.2f} %{100 * abs(f.rms[at] / f.analytic[at] - 1):>11.2f} %"
                f"{100 * f.rms_se[at] / f.rms[at]:>8.2f} %{factor * tolerance(self.rms_px, f.slope):>9.3f} {unit}"
            )
        lines += ["", "  as printed, beacons from 0 mm: the RMS of positions has no expectation, near beacons carry it"]
        for f in self.paper:
            unit, factor = _unit(f)
            slope = float(np.median(f.rms / f.sigmas))
            lines.append(
                f"  {f.kind:<18}{slope / factor:>10.2f} px per {unit} (median point), {np.median(f.effective):.0f} of "
                f"{f.n_trials} trials carry it; {factor * tolerance(self.rms_px, slope):.3f} {unit} for "
                f"{self.rms_px:g} px"
            )
        return "\n".join(lines)


def _unit(f: ErrorFigure) -> tuple[str, float]:
    return ("deg", 180.0 / np.pi) if f.kind == "camera attitude" else ("mm", 1e3)


def _entry(f: ErrorFigure, rms_px: float) -> dict[str, object]:
    unit, factor = _unit(f)
    median = float(np.median(f.rms / f.sigmas))
    slope = f.slope if np.isfinite(f.slope) else median
    return {
        "kind": f.kind, "nearest_mm": 1e3 * f.field.nearest_m,
        f"sigma_{unit}": (factor * f.sigmas).tolist(),
        "monte_carlo_px": f.rms.tolist(), "standard_error_px": f.rms_se.tolist(),
        "controlled_px": plain(f.controlled),
        "controlled_standard_error_px": plain(f.controlled_se),
        "same_draws_px": f.same_draws.tolist(), "analytic_px": plain(f.analytic),
        f"slope_px_per_{unit}": plain(f.slope / factor),
        f"slope_monte_carlo_px_per_{unit}": plain(f.slope_monte_carlo / factor),
        f"slope_standard_error_px_per_{unit}": plain(f.slope_se / factor),
        f"slope_median_px_per_{unit}": median / factor,
        "largest_deviation": float(np.abs(f.deviation).max()),
        "effective_trials": f.effective.tolist(),
        f"tolerance_{unit}": factor * tolerance(rms_px, slope),
        f"tolerance_of_three_{unit}": factor * tolerance(rms_px / np.sqrt(3.0), slope),
    }  # fmt: skip


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
    unit, factor = _unit(f)
    x = factor * f.sigmas
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
    return chart(lines, title, f"sigma of each component [{unit}]", "RMS error of u [px]")


def _page(a: ErrorAnalysis) -> str:
    rows = []
    for f in a.bounded:
        unit, factor = _unit(f)
        three = factor * tolerance(a.rms_px / np.sqrt(3.0), f.slope)
        rows.append((
            f"{_NUMBERS[f.kind]}", f.kind, fixed(f.slope / factor, 4),
            f"{fixed(f.slope_monte_carlo / factor, 4)} ± {fixed(f.slope_se / factor, 4)}",
            fixed(100 * float(np.abs(f.deviation).max()), 2) + " %",
            fixed(100 * float(np.abs(f.rms / f.analytic - 1).max()), 2) + " %",
            fixed(100 * float((f.rms_se / f.rms).max()), 2) + " %",
            f"{general(factor * tolerance(a.rms_px, f.slope), 3)} {unit}", f"{general(three, 3)} {unit}",
        ))  # fmt: skip
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
    lines = []
    for f in a.paper:
        unit, factor = _unit(f)
        slope = float(np.median(f.rms / f.sigmas))
        allowed = f"{general(factor * tolerance(a.rms_px, slope), 3)} {unit}"
        carried = f"{np.median(f.effective):,.0f}"
        lines.append((_NUMBERS[f.kind], f.kind, general(slope / factor, 3), carried, allowed))
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
