"""The section with every observation, a row for each component, with what auditors of adjustments ask for.

The value, its sigma a priori, the adjusted value and its sigma, residual, redundancy number, Baarda's w, estimated
gross error, minimal detectable bias and what that would do to the unknowns. Of more than ``MOST`` rows the page has the
worst, the tables beside it all.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from adjust.model.names import numbered
from adjust.model.result import names_of
from adjust.model.survey import FloatArray, IntArray
from adjust.native.text import NUMBERS, TEXT, Words, record_rows
from survey.project.observed import name_of_observation
from survey.report.context import Context, Listed, other_components, worst
from survey.report.language import group_name, known, t
from survey.report.markup import count, fixed, json_of, json_script, part, section
from survey.solution.quantities import units_for_people

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
    others = [(kind, ids) for kind, _, ids, *_ in names_of(c.adjustment.other_residuals)]
    each = ["" if k < n_images else name_of_observation(*others[k - n_images]) for k in seen.tolist()]
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


def _coded(values: Sequence[str]) -> dict[str, object]:
    names = list(dict.fromkeys(values))
    at = {v: i for i, v in enumerate(names)}
    return {"names": names, "codes": [at[v] for v in values]}


def _json_column(name: str, said: dict[str, object]) -> str:
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
    arrays, every = c.adjustment.other_arrays, names_of(c.adjustment.other_residuals)
    at = (np.cumsum(arrays.n_components) - arrays.n_components)[observation] + component
    seen, of = np.unique(observation, return_inverse=True)
    some = [every[k] for k in seen.tolist()]
    said = [(known(kind.replace("_", " ")), group_name(group), " · ".join(ids)) for kind, group, ids, *_ in some]
    alike, number = numbered((components, units) for *_, components, units in some)
    most = max((len(components) for components, _ in alike), default=1)
    cells, cell = np.unique(number[of] * most + component, return_inverse=True)
    named = ((alike[k // most][0][k % most], alike[k // most][1][k % most]) for k in cells.tolist())
    units = [(name, *units_for_people(name, inside)) for name, inside in named]
    own, unit, factor, small_unit, small = (np.array([u[i] for u in units], dtype=object)[cell] for i in range(5))
    texts = np.empty((len(_NAMES), len(at)), dtype=object)
    texts[:3], texts[3] = np.array(said, dtype=object).reshape(-1, 3)[of].T, ""
    texts[4], texts[5], texts[6] = own, unit, small_unit
    used, w = arrays.used[observation], arrays.standardized[at]
    suspect = np.abs(w) > c.solution["summary"]["suspects"]["standardized_limit"]
    values = np.stack([
        arrays.observed[at], arrays.adjusted[at], arrays.sigma[at], arrays.residual[at], arrays.redundancies[at], w,
        used, factor.astype(float), small.astype(float), np.where(used, suspect, 2),
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
    observation, component = values[10:].astype(np.int64)
    some, at = np.unique(observation, return_inverse=True)
    tests = c.statistics.reliability.tests.of(some)
    rows = tests.ptr[at] + component
    return {
        "Gross error": tests.error[rows] * values[8], "MDB": tests.detectable_component[rows] * values[8],
        "λ̄": tests.external[at],
    }  # fmt: skip
