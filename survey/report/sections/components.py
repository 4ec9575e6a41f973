"""Tables of the components of lenses, tables, warps and clocks, with what is significant about them."""

from collections.abc import Iterator
from typing import Any

from markupsafe import Markup

from survey.report import markup as m
from survey.report.language import known, t
from survey.solution.quantities import Status


def status_pill(status: Status) -> Markup:
    """The status of a component, or of a whole parameter."""
    if isinstance(status, dict):
        return m.joined((m.joined((k, status_pill(v)), " ") for k, v in status.items()), " ")
    return m.pill(
        {"free": "quiet", "held": "plain", "prior": "soft", "tied": "soft"}.get(status, "quiet"), known(status)
    )


def components_of(entry: dict[str, Any]) -> Iterator[tuple[str, float | None, str, float | None, str, str]]:
    """Name, value, unit, sigma, its unit and status of every component of a vector entry."""
    for name, status in entry["status"].items():
        value_key = next(k for k in entry if k == name or k.startswith(f"{name}_"))
        sigma_key = next(k for k in entry if k == f"sigma_{name}" or k.startswith(f"sigma_{name}_"))
        unit, sigma_unit = value_key[len(name) + 1 :], sigma_key[len(name) + 7 :]
        yield name, entry[value_key], unit, entry[sigma_key], sigma_unit, status


def value_in(unit: str, value: float | None, sigma: float | None, sigma_unit: str) -> str:
    """A value with decimals that suit a sigma in another unit."""
    same = sigma / 3600.0 if (unit, sigma_unit) == ("deg", "arcsec") and sigma else sigma
    return m.value_text(value, same)


def vector_table(entry: dict[str, Any], ratios: dict[str, float] | None = None) -> Markup:
    """Components of a lens, a table or a warp; ``ratios`` adds the column of significance."""
    rows, idle = [], []
    for name, value, unit, sigma, sigma_unit, status in components_of(entry):
        if status == "held" and not value:
            idle.append(m.code(name))
            continue
        row: list[str] = [m.code(name), value_in(unit, value, sigma, sigma_unit), m.sigma_text(sigma)]
        shown = unit if unit == sigma_unit else f"{unit} (σ {sigma_unit})"
        row += [shown.replace("_", " "), status_pill(status)]
        if ratios is not None:
            ratio = ratios.get(name)
            weak = name in entry.get("not_significant", ())
            row.append(m.pill("warn", m.fixed(ratio, 1)) if weak else m.fixed(ratio, 1))
        rows.append(row)
    columns = ["<Parameter", "Value", "σ", "<Unit", "<Status"] + ([] if ratios is None else ["|value| / σ"])
    at_zero = m.note(t("Held at zero: {names}.", names=m.joined(idle, ", "))) if idle else Markup()
    return (m.table(columns, rows) if rows else Markup()) + at_zero + tests_of(entry.get("significance", {}))


def tests_of(found: dict[str, Any]) -> Markup:
    """Which terms of a model differ from zero, and which do not."""
    parts = []
    for term, test in found.items():
        kind = m.pill("quiet", t("significant")) if test["significant"] else m.pill("warn", t("not significant"))
        if term == "lens_shared":
            kind = m.pill("warn", t("does not hold")) if test["significant"] else m.pill("quiet", t("holds"))
        said = t("{term}: {statistic} with {freedom} degrees of freedom, p {p}", term=term.replace("_", " "),
                 statistic=m.general(test["statistic"], 4), freedom=", ".join(map(m.count, test["freedom"])),
                 p=m.general(test["p_value"], 2))  # fmt: skip
        parts.append(m.note(m.joined((kind, said), " ")))
    return m.joined(parts)
