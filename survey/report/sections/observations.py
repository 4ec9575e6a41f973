"""Sections on what was observed: residuals and tests, the worst first; what people left out, and why; every row.

The table of all observations has a row for each component, with what auditors of adjustments ask for: the value, its
sigma a priori, the adjusted value and its sigma, residual, redundancy number, Baarda's w, estimated gross error,
minimal detectable bias and what that would do to the unknowns. Of more than ``MOST`` rows the page has the worst, the
tables beside it all.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from adjust.model.result import ObservationResidual
from adjust.model.survey import FloatArray, IntArray
from adjust.native.text import NUMBERS, TEXT, Words, record_rows
from survey.project.observed import name_of_residual
from survey.report.context import Context, Listed, other_components, worst
from survey.report.language import group_name, known, t
from survey.report.markup import (
    MISSING,
    code,
    count,
    element,
    fixed,
    general,
    joined,
    json_of,
    json_script,
    part,
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
MOST = 20_000

# what the rows are sorted by stands beside what they are of: the rest may be off a small screen
COLUMNS = (
    "Where", "Point", "Component", "w", "Residual", "σ", "Unit of σ", "Redundancy", "Gross error", "MDB", "λ̄",
    "Observed", "Adjusted", "Unit", "σ adj.", "Kind", "Group",
)  # fmt: skip
_NAMES = ("Kind", "Group", "Where", "Point", "Component", "Unit", "Unit of σ")
_BY_SIZE = {"Residual", "w", "Gross error"}
_N_VALUES = 12
_Rows = tuple[npt.NDArray[np.object_], FloatArray]
"""Of n rows: names (7, n) in the order of ``_NAMES``; values (12, n): observed, adjusted, sigma, residual, redundancy,
w, whether used, the factors to the units of values and of sigmas, 0 ordinary, 1 suspect or 2 not used, observation and
component in the tests."""


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
    if len(found) > _MOST_OTHER:
        note += " " + t("{n} more in solution.json.", n=count(len(found) - _MOST_OTHER))
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


def listed(c: Context) -> Listed:
    """What the table of all observations shows, as far as it needs no statistics."""
    n_image = c.adjustment.image_residuals.standardized.size
    observation, component, others_w = other_components(c.adjustment)
    w = np.concatenate([c.adjustment.image_residuals.standardized.ravel(), others_w])
    chosen = worst(w, MOST)
    of_image = chosen < n_image
    parts = (
        (of_image, _every_image(c, *divmod(chosen[of_image], 2))),
        (~of_image, _every_other(c, *(x[chosen[~of_image] - n_image] for x in (observation, component)))),
    )
    texts, values = np.empty((len(_NAMES), len(chosen)), dtype=object), np.empty((_N_VALUES, len(chosen)))
    for mine, (part_texts, part_values) in parts:
        texts[:, mine], values[:, mine] = part_texts, part_values
    columns = {name: _json_column(name, _coded(own)) for name, own in zip(_NAMES, texts.tolist(), strict=True)}
    columns |= _numeric(_numbers(values), values)
    n_images = len(c.adjustment.image_residuals.test)
    seen, of = np.unique(values[10].astype(int), return_inverse=True)
    each = ["" if k < n_images else name_of_residual(c.adjustment.other_residuals[k - n_images]) for k in seen.tolist()]
    places = _coded([each[i] for i in of.tolist()])
    rest = {"rows": len(chosen), "flags": values[9].astype(int).tolist(), "places": places,
            "at": [COLUMNS.index("Where"), COLUMNS.index("Point")]}  # fmt: skip
    return Listed(len(w), values, columns, json_of(rest))


def every_observation(c: Context) -> Markup:
    """The section; nothing where there is no observation."""
    rows = c.listed or listed(c)
    if not rows.total:
        return Markup()
    n, columns = rows.values.shape[1], rows.columns | _numeric(_reliability(c, rows.values), rows.values)
    said = t(
        "Every observation, one row per component, largest |w| first. w: Baarda's standardized residual. Gross error: "
        "estimated. MDB: the bias of this component alone that its test finds with the stated power; λ̄: how many of "
        "its sigmas an undetected bias can at most move any function of the unknowns. Click a heading to sort."
    )
    if c.statistics is not None:
        power = c.statistics.reliability.criteria.options.power
        said += " " + t("Power {power} %.", power=fixed(100 * power, 0))
    if rows.total > n:
        shown = {"shown": count(n), "n": count(rows.total)}
        said += " " + t("The worst {shown} of {n}; all in residuals.csv and residuals_other.csv.", **shown)
    table = part("all_observations", of="report.html")
    data = f'{{"columns":[{",".join(columns[name] for name in COLUMNS)}],{rows.rest[1:]}'
    return section("all-observations", "All observations", table + json_script("all-data", data), said)


def _coded(values: Sequence[str]) -> dict[str, Any]:
    names = list(dict.fromkeys(values))
    at = {v: i for i, v in enumerate(names)}
    return {"names": names, "codes": [at[v] for v in values]}


def _json_column(name: str, said: dict[str, Any]) -> str:
    return json_of({"key": name, "title": known(name)} | said)


def _numeric(numbers: dict[str, FloatArray], values: FloatArray) -> dict[str, str]:
    """Columns of numbers as JSON, each with its decimals; null where there is none."""
    words, none = Words.of(["null", ","]), np.empty((values.shape[1], 0), dtype=np.int64)
    out = {}
    for name, of in numbers.items():
        power = 10.0 ** _digits(name, values)
        rounded = (np.rint(of * power) / power)[:, None]
        text = record_rows(words, none, rounded, ((NUMBERS, 1), (TEXT, 1)))[0].decode().removesuffix(",")
        out[name] = f'{_json_column(name, {"size": name in _BY_SIZE})[:-1]},"values":[{text}]}}'
    return out


def _digits(name: str, values: FloatArray) -> IntArray:
    """Decimals: two digits of the sigma, three for its fractions; fixed ones for numbers without unit."""
    if name in ("Redundancy", "w", "λ̄"):
        return np.full(values.shape[1], 2, dtype=np.int64)
    sigma = values[2] * values[7 if name in ("Observed", "Adjusted") else 8]
    with np.errstate(divide="ignore", invalid="ignore"):
        places = 2 - np.floor(np.log10(np.where(sigma > 0, sigma, np.nan)))
    return np.asarray(np.clip(np.nan_to_num(places, nan=4.0), 0, 9).astype(np.int64))


def _every_image(c: Context, k: IntArray, i: IntArray) -> _Rows:
    """Of components i of image points k."""
    found, blocks = c.adjustment.image_residuals, c.adjustment.survey.image_blocks
    seen, block = np.unique(c.rows.block[k], return_inverse=True)
    of_block = [(group_name(b.group), f"{b.camera_id} · {b.epoch_id} · {b.target_id or 'points'}")
                for b in (blocks[j] for j in seen.tolist())]  # fmt: skip
    group, where = (np.array(x, dtype=object)[block] for x in zip(*of_block, strict=True)) if of_block else ("", "")
    point = [c.rows.point_ids[j] for j in c.rows.point[k].tolist()]
    texts = np.empty((len(_NAMES), len(k)), dtype=object)
    for at, column in enumerate((t("image point"), group, where, point, np.array(["u", "v"])[i], "px", "px")):
        texts[at] = column
    observed, residual, used = c.rows.uv[k, i], found.residuals[k, i], found.used[k]
    values = np.stack([
        observed, observed + residual, c.rows.sigmas[k, i], residual, found.redundancy[k, i], found.standardized[k, i],
        used, np.ones(len(k)), np.ones(len(k)), np.where(used, c.suspect[k], 2), k, i,
    ])  # fmt: skip
    return texts, values


def _every_other(c: Context, observation: IntArray, component: IntArray) -> _Rows:
    """Of these components of other observations."""
    arrays, every = c.adjustment.other_arrays, c.adjustment.other_residuals
    at = (np.cumsum(arrays.n_components) - arrays.n_components)[observation] + component
    seen, of = np.unique(observation, return_inverse=True)
    some = [every[k] for k in seen.tolist()]
    said = [(known(o.kind.replace("_", " ")), group_name(o.group), " · ".join(o.ids)) for o in some]
    each = zip((some[k] for k in of.tolist()), component.tolist(), strict=True)
    named = [(o.components[i], o.units[i]) for o, i in each]
    units_of = {(name, inside): (name, *units_for_people(name, inside)) for name, inside in set(named)}
    units = [units_of[x] for x in named]
    own, unit, factor, small_unit, small = zip(*units, strict=True) if units else ((),) * 5
    texts = np.empty((len(_NAMES), len(at)), dtype=object)
    texts[:3], texts[3] = np.array(said, dtype=object).reshape(-1, 3)[of].T, ""
    texts[4], texts[5], texts[6] = own, unit, small_unit
    used, w = arrays.used[observation], arrays.standardized[at]
    suspect = np.abs(w) > c.solution["summary"]["suspects"]["standardized_limit"]
    values = np.stack([
        arrays.observed[at], arrays.adjusted[at], arrays.sigma[at], arrays.residual[at], arrays.redundancies[at], w,
        used, np.array(factor), np.array(small), np.where(used, suspect, 2),
        len(c.adjustment.image_residuals.test) + observation, component,
    ])  # fmt: skip
    return texts, values


def _numbers(values: FloatArray) -> dict[str, FloatArray]:
    """The sigma of an adjusted observation: of the observation less that of its residual; of a prediction plus it."""
    observed, adjusted, sigma, residual, redundancy, w, used, factor, small = values[:9]
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where(np.abs(w) > 1e-6, np.abs(residual / w), sigma * np.sqrt(np.maximum(redundancy, 0.0)))
    left = np.sqrt(np.maximum(0.0, np.where(used > 0, sigma**2 - own**2, own**2 - sigma**2)))
    return {
        "Observed": observed * factor, "Adjusted": adjusted * factor, "σ": sigma * small, "σ adj.": left * small,
        "Residual": residual * small, "Redundancy": redundancy, "w": w,
    }  # fmt: skip


def _reliability(c: Context, values: FloatArray) -> dict[str, FloatArray]:
    """Gross error, minimal detectable bias and external reliability; nothing where there are no statistics."""
    if c.statistics is None:
        return dict.fromkeys(("Gross error", "MDB", "λ̄"), np.full(values.shape[1], np.nan))
    tests, (observation, component) = c.statistics.reliability.tests, values[10:].astype(np.int64)
    rows = tests.ptr[observation] + component
    return {
        "Gross error": tests.error[rows] * values[8], "MDB": tests.detectable_component[rows] * values[8],
        "λ̄": tests.external[observation],
    }  # fmt: skip
