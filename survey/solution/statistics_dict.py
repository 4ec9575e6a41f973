"""The statistics of an adjustment as plain values, for ``solution.json``: the same as the sections of the report."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adjust.model.result import Adjustment, Component, ParameterName
from adjust.statistics.reliability import observation_name
from adjust.statistics.result import BudgetEntry, Consistency, Influence, PartTest, RelativePrecision
from survey.folder.plain import attributes
from survey.solution.quantities import Scale, key_of, sigma_unit_for_people, sigmas_in
from survey.solution.records import Form, Records
from survey.solution.statistics import Statistics
from survey.solution.tolerances import Verdict, coverage


def statistics_dict(adjustment: Adjustment, found: Statistics, scale: Scale) -> dict[str, Any]:
    """Keys beside those of the solution; empty lists where there is nothing."""
    r = found.reliability
    components = found.components
    return {
        "coverage_factor_95_percent": coverage(adjustment, scale),
        "tolerances": [_verdict(v) for v in found.verdicts],
        "variance_components": None if components is None else {
            "method": components.method,
            "converged": components.converged,
            "unseparable": [list(x) for x in components.unseparable],
            "groups": {x.group: _component(x) for x in components.components},
        },
        "outliers": [
            {"action": x.action, "kind": x.kind, "ids": list(x.ids), "test": x.statistic, "limit": x.limit,
             "p_value": x.p, "error_sigmas": x.error, "round": x.round, "how": x.how}
            for x in found.decisions
        ],
        "consistency": None if found.consistency is None else _consistency(found.consistency),
        "not_computed": list(found.left_out),
        "reliability": {
            "method": r.criteria.options.method,
            "power": r.criteria.options.power,
            "level_of_one_test": float(r.criteria.alpha[0]),
            "noncentrality": float(r.criteria.lambda0[0]),
            "uncontrolled": list(r.uncontrolled),
            "worst_first": [_influence(adjustment, found, x) for x in r.influences],
        },
        "correlated_above_95_percent": [
            {"a": _path(x.a, x.a_component), "b": _path(x.b, x.b_component), "correlation": x.coefficient}
            for x in found.correlated
        ],
        "weak_directions": [
            {"inflation": x.inflation, "parts": {_path(p.name, p.component): p.amount for p in x.parts}}
            for x in found.weak
        ],
        "relative_precision": [_relative(x) for x in found.relative],
        "budget": [_budget(x) for x in found.budget],
    }  # fmt: skip


def _consistency(x: Consistency) -> dict[str, Any]:
    """Parts by kind and name; amounts of changes in SI units beside the unit."""
    parts: dict[str, list[PartTest]] = {}
    for p in x.parts:
        parts.setdefault(p.kind, []).append(p)
    return {
        "alpha": x.alpha, "level_of_one_test": x.level, "n_tests": x.n_tests, "relative_to_the_rest": x.relative,
        "parts": {kind: _parts(alike) for kind, alike in parts.items()},
        "changes": [
            {"kind": c.kind, "name": c.name, "what": c.what, "from_epoch": c.epoch or None, "test": c.statistic,
             "freedom": c.freedom, "p_value": c.p,
             "shifts": [attributes(s, "component", "unit", "amount", "sigma") for s in c.shifts]}
            for c in x.changes
        ],
    }  # fmt: skip


def _parts(tests: Sequence[PartTest]) -> Records:
    columns = {"n_observations": "n", "redundancy": "redundancy", "omega": "omega", "variance_factor": "factor",
               "p_value": "p"}  # fmt: skip
    tree = {key: np.array([getattr(p, of) for p in tests]) for key, of in columns.items()}
    tree["fits"] = np.array([not p.fails for p in tests])
    return Records([p.name for p in tests], [Form(np.arange(len(tests)), tree)])


def _path(name: ParameterName, component: str = "") -> str:
    return "/".join((*name, component) if component else name)


def _verdict(v: Verdict) -> dict[str, Any]:
    unit, factor = sigma_unit_for_people(v.unit)
    return {
        "tolerance": v.tolerance, "result": _path(v.result), "quantity": v.quantity,
        "about": "deviation_and_uncertainty" if v.of_value else "uncertainty",
        key_of("found", unit): v.found * factor, key_of("allowed", unit): v.allowed * factor, "met": v.met,
    }  # fmt: skip


def _component(x: Component) -> dict[str, Any]:
    return {
        **attributes(x, "factor", "sigma", "n", "redundancy", "omega", "freedom"), "p_value": x.p,
        **attributes(x, "lower", "upper", "status"),
    }  # fmt: skip


def _influence(adjustment: Adjustment, found: Statistics, x: Influence) -> dict[str, Any]:
    kind, ids = observation_name(adjustment, x.row)
    unit, factor = sigma_unit_for_people(x.unit)
    entry: dict[str, Any] = {
        "kind": kind, "ids": list(ids), "detectable_sigmas": x.detectable,
        "external": x.external, "moves": _path(x.name, x.component),
        key_of("by", unit): x.shift * factor, "in_its_sigmas": x.ratio,
    }  # fmt: skip
    return entry | ({"position": _path(x.position), "position_by_mm": 1e3 * x.position_shift} if x.position else {})


def _relative(x: RelativePrecision) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "a": _path(x.a), "b": _path(x.b), "difference_mm": (1e3 * x.difference).tolist(),
        "covariance_mm2": (1e6 * x.cov).tolist(), "distance_mm": 1e3 * x.distance,
        "sigma_distance_mm": 1e3 * x.sigma_distance, "level": x.ellipsoid.level,
        "ellipsoid_semi_axes_mm": (1e3 * np.asarray(x.ellipsoid.semi_axes)).tolist(),
    }  # fmt: skip
    if x.rotation_cov is not None:
        sigmas = np.degrees(sigmas_in(x.rotation_cov)) * 3600.0
        entry["sigma_rotation_arcsec"] = sigmas.tolist()
    return entry


def _budget(x: BudgetEntry) -> Mapping[str, Any]:
    unit, factor = sigma_unit_for_people(x.unit)
    return {
        "result": _path(x.name, x.component), key_of("u", unit): x.u * factor, "freedom": x.freedom, "level": x.level,
        "coverage_factor": x.coverage, key_of("expanded", unit): x.expanded * factor,
        "sources": {line.source: {"type": line.kind, key_of("u", unit): line.u * factor, "share": line.share}
                    for line in x.lines},
    }  # fmt: skip
