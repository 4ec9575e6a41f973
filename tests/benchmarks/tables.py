"""Measurements as tables of text, in Markdown, so that the terminal and the document show the same."""

from collections.abc import Sequence

import cv2
import numpy as np

from adjust.model.survey import FloatArray
from tests.benchmarks.children import Measured
from tests.benchmarks.data import Calibration


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with columns as wide as their longest entry."""
    cells = [list(head), *[list(row) for row in rows]]
    width = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, width, strict=True)) + " |" for row in cells]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in width) + "|")
    return "\n".join(lines)


def seconds(value: float) -> str:
    """Three digits."""
    return "-" if not np.isfinite(value) else f"{value:.4f}" if value < 0.1 else f"{value:.3g}"


def ratio(measured: Measured, reference: Measured) -> str:
    """How many times longer than the reference, run by run: median and range."""
    if not measured.seconds or not reference.seconds:
        return "-"
    n = min(len(measured.seconds), len(reference.seconds))
    each = np.array(measured.seconds[:n]) / np.array(reference.seconds[:n])
    return f"{np.median(each):.2f} ({each.min():.2f} to {each.max():.2f})"


def times_as_long(measured: Measured, reference: Measured) -> float:
    """Median of the ratios of processor time, run by run; nan where one of them did not run.

    By processor time, since a busy machine disturbs it least; alone, with one thread, it is the time that passes.
    """
    n = min(len(measured.cpu), len(reference.cpu))
    return float(np.median(np.array(measured.cpu[:n]) / np.array(reference.cpu[:n]))) if n else float("nan")


def times(found: Sequence[Measured], reference: Measured) -> str:
    """Time, spread, processor time, ratio and memory of all competitors."""
    rows = []
    for m in found:
        if m.failed or not m.seconds:
            rows.append([m.name, "-", "-", "-", "-", "-", "-", m.failed])
            continue
        spread = f"{seconds(min(m.seconds))} to {seconds(max(m.seconds))}"
        rows.append([
            m.name, seconds(m.median), spread, seconds(float(np.median(m.cpu))), str(len(m.seconds)),
            ratio(m, reference), f"{m.peak_mb:.0f} (+{m.peak_mb - m.idle_mb:.0f})", m.note,
        ])  # fmt: skip
    head = ("", "s (median)", "range", "CPU s", "runs", f"ratio to “{reference.name}”", "peak MB (+ by the run)", "")
    return table(head, rows)


def chi_square(case: Calibration, solution: dict[str, FloatArray]) -> float:
    """v'Pv of a solution, projected by OpenCV; nan where it has no poses of the boards."""
    if "head_from_board" not in solution:
        return float("nan")
    total = 0.0
    for c, e, uv in zip(case.camera, case.epoch, case.uv, strict=True):
        m = solution["camera_from_head"][c] @ solution["head_from_board"][e]
        lens = solution["lens"][c]
        k = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
        x = case.board @ m[:3, :3].T + m[:3, 3]
        predicted = cv2.projectPoints(x, np.zeros(3), np.zeros(3), k, lens[4:])[0][:, 0]
        total += float(np.sum((predicted - uv) ** 2))
    return total / float(case.sigma_px) ** 2


def optima(case: Calibration, found: Sequence[Measured], tight: Measured, sigmas: FloatArray) -> str:
    """How far every competitor's lens lies from the optimum, in px and in sigmas, and what its v'Pv exceeds it by."""
    rows, best = [], chi_square(case, tight.solution)
    for m in found:
        if "lens" not in m.solution or m is tight:
            continue
        d = np.abs(m.solution["lens"] - tight.solution["lens"])
        excess = chi_square(case, m.solution) - best
        rows.append([m.name, f"{d[:, :4].max():.1e}", f"{d[:, 4:].max():.1e}", f"{(d / sigmas).max():.1e}",
                     "-" if np.isnan(excess) else f"{excess:+.1e}"])  # fmt: skip
    head = ("", "largest difference, px", "of coefficients", "in sigmas", f"v'Pv above {best:.6f}")
    return table(head, rows)


def stages(found: Sequence[Measured]) -> str:
    """Median seconds of every stage."""
    names = list(dict.fromkeys(s for m in found for s in m.stages))
    rows = [
        [m.case, m.name, *[seconds(float(np.median(m.stages[s]))) if s in m.stages else "" for s in names]]
        for m in found
    ]
    return table(("case", "", *names), rows)


def against(found: dict[str, Measured], ours: str, others: Sequence[str], what: str) -> str:
    """One sentence: how many times as long as ours (which is ``what``) the others take, run by run."""
    parts = [f"{name} {ratio(found[name], found[ours])}" for name in others if name in found and found[name].seconds]
    return f"“{ours}” ({what}) against: {'; '.join(parts)} times its time."
