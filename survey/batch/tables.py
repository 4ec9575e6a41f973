"""A batch as text: the table on the screen, ``overview.json``, ``folders.csv`` and ``trends.csv``."""

from collections.abc import Sequence

import numpy as np

from adjust.model.errors import listed
from adjust.model.survey import BoolArray
from survey.batch.control import Chart
from survey.batch.record import CAUSES, DONE, FAILED, TEST_FAILED, Record
from survey.batch.run import counts, exit_code
from survey.batch.trends import LEVEL, Trends
from survey.folder.plain import plain
from survey.folder.text import cell_text, csv_text, json_text

STATES = {DONE: "done", FAILED: "error", TEST_FAILED: "does not fit"}
_MOST_TOLD, MOST_OUTSIDE = 8, 5
_RUNS = {"one_side": "on one side of the mean", "rising": "rising", "falling": "falling"}


def row_of(record: Record) -> dict[str, object]:
    """What ``--json`` says of a folder: its summary, or why it failed."""
    row: dict[str, object] = {"folder": record.folder, "exit_code": record.exit_code, "origin": record.origin,
                           "tries": record.tries, "seconds": round(record.seconds, 3)}  # fmt: skip
    if record.state == FAILED:
        return row | {"cause": record.cause, "error": record.error}
    summary = {"folder": record.folder, "summary": dict(record.summary), "warnings": list(record.warnings),
               "written": dict(record.written)}  # fmt: skip
    return row | {"summary": summary}


def summary_table(records: Sequence[Record]) -> str:
    """One line per folder, for people, and the count at the end."""
    width = max(len("folder"), *(len(r.folder) for r in records))
    lines = [f"{'folder':<{width}}  {'state':<18}  sigma0  redundancy  time, s"]
    for r in records:
        numbers = f"{CAUSES[r.cause]}" if r.state == FAILED else ""
        if r.state != FAILED:
            sigma0 = r.summary.get("sigma0")
            shown = "-" if sigma0 is None else f"{sigma0:.3f}"
            seconds = f"{r.seconds:.2f}" if r.origin == "adjusted" else r.origin
            numbers = f"{shown:>6}  {r.summary['redundancy']:10d}  {seconds:>7}"
        lines.append(f"{r.folder:<{width}}  {STATES[r.state]:<18}  {numbers}".rstrip())
    return "\n".join([*lines, "", count_line(records)])


def count_line(records: Sequence[Record]) -> str:
    """How many ended how, in one line."""
    n = counts(records)
    parts = [f"{n['done']} done"]
    parts += [f"{n['test_failed']} do not fit"] if n["test_failed"] else []
    parts += [f"{n['failed']} failed"] if n["failed"] else []
    again = n["not_adjusted_again"]
    more = f"; {again} not adjusted again, their inputs are unchanged" if again else ""
    return f"{n['folders']} folders: {', '.join(parts)}{more}"


def trend_lines(trends: Trends, records: Sequence[Record]) -> list[str]:
    """The most alarming charts in words."""
    alarming, names = trends.alarming, short_names(records)
    lines = [f"  {c.series.name}: {'; '.join(findings(trends, c, names))}" for c in alarming[:_MOST_TOLD]]
    more = len(alarming) - len(lines)
    lines += [f"  and {more} more in the overview"] if more > 0 else []
    head = f"{len(alarming)} of {len(trends.charts)} numbers are not in control over the epochs"
    return [head + (":" if lines else ""), *lines, *(f"  ! {note}" for note in trends.notes)]


def short_names(records: Sequence[Record]) -> list[str]:
    """Names of the folders without the path that all share."""
    names = [r.folder.replace("\\", "/").rstrip("/") for r in records]
    parts = [n.split("/") for n in names]
    common = 0
    while parts and all(len(p) > common + 1 and p[common] == parts[0][common] for p in parts):
        common += 1
    return ["/".join(p[common:]) for p in parts]


def findings(trends: Trends, c: Chart, names: Sequence[str]) -> list[str]:
    """What is wrong with a chart, in words: English only, as result files are. names: of the folders, short."""
    unit = f" {c.series.unit}" if c.series.unit else ""
    out = []
    for kind, epochs in ((f.kind, [names[i] for i in f.epochs]) for f in trends.findings(c)):
        if kind in _RUNS:
            out.append(f"{len(epochs)} in a row {_RUNS[kind]}: {epochs[0]} to {epochs[-1]}")
        elif kind == "outside":
            out.append("outside: " + listed(epochs, MOST_OUTSIDE))
        elif kind == "drifts":
            out.append(f"drifts {c.slope:+.2g} ± {c.slope_sigma:.1g}{unit} per epoch")
        else:
            out.append(f"epochs differ {c.ratio:.1f} times as much as their sigmas say (p {c.p:.1g})")
    return out


def overview_json(records: Sequence[Record], trends: Trends) -> str:
    """All of the overview as JSON: counts, folders, charts."""
    names = short_names(records)
    charts = {c.series.name: _chart(trends, c, names) for c in trends.charts}
    value = {
        "counts": counts(records), "exit_code": exit_code(records), "folders": [row_of(r) for r in records],
        "trends": {"alpha_of_all_tests": LEVEL, "level_of_a_test": trends.level, "n_points": trends.n_points,
                   "points_outside_expected_by_chance": trends.expected, "notes": list(trends.notes),
                   "charts": charts},
    }  # fmt: skip
    return json_text(plain(value))


def _chart(trends: Trends, c: Chart, names: Sequence[str]) -> dict[str, object]:
    at = [names[int(i)] for i in c.series.epoch]

    def named(mask: BoolArray) -> list[str]:
        return [at[int(i)] for i in np.flatnonzero(mask)]

    runs = [{"kind": r.kind, "first": at[r.first], "last": at[r.last], "n": r.last - r.first + 1} for r in c.runs]
    return {
        "unit": c.series.unit, "n_epochs": len(at), "in_control": not trends.is_alarming(c),
        "findings": findings(trends, c, names), "mean": c.mean, "sigma_mean": c.mean_sigma,
        "limit_from_scatter": c.by_scatter, "outside_of_sigma_limits": named(c.outside),
        "outside_of_scatter_limits": named(c.outside_scatter), "set_aside": named(~c.used), "runs": runs,
        "rms_deviation_over_sigma": c.ratio, "p_agreement": c.p, "slope_per_epoch": c.slope,
        "sigma_slope": c.slope_sigma, "p_no_slope": c.p_slope,
        "epochs": [{"folder": n, "value": v, "sigma": s, "limit_from_sigma": b} for n, v, s, b in zip(
            at, c.series.value.tolist(), c.series.sigma.tolist(), c.by_sigma.tolist(), strict=True)],
    }  # fmt: skip


def folders_csv(records: Sequence[Record]) -> str:
    """One row per folder."""
    head = ("folder", "state", "exit_code", "origin", "verdict", "sigma0", "redundancy", "n_observations",
            "n_unknowns", "n_not_used", "tries", "seconds", "cause", "message")  # fmt: skip
    rows: list[Sequence[object]] = [head]
    for r in records:
        s = r.summary
        numbers = (s.get("verdict", ""), *(_cell(s.get(k)) for k in (
            "sigma0", "redundancy", "n_observations", "n_unknowns")), _cell(s.get("suspects", {}).get("n_not_used")))
        message = r.error or s.get("reason", "")
        rows.append((cell_text(r.folder), r.state, r.exit_code, r.origin, *numbers, r.tries, f"{r.seconds:.3f}",
                     cell_text(r.cause), cell_text(message)))  # fmt: skip
    return csv_text(rows)


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.12g}"


def trends_csv(records: Sequence[Record], trends: Trends) -> str:
    """One row per number and epoch, with both limits."""
    head = ("name", "unit", "folder", "value", "sigma", "mean", "limit_from_sigma", "limit_from_scatter",
            "outside_of_sigma_limits", "outside_of_scatter_limits")  # fmt: skip
    rows: list[Sequence[object]] = [head]
    for c in trends.charts:
        scatter = f"{c.by_scatter:.9g}" if np.isfinite(c.by_scatter) else ""
        for i, epoch in enumerate(c.series.epoch.tolist()):
            folder = cell_text(records[epoch].folder)
            rows.append((cell_text(c.series.name), c.series.unit, folder, f"{c.series.value[i]:.12g}",
                         f"{c.series.sigma[i]:.9g}", f"{c.mean:.12g}", f"{c.by_sigma[i]:.9g}", scatter,
                         int(c.outside[i]), int(c.outside_scatter[i])))  # fmt: skip
    return csv_text(rows)
