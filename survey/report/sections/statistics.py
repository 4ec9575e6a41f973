"""Sections on the statistics: variance components, reliability, relative precision, budget, correlations."""

from collections.abc import Sequence
from itertools import compress

import numpy as np
from markupsafe import Markup

from adjust.model.result import Adjustment, Component, ParameterName, names_of
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.statistics.result import BudgetEntry, Correlation, Influence, RelativePrecision, WeakDirection
from survey.report import markup as m
from survey.report.charts import heat_map, quantiles
from survey.report.context import Context
from survey.report.language import esc, group_name, known, t
from survey.solution.quantities import sigma_unit_for_people

_MOST_ROWS = 120
_MOST_WEAK = 30
_MOST_DRAWN = 12
_MOST_PARTS = 6


def name_text(name: ParameterName) -> str:
    """A parameter as people write it: kind in words, then ids."""
    kind = known(name[0].replace("_", " "))
    return " ".join((kind, *name[1:]))


def components(c: Context) -> Markup:
    """Variance components with their own sigma and test; nothing where they were not estimated."""
    found = c.found.components
    if found is None:
        return Markup()
    rows = [_component_row(x) for x in found.components]
    columns = ("<Group", "Factor of variance", "σ of it", "Factor of σ", "n", "Redundancy", "p of 1", "<")
    said = t(
        "Estimated variance factor of every group, on top of the sigmas given ({method}, {n} solutions of the survey). "
        "p of 1: probability of a factor as far from 1 where the given sigmas are right. All sigmas and tests in this "
        "report use these factors.",
        method=found.method, n=found.iterations,
    )  # fmt: skip
    if not found.converged:
        said += " " + m.pill("bad", t("not converged"))
    mixed = [
        t("Not separable, only their mixture is known: {names}", names=", ".join(group)) for group in found.unseparable
    ]
    return m.section("components", "Variance components", m.table(columns, rows) + m.listed(mixed), said)


def _component_row(x: Component) -> tuple[str, ...]:
    kind = "warn" if x.status == "estimated" and x.p < 0.01 else "quiet" if x.status == "estimated" else "soft"
    return (
        group_name(x.group), m.value_text(x.factor, x.sigma), m.sigma_text(x.sigma),
        m.fixed(float(np.sqrt(max(x.factor, 0.0))), 3),
        m.count(x.n), m.fixed(x.redundancy, 1), m.general(x.p, 2), m.pill(kind, known(x.status)),
    )  # fmt: skip


def reliability(c: Context) -> Markup:
    """What a gross error that no test finds could do, worst first, and what is not controlled at all."""
    r = c.found.reliability
    uncontrolled = _titled("Not controlled", _most(r.uncontrolled[:_MOST_WEAK], len(r.uncontrolled)))
    rows = [_influence_row(c, x) for x in r.influences[:_MOST_WEAK]]
    columns = ("<Observation", "MDB [σ]", "λ̄", "<Moves most", "by", "<Unit", "in its σ", "<Position", "by [mm]")
    o = r.criteria.options
    method = t("Šidák's family-wise control") if o.method == "sidak" else t("Baarda's B-method")
    said = t(
        "External reliability: what the least detectable bias (power {power} %, {method}, level of a single test "
        "{level}) of an observation would do to the unknowns if it stayed undetected. Worst first.",
        power=m.fixed(100 * o.power, 0), method=method, level=m.general(float(r.criteria.alpha[0]), 2),
    )  # fmt: skip
    return m.section("reliability", "Reliability", uncontrolled + (m.table(columns, rows) if rows else Markup()),
                     said + m.more(len(r.influences) - len(rows)))  # fmt: skip


def _influence_row(c: Context, x: Influence) -> tuple[str, ...]:
    unit, factor = sigma_unit_for_people(x.unit)
    place = name_text(x.position) if x.position else m.MISSING
    return (
        observation_text(c, x.row), m.fixed(x.detectable, 1), m.fixed(x.external, 2),
        m.joined((name_text(x.name), m.code(x.component)), " "),
        m.general(x.shift * factor, 2), unit, m.fixed(x.ratio, 2), place,
        m.general(1e3 * x.position_shift, 2) if x.position else m.MISSING,
    )  # fmt: skip


def observation_text(c: Context, row: int) -> str:
    """An observation by its row in the tests: image points first, then the others."""
    n_image = len(c.adjustment.image_residuals.test)
    if row < n_image:
        block = c.adjustment.survey.image_blocks[int(c.rows.block[row])]
        return f"{block.camera_id} · {block.epoch_id} · {c.rows.point_ids[c.rows.point[row]]}"
    o = c.adjustment.other_residuals[row - n_image]
    return f"{known(o.kind.replace('_', ' '))} {' · '.join(o.ids)}"


def relative(c: Context) -> Markup:
    """Precision of neighbours relative to each other, least precise first."""
    if not c.found.relative:
        return Markup()
    found = sorted(c.found.relative, key=lambda r: -float(r.ellipsoid.semi_axes[0]))
    rows = [_relative_row(r) for r in found[:_MOST_ROWS]]
    columns = ("<From", "<To", "Distance [mm]", "σ [mm]", "a [mm]", "b [mm]", "c [mm]", "Rotation σ [″]")
    level = m.fixed(100 * found[0].ellipsoid.level, 0)
    said = t(
        "Relative precision of neighbours, independent of where the datum is: sigma of the distance, semi-axes of the "
        "relative {level} % ellipsoid, and of stations the largest sigma of their relative rotation.",
        level=level,
    )
    return m.section("relative", "Relative precision", m.table(columns, rows), said + m.more(len(found) - len(rows)))


def _relative_row(r: RelativePrecision) -> list[str]:
    axes = [m.sigma_text(1e3 * float(a)) for a in r.ellipsoid.semi_axes] + [m.MISSING] * (3 - r.ellipsoid.dimension)
    turn = m.MISSING
    if r.rotation_cov is not None:
        turn = m.sigma_text(float(np.degrees(np.sqrt(np.linalg.eigvalsh(r.rotation_cov)[-1]))) * 3600.0)
    distance, sigma = 1e3 * r.distance, 1e3 * r.sigma_distance
    return [name_text(r.a), name_text(r.b), m.value_text(distance, sigma), m.sigma_text(sigma), *axes, turn]


def budget(c: Context) -> Markup:
    """Uncertainty budget of the results: standard uncertainty, its sources, expanded uncertainty."""
    entries = c.found.budget
    if not entries:
        return Markup()
    sources = list(dict.fromkeys(line.source for e in entries for line in e.lines))
    kinds = {line.source: line.kind for e in entries for line in e.lines}
    rows = [_budget_row(e, sources) for e in entries[:_MOST_ROWS]]
    heads = [esc(f"{group_name(s)} ({kinds[s]}) [%]") for s in sources]
    columns = ["<Result", "<", "u", "<Unit", *heads, "ν", "k", "U"]
    said = t(
        "Standard uncertainty u of every result and the share of each source in its variance (GUM, JCGM 100:2008). "
        "Type A: from the scatter of this survey's own residuals; type B: given. ν: effective degrees of freedom; "
        "U = k u is the expanded uncertainty at {level} %.",
        level=m.general(100 * entries[0].level),
    )
    return m.section("budget", "Uncertainty budget", m.table(columns, rows), said + m.more(len(entries) - len(rows)))


def _budget_row(e: BudgetEntry, sources: list[str]) -> list[str]:
    unit, factor = sigma_unit_for_people(e.unit)
    share = {line.source: line.share for line in e.lines}
    shares = [m.fixed(100 * share[s], 1) if s in share else m.MISSING for s in sources]
    freedom = "∞" if not np.isfinite(e.freedom) else m.fixed(e.freedom, 0)
    return [
        name_text(e.name), m.code(e.component), m.sigma_text(e.u * factor), unit, *shares, freedom,
        m.fixed(e.coverage, 2), m.sigma_text(e.expanded * factor),
    ]  # fmt: skip


def correlations(c: Context) -> Markup:
    """The correlation matrix as a picture, pairs above 95 % and weak directions by name."""
    s = c.found
    drawn = m.element("figure", heat_map(s.correlations)) if s.correlations is not None else Markup()
    pairs = _most([_correlated(x) for x in s.correlated[:_MOST_WEAK]], len(s.correlated))
    strong = _titled("Correlated above 95 %", pairs)
    weak = _titled("Weak directions", [_weak_text(x) for x in s.weak[:10]])
    note = t("Blue: positive, red: negative; empty: none. Lines separate the parameters.")
    return m.section("correlations", "Correlations", drawn + strong + weak, note)


def _titled(title: str, items: Sequence[str]) -> Markup:
    return m.element("h3", t(title)) + m.listed(items, "") if items else Markup()


def _most(first: Sequence[str], n: int) -> list[str]:
    """The first of ``n``, and how many more there are."""
    return [*first, *filter(None, [m.more(n - len(first))])]


def _correlated(x: Correlation) -> Markup:
    first, second = (name_text(x.a), m.code(x.a_component)), (name_text(x.b), m.code(x.b_component))
    return m.joined((*first, t("with"), *second), " ") + f": {m.fixed(100 * x.coefficient, 1)} %"


def _weak_text(x: WeakDirection) -> Markup:
    parts = []
    for part in x.parts[:_MOST_PARTS]:
        unit, factor = sigma_unit_for_people(part.unit)
        amount = m.general(part.amount * factor, 2)
        parts.append(m.joined((name_text(part.name), m.code(part.component), amount, unit), " "))
    left_out = len(x.parts) - _MOST_PARTS
    more = t(" and {n} more", n=left_out) if left_out > 0 else Markup()
    return t("{n} times weaker together than alone: ", n=m.general(x.inflation, 3)) + m.joined(parts, ", ") + more


def normality(c: Context) -> Markup:
    """Quantiles of the standardized residuals of every group against those of the normal distribution."""
    drawn = [quantiles(group_name(name), w) for name, w in standardized_by_group(c.adjustment).items() if len(w) >= 8]
    note = t(
        "Standardized residuals of each group in order, against the quantiles that as many normally distributed ones "
        "would have. The band holds 95 % of such points one by one."
    )
    if len(drawn) > _MOST_DRAWN:
        note += " " + t("The first {shown} of {n} groups are drawn.", shown=_MOST_DRAWN, n=m.count(len(drawn)))
    return m.section("normality", "Distribution of residuals", m.figures(drawn[:_MOST_DRAWN]), note)


def standardized_by_group(adjustment: Adjustment) -> dict[str, FloatArray]:
    """Standardized residuals of every group's used observations; none that is no number."""
    found, readings = adjustment.image_residuals, adjustment.reading_residuals
    out: dict[str, list[FloatArray]] = {}

    def add(groups: Sequence[str], sizes: IntArray | int, used: BoolArray, standardized: FloatArray) -> None:
        at = {name: i for i, name in enumerate(dict.fromkeys(groups))}
        number = np.repeat(np.array([at[name] for name in groups], dtype=np.int64), sizes)
        for name, i in at.items():
            if (mine := used & (number == i)).any():
                out.setdefault(name, []).append(standardized[mine].ravel())

    add([b.group for b in adjustment.survey.image_blocks], np.diff(found.block_ptr), found.used, found.standardized)
    others, n = adjustment.other_arrays, len(adjustment.single_residuals)
    used = others.used & (np.arange(len(others.used)) < n)
    groups = [group for _, group, *_ in compress(names_of(adjustment.other_residuals), used.tolist())]
    mine = used[others.observation]
    add(groups, others.n_components[used], mine[mine], others.standardized[mine])
    if readings is not None:
        add([r.group for r in adjustment.survey.readings], 1, readings.used, readings.standardized)
    joint = {name: np.concatenate(parts) for name, parts in out.items()}
    return {name: w[np.isfinite(w)] for name, w in joint.items()}
