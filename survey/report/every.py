"""All observations as one table that can be searched and sorted on the screen: image points and everything else.

One row per component. What stands in it is what auditors of adjustments ask for: the value, its sigma a priori, the
adjusted value and its sigma, residual, redundancy number, Baarda's w, estimated gross error, minimal detectable bias
and what that would do to the unknowns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from adjust.model import FloatArray, IntArray
from survey.quantities import sigma_unit_for_people, unit_for_people
from survey.report.context import Context
from survey.report.language import group_name, known, t
from survey.report.markup import count, fixed, heads, json_script, part, section

MOST = 20_000


@dataclass(eq=False)
class _Rows:
    """Columns in the making; numbers as (n,) arrays in the units shown, names as lists."""

    names: dict[str, list[str]]
    numbers: dict[str, FloatArray]
    flags: IntArray


# what the rows are sorted by stands beside what they are of: the rest may be off a small screen
COLUMNS = (
    "Where", "Point", "Component", "w", "Residual", "σ", "Unit of σ", "Redundancy", "Gross error", "MDB", "λ̄",
    "Observed", "Adjusted", "Unit", "σ adj.", "Kind", "Group",
)  # fmt: skip
_NAMES = ("Kind", "Group", "Where", "Point", "Component", "Unit", "Unit of σ")
_NUMBERS = tuple(name for name in COLUMNS if name not in _NAMES)
_SORTED_BY = COLUMNS.index("w")
_BY_SIZE = {"Residual", "w", "Gross error"}


def every_observation(c: Context) -> Markup:
    """The section; nothing where there is no observation."""
    rows = _all_rows(c)
    n = len(rows.flags)
    if not n:
        return Markup()
    worst = np.argsort(-np.nan_to_num(np.abs(rows.numbers["w"]), nan=-1.0), kind="stable")
    kept = worst[:MOST]
    columns = [
        _coded(name, [rows.names[name][i] for i in kept])
        if name in _NAMES
        else _numeric(name, rows.numbers[name][kept], _digits(name, rows, kept))
        for name in COLUMNS
    ]
    data = {"rows": len(kept), "columns": columns, "flags": rows.flags[kept].tolist()}
    more = ""
    if n > len(kept):
        numbers = {"shown": count(len(kept)), "n": count(n)}
        more = " " + t("The worst {shown} of {n}; all in residuals.csv and residuals_other.csv.", **numbers)
    power = c.statistics.reliability.criteria.options if c.statistics is not None else None
    said = t(
        "Every observation, one row per component, largest |w| first. w: Baarda's standardized residual. Gross error: "
        "estimated. MDB: the bias of this component alone that its test finds with the stated power; λ̄: how many of "
        "its sigmas an undetected bias can at most move any function of the unknowns. Click a heading to sort."
    )
    if power is not None:
        said += " " + t("Power {power} %.", power=fixed(100 * power.power, 0))
    shown = part("all_observations", heads(_left(x) for x in COLUMNS), _SORTED_BY, of="report.html")
    return section("all-observations", "All observations", shown + json_script("all-data", data), said + more)


def _left(column: str) -> str:
    return f"<{column}" if column in _NAMES else column


def _coded(name: str, values: Sequence[str]) -> dict[str, Any]:
    names = list(dict.fromkeys(values))
    at = {v: i for i, v in enumerate(names)}
    return {"names": names, "codes": [at[v] for v in values]}


def _numeric(name: str, values: FloatArray, digits: IntArray) -> dict[str, Any]:
    out: list[Any] = []
    for value, places in zip(values.tolist(), digits.tolist(), strict=True):
        if not np.isfinite(value):
            out.append(None)
        elif places > 0:
            out.append(round(value, places))
        else:
            out.append(round(value))
    return {"values": out, "size": name in _BY_SIZE}


def _digits(name: str, rows: _Rows, kept: IntArray) -> IntArray:
    """Decimals: two digits of the sigma, three for its fractions; fixed ones for numbers without unit."""
    if name in ("Redundancy", "w", "λ̄"):
        return np.full(len(kept), 2, dtype=np.int64)
    sigma = rows.numbers["σ"][kept]
    if name in ("Observed", "Adjusted"):
        sigma = sigma * rows.numbers["_value_per_sigma"][kept]
    with np.errstate(divide="ignore", invalid="ignore"):
        places = 2 - np.floor(np.log10(np.where(sigma > 0, sigma, np.nan)))
    return np.asarray(np.clip(np.nan_to_num(places, nan=4.0), 0, 9).astype(np.int64))


def _all_rows(c: Context) -> _Rows:
    image, other = _image_rows(c), _other_rows(c)
    names = {k: image.names[k] + other.names[k] for k in _NAMES}
    numbers = {k: np.concatenate([image.numbers[k], other.numbers[k]]) for k in (*_NUMBERS, "_value_per_sigma")}
    return _Rows(names, numbers, np.concatenate([image.flags, other.flags]))


def _image_rows(c: Context) -> _Rows:
    found, blocks = c.adjustment.image_residuals, c.adjustment.survey.image_blocks
    n = len(found.test)
    kind = t("image point")
    where = [f"{b.camera_id} · {b.epoch_id} · {b.target_id or 'points'}" for b in blocks]
    points = c.rows.point_ids
    names: dict[str, list[str]] = {k: [] for k in _NAMES}
    for i in range(n):
        b = int(c.rows.block[i])
        for component in ("u", "v"):
            row = (kind, group_name(blocks[b].group), where[b], points[c.rows.point[i]], component, "px", "px")
            for k, value in zip(_NAMES, row, strict=True):
                names[k].append(value)
    observed, sigma = c.rows.uv.ravel(), c.rows.sigmas.ravel()
    residual = found.residuals.ravel()
    numbers = _numbers(observed, sigma, residual, found.redundancy.ravel(), found.standardized.ravel(),
                       np.repeat(found.used, 2))  # fmt: skip
    numbers |= _reliability(c, 0, n, np.ones(2 * n))
    flags = np.where(found.used, np.where(c.suspect, 1, 0), 2)
    return _Rows(names, numbers | {"_value_per_sigma": np.ones(2 * n)}, np.repeat(flags, 2).astype(np.int64))


def _other_rows(c: Context) -> _Rows:
    others = c.adjustment.other_residuals
    names: dict[str, list[str]] = {k: [] for k in _NAMES}
    columns: list[tuple[float, ...]] = []
    flags, per_sigma = [], []
    limit = c.solution["summary"]["suspects"]["standardized_limit"]
    for o in others:
        for i, component in enumerate(o.components):
            unit, factor = unit_for_people(component, o.units[i])
            sigma_unit, sigma_factor = sigma_unit_for_people(o.units[i])
            kind, where = known(o.kind.replace("_", " ")), " · ".join(o.ids)
            row = (kind, group_name(o.group), where, "", component, unit, sigma_unit)
            for k, value in zip(_NAMES, row, strict=True):
                names[k].append(value)
            columns.append((o.observed[i], o.sigma[i], o.residual[i], o.redundancy[i], o.standardized[i], float(o.used),
                            factor, sigma_factor, o.adjusted[i]))  # fmt: skip
            flags.append(2 if not o.used else 1 if abs(o.standardized[i]) > limit else 0)
            per_sigma.append(factor / sigma_factor)
    a = np.array(columns, dtype=float).reshape(-1, 9).T
    numbers = _numbers(a[0], a[1], a[2], a[3], a[4], a[5] > 0)
    numbers["Adjusted"] = a[8]
    for k in ("Observed", "Adjusted"):
        numbers[k] = numbers[k] * a[6]
    for k in ("σ", "σ adj.", "Residual"):
        numbers[k] = numbers[k] * a[7]
    n_image = len(c.adjustment.image_residuals.test)
    numbers |= _reliability(c, n_image, n_image + len(others), a[7])
    return _Rows(names, numbers | {"_value_per_sigma": np.array(per_sigma)}, np.array(flags, dtype=np.int64))


def _numbers(
    observed: FloatArray, sigma: FloatArray, residual: FloatArray, redundancy: FloatArray, w: FloatArray, used: Any
) -> dict[str, FloatArray]:
    """The sigma of an adjusted observation: of the observation less that of its residual; of a prediction plus it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where(np.abs(w) > 1e-6, np.abs(residual / w), sigma * np.sqrt(np.maximum(redundancy, 0.0)))
    adjusted = np.sqrt(np.maximum(0.0, np.where(used, sigma**2 - own**2, own**2 - sigma**2)))
    return {
        "Observed": observed, "σ": sigma, "Adjusted": observed + residual, "σ adj.": adjusted, "Residual": residual,
        "Redundancy": redundancy, "w": w,
    }  # fmt: skip


def _reliability(c: Context, first: int, last: int, factor: FloatArray) -> dict[str, FloatArray]:
    """Gross error, minimal detectable bias and external reliability of the rows of observations first to last."""
    if c.statistics is None:
        nothing = np.full(len(factor), np.nan)
        return {"Gross error": nothing, "MDB": nothing, "λ̄": nothing}
    tests = c.statistics.reliability.tests
    rows = slice(int(tests.ptr[first]), int(tests.ptr[last]))
    per_row = np.repeat(tests.external[first:last], np.diff(tests.ptr[first : last + 1]))
    return {"Gross error": tests.error[rows] * factor, "MDB": tests.detectable_component[rows] * factor, "λ̄": per_row}
