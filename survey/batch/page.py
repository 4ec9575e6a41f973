"""The overview of a batch as one HTML page: what failed and why, what the tests say, trends with control charts."""

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from survey.batch.charts import control_chart
from survey.batch.control import ONE_SIDE, TREND, Chart
from survey.batch.record import CAUSES, FAILED, TEST_FAILED, Record
from survey.batch.run import counts
from survey.batch.tables import MOST_OUTSIDE, folders_csv, overview_json, short_names, trends_csv
from survey.batch.trends import LEVEL, Trends
from survey.folder.replacing import write_set
from survey.folder.text import time_text
from survey.report import markup as m
from survey.report.language import group_name, known, message, speaking, t

_MOST_CHARTS, _LEAST_CHARTS = 24, 6
_MOST_MORE = 120
_MOST_WARNINGS = 3


def overview_html(
    records: Sequence[Record], trends: Trends, place: Path, date: str = "", in_language: str = "en"
) -> str:
    """The page, whose links are relative to its folder ``place``. Raises SurveyError for a language there is not."""
    with speaking(in_language):
        made = (
            ("failures", "Failures", _failures(records, place)),
            ("tests", "Global tests", _tests(records, place)),
            ("control", "Control charts", _control(records, trends)),
            ("numbers", "All numbers", _numbers(trends, records)),
            ("folders", "Folders", _folders(records, place)),
        )
        nav = m.part("nav", [(anchor, t(name)) for anchor, name, body in made if body])
        shown = _header(records, trends, date) + nav + m.joined((body for _, _, body in made), "\n")
        return m.document(t("Overview of {n} surveys", n=m.count(len(records))), shown)


def _header(records: Sequence[Record], trends: Trends, date: str) -> Markup:
    n = counts(records)
    alarming = trends.alarming
    if n["failed"]:
        kind, word = "failed", t("{n} failed", n=m.count(n["failed"]))
    elif n["test_failed"] or alarming:
        kind, word = "check", t("Needs a look")
    else:
        kind, word = "passed", t("In control")
    said = t(
        "{failed} of {n} surveys could not be adjusted, {tested} fail their global test; {k} of {m} numbers are not in "
        "control over the epochs.",
        failed=m.count(n["failed"]), n=m.count(n["folders"]), tested=m.count(n["test_failed"]),
        k=m.count(len(alarming)), m=m.count(len(trends.charts)),
    )  # fmt: skip
    seconds = sum(r.seconds for r in records if r.origin == "adjusted")
    cards = (
        (m.count(n["folders"]), t("surveys")), (m.count(n["done"]), t("passed")),
        (m.count(n["test_failed"]), t("does not fit")), (m.count(n["failed"]), t("not adjusted")),
        (m.count(n["not_adjusted_again"]), t("unchanged, not adjusted again")),
        (t("{n} s", n=m.fixed(seconds, 1)), t("time of all adjustments")),
    )  # fmt: skip
    title = t("Overview of {n} surveys", n=m.count(len(records)))
    head = m.part("header", t("Overview of a batch"), title, date)
    return m.joined((head, m.part("verdict", kind, word, said), m.part("cards", cards)))


def _link(record: Record, name: str, place: Path) -> Markup:
    report = record.written.get("report.html")
    if not report:
        return m.element("b", name)
    return m.part("link", quote(os.fsencode(Path(os.path.relpath(report, place)).as_posix())), name)


def _failures(records: Sequence[Record], place: Path) -> Markup:
    rows = [
        (_link(r, name, place), m.pill("bad", t(CAUSES[r.cause])), _wrapped(message(r.error).split("\n")), str(r.tries))
        for r, name in zip(records, short_names(records), strict=True)
        if r.state == FAILED
    ]
    note = t("What could not be adjusted, where the error is and what to do. Everything else was adjusted as usual.")
    columns = ("<Survey", "<Why", "<Message", "Tries")
    return m.section("failures", "Failures", m.table(columns, rows) if rows else "", note)


def _wrapped(lines: Sequence[str]) -> Markup:
    return m.element("div", m.part("lines", lines), "words")


def _tests(records: Sequence[Record], place: Path) -> Markup:
    rows = []
    for r, name in zip(records, short_names(records), strict=True):
        if r.state == TEST_FAILED:
            test = r.summary["global_test"]
            interval = f"{m.fixed(test['lower'], 0)} – {m.fixed(test['upper'], 0)}"
            rows.append((_link(r, name, place), m.fixed(r.summary["sigma0"], 3), m.fixed(test["omega"], 1), interval,
                         _worst_group(r), _wrapped(_why(r))))  # fmt: skip
    columns = ("<Survey", "sigma0", "v'Pv", "expected", "<Worst group", "<Why")
    note = t(
        "Solved, but the residuals are larger than the sigmas say. Worst group: the one whose weighted square sum is "
        "furthest above its expectation, with the factor that its sigmas would need."
    )
    return m.section("tests", "Global tests", m.table(columns, rows) if rows else "", note)


def _worst_group(record: Record) -> str:
    found = [(g.get("deviation") or 0.0, name, g.get("sigma_scale")) for name, g in record.groups.items()]
    if not found:
        return m.MISSING
    _, name, scale = max(found)
    return f"{group_name(name)} × {m.fixed(scale, 2)}"


def _why(record: Record) -> list[str]:
    warnings = [w for w in record.warnings if not w.startswith("global test failed")]  # which the reason says
    said = [record.summary.get("reason", ""), *warnings[:_MOST_WARNINGS]]
    more = len(warnings) - _MOST_WARNINGS
    lines = [line for s in said if s for line in message(s).split("\n")]
    return lines + ([t("{n} more warnings in solution.json.", n=m.count(more))] if more > 0 else [])


def _control(records: Sequence[Record], trends: Trends) -> Markup:
    if not trends.charts:
        return Markup()
    alarming = trends.alarming
    quality = [c for c in trends.charts if c.series.name == "sigma0" and c not in alarming]
    shown = [*quality, *alarming[:_MOST_CHARTS]]
    shown += [c for c in trends.charts if c not in shown][: max(0, _LEAST_CHARTS - len(shown))]
    shown_names = {c.series.name for c in shown}
    calm = [c for c in trends.charts if c.series.name not in shown_names]
    note = t(
        "Deviations from the weighted mean of the epochs in control (hollow: set aside). Band: three sigmas as each "
        "epoch claims them; dashed: three sigmas from the scatter (median moving range). Red: outside of its own "
        "sigmas, orange: outside of the scatter alone; orange line: {side} in a row on one side, or {trend} steadily "
        "up or down. A cross is an epoch without result. Chance alone puts {expected} of all {n} points outside.",
        side=ONE_SIDE, trend=TREND, expected=m.general(trends.expected, 2), n=m.count(trends.n_points),
    )  # fmt: skip
    body = _figures(shown, records)
    if calm:
        rest = t("{n} more charts", n=m.count(len(calm[:_MOST_MORE])))
        body += m.part("details", rest, _figures(calm[:_MOST_MORE], records), False)
    said = m.joined(m.element("p", message(n)) for n in trends.notes)
    return m.section("control", "Control charts", said + body, note)


def _figures(charts: Sequence[Chart], records: Sequence[Record]) -> Markup:
    names = short_names(records)
    failed = [i for i, r in enumerate(records) if r.state == FAILED]
    return m.figures(control_chart(c, names, failed, _title(c)) for c in charts)


def _title(c: Chart) -> str:
    kind, *rest = c.series.name.split("/")
    return " · ".join((known(kind.replace("_", " ")).rstrip(":"), *rest))


def _numbers(trends: Trends, records: Sequence[Record]) -> Markup:
    names = short_names(records)
    rows, classes = [], []
    for c in trends.charts:
        alarming = trends.is_alarming(c)
        classes.append("suspect" if alarming else "")
        spread = c.by_scatter / 3.0
        rows.append((
            m.element("b", _title(c)), c.series.unit, str(len(c.series.value)), m.value_text(c.mean, c.mean_sigma),
            m.sigma_text(c.mean_sigma), m.sigma_text(float(np.median(c.series.sigma))), m.sigma_text(spread),
            m.fixed(c.ratio, 2), m.general(c.p, 2), _slope(c), m.general(c.p_slope, 2), _alarm(trends, c, names),
        ))  # fmt: skip
    columns = ("<Number", "<Unit", "n", "Mean", "σ", "σ of one", "Scatter", "Ratio", "p", "Per epoch", "p", "<Finding")
    note = t(
        "σ of one: median of what the epochs claim. Scatter: sigma from the moving range. Ratio: deviations over their "
        "sigmas, 1 where sigmas can be believed; p: that chance makes it so large. Per epoch: slope, and p of none. "
        "Marked where a test fails at {level} % for all numbers together, or a run is too long for chance.",
        level=m.general(100 * LEVEL),
    )  # fmt: skip
    return m.section("numbers", "All numbers", m.table(columns, rows, "", classes) if rows else "", note)


def _slope(c: Chart) -> Markup:
    return m.part("below", m.value_text(c.slope, c.slope_sigma), f"± {m.sigma_text(c.slope_sigma)}")


def _alarm(trends: Trends, c: Chart, names: Sequence[str]) -> Markup:
    words = {"disagrees": ("bad", t("epochs disagree")), "drifts": ("warn", t("drift")),
             "one_side": ("soft", t("on one side")), "rising": ("soft", t("rising")),
             "falling": ("soft", t("falling"))}  # fmt: skip
    out: list[str] = []
    for f in trends.findings(c):
        epochs = [names[i] for i in f.epochs]
        if f.kind == "outside":
            out.append(f"{t('outside:')} {', '.join(epochs[:MOST_OUTSIDE])}{' …' * (len(epochs) > MOST_OUTSIDE)}")
        else:
            pill = m.pill(*words[f.kind])
            out.append(m.joined((pill, f"{epochs[0]} – {epochs[-1]}"), " ") if epochs else pill)
    return _wrapped([m.joined(out, " ")]) if out else Markup()


def _folders(records: Sequence[Record], place: Path) -> Markup:
    rows, classes = [], []
    for r, name in zip(records, short_names(records), strict=True):
        s = r.summary
        verdict = s.get("verdict", "failed")
        word = {"passed": t("Passed"), "check": t("Needs a look"), "failed": t("Failed")}[verdict]
        kind = {"passed": "good", "check": "warn", "failed": "bad"}[verdict]
        origin = {"adjusted": t("adjusted"), "unchanged": t("unchanged"), "resumed": t("as before")}[r.origin]
        numbers = [m.count(s[k]) if k in s else m.MISSING for k in ("n_observations", "n_unknowns", "redundancy")]
        not_used = s.get("suspects", {}).get("n_not_used")
        seconds = m.fixed(r.seconds, 2) if r.origin == "adjusted" else m.MISSING
        said = message(r.error or s.get("reason", "")).splitlines()[0] if (r.error or s.get("reason")) else ""
        classes.append("suspect" if r.state == FAILED else "")
        title = m.element("span", s["title"], "s") if s.get("title") else Markup()
        rows.append((_link(r, name, place) + title, m.pill(kind, word), _wrapped([said]), m.fixed(s.get("sigma0"), 3),
                     *numbers, m.MISSING if not_used is None else m.count(not_used), origin, seconds))  # fmt: skip
    columns = ("<Survey", "<", "<Reason", "sigma0", "n", "u", "Redundancy", "Not used", "<", "s")
    note = t("n observations, u unknowns. A name leads to the survey's own report.")
    return m.section("folders", "Folders", m.table(columns, rows, "", classes), note)


def write_overview(place: Path, records: Sequence[Record], trends: Trends, language: str = "en") -> dict[str, Path]:
    """Write overview.html, overview.json, folders.csv and trends.csv into ``place``; the paths by name."""
    date = time_text()
    place = Path(place).absolute()
    texts = {
        "folders.csv": folders_csv(records),
        "trends.csv": trends_csv(records, trends),
        "overview.html": overview_html(records, trends, place, date, language),
        "overview.json": overview_json(records, trends),
    }
    return write_set(place, texts)
