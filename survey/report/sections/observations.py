"""Sections on what was observed: residuals and tests, the worst first; what people left out, and why."""

import math
from typing import Any

from markupsafe import Markup

from adjust.model.result import ObservationResidual
from survey.report.context import Context, other_components, worst
from survey.report.language import group_name, known, t
from survey.report.markup import (
    MISSING,
    code,
    count,
    element,
    fixed,
    general,
    joined,
    more,
    pill,
    section,
    sigma_text,
    table,
    value_text,
)
from survey.solution.quantities import units_for_people

_MOST_OTHER = 200
_MOST_IMAGE = 30
_MOST_IMAGES = 10


def _flag(used: bool, suspect: bool) -> str:
    if not used:
        return pill("soft", t("not used"))
    return pill("bad", t("suspect")) if suspect else ""


def _row_class(used: bool, suspect: bool) -> str:
    return "off" if not used else "suspect" if suspect else ""


def others(c: Context) -> Markup:
    """Everything but image points, one row per component, sorted by |standardized residual|."""
    limit = c.solution["summary"]["suspects"]["standardized_limit"]
    observation, component, w = other_components(c.adjustment)
    order = worst(w, _MOST_OTHER)  # what cannot be tested (no redundancy, no number) comes last
    shown_rows = [(c.adjustment.other_residuals[observation[k]], int(component[k]), abs(w[k]) > limit) for k in order]
    rows = [_other_row(*row) for row in shown_rows]
    classes = [_row_class(o.used, suspect) for o, _, suspect in shown_rows]
    columns = (
        "<Kind", "<Between", "<Component", "Observed", "Adjusted", "<Unit", "Residual", "σ", "<Unit", "Redundancy",
        "Standardized", "<",
    )  # fmt: skip
    shown = {"shown": count(len(rows)), "n": count(len(w))}
    note = t(
        "Suspect: |standardized residual| above {limit}. Sigmas are those given to the program.", limit=fixed(limit, 2)
    )
    if len(w) > len(rows):
        note += " " + t("The worst {shown} of {n} rows; all in residuals_other.csv.", **shown)
    return section("observations", "Other observations", table(columns, rows, "", classes) if rows else "", note)


def _other_row(o: ObservationResidual, i: int, suspect: bool) -> list[str]:
    unit, factor, sigma_unit, sigma_factor = units_for_people(o.components[i], o.units[i])
    shown_sigma = float(o.sigma[i] * factor)
    residual, sigma = float(o.residual[i] * sigma_factor), float(o.sigma[i] * sigma_factor)
    # an r of zero means that nothing controls the observation: its residual says nothing
    flag = [] if o.redundancy[i] > 0.05 else [pill("warn", t("uncontrolled"))]
    redundancy = joined((fixed(o.redundancy[i], 2), *flag), " ")
    word = known(o.kind.replace("_", " "))
    kind = word if o.group == o.kind else joined((word, element("small", group_name(o.group))), " ")
    return [
        kind, " · ".join(o.ids), code(o.components[i]),
        value_text(float(o.observed[i] * factor), shown_sigma), value_text(float(o.adjusted[i] * factor), shown_sigma),
        unit, value_text(residual, sigma), sigma_text(sigma), sigma_unit, redundancy,
        fixed(o.standardized[i], 2), _flag(o.used, suspect),
    ]  # fmt: skip


def image_points(c: Context) -> Markup:
    """The image points with the largest test, and the images with the largest residuals."""
    found, blocks = c.adjustment.image_residuals, c.adjustment.survey.image_blocks
    rows, classes = [], []
    for k in worst(found.test, _MOST_IMAGE):
        block = blocks[c.rows.block[k]]
        used, suspect = bool(found.used[k]), bool(c.suspect[k])
        values = (*c.rows.uv[k], *found.residuals[k], *found.standardized[k])
        numbers = [fixed(v, n) for v, n in zip(values, (2, 2, 3, 3, 2, 2), strict=True)]
        names = (block.camera_id, block.epoch_id, block.target_id or "world", c.rows.point_ids[c.rows.point[k]])
        redundancy = [fixed(r, 2) for r in found.redundancy[k]]
        rows.append([*names, *numbers, *redundancy, fixed(found.test[k], 2), _flag(used, suspect)])
        classes.append(_row_class(used, suspect))
    columns = (
        "<Camera", "<Epoch", "<Target", "<Point", "u [px]", "v [px]", "res. u [px]", "res. v [px]", "std. u", "std. v",
        "red. u", "red. v", "Test", "<",
    )  # fmt: skip
    s, n = c.solution["summary"]["suspects"], count(len(found.test))
    note = t(
        "The {shown} largest of {n}. Test: chi-square with 2 degrees of freedom, suspect above {limit} ({alpha} % "
        "together). The others are in residuals.csv.",
        shown=len(rows), n=n, limit=fixed(s["image_test_limit"], 1), alpha=general(100 * s["alpha"]),
    )  # fmt: skip
    body = table(columns, rows, "", classes) + _images(c) if rows else ""
    return section("image-points", "Image points", body, note)


def _images(c: Context) -> Markup:
    images = {camera_id: camera["images"] for camera_id, camera in c.solution["cameras"].items()}
    every = [(camera_id, epoch, rms) for camera_id, of in images.items()
             for epoch, rms in of.numbers("rms_residual_px").items() if not math.isnan(rms)]  # fmt: skip
    rows = [[camera, epoch, count(images[camera][epoch]["n_image_points"]), fixed(rms, 3)]
            for camera, epoch, rms in sorted(every, key=lambda x: -x[2])[:_MOST_IMAGES]]  # fmt: skip
    columns = ("<Camera", "<Epoch", "Points", "RMS residual [px]")
    return element("h3", t("Images with the largest residuals")) + table(columns, rows) if rows else Markup()


def excluded(c: Context) -> Markup:
    """Rows of exclusions.csv in force, as they stand there; empty where nothing was left out by anybody."""
    found, out = c.solution["exclusions"], c.solution["left_out"]
    if not found and not any(out.values()):
        return Markup()
    limit = c.solution["summary"]["suspects"]["standardized_limit"]
    columns = ("<What", "<Reason", "<Who", "<When", "Images", "Image points", "Readings", "Largest |w| now", "<")
    rows = table(columns, [_excluded_row(e, limit) for e in found[:_MOST_OTHER]]) if found else Markup()
    note = t(
        "{people} observations are left out by people (observations/exclusions.csv), {files} only by used = false in "
        "their table, {run} by this adjustment. What is left out is predicted and tested as long as the others "
        "determine it: a small residual says that it would fit now.",
        people=count(out["by_people"]), files=count(out["in_files"]), run=count(out["in_this_run"]),
    )  # fmt: skip
    note += more(len(found) - _MOST_OTHER)
    return section("excluded", "Excluded by people", rows or element("p", t("Nothing is excluded by people.")), note)


def _excluded_row(e: dict[str, Any], limit: float) -> tuple[str, ...]:
    w = e["largest_standardized_residual"]
    reason = e["reason"] if e["reason"] else pill("soft", t("no reason given"))
    meets = e["n_image_points"] + e["n_spots"] + e["n_readings"]
    flag = pill("soft", t("names nothing")) if not meets else "" if w is None else (
        pill("quiet", t("fits now")) if w <= limit else pill("soft", t("does not fit"))
    )  # fmt: skip
    return (
        code(e["name"]), reason, e["author"], e["time"], count(e["n_images"]),
        count(e["n_image_points"] + e["n_spots"]), count(e["n_readings"]), MISSING if w is None else fixed(w, 1), flag,
    )  # fmt: skip
