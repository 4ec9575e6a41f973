"""What explains that a survey does not fit: the causes that were tried, in a report or where nothing was adjusted."""

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from survey.report.context import Context
from survey.report.language import message, t
from survey.report.markup import code, fixed, general, joined, part, section, table


def diagnosis(c: Context) -> Markup:
    """The causes named by the diagnosis of this adjustment."""
    return causes(c.solution.get("diagnosis", ()), c.run.folder)


def causes(found: Sequence[dict[str, Any]], folder: str) -> Markup:
    """A table of causes, the first one first: entries of ``diagnosis`` of ``solution.json``."""
    if not found:
        return Markup()
    rows = [
        (
            str(number), message(x["cause"]), message(x["change"]), code(x["where"]) if x["where"] else "",
            fixed(100.0 * x["explained"], 0), general(x["statistic"], 3), general(x["critical"], 3),
            fixed(100.0 * x["probability"], 0), general(x["sigma0"], 3),
        )
        for number, x in enumerate(found, start=1)
    ]  # fmt: skip
    columns = ("<No.", "<Cause", "<Change", "<Where", "Explains [%]", "Test", "Limit", "Probability [%]", "sigma0 then")
    possible = [code(f"labsurvey adjust {folder} --try {i}") for i, x in enumerate(found, 1) if x["can_be_tried"]]
    said = t(
        "Each cause was tried: the survey adjusted with that one change. It explains the part given of the misfit "
        "beyond noise; the drop of v'Pv is tested against a limit that all causes looked at share. The probability "
        "compares the causes with each other and with the survey as it stands."
    )
    how = t("A program can do it, and it can be taken back: {commands}", commands=joined(possible, ", ")) \
        if possible else t("Only a person can do that.")  # fmt: skip
    return section("diagnosis", "Diagnosis", table(columns, rows) + part("element", "p", how, "lead"), said)
