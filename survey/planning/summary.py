"""A plan as plain values and as text for the terminal."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from adjust.design import (
    Budget,
    Component,
    Selection,
    Tolerance,
    Trials,
    WeakDirection,
    group_redundancy,
)
from adjust.design.pose_budget import PoseTolerance
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray
from adjust.precision.precision import precision_of
from survey.folder.plain import attributes, plain
from survey.planning.building import Planned
from survey.planning.navigation import NavigationOutcome
from survey.planning.plan_file import Plan
from survey.solution.quantities import key_of, sigma_unit_for_people

_MOST = 8


@dataclass(frozen=True)
class Met:
    """A component with the sigma that is required of it and the one that is planned (SI), and what people read."""

    component: Component
    required: float
    planned: float
    unit: str
    factor: float

    @property
    def met(self) -> bool:
        """Whether it is as precise as required."""
        return self.planned <= self.required * (1 + 1e-9)


@dataclass(frozen=True, eq=False)
class PlanningOutcome:
    """All that is known of a plan."""

    folder: Path
    title: str
    plan: Plan
    planned: Planned
    expected: Adjustment
    weak: tuple[WeakDirection, ...]
    wanted: tuple[Component, ...]
    selection: Selection | None
    required: dict[Component, float]
    budget: Budget | None
    tolerances: tuple[Tolerance, ...]
    trials: Trials | None
    network: dict[str, object] | None
    navigation: NavigationOutcome | None
    seconds: dict[str, float] = field(default_factory=dict)
    paths: dict[str, Path] = field(default_factory=dict)

    @property
    def requirements(self) -> tuple[Met, ...]:
        """What is required, beside what is planned."""
        planned = () if self.budget is None else self.budget.sigmas.tolist()
        return tuple(Met(c, r, s, *sigma_unit_for_people(c.unit))
                     for (c, r), s in zip(self.required.items(), planned, strict=self.budget is not None))  # fmt: skip

    def summary(self) -> dict[str, object]:
        """As plain values."""
        return plan_summary(self)

    def text(self) -> str:
        """For people."""
        return plan_text(self)


def expected_sigmas(o: PlanningOutcome) -> Iterator[tuple[ParameterName, list[tuple[str, float, str]]]]:
    """Of every unknown: its components, their sigmas for people and the units of these."""
    for name, unknown in precision_of(o.expected).unknowns.by_name.items():
        estimate = o.expected.estimates[name]
        s = dict(zip(estimate.components, np.sqrt(np.maximum(np.diag(estimate.cov), 0.0)).tolist(), strict=True))
        shown = [(c, *sigma_unit_for_people(u)) for c, u in zip(unknown.components, unknown.units, strict=True)]
        yield name, [(c, factor * s[c], unit) for c, unit, factor in shown]


def _sigma_of(component: Component, sigma: float) -> str:
    """``0.12 mm``."""
    unit, factor = sigma_unit_for_people(component.unit)
    return f"{factor * sigma:.3g} {unit}".strip()


def plan_summary(o: PlanningOutcome) -> dict[str, object]:
    """All figures by name, units in the keys."""
    out: dict[str, object] = {
        "folder": str(o.folder),
        "title": o.title,
        "observations": o.expected.n_observations,
        "unknowns": o.expected.n_unknowns,
        "redundancy": o.expected.redundancy,
        "datum_defect": o.expected.datum_defect,
        "existing_images": o.planned.n_existing_blocks,
        "planned_epochs": o.planned.n_planned_epochs,
        "planned_blocks": len(o.planned.survey.image_blocks) - o.planned.n_existing_blocks,
        "groups": {
            g: {"observations": n, "redundancy": r, "smallest": float(q[0]), "median": float(q[1])}
            for g, (n, r, q) in group_redundancy(o.expected).items()
        },
        "sigmas": {
            ".".join(name): {f"sigma_{key_of(c, unit)}": sigma for c, sigma, unit in sigmas}
            for name, sigmas in expected_sigmas(o)
        },
        "weak_directions": [
            {"factor": w.factor, "parts": [{"unknown": a, "component": c, "share": s} for a, c, s in w.parts]}
            for w in o.weak
        ],
        "notes": [*o.planned.notes, *o.expected.warnings],
        "seconds": o.seconds,
        "written": {name: str(path) for name, path in o.paths.items()},
    }
    if o.selection is not None:
        out["selection"] = _selection(o.selection)
    if o.budget is not None:
        out["tolerances"] = _tolerances(o)
    if o.trials is not None:
        t = o.trials
        out["monte_carlo"] = {
            "trials": len(t.errors), "failed": len(t.failed), "mean_square": t.mean_square, "dof": t.dof,
            "band_99": list(t.band), "passed": t.passed, "mean_omega": float(t.omega.mean()),
            "rms_over_sigma": [float(t.ratios.min()), float(np.median(t.ratios)), float(t.ratios.max())],
        }  # fmt: skip
    if o.network is not None:
        out["network"] = o.network
    if o.navigation is not None:
        out["navigation"] = _navigation(o.navigation)
    return out


def _selection(s: Selection) -> dict[str, object]:
    gain = ("name", "kind", "ln_det", "ln_det_all", "mean_variance")
    wanted = {}
    for c, before, after in zip(s.wanted, s.sigmas.tolist(), s.after.tolist(), strict=True):
        unit, factor = sigma_unit_for_people(c.unit)
        wanted[c.text] = {f"sigma_{when}_{unit}".rstrip("_"): factor * sigma
                          for when, sigma in (("before", before), ("after", after))}  # fmt: skip
    return {
        "criterion": s.criterion,
        "chosen": [attributes(g, *gain) for g in s.steps],
        "candidates": [attributes(g, *gain) for g in s.first],
        "wanted": wanted,
    }


def _tolerances(o: PlanningOutcome) -> dict[str, object]:
    return {
        "met": all(r.met for r in o.requirements),
        "groups": {t.group: {"factor_alone": plain(t.alone), "factor_together": plain(t.together),
                             "limited_by": t.limiting} for t in o.tolerances},
        "components": {
            r.component.text: {"required": r.factor * r.required, "planned": r.factor * r.planned, "unit": r.unit}
            for r in o.requirements
        },
    }  # fmt: skip


def tolerance_values(t: PoseTolerance) -> tuple[str, float, float, float]:
    """Unit for people, then alone, beside, shared in it."""
    unit, factor = ("deg", 180.0 / np.pi) if t.unit == "rad" else sigma_unit_for_people(t.unit)
    return unit, factor * t.alone, factor * t.beside, factor * t.shared


def pose_sigmas(n: NavigationOutcome) -> tuple[FloatArray, FloatArray]:
    """Largest sigma of rotation (deg) and of translation (mm) of every pose."""
    return np.degrees(n.sigmas[:, :3].max(axis=1)), 1e3 * n.sigmas[:, 3:].max(axis=1)


def _navigation(n: NavigationOutcome) -> dict[str, object]:
    turn, shift = pose_sigmas(n)
    out: dict[str, Any] = {
        "station": n.station_id,
        "poses": len(n.precision),
        "undetermined": sum(bool(e.undetermined) for e in n.precision),
        "meet_requirement": int(np.sum(meets(n))),
        "beacons": len(n.beacons.beacon_ids),
        "sigma_rotation_deg": plain(turn),
        "sigma_translation_mm": plain(shift),
        "beacons_seen": [len(e.beacon_ids) for e in n.precision],
        "tolerances": {},
    }
    for t in n.tolerances:
        unit, alone, beside, shared = tolerance_values(t)
        key = t.source.replace(" ", "_")
        out["tolerances"][key] = {f"alone_{unit}": plain(alone), f"beside_{unit}": plain(beside),
                                  f"shared_{unit}": plain(shared)}  # fmt: skip
    if n.tolerances:
        out["simulated_over_predicted"] = plain(n.simulated)
    if n.placement is not None:
        p = n.placement
        out["placement"] = {
            "x_mm": (1e3 * n.places).tolist(), "measure": plain(p.measure), "exchanged": p.exchanged,
            "final": p.final, "criterion": n.plan.criterion,
        }  # fmt: skip
    return out


def meets(n: NavigationOutcome) -> FloatArray:
    """(q,) whether every component of a pose is as precise as required."""
    limit = np.array([n.plan.required_rotation] * 3 + [n.plan.required_translation] * 3)
    return np.asarray((n.sigmas <= limit).all(axis=1))


def plan_text(o: PlanningOutcome) -> str:
    """For the terminal, problems first."""
    e = o.expected
    name = o.title or str(o.folder)
    lines = [f"{name}: {e.n_observations} observations, {e.n_unknowns} unknowns, redundancy {e.redundancy}"]
    lines += [f"  ! {note}" for note in (*o.planned.notes, *e.warnings)]
    lines += ["", f"  {'group':<18}{'observations':>13}{'redundancy':>12}{'smallest':>10}{'median':>8}"]
    for group, (n, r, q) in group_redundancy(e).items():
        lines.append(f"  {group:<18}{n:>13}{r:>12.1f}{q[0]:>10.3f}{q[1]:>8.3f}")
    lines += ["", *_sigma_lines(o)]
    if o.weak:
        lines += ["", "  weak directions", *(f"    {w.text()}" for w in o.weak[:3])]
    if o.network is not None:
        w = o.network
        lines += ["", f"  network: {w['n_stations']} stations, {w['measured_pairs']} of {w['measurable_pairs']} pairs, "
                      f"{w['independent_conditions']} conditions, {w['conditions_per_pair']:.2f} per pair"]  # fmt: skip
    lines += _selection_lines(o) + _tolerance_lines(o) + _trial_lines(o) + _navigation_lines(o)
    return "\n".join(lines)


def _sigma_lines(o: PlanningOutcome) -> list[str]:
    out = ["  expected sigmas (a priori)"]
    lasting = [(name, sigmas) for name, sigmas in expected_sigmas(o) if len(name) < 3]
    for name, sigmas in lasting[: 4 * _MOST]:
        groups: dict[str, list[str]] = {}
        for c, sigma, unit in sigmas:
            groups.setdefault(unit, []).append(f"{c} {sigma:.3g}")
        words = "   ".join(" ".join(v) + f" {unit}".rstrip() for unit, v in groups.items())
        out.append(f"    {'.'.join(name):<28}{words}")
    if len(lasting) > 4 * _MOST:
        out.append(f"    and {len(lasting) - 4 * _MOST} more, see plan.html")
    return out


def _selection_lines(o: PlanningOutcome) -> list[str]:
    s = o.selection
    if s is None:
        return []
    out = ["", f"  what to add next ({s.criterion}-optimal), each beside those above it"]
    out += [f"    {'gain in':<34}{'ln det':>9}{'of all':>9}{'variance':>10}"]
    for g in s.steps:
        less = f"-{100 * g.mean_variance:.1f} %"
        out.append(f"    {g.kind + ' ' + g.name:<34}{g.ln_det:>9.3f}{g.ln_det_all:>9.3f}{less:>10}")
    gained = sorted(zip(s.wanted, s.sigmas, s.after, strict=True), key=lambda x: x[2] / x[1] if x[1] > 0 else 1.0)
    out += [f"    {c.text:<34}{_sigma_of(c, a)} -> {_sigma_of(c, b)}" for c, a, b in gained[:_MOST]]
    return out


def _tolerance_lines(o: PlanningOutcome) -> list[str]:
    if o.budget is None:
        return []
    out = ["", "  required precision"]
    for x in o.requirements:
        required, planned = (_sigma_of(x.component, sigma) for sigma in (x.required, x.planned))
        word = "met" if x.met else "NOT MET"
        out.append(f"    {x.component.text:<34}{required:>14} required{planned:>14} planned   {word}")
    out.append(f"    {'sigmas may be, times the planned':<34}{'alone':>9}{'together':>10}   limited by")
    for t in o.tolerances:
        out.append(f"    {t.group:<34}{_factor(t.alone):>9}{_factor(t.together):>10}   {t.limiting}")
    return out


def _factor(value: float) -> str:
    if np.isnan(value):
        return "never"
    return "any" if value > 1e6 else f"{value:.3g}"


def _trial_lines(o: PlanningOutcome) -> list[str]:
    t = o.trials
    if t is None:
        return []
    word = "agrees" if t.passed else "DOES NOT AGREE"
    return [
        "",
        f"  Monte Carlo: {len(t.errors)} simulated surveys adjusted, {len(t.failed)} failed; scatter {word} with the "
        "predicted covariance",
        f"    mean of d' inv(C) d {t.mean_square:.2f}, expected {t.dof} ({t.band[0]:.2f} to {t.band[1]:.2f} at 99 %)",
        f"    RMS error over sigma: {t.ratios.min():.3f} to {t.ratios.max():.3f}, median {np.median(t.ratios):.3f}",
    ]


def _navigation_lines(o: PlanningOutcome) -> list[str]:
    n = o.navigation
    if n is None:
        return []
    turn, shift = pose_sigmas(n)
    good = np.isfinite(turn) & np.isfinite(shift)
    head = f"  navigation of {n.station_id} from {len(n.beacons.beacon_ids)} beacons: {int(good.sum())} of {len(turn)}"
    out = ["", f"{head} poses determined, {int(meets(n).sum())} as precise as required"]
    if good.any():
        out.append(
            f"    largest sigma of a pose: median {np.median(turn[good]):.3f} deg {np.median(shift[good]):.2f} mm, "
            f"worst {turn[good].max():.3f} deg {shift[good].max():.2f} mm"
        )
    if n.placement is not None:
        out.append(f"    placed ({n.plan.criterion} pose, in required variances; {n.placement.exchanged} exchanged)")
        for i, x in enumerate(1e3 * n.places):
            out.append(f"      N{i + 1:<4}{x[0]:>9.1f}{x[1]:>9.1f}{x[2]:>9.1f} mm")
        out.append(f"      measure at the end {n.placement.final:.3g}")
    if n.tolerances:
        out.append(f"    {'tolerances':<22}{'alone':>10}{'beside':>10}{'shared':>10}")
        for t in n.tolerances:
            unit, *values = tolerance_values(t)
            cells = "".join(f"{'never' if np.isnan(v) else f'{v:.3g}':>10}" for v in values)
            out.append(f"    {t.source:<22}{cells} {unit}")
        low, high = n.simulated.min(), n.simulated.max()
        out.append(f"    simulated with the shared tolerances: RMS error {low:.3f} to {high:.3f} of its prediction")
    return out
