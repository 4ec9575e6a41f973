"""The section on what people left out: each exclusion with its reason, who, when, and how it would fit now."""

from typing import Any

from survey.report.context import Context
from survey.report.language import t
from survey.report.markup import MISSING, count, esc, fixed, pill, section, table


def excluded(c: Context) -> str:
    """Rows of exclusions.csv in force, as they stand there; empty where nothing was left out by anybody."""
    found, out = c.solution["exclusions"], c.solution["left_out"]
    if not found and not any(out.values()):
        return ""
    limit = c.solution["summary"]["suspects"]["standardized_limit"]
    columns = ("<What", "<Reason", "<Who", "<When", "Images", "Image points", "Readings", "Largest |w| now", "<")
    rows = table(columns, [_row(e, limit) for e in found]) if found else ""
    note = t(
        "{people} observations are left out by people (observations/exclusions.csv), {files} only by used = false in "
        "their table, {run} by this adjustment. What is left out is predicted and tested as long as the others "
        "determine it: a small residual says that it would fit now.",
        people=count(out["by_people"]), files=count(out["in_files"]), run=count(out["in_this_run"]),
    )  # fmt: skip
    return section("excluded", "Excluded by people", rows or f"<p>{t('Nothing is excluded by people.')}</p>", note)


def _row(e: dict[str, Any], limit: float) -> tuple[str, ...]:
    w = e["largest_standardized_residual"]
    reason = esc(e["reason"]) if e["reason"] else pill("soft", t("no reason given"))
    meets = e["n_image_points"] + e["n_spots"] + e["n_readings"]
    flag = pill("soft", t("names nothing")) if not meets else "" if w is None else (
        pill("quiet", t("fits now")) if w <= limit else pill("soft", t("does not fit"))
    )  # fmt: skip
    return (
        f"<code>{esc(e['name'])}</code>", reason, esc(e["author"]), esc(e["time"]), count(e["n_images"]),
        count(e["n_image_points"] + e["n_spots"]), count(e["n_readings"]), MISSING if w is None else fixed(w, 1), flag,
    )  # fmt: skip
