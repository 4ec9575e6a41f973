"""The section with every observation, a row for each component, with what auditors of adjustments ask for.

The value, its sigma a priori, the adjusted value and its sigma, residual, redundancy number, Baarda's w, estimated
gross error, minimal detectable bias and what that would do to the unknowns. Of more than ``MOST`` rows the page has the
worst, the tables beside it all.
"""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from adjust.model.names import numbered
from adjust.model.result import names_of
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.text import NUMBERS, TEXT, WORD, Words, record_rows
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
_BY_SIZE, _FIXED = {"Residual", "w", "Gross error"}, {"Redundancy", "w", "λ̄"}
"""What is sorted by its size, and what has no unit, and two decimals."""
_N_VALUES = 12
_Names = tuple[Sequence[str], IntArray]
"""Of n rows the names that there are, and which of them each has (n,)."""
_Rows = tuple[Sequence[_Names], FloatArray]
"""Of n rows: names in the order of ``_NAMES``, then those of observations in the page; values (12, n): observed,
adjusted, sigma, residual, redundancy, w, whether used, the factors to the units of values and of sigmas, 0 ordinary,
1 suspect or 2 not used, observation and component in the tests."""


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
    values = np.empty((_N_VALUES, len(chosen)))
    for mine, (_, part_values) in parts:
        values[:, mine] = part_values
    *named, places = (_coded([(mine, *names[i]) for mine, (names, _) in parts]) for i in range(len(_NAMES) + 1))
    columns = {name: f"{_json_column(name, {})[:-1]},{own}}}" for name, own in zip(_NAMES, named, strict=True)}
    columns |= _numeric(_numbers(values), values)
    at = json_of([COLUMNS.index("Where"), COLUMNS.index("Point")])
    flags = _whole(values[9].astype(np.int64), 3)
    rest = f'{{"rows":{len(chosen)},"flags":{flags},"places":{{{places}}},"at":{at}}}'
    return Listed(len(w), values, columns, rest)


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


def _coded(parts: Sequence[tuple[BoolArray, Sequence[str], IntArray]]) -> str:
    """Names in the order in which rows have them, and which each has, as JSON; of parts their rows, names and which."""
    names, same = numbered(name for _, own, _ in parts for name in own)
    code, before = np.empty(len(parts[0][0]), dtype=np.int64), 0
    for mine, own, which in parts:
        code[mine], before = same[before:][which], before + len(own)
    first = np.full(len(names), len(code))
    first[code[::-1]] = np.arange(len(code))[::-1]  # the last that is written stays
    order = np.argsort(first, kind="stable")[: np.count_nonzero(first < len(code))]
    rank = np.zeros(len(names), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return f'"names":{json_of([names[k] for k in order.tolist()])},"codes":{_whole(rank[code], len(order))}'


def _whole(numbers: IntArray, end: int) -> str:
    """Whole numbers below ``end`` as JSON."""
    words, none = Words.of([",", *map(str, range(end))]), np.empty((len(numbers), 0))
    text, _ = record_rows(words, 1 + numbers[:, None], none, ((WORD, 0), (TEXT, 0)))
    return f"[{str(text, 'ascii').removesuffix(',')}]"


def _json_column(name: str, said: dict[str, object]) -> str:
    return json_of({"key": name, "title": known(name)} | said)


def _numeric(numbers: dict[str, FloatArray], values: FloatArray) -> dict[str, str]:
    """Columns of numbers as JSON, each with its decimals; null where there is none."""
    words, none = Words.of(["null", ","]), np.empty((values.shape[1], 0), dtype=np.int64)
    of_value, of_sigma = (10.0 ** _digits(values[2] * values[k]) for k in (7, 8))
    out = {}
    for name, of in numbers.items():
        power = 100.0 if name in _FIXED else of_value if name in ("Observed", "Adjusted") else of_sigma
        rounded = (np.rint(of * power) / power)[:, None]
        text = str(record_rows(words, none, rounded, ((NUMBERS, 1), (TEXT, 1)))[0], "ascii").removesuffix(",")
        out[name] = f'{_json_column(name, {"size": name in _BY_SIZE})[:-1]},"values":[{text}]}}'
    return out


def _digits(sigma: FloatArray) -> IntArray:
    """Decimals: two digits of the sigma, three for its fractions."""
    with np.errstate(divide="ignore", invalid="ignore"):
        places = 2 - np.floor(np.log10(np.where(sigma > 0, sigma, np.nan)))
    return np.asarray(np.clip(np.nan_to_num(places, nan=4.0), 0, 9).astype(np.int64))


def _every_image(c: Context, k: IntArray, i: IntArray) -> _Rows:
    """Of components i of image points k."""
    found, blocks = c.adjustment.image_residuals, c.adjustment.survey.image_blocks
    seen, block = np.unique(c.rows.block[k], return_inverse=True)
    of_block = [(group_name(b.group), f"{b.camera_id} · {b.epoch_id} · {b.target_id or 'points'}")
                for b in (blocks[j] for j in seen.tolist())]  # fmt: skip
    groups, where = zip(*of_block, strict=True) if of_block else ((), ())
    points, point = np.unique(c.rows.point[k], return_inverse=True)
    one = np.zeros(len(k), dtype=np.int64)
    pixels = ("px",), one
    called = [c.rows.point_ids[j] for j in points.tolist()], point
    names = ((t("image point"),), one), (groups, block), (where, block), called, ("uv", i), pixels, pixels, (("",), one)
    observed, residual, used = c.rows.uv[k, i], found.residuals[k, i], found.used[k]
    values = np.stack([
        observed, observed + residual, c.rows.sigmas[k, i], residual, found.redundancy[k, i], found.standardized[k, i],
        used, np.ones(len(k)), np.ones(len(k)), np.where(used, c.suspect[k], 2), k, i,
    ])  # fmt: skip
    return names, values


def _every_other(c: Context, observation: IntArray, component: IntArray) -> _Rows:
    """Of these components of other observations."""
    arrays, every = c.adjustment.other_arrays, names_of(c.adjustment.other_residuals)
    at = (np.cumsum(arrays.n_components) - arrays.n_components)[observation] + component
    seen, of = np.unique(observation, return_inverse=True)
    some = [every[k] for k in seen.tolist()]
    kinds, kind = numbered(kind for kind, *_ in some)
    groups, group = numbered(group for _, group, *_ in some)
    alike, number = numbered((components, units) for *_, components, units in some)
    most = max((len(components) for components, _ in alike), default=1)
    cells, cell = np.unique(number[of] * most + component, return_inverse=True)
    named = ((alike[k // most][0][k % most], alike[k // most][1][k % most]) for k in cells.tolist())
    own = [(name, *units_for_people(name, inside)) for name, inside in named]
    components, units, factors, small_units, small = zip(*own, strict=True) if own else ((), (), (), (), ())
    names = (
        ([known(name.replace("_", " ")) for name in kinds], kind[of]), (list(map(group_name, groups)), group[of]),
        ([" · ".join(ids) for _, _, ids, *_ in some], of), (("",), np.zeros(len(at), dtype=np.int64)),
        (components, cell), (units, cell), (small_units, cell),
        ([name_of_observation(name, ids) for name, _, ids, *_ in some], of),
    )  # fmt: skip
    used, w = arrays.used[observation], arrays.standardized[at]
    suspect = np.abs(w) > c.solution["summary"]["suspects"]["standardized_limit"]
    values = np.stack([
        arrays.observed[at], arrays.adjusted[at], arrays.sigma[at], arrays.residual[at], arrays.redundancies[at], w,
        used, *(np.array(x, dtype=float)[cell] for x in (factors, small)), np.where(used, suspect, 2),
        len(c.adjustment.image_residuals.test) + observation, component,
    ])  # fmt: skip
    return names, values


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
